"""An estimation asked again: right under other distributions and requirements, refused where its runs cannot tell."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest, norm
from typer.testing import CliRunner

import sbt
from sbt.campaigns.again import Reused, SeenAgain
from sbt.campaigns.asking import answer
from sbt.cli import app
from sbt.estimators.reweighting import ReusedBatch, WeightedShare, defended_bound, few_hits_bound
from sbt.problem.sensitivity import space_parameters

ROOT2 = np.sqrt(2.0)


def linear(mean: float = 0.0, std: float = 1.0, beta: float = 3.5) -> float:
    """Return P(x1 + x2 >= beta sqrt(2)), x1 normal with these, x2 standard normal."""
    return float(norm.sf((beta - mean / ROOT2) / np.sqrt((1.0 + std**2) / 2.0)))


@pytest.fixture(scope="module")
def estimated(tmp_path_factory: pytest.TempPathFactory) -> sbt.Result:
    folder = tmp_path_factory.mktemp("again") / "store"
    keys: dict[str, Any] = {"budget": 140, "initial": 14, "batch": 14, "stop": {"cov": None}, "executor": "serial"}
    return sbt.run(campaign="estimation", scenario="testbed:linear_d2", seed=2, store=folder, report=False, **keys)


@pytest.fixture(scope="module")
def crude(tmp_path_factory: pytest.TempPathFactory) -> sbt.Result:
    """Draws from the distribution itself: P(0.2 x + kind > 1.2), kind 0.3 or 1."""
    scenario = sbt.Scenario(
        "crude",
        inputs=[sbt.Parameter("x", -4, 4, "", sbt.Normal(0.0, 1.0)), sbt.Parameter("kind", choices={"car": 0.7, "truck": 0.3})],
        evaluate=lambda values, seed: {"y": 0.2 * values["x"] + (1.0 if values["kind"] == "truck" else 0.3)},
        requirement=sbt.Requirement("y", low=1.2),
    )
    folder = tmp_path_factory.mktemp("crude") / "store"
    return sbt.run(
        campaign="estimation", scenario=scenario, acquisition="monte_carlo", budget=4000, stop={"cov": None}, store=folder,
        executor="serial", report=False,
    )  # fmt: skip


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.7, 1.0), (0.0, 1.4), (-0.3, 0.9)])
def test_other_distributions(estimated, mean, std):
    found = estimated.estimate({"x1": sbt.Normal(mean, std)})
    assert found.low <= linear(mean, std) <= found.high
    assert found.probability == pytest.approx(linear(mean, std), rel=0.15)


def test_few_known_critical_runs_leave_the_bound_of_random_draws(estimated):
    """What the campaign itself says where critical runs are known at fewer than ten inputs."""
    history = estimated.history
    y = np.sort(history.y(history.metrics[0])[history.ok])
    found = estimated.estimate(critical=(-np.inf, 0.5 * (y[7] + y[8])))
    assert any("critical runs are known at" in said for said in found.warnings)
    assert 0.02 < found.high < 0.2


def test_another_threshold(estimated):
    found = estimated.estimate(critical=(-np.inf, 0.1))
    assert found.low <= linear(beta=3.4) <= found.high
    assert estimated.estimate(critical=(None, 0.1)) == found
    none = estimated.estimate(critical=(-90.0, -80.0))
    assert (none.probability, none.low, none.exact_bound) == (0.0, 0.0, none.exact_bound)
    assert none.exact_bound is not None


def test_sensitivities_are_derivatives(estimated):
    """Against the closed form: dP/dmean and dP/dstd of each input."""
    found = estimated.sensitivity().set_index(["input", "parameter"])
    step = 1e-4
    by_mean = (linear(step) - linear(-step)) / (2 * step)
    by_std = (linear(std=1 + step) - linear(std=1 - step)) / (2 * step)
    for name in ("x1", "x2"):
        for parameter, truth in (("mean", by_mean), ("std", by_std)):
            row = found.loc[(name, parameter)]
            assert abs(row["derivative"] - truth) <= 4 * row["std_error"] + 0.05 * truth
    assert found.loc[("x1", "std")]["elasticity"] == pytest.approx(by_std / linear(), rel=0.2)
    assert found.loc[("x1", "std")]["raised"] == pytest.approx(linear(std=1.1), rel=0.2)


@pytest.mark.slow
def test_the_correlation_of_truncated_inputs_is_raised_and_lowered(tmp_path):
    """Far points of a pool are rounded to the end of a range, where a ratio of densities told P = 1."""
    inputs = [sbt.Parameter("gap", 2, 40, "m", sbt.Normal(22, 6)), sbt.Parameter("v", 0, 20, "m/s", sbt.Normal(10, 4))]
    scenario = sbt.Scenario(
        "follow", inputs, sbt.Requirement("m", high=5.0), evaluate=lambda x, _: {"m": x["gap"] - 0.65 * x["v"]}, metrics=["m"]
    )
    found = sbt.run(
        campaign="estimation", scenario=scenario, correlation=[{"inputs": ["gap", "v"], "value": -0.6}], budget=120, seed=0,
        stop={"cov": None}, executor="serial", store=tmp_path / "store", report=False,
    )  # fmt: skip
    row = found.sensitivity().set_index("parameter").loc["correlation"]
    assert row["raised"] == pytest.approx(0.0847, rel=0.03)  # four million draws
    assert row["lowered"] == pytest.approx(0.0917, rel=0.03)
    assert found.estimate(critical=(-np.inf, 1e6)).probability == 1.0


@pytest.mark.slow
def test_one_requirement_of_a_combination_is_asked_for_by_its_name(tmp_path):
    inputs = [sbt.Parameter(name, -6, 6, "", sbt.Normal(0, 1)) for name in "xw"]
    required = sbt.any_of(sbt.Requirement("y", low=2.0, name="late"), sbt.Requirement("z", low=3.5))
    scenario = sbt.Scenario("two", inputs, required, evaluate=lambda v, _: {"y": v["x"], "z": v["x"] + v["w"]})
    found = sbt.run(
        campaign="estimation", scenario=scenario, budget=120, seed=0, stop={"cov": None}, executor="serial", report=False,
        store=tmp_path / "store",
    )  # fmt: skip
    assert found.estimate(metric="late").probability == pytest.approx(norm.sf(2.0), rel=0.05)
    assert found.estimate(metric="y") == found.estimate(metric="late")
    assert found.estimate(metric="late", critical=(2.5, np.inf)) == found.estimate(metric="y", critical=(2.5, np.inf))
    said = CliRunner().invoke(app, ["estimate-again", str(found.store), "--metric", "late", "--critical", "1e3,inf"])
    assert "among 120 runs" in " ".join(said.output.split())


def test_draws_from_the_distribution_itself(crude):
    found = crude.estimate({"x": sbt.Normal(0.5, 1.0), "kind": {"choices": {"car": 0.2, "truck": 0.8}}})
    truth = 0.8 * norm.sf(0.5) + 0.2 * norm.sf(4.0)  # x > 1 of a truck, x > 4.5 of a car
    assert found.low <= truth <= found.high
    shares = crude.sensitivity().set_index(["input", "parameter"])
    row = shares.loc[("kind", "truck")]
    assert row["derivative"] == pytest.approx(norm.sf(1.0), abs=4 * row["std_error"])
    row = shares.loc[("x", "mean")]
    assert row["derivative"] == pytest.approx(0.3 * norm.pdf(1.0), abs=4 * row["std_error"])


def test_draws_that_are_all_critical_bound_the_probability_from_below_alone(tmp_path):
    """Of 300 runs 11 lie in the range that is asked for, where every run is critical: .86 was stated, without a word."""
    scenario = sbt.Scenario(
        "late", [sbt.Parameter("a", 0.0, 12.0, "", sbt.Triangular(0.0, 3.0, 10.0))], sbt.Requirement("y", low=7.0),
        evaluate=lambda values, seed: {"y": values["a"]}, metrics=["y"],
    )  # fmt: skip
    result = sbt.run(
        campaign="estimation", scenario=scenario, acquisition="monte_carlo", budget=300, stop={"cov": None}, seed=5,
        store=tmp_path / "s", executor="serial", report=False,
    )  # fmt: skip
    found = result.estimate({"a": {"min": 8.0, "max": 9.0}})
    assert (found.probability, found.high) == (1.0, 1.0)
    assert 0.0 < found.low < 0.95
    assert "no counted draw was safe: only a lower bound is given" in found.warnings
    for asked in ({"max": 9.0}, {"min": 2.0}):  # others are safe, too
        assert not any("lower bound" in text for text in result.estimate({"a": asked}).warnings)
    with pytest.raises(sbt.InputError, match=r"within \[0, 10\], but is to be 10\.\d+ to 12, where there were no draws"):
        result.estimate({"a": sbt.Uniform()})


def test_failed_draws_are_safe_below_where_all_others_are_critical():
    """15 of 20 draws were critical, the others failed: at least .83 was stated for what may be .75."""
    inputs = [sbt.Parameter("a", 0.0, 1.0)]
    space = sbt.Scenario("s", inputs, sbt.Requirement("y", low=0.0), evaluate=lambda v, s: {"y": 0.0}).space
    x, critical = np.full((20, 1), 0.5), np.repeat([1.0, 0.0], [15, 5])
    safe, worst = (ReusedBatch(x, np.ones(20), np.zeros(20), hits) for hits in (critical, np.ones(20)))
    for crude in (False, True):
        seen = SeenAgain(15, 0, 20, 15, 5, 0, 15, nominal=np.ones(20), ratio=np.ones(9))
        found = answer(Reused(space, (safe,), (worst,), 5, np.ones(20), crude, np.full(20, -1), 3.0, seen))
        assert found.probability == 0.75
        assert binomtest(15, 20).proportion_ci().low == pytest.approx(found.low, rel=0.02)
        assert found.high == 1.0


def test_failed_draws_that_a_metamodel_chose_are_not_held_against_draws_that_it_did_not():
    """13 failed where it looked, and none of 20 draws from the distribution: at most 1 was stated for what may be .09."""
    inputs = [sbt.Parameter("a", 0.0, 1.0)]
    space = sbt.Scenario("s", inputs, sbt.Requirement("y", low=0.0), evaluate=lambda v, s: {"y": 0.0}).space
    x, weight, nominal = np.full((50, 1), 0.5), np.repeat([2.0, 0.3], [20, 30]), np.repeat([1.0, 0.0], [20, 30])
    safe, worst = (ReusedBatch(x, weight, np.zeros(50), np.repeat([0.0, failed], [37, 13])) for failed in (0.0, 1.0))
    for critical in (3, 0):
        seen = SeenAgain(critical, 47, 20, 0, 0, 0, 3, nominal=nominal, ratio=np.ones(9))
        found = answer(Reused(space, (safe,), (worst,), 13, nominal, False, np.full(50, -1), 3.0, seen))
        assert (found.probability, found.low) == (0.0, 0.0)
        assert found.failed_as_critical == pytest.approx(13 * 0.3 / 50)
        assert found.failed_as_critical < found.high < 0.25
        assert (found.exact_bound is None) == (critical > 0)


def test_what_the_runs_cannot_tell_is_refused(estimated, crude, tmp_path):
    with pytest.raises(sbt.InputError, match="effective sample size"):
        estimated.estimate({"x1": sbt.Normal(9.0, 0.2)})
    with pytest.raises(sbt.InputError, match="must stay where the campaign drew it"):
        crude.estimate({"x": {"max": 6.0}})
    with pytest.raises(sbt.InputError, match=r"an input must be one of x1, x2, but got 'x3'.*constant"):
        estimated.estimate({"x3": sbt.Normal(0, 1)})
    with pytest.raises(sbt.InputError, match=r"one that the runs measured \(y\)|must be one of y"):
        estimated.estimate(metric="ttc", critical=(0.0, 1.0))
    for wrong in (("low", 1.0), (0.0, 1.0, 2.0), 3.0):
        with pytest.raises(sbt.InputError, match=r"critical must be an interval \(low, high\)"):
            estimated.estimate(critical=wrong)
    other = sbt.run(
        campaign="falsification", scenario="testbed:linear_d2", budget=10, store=tmp_path / "f", executor="serial", report=False
    )
    with pytest.raises(sbt.InputError, match="known densities"):
        other.estimate()


def test_the_command(estimated, tmp_path):
    store, database = str(estimated.store), Path(estimated.store) / "campaign.sqlite"
    before = hashlib.sha256(database.read_bytes()).hexdigest()
    given = tmp_path / "other.yaml"
    given.write_text("inputs:\n  x1: {distribution: {kind: normal, mean: 0.7, std: 1}}\n")
    result = CliRunner().invoke(app, ["estimate-again", store, "--inputs", str(given), "--critical=-inf,0", "--json"])
    found = json.loads(result.stdout)
    assert found["low"] <= linear(0.7) <= found["high"]
    assert {"input", "elasticity", "raised"} <= set(found["sensitivity"][0])
    given.write_text("x1: {distribution: {kind: normal, mean: 0.7}}\n")
    result = CliRunner().invoke(app, ["estimate-again", store, "--inputs", str(given)])
    assert (result.exit_code, f"{given}:1:20: inputs.x1.distribution" in result.stderr) == (2, True)
    given.write_text("input: {x1: {distribution: {kind: normal, mean: 0.7, std: 1}}}\n")
    result = CliRunner().invoke(app, ["estimate-again", store, "--inputs", str(given)])
    assert (result.exit_code, f"{given}:1:1: input: unknown key (did you mean 'inputs'?)" in result.stderr) == (2, True)
    assert hashlib.sha256(database.read_bytes()).hexdigest() == before


@pytest.mark.parametrize(
    "given",
    [
        {"distribution": sbt.Normal(1.0, 0.5)}, {"distribution": sbt.LogNormal(1.0, 0.5)},
        {"distribution": sbt.Normal(2.0, 1.0), "kind": "integer"},
    ],
    ids=("normal", "lognormal", "integer"),
)  # fmt: skip
def test_scores_are_derivatives_of_expectations(given):
    """d E[x] / d parameter = E[x score] and E[score] = 0: truncated, correlated and constrained too."""
    a, b = sbt.Parameter("a", 0, 4, "", **given), sbt.Parameter("b", 0, 3, "", sbt.Normal(1.0, 1.0))
    space = sbt.ParameterSpace(
        (a, b), correlation=((1.0, 0.4), (0.4, 1.0)), constraints=(("a + b < 5", lambda v: v["a"] + v["b"] < 5),)
    )
    x = space.sample(50_000, np.random.default_rng(1))
    for each in space_parameters(space):
        score, step = each.score(x), 0.02 * each.scale
        assert abs(score.mean()) < 5 * score.std() / np.sqrt(len(x)) + 1e-3 * score.std()
        ratios = [each.ratio(x, each.value + side * step) for side in (1.0, -1.0)]
        assert all(r is not None for r in ratios)
        moved = [float((r * x[:, 0]).mean() / r.mean()) for r in ratios if r is not None]
        assert float(((x[:, 0] - x[:, 0].mean()) * score).mean()) == pytest.approx(
            (moved[0] - moved[1]) / (2 * step), rel=0.05, abs=1e-2
        )


def test_the_bound_is_that_of_the_campaign_under_its_own_distribution():
    nominal = np.full(50, 0.2)
    assert defended_bound(2, nominal, np.ones(100), 0.95) == pytest.approx(few_hits_bound(2, nominal, 0.95))
    assert defended_bound(2, nominal, np.full(100, 3.0), 0.95) == pytest.approx(min(3 * few_hits_bound(2, nominal, 0.95), 1.0))


def test_weighted_shares_cover():
    """Draws from N(0, 1), asked for N(1, 1): P(x > 1) = 0.5 with few draws, 400 times."""
    rng, covered = np.random.default_rng(3), 0
    for _ in range(400):
        x = rng.standard_normal(300)
        share = WeightedShare(norm.pdf(x, 1.0) / norm.pdf(x), (x > 1.0).astype(float))
        covered += share.lower(0.975) <= 0.5 <= share.upper(0.975)
    assert covered >= 376
    assert WeightedShare(np.full(100, 2.0), np.zeros(100)).upper(0.95) == pytest.approx(-2.0 * np.log(0.05) / 100)


def test_an_unchanged_question_to_random_draws_has_their_exact_interval(crude):
    assert (found := crude.estimate()).probability > 0.0
    told = crude.conclusion
    assert (found.probability, found.low, found.high) == pytest.approx((told.probability, told.low, told.high), rel=1e-9)


class Surprise:
    """Says of a run whether it is critical by its seed: the first one from `late` on that no metamodel would choose."""

    def __init__(self, late: int):
        self.late, self.runs, self.told = late, 0, False

    def __call__(self, values: dict[str, Any]) -> bool:
        self.runs += 1
        now = self.runs >= self.late and max(values["a"], values["c"]) < 1.0 and not self.told
        self.told |= now
        return now


@pytest.mark.parametrize("late", [pytest.param(150, marks=pytest.mark.slow), 186])
def test_asking_again_knows_what_the_metamodel_denied(tmp_path: Path, late: int):
    """One run of a smooth metric is critical by its seed, far from where others are: before, or after the last that counts."""
    surprise = Surprise(late)

    def evaluate(values: dict[str, Any], seed: int) -> dict[str, float]:
        return {"ttc": 0.0 if surprise(values) else 3.5 - values["a"]}

    inputs = [sbt.Parameter("a", -5, 5, "m", sbt.Normal(0, 1)), sbt.Parameter("c", 0, 1, "m")]
    scenario = sbt.Scenario("late", inputs, sbt.Requirement("ttc", high=0.5), evaluate=evaluate)
    result = sbt.run(
        campaign="estimation", scenario=scenario, budget=200, seed=1, gate={"probability": 0.003}, executor="serial",
        report=False, store=tmp_path / "store",
    )  # fmt: skip
    told, again = result.conclusion, result.estimate()
    denied = [text for text in told.warnings if "denied" in text]
    assert late == 150 or len(denied) == 2
    assert len([text for text in again.warnings if "denied" in text]) == len(denied)
    assert again.undetected_mass_bound == pytest.approx(told.undetected_mass_bound, rel=1e-6)
    assert again.high > 0.9 * told.high
    wider = result.estimate(critical=(-np.inf, 1.0))  # what is critical by it was not denied: it was not asked for
    assert wider.undetected_mass_bound == pytest.approx(told.undetected_mass_bound, rel=1e-6)


def test_each_requirement_knows_what_the_metamodel_denied(tmp_path: Path):
    surprise = Surprise(206)

    def evaluate(values: dict[str, Any], seed: int) -> dict[str, float]:
        return {"ttc": 0.0 if surprise(values) else 3.5 - values["a"], "gap": 3.3 - values["c"]}

    inputs = [sbt.Parameter("a", -5, 5, "m", sbt.Normal(0, 1)), sbt.Parameter("c", -5, 5, "m", sbt.Normal(0, 1))]
    need = sbt.any_of(sbt.Requirement("ttc", high=0.5), sbt.Requirement("gap", high=0.5))
    result = sbt.run(
        campaign="estimation", scenario=sbt.Scenario("late", inputs, need, evaluate=evaluate), budget=220, seed=1,
        gate={"probability": 0.006}, executor="serial", report=False, store=tmp_path / "store",
    )  # fmt: skip
    told = result.conclusion
    assert any("after the last one that counts" in text for text in told.warnings)
    ttc, gap = told.requirements
    assert ttc.high > 0.9 * told.high  # it was violated where that was denied
    assert gap.high < 0.01
    assert result.estimate(metric="ttc").high > 0.9 * told.high
    assert result.estimate(metric="gap").high < 0.01
