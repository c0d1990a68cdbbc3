"""What is predicted of a metric lies within its scale, whatever is learned in its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.ended import ended
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.joint import metamodel_for
from sbt.metamodels.persistence import load, save
from sbt.metamodels.prediction import Prediction, Scale
from sbt.metamodels.saturation import Opened
from sbt.metamodels.scores import scores
from sbt.metamodels.warp import Warp
from sbt.metamodels.warped_prediction import WarpedPrediction
from sbt.problem.combination import any_of
from sbt.problem.requirement import CriticalInterval, Requirement

DISC = CriticalInterval(low=2.0)


def speed(u):
    """A speed of impact: 0 where nothing touches."""
    return 15.0 * np.sqrt(np.maximum(0.25 - np.hypot(u[:, 0] - 0.6, u[:, 1] - 0.4), 0.0))


def learned(metamodel, y_of, critical, n=80):
    rng = np.random.default_rng(3)
    u, at = rng.random((n, 2)), rng.random((2000, 2))
    return Opened(metamodel, critical).fit(u, y_of(u), rng)(at), y_of(at)


@pytest.mark.parametrize(("lowest", "highest"), [(-0.5, np.inf), (-np.inf, 0.4), (-1.0, 2.0), (3.0, np.inf)])
def test_moments_are_those_of_values_that_are_cut_off(lowest: float, highest: float):
    rng, mean, std = np.random.default_rng(0), np.array([[0.0, 2.0], [-3.0, 1.0]]), np.array([[1.0, 0.5], [2.0, 3.0]])
    prediction = Prediction(mean, std, np.array([0.4, 0.6]), np.zeros(2), scale=Scale(lowest, highest))
    k = rng.choice(2, p=prediction.weight, size=400_000)
    y = np.clip(mean[k] + std[k] * rng.standard_normal((400_000, 2)), lowest, highest)
    told = ended(prediction)
    assert told.mu == pytest.approx(y.mean(axis=0), abs=0.01)
    assert told.sigma == pytest.approx(y.std(axis=0), abs=0.01)
    for q in (0.05, 0.5, 0.95):
        assert told.quantile(q) == pytest.approx(np.quantile(y, q, axis=0), abs=0.03)
    assert told.cdf(np.full(2, 0.2)) == pytest.approx((y <= 0.2).mean(axis=0), abs=0.005)
    assert told.take(np.array([1])).mu == pytest.approx(told.mu[1:])


KINDS = {"auto": Auto(), "gp": GaussianProcess(nu=2.5, input_noise=False), "et": ExtraTrees()}


def test_what_lies_far_below_in_another_unit_is_told_at_the_end():
    """Mean and standard deviation in the unit of the metric were -350 and 320: as a Gaussian a tenth of it lies above 0."""
    rng, warp = np.random.default_rng(0), Warp(5.0, 12.0)
    warped = Prediction(np.array([[-4.1, -0.3, 1.0]]), np.array([[0.9, 0.4, 0.1]]), np.ones(1), np.zeros(3))
    told = ended(replace(WarpedPrediction.of(warped, warp), scale=Scale(low=0.0)))
    y = np.maximum(warp.back(warped.mean[0] + warped.std[0] * rng.standard_normal((400_000, 3))), 0.0)
    assert told.mu == pytest.approx(y.mean(axis=0), rel=0.02, abs=0.01)
    assert told.sigma == pytest.approx(y.std(axis=0), rel=0.1, abs=0.05)


@pytest.mark.parametrize("metamodel", KINDS.values(), ids=KINDS)
def test_a_speed_of_impact_is_told_within_its_values(metamodel):
    """RMSE was 40 to 80 times the metric's: where it is 0, what is learned goes on far below."""
    prediction, y = learned(metamodel, speed, DISC)
    told, found = ended(prediction), scores(prediction, y, DISC)
    assert told.mu.min() >= 0.0
    assert told.quantile(0.05).min() >= 0.0
    assert found["rmse"] < 0.6 * y.std()
    assert found["rmse"] == pytest.approx(float(np.sqrt(np.mean((told.mu - y) ** 2))))
    assert found["coverage_95"] > 0.85
    assert (told.probability(DISC) == prediction.probability(DISC)).all()


@pytest.mark.parametrize("critical", [CriticalInterval(low=1.0), CriticalInterval(low=0.5), CriticalInterval(1.0, 1.0)])
def test_a_flag_is_told_by_how_likely_it_is(critical: CriticalInterval):
    """The mean was .45 at flags that are 0."""
    prediction, y = learned(Auto(), lambda u: (speed(u) > 0.0).astype(float), critical)
    told, p = ended(prediction), prediction.probability(critical)
    assert told.mu == pytest.approx(p)
    assert told.sigma == pytest.approx(np.sqrt(p * (1.0 - p)), abs=1e-6)
    assert set(told.quantile(0.05)) <= {0.0, 1.0}
    found = scores(prediction, y, critical)
    assert found["log_likelihood_mixture"] == pytest.approx(float(np.log(np.where(y == 1.0, p, 1.0 - p)).mean()), abs=1e-6)
    assert found["coverage_95"] > 0.9
    assert told.take(np.arange(3)).mu == pytest.approx(told.mu[:3])


def test_a_time_that_is_capped_is_told_below_the_cap():
    critical = CriticalInterval(high=1.5)
    prediction, _ = learned(Auto(), lambda u: np.clip(12.0 * u[:, 0] + 3.0 * np.sin(9.0 * u[:, 1]), 0.0, 10.0), critical)
    told = ended(prediction)
    assert 0.0 <= told.mu.min() <= told.mu.max() <= 10.0
    assert told.quantile(0.95).max() <= 10.0


@pytest.mark.parametrize("kind", ["count", "flag", "speed"])
def test_what_is_saved_tells_the_same(kind: str, tmp_path: Path):
    """A count was told half a step beside itself at the edge: 4.55 for 4, 5.4 for 5."""
    rng, at = np.random.default_rng(3), np.random.default_rng(4).random((500, 2))
    of = {"count": lambda u: np.floor(6.0 * u.sum(axis=1)), "flag": lambda u: 1.0 * (speed(u) > 0.0), "speed": speed}[kind]
    u, critical = rng.random((120, 2)), CriticalInterval(low=5.0 if kind == "count" else 1.0)
    predictor = Opened(Auto(), critical).fit(u, of(u), rng)
    save(predictor, tmp_path / "saved.sbtmodel")
    first, again = ended(predictor(at)), ended(load(tmp_path / "saved.sbtmodel")(at))
    assert first.mu == pytest.approx(again.mu)
    assert first.quantile(0.9) == pytest.approx(again.quantile(0.9))
    if kind == "count":
        error = first.mu - of(at)
        assert np.abs([error[of(at) == value].mean() for value in (4.0, 5.0)]).max() < 0.3


def test_the_margin_of_a_combination_is_that_of_metrics_within_their_values():
    need = any_of(Requirement("speed", low=2.0), Requirement("gap", high=0.2))
    rng = np.random.default_rng(1)
    u, at = rng.random((80, 2)), rng.random((1000, 2))

    def both(u):
        return np.column_stack([speed(u), u[:, 0]])

    prediction = metamodel_for(Auto(), need.critical).fit(u, both(u), rng)(at)
    told, margin = ended(prediction), need.critical.with_leaves(need.critical.leaves, prediction.critical.scale).margin(both(at))
    assert float(np.sqrt(np.mean((told.mu - margin) ** 2))) < 0.5 * margin.std()
    assert told.probability(CriticalInterval(high=0.0)) == pytest.approx(prediction.probability(CriticalInterval(high=0.0)))


def test_a_metric_that_goes_on_is_told_as_it_is():
    prediction = Prediction.gaussian([0.0, 1.0], [1.0, 1.0])
    assert ended(prediction) is prediction
    assert ended(ended(replace(prediction, scale=Scale(low=0.0)))).mu[0] > 0.0


def test_predict_figures_and_scores_say_the_same(tmp_path: Path):
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]

    def evaluate(values: dict, _: int) -> dict[str, float]:
        return {"v": float(speed(np.array([[values["a"], values["b"]]]))[0])}

    scenario = sbt.Scenario("impact", inputs, sbt.Requirement("v", low=2.0), evaluate=evaluate)
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=60, seed=1, store=tmp_path / "s", executor="serial", report=False,
        validation={"share": 0.2},
    )  # fmt: skip
    told = result.predict(result.frame)
    assert told["mean"].between(0.0, 4.0 * result.frame["y.v"].max()).all()
    line = result.plot.slices(x="a").get_lines()[0].get_ydata()
    assert np.min(line) >= 0.0
    assert result.conclusion.validation.rmse < 1.0
