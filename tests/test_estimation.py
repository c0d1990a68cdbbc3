"""The estimation campaign: true statements in every case, the same on every way, nothing counted that was not drawn."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import chi2, norm
from studies import run_loaded, settings_of
from typer.testing import CliRunner

import sbt
from sbt.campaigns.counting import Seen, counted_batches, denied_by_draws, hardly_known
from sbt.campaigns.gate import Limits, gate_verdict
from sbt.campaigns.many_inputs import halves_that_count
from sbt.campaigns.settings import Gate
from sbt.cli import app
from sbt.config.load import ConfigError, load, parse
from sbt.errors import InputError
from sbt.estimators import binomial
from sbt.loop.stages import Log
from sbt.problem.distribution import Distribution
from sbt.store.database import Store
from sbt.store.history import History
from sbt.testbeds import analytic, truth

Run = Callable[..., dict[str, Any]]
NEAREST = {"kind": "analytic.py:Nearest"}
QUICK = {"campaign": "estimation", "metamodel": NEAREST, "budget": 60, "initial": 10, "batch": 10, "stop": {"cov": None}}
DISC = np.pi * 0.09


def on_testbed(name: str, folder: Path, **keys: Any) -> dict[str, Any]:
    given = {"campaign": "estimation", "scenario": f"testbed:{name}", "executor": {"kind": "serial"}, "store": str(folder / "s")}
    return run_loaded(parse(json.dumps({**given, **keys})), report=False)


def test_a_known_probability(tmp_path):
    p = truth("four_branch_7").probability
    found = on_testbed("four_branch_7", tmp_path, budget=120, stop={"cov": None})["conclusion"]
    assert found["probability"] == pytest.approx(p, rel=0.15)
    assert found["low"] <= p <= found["high"]
    assert found["hits"] >= 10
    assert found["undetected_mass_bound"] < 0.4  # 3 over the draws from the inputs' distribution, those that only teach too


@pytest.mark.slow
def test_large_batches_leave_some_to_learn_from(tmp_path):
    """A single batch counted, drawn by what a search had learned: errors of a sixth, and a fifth of the intervals missed."""
    p = float(ndtr(-2.0 - 0.3 * np.sin(5.0 * (np.arange(5000) + 0.5) / 5000)).mean())
    inputs = [sbt.Parameter("x", -5, 5, distribution=sbt.Normal(0, 1)), sbt.Parameter("y", 0, 1)]
    capped = sbt.Scenario(
        "capped", inputs, sbt.Requirement("m", high=0.0),
        evaluate=lambda v, seed: {"m": min(2.0 - v["x"] + 0.3 * math.sin(5.0 * v["y"]), 1.5)},
    )  # fmt: skip
    found = sbt.run(campaign="estimation", scenario=capped, budget=300, batch=150, stop={"cov": None}, seed=5, executor="serial",
                    report=False, store=tmp_path / "s")  # fmt: skip
    assert found.frame.groupby("iteration").size().max() <= 37
    assert found.conclusion.probability == pytest.approx(p, rel=0.03)
    assert found.conclusion.low <= p <= found.conclusion.high


@pytest.mark.slow
def test_intervals_cover_over_seeds(tmp_path):
    p, covered = truth("four_branch_7").probability, 0
    for seed in range(12):
        found = on_testbed("four_branch_7", tmp_path / str(seed), budget=124, seed=seed, stop={"cov": None})["conclusion"]
        covered += found["low"] <= p <= found["high"]
    assert covered >= 11


def test_it_stops_at_its_target(tmp_path):
    result = on_testbed("linear_d2", tmp_path, budget=300, batch=15, stop={"cov": 0.2})
    assert (result["stopped"], result["runs"] < 300) == ("cov", True)
    assert result["conclusion"]["cov"] <= 0.2


def test_interrupted_and_in_two_processes_it_is_the_same(campaign: Run, configured: Callable[..., Path], rows: Any):
    whole = campaign("whole", **QUICK)

    def interrupt(progress: Any) -> None:
        if progress.done == 47:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_loaded(load(configured("again", **QUICK)), progress=interrupt, report=False)
    again = campaign("again", **QUICK)
    two = campaign("two", **QUICK | {"executor": {"kind": "local", "workers": 2}})
    assert whole["conclusion"] == again["conclusion"] == two["conclusion"]
    assert rows(whole["store"]) == rows(again["store"]) == rows(two["store"])


def test_nothing_critical(campaign: Run):
    found = campaign(**QUICK, requirement={"critical": [-9.0, -8.0]})["conclusion"]
    assert (found["probability"], found["low"], found["hits"]) == (0.0, 0.0, 0)
    assert found["high"] > found["exact_bound"] > 0.0  # 97.5 % and 95 %
    assert found["exact_bound"] < 0.25  # 3 over half of about 30 draws
    assert any("no draw that counts was critical" in w for w in found["warnings"])
    assert found["failed_as_critical"] == 0.0
    assert not found.get("convergence")


def test_everything_critical(campaign: Run):
    found = campaign(**QUICK, requirement={"critical": [-9.0, 9.0]})["conclusion"]
    assert (found["probability"], found["high"]) == (1.0, 1.0)
    assert 0.7 < found["low"] < 1.0


@pytest.mark.slow
def test_half_of_the_space_fails(campaign: Run):
    result = campaign(scenario="SOME_FAIL", **QUICK | {"budget": 100})
    found = result["conclusion"]
    assert result["failed"] > 0
    assert found["failed_as_safe"] < found["failed_as_critical"]
    assert found["low"] < DISC < found["high"]  # the hidden part of the disc lies where runs fail
    assert found["high"] > 0.3  # all that fails may be critical
    assert "runs failed" in found["warnings"][0]


def test_a_budget_without_a_counted_draw_gives_no_number(campaign: Run):
    found = campaign(**QUICK | {"budget": 10})["conclusion"]
    assert (found["probability"], found["low"], found["high"]) == (None, 0.0, 1.0)
    assert "no draw counts" in found["warnings"][0]


def test_a_thin_region(campaign: Run):
    """The ring 0.3 < r < 0.305 of the square."""
    found = campaign(**QUICK | {"budget": 120, "requirement": {"critical": [0.0, 0.005]}})["conclusion"]
    assert found["low"] <= np.pi * (0.305**2 - 0.3**2) <= found["high"]


def test_separated_regions(campaign: Run):
    """The four corners of the square that are farther than 0.6 from its middle."""
    result = campaign(**QUICK | {"budget": 120, "requirement": {"critical": [0.3, 9.0]}})
    segment = 0.36 * np.arccos(0.5 / 0.6) - 0.5 * np.sqrt(0.36 - 0.25)  # of the circle beyond one side of the square
    p = 1.0 - (np.pi * 0.36 - 4.0 * segment)
    assert p == pytest.approx(0.0491, abs=1e-4)
    found = result["conclusion"]
    assert found["low"] <= p <= found["high"] < 0.2
    assert found["probability"] == pytest.approx(p, rel=0.5)
    with Store.read(Path(result["store"])) as store:
        history = store.history()
    corners = {(bool(a > 0.5), bool(b > 0.5)) for a, b in history.x[history.y("y") >= 0.3]}
    assert corners == {(i, j) for i in (False, True) for j in (False, True)}


def test_an_input_without_influence(campaign: Run, analytic: Path):
    with analytic.open("a") as file:
        file.write("\n\nIDLE = scenario(line)\n")  # a < 0.25 of the square, whatever b is
    metamodel = {"kind": "gp", "nu": 2.5, "input_noise": False}
    found = campaign(scenario="IDLE", **QUICK | {"metamodel": metamodel})["conclusion"]
    assert found["low"] <= 0.25 <= found["high"]
    assert found["probability"] == pytest.approx(0.25, abs=0.01)


def test_crude_monte_carlo(campaign: Run):
    crude = QUICK | {"acquisition": {"kind": "monte_carlo"}, "budget": 400, "batch": 200}
    found = campaign(**crude)["conclusion"]
    assert (found["low"] < DISC < found["high"], found["counted"]) == (True, 400)
    assert found["probability"] == found["hits"] / 400


def test_subset_simulation_with_repeats(tmp_path):
    """25 inputs; the truth is 2.5e-3, which 5 x 200 points a level meet about."""
    found = on_testbed("hartmann6_in_25", tmp_path, budget=2500, acquisition={"kind": "subset"})
    conclusion = found["conclusion"]
    assert found["stopped"] == "converged"
    assert conclusion["low"] <= truth("hartmann6_in_25").probability <= conclusion["high"] < 0.05


def test_many_inputs_are_estimated_where_they_matter(tmp_path):
    """Crude Monte Carlo would meet no critical run."""
    p = truth("linear_d30").probability
    found = on_testbed("linear_d30", tmp_path, budget=240, stop={"cov": None})["conclusion"]
    assert found["probability"] == pytest.approx(p, rel=0.1)
    assert found["low"] <= p <= found["high"]


def _of_twenty(p: float, *, flag: bool = False) -> sbt.Scenario:
    """Beyond a sphere in twenty normal inputs, with this probability: no few directions explain it."""
    edge = float(chi2(20).isf(p))

    def evaluate(values: dict[str, Any], seed: int) -> dict[str, float]:
        m = edge - sum(float(v) ** 2 for v in values.values())
        return {"m": (1.0 if m > 0 else -1.0) if flag else m}

    inputs = [sbt.Parameter(f"x{k}", -9, 9, "", sbt.Normal(0, 1)) for k in range(20)]
    return sbt.Scenario("sphere", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])


def _campaigns(scenario: sbt.Scenario, folder: Path, seeds: int | range, budget: int, **keys: Any) -> list[Any]:
    return [
        sbt.run(
            campaign="estimation", scenario=scenario, seed=seed, budget=budget, executor="serial", report=False,
            store=str(folder / f"{seed}"), **keys,
        ) for seed in (range(seeds) if isinstance(seeds, int) else seeds)
    ]  # fmt: skip


@pytest.mark.slow
def test_many_inputs_are_no_worse_than_crude_monte_carlo(tmp_path):
    """Subset simulation stated nothing in 14 of 50 such campaigns, had twice the error in the others, and stopped early."""
    p, budget = 0.02, 300
    found = _campaigns(_of_twenty(p), tmp_path, 10, budget)
    error = np.array([(r.conclusion.probability or 0.0) / p - 1.0 for r in found])
    assert np.sqrt(np.mean(error**2)) < 1.3 * math.sqrt((1.0 - p) / p / budget)
    assert sum(r.conclusion.low <= p <= r.conclusion.high for r in found) >= 9
    for r in found:
        assert (len(r.frame), r.conclusion.counted) == (budget, budget)  # the first draws count, too
        assert r.conclusion.hits == int(r.frame["critical"].sum())
        assert "This trusts no search" in r.sentences()[1]
        assert not any("chosen by results" in said for said in r.sentences())


def test_common_critical_runs_of_many_inputs_end_by_the_stop_rule(tmp_path):
    (found,) = _campaigns(_of_twenty(0.5), tmp_path, 1, 300)
    assert found.conclusion.cov <= 0.1
    assert found.conclusion.counted == len(found.frame) < 300


def test_a_flag_of_many_inputs_has_no_levels(tmp_path):
    """It would be crude Monte Carlo with a fifth of the runs."""
    (found,) = _campaigns(_of_twenty(0.0005, flag=True), tmp_path, 1, 2000)
    assert set(found.frame["stage"]) == {"random", "monte_carlo"}
    assert found.conclusion.counted == 2000


def test_rare_critical_runs_of_many_inputs_take_subset_simulation_and_the_whole_budget(tmp_path):
    """Crude Monte Carlo with as many runs would have an error of 1.6 P; subset simulation once ended with runs left."""
    p = 0.0002
    (found,) = _campaigns(_of_twenty(p), tmp_path, 1, 2000)
    counts = found.frame["stage"].value_counts()
    assert counts["subset"] > 500
    assert counts["random"] >= 333  # the trial, and what subset simulation left
    assert len(found.frame) == 2000
    assert 0.2 * p < found.conclusion.probability < 4.0 * p
    assert found.conclusion.low <= p <= found.conclusion.high < 0.01
    random = counts["random"] + counts["subset level 0"]
    assert found.conclusion.undetected_mass_bound == pytest.approx(1.0 - 0.05 ** (1.0 / random))


@pytest.mark.parametrize(
    ("hits", "says"), [((0, 0), (False, False)), ((1, 0), (False, True)), ((0, 2), (True, False)), ((1, 1), (True, True))]
)
def test_no_draw_decides_whether_it_counts_itself(hits, says):
    """A half of the first draws counts where the other half has critical runs."""
    margin = np.random.default_rng(0).random(332) + 0.1
    margin[: hits[0]] = margin[166 : 166 + hits[1]] = -1.0
    assert halves_that_count(margin, 2000) == says
    assert halves_that_count(margin, 1000) == (True, True)  # too few points a level for anything else


def test_subset_simulation_says_when_it_was_too_short(tmp_path):
    found = on_testbed("linear_d10", tmp_path, budget=100, acquisition={"kind": "subset"})["conclusion"]
    assert found["probability"] is None
    assert found["high"] > truth("linear_d10").probability
    assert "larger budget" in found["warnings"][0]


def test_of_one_repeat_that_met_something_the_spread_is_not_known(tmp_path):
    """Twenty points a level, of which two go on. Its upper end was at .0024, whatever the other four had not met."""
    (found,) = _campaigns(_of_twenty(0.001), tmp_path, range(14, 15), 400, acquisition={"kind": "subset"})
    assert found.conclusion.probability > 0.0
    assert found.conclusion.high == pytest.approx(1.0 - 0.025 ** (1.0 / 100))
    assert any("100 random draws set the upper end" in said for said in found.conclusion.warnings)


def test_it_refuses_runs_of_unknown_density(campaign: Run, configured: Callable[..., Path]):
    result = campaign(**QUICK)
    with Store.read(Path(result["store"])) as store:
        log = Log(store.history(), tuple(store.iterations()), ())
    loaded = load(configured(**QUICK))
    settings = settings_of(loaded)
    assert counted_batches(log, settings)
    blank = History(log.history.names, {**log.history.columns, "log_q": np.full(len(log.history), np.nan)})
    with pytest.raises(InputError, match="known proposal density"):
        counted_batches(replace(log, history=blank), settings)


def test_incomplete_batches_do_not_count(campaign: Run, configured: Callable[..., Path]):
    """Runs that crash end early: a batch with what came back would over-count them."""
    result = campaign(**QUICK)
    with Store.read(Path(result["store"])) as store:
        log = Log(store.history(), tuple(store.iterations()), ())
    loaded = load(configured(**QUICK))
    settings = settings_of(loaded)
    cut = replace(log, history=log.history.where(np.arange(len(log.history)) < len(log.history) - 3))
    assert len(counted_batches(cut, settings)) == len(counted_batches(log, settings)) - 1


def test_a_warm_start_teaches_and_is_not_counted(campaign: Run, configured: Callable[..., Path]):
    before = campaign("before", campaign="boundary", budget=40)
    result = campaign("after", **QUICK, warm_start={"store": before["store"]})
    assert result["runs"] == 60
    with Store.read(Path(result["store"])) as store:
        assert store.iterations()[0].proposal["method"] != "sobol"  # it has learned already
        assert all(r.stage != "boundary" for r in store.history().records)
    with pytest.raises(InputError, match="same scenario"):
        campaign("other", "LINE", **QUICK, warm_start={"store": before["store"]})
    with pytest.raises(ConfigError, match="warm_start: a campaign falsification does not take it"):
        load(configured("wrong", campaign="falsification", warm_start={"store": before["store"]}))


def test_the_gate_decides_by_one_sided_limits():
    limits = Limits(lambda c: 0.01 * (1 - c), lambda c: 0.01 * (1 + c))
    assert gate_verdict(limits, Gate(0.02)).verdict == "pass"
    assert gate_verdict(limits, Gate(0.0001)).verdict == "fail"
    assert gate_verdict(limits, Gate(0.01)).verdict == "undecided"


def test_limits_by_few_draws_are_no_wider_than_exact_ones_with_half_the_error():
    few, exact = Limits(lambda c: 0.01 * (1 - c), lambda c: 0.4 * c), Limits(lambda c: 0.02 * (1 - c), lambda c: 0.1 * c)
    found = few.within(exact, 0.05, 0.06)
    assert found.lower(0.9) == pytest.approx(0.001)  # its own: the other, with 0.95, is as near
    assert found.upper(0.9) == pytest.approx(0.095)
    for value in (0.0, 0.3):  # an end is never beyond the estimate
        held = few.within(exact, value, value)
        assert held.lower(0.9) <= max(value, few.lower(0.9))
        assert held.upper(0.9) >= min(value, few.upper(0.9))


def test_limits_of_an_estimate_that_random_draws_deny_end_at_it():
    """5 hits, one of which moves the estimate of .19 by 98 %, had the interval 0 to 1 beside 85 draws that met one."""
    seen, anything = Seen(6, 140, 85, 1, 0, 1, 6), Limits(lambda _: 0.0, lambda _: 1.0)
    for value in (0.01, 0.19):
        found = anything.within(seen.limits, value, value)
        assert 0.0 < found.lower(0.975) < 0.001
        assert found.upper(0.975) == pytest.approx(max(value, binomial.upper(1, 85, 0.9875)))
        assert hardly_known(value, 0.98 * value)
        assert bool(denied_by_draws(seen.limits, "85 draws", value, value, 0.975)) == (value == 0.19)
    assert not hardly_known(0.19, 0.05)
    assert hardly_known(0.97, 0.02)


def test_a_gate_does_not_pass_on_a_metamodel_that_was_refuted():
    limits = Limits(lambda _: 0.001, lambda _: 0.002)
    refuted = gate_verdict(limits, Gate(0.02), 0.12, 1)
    assert refuted.verdict == "undecided"
    assert "1 draw was critical where the metamodel denied it" in refuted.statement
    assert gate_verdict(limits, Gate(0.02), 0.01, 1).verdict == "pass", "few enough of them by these draws alone"
    unknown = gate_verdict(limits, Gate(0.02), 0.12, 0, 78.0)
    assert unknown.verdict == "undecided"
    assert "coefficient of variation of 78" in unknown.statement
    assert "failures that few seeds show" in gate_verdict(limits, Gate(0.02), 0.12, 0, 0.1).statement
    assert gate_verdict(Limits(lambda _: 0.03, lambda _: 0.05), Gate(0.02), 0.12, 1).verdict == "fail"


@pytest.mark.parametrize("allowed", [0.9999, 0.99951, 0.0123456, 1.5e-7])
@pytest.mark.parametrize(("low", "high"), [(0.5, 0.999999), (0.5, 1 + 1e-6), (1 + 1e-6, 1.00001)])
def test_a_gate_names_what_was_asked_and_ends_on_their_side_of_it(allowed, low, high):
    """'At least 0.963 and at most 1: whether it is within 1 is open' was said of 0.9999."""
    limits = Limits(lambda _: low * allowed, lambda _: high * allowed)
    statement = gate_verdict(limits, Gate(allowed, 0.9995)).statement
    assert f" {allowed!r}" in statement
    assert "with 0.9995 confidence" in statement
    for words, end in (("at least", low), ("at most", high)):
        told = [float(each.split()[0].rstrip(":,;")) for each in statement.split(f"{words} ")[1:]]
        assert all((each > allowed) == (end > 1) and each != allowed for each in told)


@pytest.mark.parametrize(("undetected", "told"), [(0.12, True), (0.01, False)])
def test_a_gate_that_passes_says_what_it_cannot_exclude(undetected, told):
    verdict = gate_verdict(Limits(lambda _: 0.001, lambda _: 0.002), Gate(0.02), undetected)
    assert verdict.verdict == "pass"
    assert ("could hold up to 0.12" in verdict.statement) == told


@pytest.mark.slow
def test_a_gate_goes_on_while_its_pass_would_trust_the_search(tmp_path):
    """The estimate is precise long before what no run has met is known to be less than what is allowed."""
    keys = {"campaign": "estimation", "scenario": "testbed:linear_d2", "budget": 240, "seed": 3, "executor": "serial"}
    without, gated = (
        sbt.run(**keys, store=tmp_path / name, report=False, **more)
        for name, more in (("without", {}), ("gated", {"gate": {"probability": 0.002}}))
    )
    assert len(without.history) < 220
    assert len(gated.history) == 240
    assert gated.conclusion.gate.verdict == "pass"
    assert gated.conclusion.gate.statement.startswith("if the search has met whatever is critical")
    assert gated.conclusion.undetected_mass_bound < 0.6 * without.conclusion.undetected_mass_bound
    assert (gated.frame["x.x1"][: len(without.history)] == without.frame["x.x1"]).all()


def test_a_failure_that_was_denied_after_the_last_count_is_in_the_interval(tmp_path):
    """A box of 1 % in which the metric jumps: the estimate knows nothing of it when random draws for the gate meet it."""

    def evaluate(values, seed):
        smooth = min(3.6 - values["a"] - 0.3 * values["b"], 5.0)
        return {"ttc": 0.0 if max(abs(values["x"] - 0.7), abs(values["y"] - 0.35)) < 0.05 else smooth}

    inputs = [sbt.Parameter(each, -5.0, 5.0, "", sbt.Normal(0, 1)) for each in "ab"]
    inputs += [sbt.Parameter(each, 0.0, 1.0) for each in "xy"]
    scenario = sbt.Scenario("box", inputs, sbt.Requirement("ttc", high=0.5), evaluate=evaluate, metrics=["ttc"])
    keys = {"budget": 230, "executor": "serial", "report": False, "gate": {"probability": 0.003}}
    for seed in (13, 4, 0, 1, 5, 6, 7):  # some meet it late
        found = sbt.run(campaign="estimation", scenario=scenario, seed=seed, store=tmp_path / str(seed), **keys).conclusion
        if any("after the last one that counts was critical" in said for said in found.warnings):
            break
    else:
        pytest.fail("no campaign met the box after its last count")
    assert found.gate.verdict == "undecided"
    assert found.low <= 0.01 + 0.99 * norm.sf(3.1 / np.sqrt(1.09)) <= found.high


@pytest.mark.parametrize(("probability", "code", "verdict"), [(0.9, 0, "pass"), (0.05, 3, "fail"), (0.28, 3, "undecided")])
def test_the_gate_is_an_exit_code_and_junit(configured: Callable[..., Path], tmp_path, probability, code, verdict):
    config = configured(**QUICK | {"acquisition": {"kind": "monte_carlo"}, "budget": 100, "gate": {"probability": probability}})
    done = CliRunner().invoke(app, ["run", str(config), "--json", "--junit", str(tmp_path / "j.xml")])
    assert done.exit_code == code
    assert json.loads(done.stdout.splitlines()[0])["conclusion"]["gate"]["verdict"] == verdict
    suite = ET.parse(tmp_path / "j.xml").getroot()
    assert (suite.get("failures"), suite.get("tests")) == (str(int(code == 3)), "2")


def test_heavy_noise_is_left_to_crude_monte_carlo(tmp_path):
    """P(critical) hardly depends on the inputs: a proposal gains nothing, and the runs that would learn it count instead."""
    inputs = {name: Distribution.of(kind="normal", mean=0.0, std=1.0) for name in ("a", "b")}
    noisy = analytic(lambda x: 3.0 - 0.5 * x[:, 0] - 0.3 * x[:, 1], inputs=inputs, critical=(-np.inf, 0.0), name="n", noise=1.3)
    found = sbt.run(
        campaign="estimation", scenario=noisy, budget=300, stop={"cov": None}, executor="serial", store=tmp_path / "s",
        report=False,
    ).summary["conclusion"]
    p = ndtr(-3.0 / math.sqrt(0.5**2 + 0.3**2 + 1.3**2))
    assert found["counted"] >= 0.85 * 300
    assert found["low"] <= p <= found["high"]
    assert found["probability"] == found["hits"] / found["counted"]
