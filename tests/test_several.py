"""Several requirements in one: what is critical, how far from it, and with which probability."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import sbt
from sbt.campaigns.each import independence_words
from sbt.config.assemble import scenario_of
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.estimators.surrogate import fit_log_probability
from sbt.loop.several import independence
from sbt.loop.stages import Facts, sentences_of
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.joint import JointMetamodel, JointPrediction, joined_log_probability
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import JointWarp
from sbt.problem.combination import MARGIN, CombinedInterval, all_of, any_of, from_plain, to_plain
from sbt.problem.outcome import given
from sbt.problem.requirement import CriticalInterval, Requirement
from tests.measured_runs import Runs

NEAR, FAST, BOTH_ENDS = Requirement("near", high=1.0), Requirement("fast", low=5.0), Requirement("mid", -1.0, 2.0, name="middle")
NESTED = any_of(NEAR, all_of(FAST, BOTH_ENDS, name="inner"))


def test_the_margin_says_what_is_critical_whatever_its_scale():
    rng = np.random.default_rng(0)
    runs = Runs(near=rng.normal(1, 2, 500), fast=rng.normal(4, 3, 500), mid=rng.normal(0, 1e6, 500))
    expected = (runs.y("near") <= 1) | ((runs.y("fast") >= 5) & (runs.y("mid") >= -1) & (runs.y("mid") <= 2))
    np.testing.assert_array_equal(NESTED.critical_runs(runs), expected)
    np.testing.assert_array_equal(NESTED.margins(runs) <= 0, expected)
    one = {name: float(runs.y(name)[7]) for name in runs.metrics}
    assert NESTED.is_critical(one) == expected[7] == (NESTED.told_of(one) <= 0)
    assert set(NESTED.violated(one)) <= {"near", "fast", "middle"}


def test_a_later_run_does_not_move_the_margins_of_earlier_ones():
    rng = np.random.default_rng(1)
    y = np.column_stack([rng.normal(1, 2, 400), 1e4 * rng.normal(4, 3, 400)])
    critical = any_of(NEAR, FAST).critical
    np.testing.assert_array_equal(critical.margin(y)[:100], critical.margin(y[:100]))


@pytest.mark.parametrize(("how", "near", "fast", "critical", "known"), [
    ("any", 0.0, np.nan, True, True), ("any", 2.0, np.nan, False, False),
    ("all", 0.0, np.nan, False, False), ("all", 2.0, np.nan, False, True),
])  # fmt: skip
def test_an_unknown_metric_leaves_unknown_only_what_it_decides(how, near, fast, critical, known):
    runs, need = Runs(near=[near], fast=[fast]), (any_of if how == "any" else all_of)(NEAR, FAST)
    assert need.critical_runs(runs)[0] == critical
    assert np.isfinite(need.margins(runs)[0]) == known


def test_plain_data_gives_the_same_requirement_back():
    assert from_plain(to_plain(NESTED)) == NESTED
    assert from_plain(to_plain(BOTH_ENDS)) == BOTH_ENDS


def test_names_and_metrics_must_differ():
    with pytest.raises(InputError, match="different metrics, but got 'near' twice"):
        any_of(NEAR, Requirement("near", low=5.0, name="far"))
    with pytest.raises(InputError, match="different names, but got 'near' twice"):
        any_of(NEAR, Requirement("other", low=5.0, name="near"))
    with pytest.raises(InputError, match="at least one"):
        any_of()


def _joint(n: int = 6) -> tuple[JointPrediction, CombinedInterval]:
    rng = np.random.default_rng(3)
    parts = [Prediction.gaussian(rng.normal(m, 1, n), rng.uniform(0.3, 2, n)) for m in (1.5, 4.0, 0.5)]
    critical = NESTED.critical.with_leaves(NESTED.critical.leaves, (1.0, 2.0, 0.5))
    return JointPrediction.of(parts, critical), critical


@pytest.mark.parametrize(("sign", "above", "often"), [(1, False, "likelier"), (-1, False, "less likely"), (-1, True, "likelier")])
def test_what_metrics_share_beside_the_inputs_is_said_with_its_direction(sign, above, often):
    noise = np.random.default_rng(0).standard_normal(60)
    second = Requirement("b", low=0.0) if above else Requirement("b", high=0.0)
    parts = tuple(Prediction.gaussian(np.zeros(60), np.ones(60)) for _ in range(2))
    joint = JointPrediction.of(parts, all_of(Requirement("a", high=0.0), second).critical)
    found = independence((Requirement("a", high=0.0), second), joint, np.column_stack([noise, sign * noise]))
    assert f"both at once are {often} than it states" in independence_words(found)[0]


@pytest.mark.parametrize(("metrics", "runs"), [(2, 9), (3, 9), (4, 9), (4, 60)])
def test_chance_rarely_makes_metrics_look_dependent(metrics, runs):
    """It did in 16 % of campaigns with three independent metrics and 31 % of those with four; fewer than 30 runs are not sure."""
    parts = tuple(Requirement(name, high=0.0) for name in "abcd"[:metrics])
    plain = [Prediction.gaussian(np.zeros(runs), np.ones(runs)) for _ in parts]
    joint, rng, alarms = JointPrediction.of(plain, all_of(*parts).critical), np.random.default_rng(5), []
    for _ in range(300):
        [said] = independence_words(independence(parts, joint, rng.standard_normal((runs, metrics))))
        alarms.append("no sign that" not in said)
        assert not alarms[-1] or ("and may be off" in said) == (runs < 30)
    assert np.mean(alarms) < 0.09
    shared = rng.standard_normal((runs, 1)) + 0.1 * rng.standard_normal((runs, metrics))
    assert "no sign that" not in independence_words(independence(parts, joint, shared))[0]


def test_equal_residuals_of_metrics_at_their_caps_make_no_dependence():
    """By the order of rows two independent metrics, nine tenths of them at the cap, had a rank correlation of .7."""
    parts, n, rng = tuple(Requirement(name, high=0.0) for name in "ab"), 60, np.random.default_rng(2)
    plain = [Prediction.gaussian(np.zeros(n), np.ones(n)) for _ in parts]
    joint, alarms = JointPrediction.of(plain, all_of(*parts).critical), []
    for _ in range(200):
        residuals = np.where(rng.random((n, 2)) < 0.9, 0.0, rng.standard_normal((n, 2)))
        alarms += ["no sign that" not in said for said in independence_words(independence(parts, joint, residuals))]
    assert len(alarms) > 150
    assert np.mean(alarms) < 0.09
    assert independence(parts, joint, np.zeros((n, 2))) is None


def test_a_prediction_of_the_margin_is_that_of_independent_metrics():
    prediction, critical = _joint()
    rng = np.random.default_rng(4)
    draws = np.stack([p.mu + p.sigma * rng.standard_normal((200_000, len(p))) for p in prediction.parts], axis=-1)
    margin = critical.margin(draws)
    np.testing.assert_allclose(prediction.probability(MARGIN), (margin <= 0).mean(axis=0), atol=5e-3)
    middle = CriticalInterval(-0.4, 0.3)
    np.testing.assert_allclose(prediction.probability(middle), ((margin >= -0.4) & (margin <= 0.3)).mean(axis=0), atol=5e-3)
    scaled = any_of(NEAR, FAST).critical.with_leaves((NEAR.critical, FAST.critical), (1, 2))
    two = JointPrediction.of(prediction.parts[:2], scaled)
    drawn = np.minimum(draws[..., 0] - 1.0, (5.0 - draws[..., 1]) / 2.0)
    np.testing.assert_allclose(two.mu, drawn.mean(axis=0), atol=1e-2)
    np.testing.assert_allclose(two.sigma, drawn.std(axis=0), atol=1e-2)


def test_probabilities_of_combinations_are_exact_in_the_tails():
    log_p = np.array([-800.0, -1e-300])
    pair = (log_p, np.log(-np.expm1(log_p)))
    either = any_of(NEAR, FAST).critical
    low, high = joined_log_probability(either, [pair, pair]), joined_log_probability(all_of(NEAR, FAST).critical, [pair, pair])
    np.testing.assert_allclose(low[0][0], -800.0 + np.log(2.0), rtol=1e-12)
    np.testing.assert_allclose(high[0][0], -1600.0, rtol=1e-12)
    np.testing.assert_allclose(high[1][1], pair[1][1] + np.log(2.0), rtol=1e-12)


def test_each_metric_has_a_metamodel_of_its_own():
    rng = np.random.default_rng(5)
    u = rng.random((60, 2))
    y = np.column_stack([3.0 * u[:, 0], 10.0 * u[:, 1]])
    y[5, 1] = np.nan
    critical = any_of(NEAR, FAST).critical
    predictor = JointMetamodel(GaussianProcess(), critical).fit(u, y, np.random.default_rng(0))
    at = rng.random((200, 2))
    truth = (3.0 * at[:, 0] <= 1.0) | (10.0 * at[:, 1] >= 5.0)
    assert ((predictor(at).probability(MARGIN) > 0.5) == truth).mean() > 0.97
    paths = predictor.sample_paths(at, 3, np.random.default_rng(1))
    assert ((paths <= 0) == truth).mean() > 0.97
    warp = JointWarp.around_edges(y, critical)
    np.testing.assert_array_equal(warp.values(y[:5]) <= 0, critical.contains(y[:5]))


BAD = {
    "any: [{metric: ttc_mn, critical: [0, 1]}]": r"any.0.metric: a metric must be one of .*did you mean 'ttc_min'",
    "any: []": "any must list at least one requirement",
    "{any: [{metric: ttc_min}], all: [{metric: ttc_min}]}": "one of metric, stl, any and all, but got any and all",
    "any: [{metric: ttc_min}, {metric: d_min, critical: [0, 1], name: ttc_min}]": "different names, but got 'ttc_min' twice",
    "any: [{metric: ttc_min}, {metric: ttc_min, critical: [0, 1]}]": "different metrics, but got 'ttc_min' twice",
    "any: [{metric: ttc_min, critical: [2, 1]}]": r"any.0.critical: a critical interval needs low <= high",
    "all: [{metric: d_min}]": r"all.0: critical: \[low, high\] is required",
    "{any: [{metric: ttc_min}], critical: [0, 1]}": "critical belongs to each requirement of any",
}


@pytest.mark.parametrize("keys", BAD)
def test_bad_combinations_are_refused_where_they_stand(keys):
    text = f"campaign: boundary\nscenario: cut_in\nrequirement: {keys if keys[0] == '{' else '{' + keys + '}'}\n"
    with pytest.raises(InputError, match=BAD[keys]) as error:
        scenario_of(parse(text))
    assert "<text>:3:" in str(error.value)


def test_formulas_and_metrics_combine():
    need = scenario_of(parse(
        "campaign: boundary\nscenario: cut_in\n"
        "requirement: {any: [{metric: ttc_min}, {stl: 'G(gap > 2)', name: gap}, {all: [{stl: 'G(ttc > 1)'}, "
        "{metric: d_min, critical: [-.inf, 3]}]}]}\n"
    )).requirement  # fmt: skip
    assert [part.metric for part in need.parts] == ["ttc_min", "gap", "stl", "d_min"]
    assert need.metric == "any(ttc_min, gap, all(stl, d_min))"


EITHER = any_of(Requirement("left", high=-1.8), Requirement("right", low=2.2, name="high"))


def _campaign(tmp_path, kind: str, budget: int, need: Requirement = EITHER, name: str = "store", **keys) -> sbt.Result:
    scenario = sbt.Scenario(
        "two", [sbt.Parameter(n, -5.0, 5.0, "", sbt.Normal(0.0, 1.0)) for n in "ab"], need, metrics=["left", "right"],
        evaluate=lambda values, seed: {"left": values["a"] + 0.1 * values["b"], "right": values["b"] - 0.2 * values["a"]},
    )  # fmt: skip
    return sbt.run(
        campaign=kind, scenario=scenario, budget=budget, store=tmp_path / name, executor="serial", report=kind == "falsification",
        **keys,
    )  # fmt: skip


def test_a_falsification_finds_both_and_says_which(tmp_path):
    result = _campaign(tmp_path, "falsification", 40)
    found = result.conclusion
    assert {name for mode in found.failure_modes for name in mode.violates} == {"left", "high"}
    frame, history = result.frame, result.history
    names = {"left": history.y("left") <= -1.8, "high": history.y("right") >= 2.2}
    written = [{name for name, mask in names.items() if mask[k]} for k in range(len(history))]
    assert [set(filter(None, text.split("; "))) for text in frame["violates"]] == written
    np.testing.assert_array_equal(frame["margin"] <= 0, frame["critical"])
    assert sum(found.violates.values()) >= found.critical_runs
    page = (tmp_path / "store" / "report.html").read_text()
    assert "left ≤ -1.8 or right ≥ 2.2" in page
    assert ">violates</th>" in page
    result.plot.runs()


@pytest.mark.slow
def test_boundary_and_coverage_tell_the_share_of_each(tmp_path):
    _campaign(tmp_path, "boundary", 20, initial=10, batch=10)
    result = _campaign(tmp_path, "boundary", 40, initial=10, batch=10)
    whole = _campaign(tmp_path, "boundary", 40, name="whole", initial=10, batch=10)
    np.testing.assert_array_equal(result.history.x, whole.history.x)  # resumed: as if never interrupted
    np.testing.assert_array_equal(result.frame["margin"], whole.frame["margin"])
    shares = {one.name: one.critical_fraction for one in result.conclusion.requirements}
    assert shares == pytest.approx({"left": 0.32, "high": 0.28}, abs=0.02)
    assert result.conclusion.critical_fraction == pytest.approx(0.32 + 0.28 - 0.11, abs=0.03)
    assert set(result.conclusion.held_out_fractions) == {"left", "high"}
    found = result.predict({"a": [-3.0, 0.0], "b": 0.0})
    np.testing.assert_allclose(found["p_critical.left"], [1.0, 0.0], atol=1e-3)
    np.testing.assert_array_equal(result.predict({"a": [-3.0, 0.0], "b": 0.0}), found)  # from the file beside the store
    even = _campaign(tmp_path, "coverage", 64, name="even").conclusion
    assert even.requirements["left"].critical_fraction == pytest.approx(0.32, abs=0.05)


@pytest.mark.parametrize("how", [pytest.param("auto", marks=pytest.mark.slow), "monte_carlo"])
def test_an_estimation_tells_the_probability_of_each_from_the_same_draws(tmp_path, how):
    sides = np.array([-1.8 / np.sqrt(1.01), -2.2 / np.sqrt(1.04)])  # of -(a + b / 10) and b - a / 5, correlated by .1
    truth = dict(zip(("left", "high"), norm.cdf(sides), strict=True))
    rho = 0.1 / np.sqrt(1.01 * 1.04)
    union = truth["left"] + truth["high"] - multivariate_normal.cdf(sides, cov=[[1.0, rho], [rho, 1.0]])
    budget = 90 if how == "auto" else 2000
    found = _campaign(tmp_path, "estimation", budget, acquisition=how, stop={"cov": None}).conclusion
    assert found.low < union < found.high
    assert [one.name for one in found.requirements] == ["left", "high"]
    for one in found.requirements:
        assert one.low < truth[one.name] < one.high
        assert one.probability <= found.probability * 1.05
    if how == "auto":
        assert found.probability == pytest.approx(union, rel=0.1)


def test_the_noise_of_a_margin_is_what_is_left_where_the_metrics_are_known():
    """Of the larger, or smaller, of two noisy margins; none where no metric is noisy."""
    rng, mean, noise = np.random.default_rng(5), np.array([[0.2, 1.0], [0.4, -0.5]]), np.array([[0.3, 0.1], [0.2, 0.6]])
    leaves = (Requirement("a", high=0.0), Requirement("b", high=0.0))
    drawn = mean[:, :, None] + noise[:, :, None] * rng.standard_normal((2, 2, 200_000))
    for how, of in ((any_of, np.min), (all_of, np.max)):
        critical = how(*leaves).critical
        parts = [Prediction.gaussian(mean[k], 2.0 * noise[k], noise[k]) for k in range(2)]
        found = JointPrediction.of(parts, critical)
        assert found.noise == pytest.approx(of(drawn, axis=0).std(axis=1), rel=0.02)
        assert (found.epistemic > 0.0).all()
        sure = JointPrediction.of([Prediction.gaussian(mean[k], 2.0 * noise[k]) for k in range(2)], critical)
        assert (sure.noise == 0.0).all()


def test_the_noise_of_repeats_is_that_of_each_metric():
    """An estimation whose metamodels learn no noise from the runs: what repeats tell is left to each metric alone."""
    z = np.linspace(-2.0, 2.0, 15)[:, None]
    y, critical = np.column_stack([z[:, 0], 3.0 * z[:, 0]]), any_of(Requirement("a", low=1.0), Requirement("b", low=3.0)).critical

    def parts(noise):
        process, rng = GaussianProcess(nu=2.5, input_noise=False), np.random.default_rng(0)
        fitted = fit_log_probability(process, lambda at: 0.5 + at / 10.0, critical, z, y, rng, noise)
        return [float(np.exp(part(np.array([[0.5]]))[0][0])) for part in fitted.parts]

    plain, of_the_first = parts(()), parts((0.25, 0.0))
    assert plain[0] < 1e-3
    assert of_the_first[0] > 0.05  # (1 - 0.5) / 0.5: one standard deviation from critical
    assert of_the_first[1] == plain[1]


def test_what_is_predicted_of_a_margin_has_the_units_of_the_runs(tmp_path, monkeypatch):
    """Held-out and failed runs teach nothing, but margins of runs are told in the unit that is usual among all of them."""
    kept = {}
    monkeypatch.setattr("sbt.report.explorer.slices_through", lambda *given: kept.update(predict=given[0], need=given[1]))
    scenario = sbt.Scenario(
        "two", [sbt.Parameter(n, 0.0, 1.0) for n in "ab"], any_of(Requirement("left", high=0.0), Requirement("right", high=0.0)),
        metrics=["left", "right"], evaluate=lambda values, seed: {"left": values["a"] - 0.2, "right": values["b"] - 0.1},
    )  # fmt: skip
    keys = {"campaign": "boundary", "budget": 40, "seed": 1, "executor": "serial", "validation": {"share": 0.3}}
    result = sbt.run(scenario=scenario, store=tmp_path / "store", report=True, **keys)
    u, margin = result.history.x, result.frame["margin"]  # the space is the unit cube
    teaching = result.scenario.requirement.critical.usual(result.scenario.requirement.values(result.history.training))
    assert kept["need"].scale != teaching
    for predicted in (kept["predict"](u), result.fitted.predict(u)):
        np.testing.assert_allclose(predicted.mu, margin, atol=0.05)
    np.testing.assert_allclose(result.predict(u)["mean"], margin, atol=0.05)


@pytest.mark.parametrize("campaign", ["falsification", "boundary"])
def test_a_failed_run_that_is_critical_by_what_it_gave_is_told(tmp_path: Path, campaign: str):
    """Nothing told of it: "not falsified", and "17 runs failed and say nothing about safety"."""

    def simulate(values: dict[str, float], seed: int) -> dict[str, float]:
        hit = values["a"] > 0.8
        return {"hit": float(hit), "late": math.nan if hit else 5.0 - values["a"]}

    either = sbt.any_of(sbt.Requirement("hit", low=0.5), sbt.Requirement("late", high=0.0))
    scenario = sbt.Scenario("s", [sbt.Parameter("a", 0.0, 1.0)], either, evaluate=simulate, metrics=["hit", "late"])
    found = sbt.run(campaign=campaign, scenario=scenario, budget=20, store=tmp_path / "s", executor="serial", report=False)
    failed = found.frame[found.frame["status"] == "failed"]
    assert given(failed["reason"].iloc[0]) == {"hit": 1.0}
    told = f"{len(failed)} of the runs that failed (such as run {failed['index'].iloc[0]}) are critical by what they gave"
    assert any(sentence.startswith(told) for sentence in found.sentences())
    assert not critical_by_what_they_gave(found, "late")
    assert critical_by_what_they_gave(found, "hit")
    assert [given(f"no; the run gave {text}") for text in ("much", "[1]", '{"a": "x"}')] == [{}, {}, {}]


def critical_by_what_they_gave(found: sbt.Result, metric: str) -> bool:
    """Return whether a conclusion says so of a requirement on one of its metrics alone."""
    need = next(part for part in found.scenario.requirement.parts if part.metric == metric)
    facts = replace(Facts.of(found.history, found.scenario), requirement=need)
    return any("are critical by what they gave" in sentence for sentence in sentences_of(found.conclusion, facts))
