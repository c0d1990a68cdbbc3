"""Laws of estimations that run every combination: exact without noise, stratified with it, whatever was asked."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import sbt
from sbt.campaigns.summing import Summed
from sbt.estimators.reweighting import WeightedShare
from sbt.problem.combination import any_of
from sbt.seeds import stream

KINDS = {"car": 0.7, "bus": 0.25, "tram": 0.05}
LANES = {1: 0.5, 2: 0.3, 3: 0.2}


def margin(values):
    return values["lane"] - 1.5 + (0.8 if values["kind"] == "car" else -0.7)


def campaign(tmp_path: Path, *, noise=0.0, fails=(), requirement=None, **keys):
    def evaluate(values, seed):
        y = margin(values) + noise * stream(seed, "noise").standard_normal()
        return {"m": math.nan if values["kind"] in fails else y, "lane": values["lane"]}

    inputs = [
        sbt.Parameter("kind", choices=KINDS), sbt.Parameter("side", choices=("left", "right")),
        sbt.Parameter("lane", 1, 3, kind="integer", distribution=sbt.Normal(1.0, 1.2)),
    ]  # fmt: skip
    scenario = sbt.Scenario(
        "few", inputs=inputs, evaluate=evaluate, requirement=requirement or sbt.Requirement("m", high=0.0),
        metrics=["m", "lane"],
    )  # fmt: skip
    keys = {"budget": 100, "seed": 3, "executor": "serial", "report": False} | keys
    return sbt.run(campaign="estimation", scenario=scenario, store=tmp_path / "s", **keys)


def lanes(mean=1.0):
    """Probabilities of the lanes: a normal distribution, truncated, rounded."""
    p = np.diff(norm.cdf([0.5, 1.5, 2.5, 3.5], mean, 1.2))
    return dict(zip((1, 2, 3), p / p.sum(), strict=True))


def truth(mean=1.0, allowed=lambda kind, lane: True):
    share = {(k, n): KINDS[k] * p for k in KINDS for n, p in lanes(mean).items() if allowed(k, n)}
    return sum(p for (k, n), p in share.items() if margin({"kind": k, "lane": n}) <= 0) / sum(share.values())


def test_every_combination_is_run_and_the_sum_is_exact(tmp_path):
    """The interval is as narrow as is asked, by what so many agreeing runs may have missed: no more runs are spent on that."""
    result = campaign(tmp_path)
    said, runs = result.conclusion, result.history
    assert result.summary["stopped"] == "all combinations"
    assert len(np.unique(runs.x, axis=0)) == said.combinations == 18
    assert 18 + 2 < len(runs) < 100
    assert said.probability == pytest.approx(truth(), rel=1e-9)
    assert said.low == pytest.approx(truth() - missed(result, critical=True), rel=1e-9)
    assert said.high == pytest.approx(truth() + missed(result, critical=False), rel=1e-9)
    assert 0.0 < said.cov < 0.1
    assert said.undetected_mass_bound == 0.0
    assert "exact if the simulator is deterministic" in result.sentences()[0]
    again = result.estimate({"lane": {"distribution": {"kind": "normal", "mean": 2.0, "std": 1.2}}})
    assert again.probability == pytest.approx(truth(2.0), rel=1e-9)
    assert again.low < again.probability < again.high < again.low + 0.3


def missed(result, *, critical):
    """The exact upper limit (97.5 %) of what combinations that always ended alike do otherwise."""
    runs = result.history.where(np.isin(result.history.stage, ("combination", "replicate")))
    x, at, times = np.unique(runs.x, axis=0, return_inverse=True, return_counts=True)
    space = result.scenario.space
    p = np.exp(sum(each.log_density(x[:, k]) for k, each in enumerate(space.parameters)))
    mine = np.zeros(len(x), dtype=bool)
    mine[at] = result.scenario.requirement.critical_runs(runs) == critical
    return min(-math.log(0.025) * max(p[mine] / times[mine]) / p.sum(), p[mine].sum() / p.sum())


@pytest.mark.slow
@pytest.mark.parametrize("event", ["few seeds", "few seeds fail"])
def test_what_few_seeds_decide_is_in_the_interval_of_a_sum(tmp_path, event):
    """Every combination has a value of its own, and 4 % of the seeds give another, or none: two repeats show no noise."""
    covered, share = 0, 0.04

    def evaluate(values, seed):
        rare = stream(seed, "event").random() < share
        y = 2.0 + values["lane"] + 0.3 * values["side"] - 6.0 * (values["side"] == 5)
        return {"m": (-1.0 if event == "few seeds" else math.nan) if rare else y}

    inputs = [sbt.Parameter("lane", 1, 3, kind="integer"), sbt.Parameter("side", 0, 5, kind="integer")]
    scenario = sbt.Scenario("rare", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])
    sure = 1 / 9  # of 18 combinations two are always critical
    for seed in range(20):
        keys = {"budget": 60, "seed": seed, "executor": "serial", "report": False, "store": tmp_path / str(seed)}
        said = sbt.run(campaign="estimation", scenario=scenario, **keys).conclusion
        either = sure + share * (1 - sure)
        safe, worst = either if event == "few seeds" else sure * (1 - share), either
        covered += said.low <= safe and worst <= said.high
    assert covered >= 18


def test_constraints_leave_combinations_of_exact_probability(tmp_path):
    said = campaign(tmp_path, constraints=["lane < 3"]).conclusion
    assert said.combinations == 12
    assert said.probability == pytest.approx(truth(allowed=lambda kind, lane: lane < 3), rel=1e-9)


def test_failed_combinations_widen_the_interval_by_their_probability(tmp_path):
    result = campaign(tmp_path, fails=("tram",))
    said = result.conclusion
    known = truth() - KINDS["tram"] * sum(p for n, p in lanes().items() if margin({"kind": "tram", "lane": n}) <= 0)
    assert (said.failed_as_safe, said.failed_as_critical) == pytest.approx((known, known + KINDS["tram"]), rel=1e-9)
    assert "exact" not in result.sentences()[0]  # what fails has no outcome, however often it is run
    assert known - 0.1 < said.low < known < known + KINDS["tram"] < said.high < known + KINDS["tram"] + 0.1


def test_each_requirement_is_summed(tmp_path):
    both = any_of(sbt.Requirement("m", high=0.0), sbt.Requirement("lane", low=3.0))
    said = campaign(tmp_path, requirement=both).conclusion
    assert [each.probability for each in said.requirements] == pytest.approx([truth(), lanes()[3]], rel=1e-9)
    assert all(each.low < each.probability < each.high for each in said.requirements)


def test_a_noisy_simulator_is_asked_again_in_proportion(tmp_path):
    result = campaign(tmp_path, noise=0.6, stop={"cov": None}, budget=150)
    said = result.conclusion
    expected = sum(KINDS[k] * p * norm.cdf(-margin({"kind": k, "lane": n}) / 0.6) for k in KINDS for n, p in lanes().items())
    assert result.summary["stopped"] == "budget"
    assert said.low < expected < said.high
    assert said.high - said.low < 0.25
    kinds = result.history.x[np.isin(result.history.stage, ("combination", "replicate")), 0]
    car, bus, tram = (int((kinds == k).sum()) for k in range(3))
    assert car > 2 * bus > 2 * tram


def test_a_budget_that_is_too_small_goes_on_with_draws_where_it_grows(tmp_path):
    first = campaign(tmp_path, budget=14, initial=14, batch=6)
    assert set(first.history.stage) == {"initial"}
    more = campaign(tmp_path, budget=20, initial=14, batch=6)
    assert "combination" not in more.history.stage
    assert len(more.history) > len(first.history)


def test_limits_of_noisy_sums_cover():
    """Strata of unequal probability, sizes in proportion, and rates between 0 and 1."""
    rng, p, n = stream(1, "strata"), np.array([0.5, 0.3, 0.15, 0.05]), np.array([20, 12, 6, 2])
    weight = np.repeat(p / n * n.sum(), n)
    for rate in ([0.1, 0.02, 0.3, 0.9], [0.9, 0.95, 1.0, 0.4]):
        rate, missed = np.array(rate), np.zeros(2)
        for _ in range(600):
            share = WeightedShare(weight, (rng.random(n.sum()) < np.repeat(rate, n)).astype(float))
            found = Summed(share, share, 0.0, 4, True)
            missed += found.lower(0.975) > p @ rate, found.upper(0.975) < p @ rate
        assert (missed / 600 < 0.035).all()


def test_a_sum_says_how_many_runs_make_it_precise_and_its_sensitivities_have_an_error(tmp_path):
    result = campaign(tmp_path, budget=24)
    (advice,) = (said for said in result.sentences() if said.startswith("Next:"))
    asked = int(re.search(r"budget: ([\d,]+)", advice)[1].replace(",", ""))
    enough = campaign(tmp_path / "enough", budget=2 * asked)
    assert 0.5 * asked < len(enough.history) < 1.5 * asked
    assert (result.sensitivity()["std_error"] > 0.0).all()


def crowded(tmp_path: Path, evaluate, *, budget=80, seed=0, requirement=None, **keys):
    """A campaign of 72 combinations of which one has seven tenths of the probability."""
    inputs = [
        sbt.Parameter("kind", choices={"car": 0.95, "truck": 0.03, "bike": 0.02}),
        sbt.Parameter("n", 0, 23, kind="integer", distribution=sbt.Normal(0.0, 0.6)),
    ]  # fmt: skip
    need = requirement or sbt.Requirement("m", high=0.0)
    scenario = sbt.Scenario("crowded", inputs, need, evaluate=evaluate, metrics=["m", "n"])
    keys = {"stop": {"cov": None}, "executor": "serial", "report": False} | keys
    return sbt.run(campaign="estimation", scenario=scenario, budget=budget, seed=seed, store=tmp_path / str(seed), **keys)


def chance(share, fails=0.0):
    def evaluate(values, seed):
        rng = stream(seed, "chance")
        return {"m": math.nan if rng.random() < fails else rng.random() - share(values), "n": values["n"]}

    return evaluate


@pytest.mark.slow
def test_a_noisy_sum_is_as_precise_as_random_draws_where_few_combinations_have_the_probability(tmp_path):
    """A run of each of 72 combinations left three of 80 to that of seven tenths: 2.8 times the error of random draws."""
    found = [crowded(tmp_path, chance(lambda _: 0.3), seed=seed) for seed in range(16)]
    error = [each.conclusion.probability - 0.3 for each in found]
    assert np.sqrt(np.mean(np.square(error))) < 1.4 * np.sqrt(0.3 * 0.7 / 80)
    assert sum(each.conclusion.low <= 0.3 <= each.conclusion.high for each in found) >= 15
    said, stages = found[0].conclusion, found[0].history.stage
    assert said.combinations == 72
    assert said.drawn_combinations == 72 - (stages == "combination").sum() > 60
    assert (stages == "rest").sum() >= 1
    assert said.undetected_mass_bound == 0.0
    first, second, third = found[0].sentences()[:3]
    assert f"{72 - said.drawn_combinations} of all 72 combinations of the inputs and, as the simulator is noisy, random" in first
    assert "none is unseen" not in second
    assert "runs all" not in third

    def kill(progress):
        if progress.done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        crowded(tmp_path / "killed", chance(lambda _: 0.3), progress=kill)
    again = crowded(tmp_path / "killed", chance(lambda _: 0.3))
    assert again.frame.drop(columns="seconds").equals(found[0].frame.drop(columns="seconds"))


@pytest.mark.slow
def test_what_random_draws_stand_for_is_unbiased_and_covered(tmp_path):
    """Some of what is mostly critical is not run for itself, and a tenth of the runs fails by chance: both readings count."""

    def share(values):
        return 0.9 if values["kind"] != "car" and values["n"] >= 1 else 0.05

    both = any_of(sbt.Requirement("m", high=0.0), sbt.Requirement("n", low=2.0))
    found = [crowded(tmp_path, chance(share, 0.1), seed=seed, budget=120, requirement=both) for seed in range(24)]
    p = {(k, n): q * w for k, q in (("car", 0.95), ("truck", 0.03), ("bike", 0.02)) for n, w in enumerate(_lanes())}
    one, other = (sum(w * s(*key) for key, w in p.items()) for s in (lambda k, n: share({"kind": k, "n": n}), lambda _, n: n > 1))
    either = sum(w * (1.0 if n > 1 else share({"kind": k, "n": n})) for (k, n), w in p.items())
    assert sum(f.conclusion.low <= 0.9 * either and 0.1 + 0.9 * either <= f.conclusion.high for f in found) >= 22
    mine = [f.conclusion.requirements[0].probability for f in found]
    assert abs(np.mean(mine) - 0.9 * one) < 3.0 * np.std(mine) / math.sqrt(len(mine))
    assert sum(f.conclusion.requirements[1].low <= 0.9 * other <= f.conclusion.requirements[1].high for f in found) >= 22
    again = [f.estimate({"n": {"distribution": {"kind": "normal", "mean": 0.0, "std": 0.9}}}) for f in found]
    p = {(k, n): q * w for k, q in (("car", 0.95), ("truck", 0.03), ("bike", 0.02)) for n, w in enumerate(_lanes(0.9))}
    either = sum(w * (1.0 if n > 1 else share({"kind": k, "n": n})) for (k, n), w in p.items())
    assert abs(np.mean([a.probability for a in again]) - 0.9 * either) < 3.0 * np.std([a.probability for a in again]) / 24**0.5
    assert sum(a.low <= 0.9 * either and 0.1 + 0.9 * either <= a.high for a in again) >= 22


def _lanes(std=0.6):
    p = np.diff(norm.cdf(np.arange(-0.5, 24.0), 0.0, std))
    return p / p.sum()


def test_sums_without_much_noise_run_every_combination_however_unlikely(tmp_path):
    def evaluate(values, seed):
        return {"m": 1.5 - values["n"] - (values["kind"] == "bike") + noise * stream(seed, "noise").random(), "n": values["n"]}

    p = {(k, n): q * w for k, q in (("car", 0.95), ("truck", 0.03), ("bike", 0.02)) for n, w in enumerate(_lanes())}
    truth = sum(w for (k, n), w in p.items() if 1.5 - n - (k == "bike") <= 0)
    for noise in (0.0, 0.01):
        result = crowded(tmp_path / str(noise), evaluate)
        assert result.conclusion.probability == pytest.approx(truth, rel=1e-9)
        assert len(np.unique(result.history.x, axis=0)) == result.conclusion.combinations == 72
        assert result.conclusion.drawn_combinations is None
