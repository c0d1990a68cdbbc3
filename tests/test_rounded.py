"""Metrics that come in steps: each run tells a range, and P(critical) is that of what was rounded."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.metamodels import persistence
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import Predictor, sample_paths
from sbt.metamodels.ended import ended
from sbt.metamodels.expectation_propagation import Hyper, Priors, _log_posterior, believe, log_probability
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.rounded import RoundedPredictor, rounding
from sbt.metamodels.saturation import Opened
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

QUICK = Auto(**Auto.PRESETS["quick"])


def slope(u: Points) -> Vector:
    return np.asarray(4.0 * u[:, 0] + 2.0 * u[:, 1] ** 2 - 1.5 * u[:, 2])


def rounded(u: Points, step: float) -> Vector:
    return np.floor(slope(u) / step + 1e-9) * step


def fitted(step: float, edge: float, runs: int = 80) -> tuple[Predictor, Points, Mask]:
    """Return what learned a rounded slope, new points, and which of them are critical: at most the edge."""
    u, new = SobolSequence(3, 1).points(0, runs), stream(1, "new").random((8000, 3))
    predictor = Opened(QUICK, CriticalInterval(high=edge)).fit(u, rounded(u, step), stream(1, "fit"))
    return predictor, new, rounded(new, step) <= edge


def loss(prediction: Prediction, edge: float, critical: Mask) -> float:
    inside, outside = prediction.log_probability(CriticalInterval(high=edge))
    return float(-np.where(critical, inside, outside).mean())


def test_the_slope_of_the_evidence_of_ranges_is_that_of_their_evidence():
    u = stream(1, "ranges").random((40, 2))
    y = np.round(3.0 * np.hypot(*(u - 0.4).T) / 0.3) * 0.3
    low, high = np.where(y == y.min(), -np.inf, y - 0.15), np.where(y == y.max(), np.inf, y + 0.15)
    priors = Priors((0.0, 1.0), (0.0, 1.0), (0.0, 2.0), (math.log(0.01), 2.0), ())
    theta = Hyper(np.array([0.4, 0.6]), 1.2, 0.8, 0.05).theta
    told = _log_posterior(theta, u, low, high, priors, None)[1]
    steps = [1e-4 * row for row in np.eye(5)]
    ends = [[_log_posterior(theta + sign * s, u, low, high, priors, None)[0] for sign in (1.0, -1.0)] for s in steps]
    assert told == pytest.approx([(up - down) / 2e-4 for up, down in ends], abs=0.05)


def test_the_probability_of_a_range_keeps_its_digits_in_the_tails():
    low, high = np.array([8.0, -30.0, 39.0, -1e-9, -1.0]), np.array([9.0, -29.0, 60.0, 1e-9, 3.0])
    near = np.minimum(np.abs(low), np.abs(high)) * (low * high > 0.0)  # where the density of a range is largest
    x = np.linspace(low, high, 1_000_001)
    density = np.exp(-0.5 * (x**2 - near**2)) / math.sqrt(2.0 * math.pi)
    told = np.log(np.trapezoid(density, x, axis=0)) - 0.5 * near**2
    assert log_probability(low, high) == pytest.approx(told, abs=1e-6)
    assert log_probability(np.array([-np.inf, 39.0]), np.array([-39.0, np.inf])) == pytest.approx(told[[2, 2]], abs=1e-6)


@pytest.mark.parametrize(("step", "edge"), [(0.1, 0.35), (0.5, 0.5), (1.2, 0.0)])
def test_what_is_expected_on_the_wrong_side_of_a_rounded_metric_is_what_lies_there(step: float, edge: float):
    predictor, new, critical = fitted(step, edge)
    prediction = predictor(new)
    p = prediction.probability(CriticalInterval(high=edge))
    wrong, expected = float(((p > 0.5) != critical).mean()), float(np.minimum(p, 1.0 - p).mean())
    assert expected < 3.0 * wrong + 0.002
    assert wrong < 3.0 * expected + 0.002
    assert loss(prediction, edge, critical) < 0.04  # a process of the values has .07, .09 and .10


def test_a_step_that_no_run_has_is_known_from_the_others():
    u = SobolSequence(1, 1).points(0, 64)
    y = np.floor(10.0 * u[:, 0])
    kept = y != 4.0
    told = rounding(u[kept], y[kept], CriticalInterval(high=3.0))
    assert told is not None
    assert (told.edge, told.width) == (3.5, 1.0)
    between = rounding(u[kept], y[kept], CriticalInterval(high=4.2))
    assert between is not None
    assert between.edge == 4.5


def test_critical_above_is_critical_below_mirrored():
    u = SobolSequence(2, 1).points(0, 40)
    y = np.floor(6.0 * u[:, 0] + 3.0 * u[:, 1])
    below, above = (
        Opened(QUICK, critical).fit(u, values, stream(1, "fit"))(u).probability(critical)
        for values, critical in ((y, CriticalInterval(high=2.0)), (-y, CriticalInterval(low=-2.0)))
    )  # fmt: skip
    assert below == pytest.approx(above, abs=1e-3)


def test_metrics_without_steps_are_learned_as_before():
    u = SobolSequence(3, 1).points(0, 60)
    assert rounding(u, slope(u), CriticalInterval(high=0.3)) is None
    assert rounding(u, np.maximum(slope(u), 0.0), CriticalInterval(high=0.3)) is None  # ends with a value that many have
    assert rounding(u, rounded(u, 0.5), CriticalInterval(0.0, 0.5)) is None


def test_what_is_told_of_a_rounded_metric_lies_where_its_runs_do(tmp_path: Path):
    predictor, new, critical = fitted(0.5, 0.5)
    told = ended(predictor(new))
    assert np.abs(told.mu - rounded(new, 0.5)).mean() < 0.2
    paths = sample_paths(predictor, new[:300], 200, stream(1, "paths"))
    p = predictor(new[:300]).probability(CriticalInterval(high=0.5))
    assert np.abs((paths <= 0.5).mean(axis=0) - p).max() < 0.15
    persistence.save(predictor, tmp_path / "m.sbtmodel")
    again = persistence.load(tmp_path / "m.sbtmodel")(new[:50])
    assert again.probability(CriticalInterval(high=0.5)) == pytest.approx(
        predictor(new[:50]).probability(CriticalInterval(high=0.5)), abs=1e-12
    )
    assert critical.any()


def test_a_noisy_count_keeps_its_noise():
    """A Poisson count of at least 4: P is that of the count, not that of its mean."""
    u, new = SobolSequence(1, 2).points(0, 200), np.linspace(0.02, 0.98, 200)[:, None]
    y = stream(3, "count").poisson(6.0 * u[:, 0]).astype(np.float64)
    critical = CriticalInterval(low=4.0)
    p = Opened(QUICK, critical).fit(u, y, stream(1, "fit"))(new).probability(critical)
    from scipy.stats import poisson

    truth = poisson.sf(3, 6.0 * new[:, 0])
    assert np.sqrt(np.mean((p - truth) ** 2)) < 0.1


@pytest.mark.slow
def test_a_boundary_of_a_rounded_metric_ends_when_it_is_known(tmp_path: Path):
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = sbt.Scenario(
        "rounded", inputs, sbt.Requirement("y", high=0.5),
        evaluate=lambda v, seed: {"y": float(rounded(np.array([[v["a"], v["b"], v["c"]]]), 0.5)[0])},
    )  # fmt: skip
    found = sbt.run(
        campaign="boundary", scenario=scenario, budget=150, seed=1, executor="serial", store=tmp_path / "s", report=False,
        stop={"misclassified": 0.01},
    )  # fmt: skip
    assert len(found.history) < 150
    assert found.conclusion.expected_misclassified <= 0.01


def test_the_predictor_of_a_rounded_metric_is_the_one_that_knows_ranges():
    predictor, *_ = fitted(0.1, 0.35)
    mixture = getattr(predictor, "predictor", predictor)
    mixture = getattr(mixture, "predictor", mixture)
    assert any(isinstance(each, RoundedPredictor) for each in mixture.predictors)


def test_steps_are_known_but_for_the_last_digits():
    """A post-encroachment time is a difference of multiples of the step: .1 + .2 is not .3."""
    u, rng = SobolSequence(2, 1).points(0, 120), stream(1, "late")
    late = rng.integers(0, 300, 120)
    y = (late + np.round(12.0 * u[:, 0] + 8.0 * u[:, 1])) * 0.1 - late * 0.1
    assert len(np.unique(y)) > 1.5 * len(np.unique(np.round(y, 6)))
    told = rounding(u, y, CriticalInterval(high=0.55))
    assert told is not None
    assert (told.edge, told.width) == (pytest.approx(0.55), pytest.approx(0.1))
    p = Opened(QUICK, CriticalInterval(high=0.55)).fit(u, y, stream(1, "fit"))(u).probability(CriticalInterval(high=0.55))
    assert ((p > 0.5) == (y <= 0.55)).mean() > 0.97
    assert rounding(u, y, CriticalInterval(high=0.6)) is None  # which of them are critical is decided by the last digits
    few = np.repeat([0.0, 0.001, 1.00037, 2.7], 30)
    found = rounding(u, few, CriticalInterval(high=0.0005))
    assert found is not None
    assert found.width == pytest.approx(0.001)
    assert found.high[-1] == np.inf
    assert found.low[-1] == pytest.approx(0.5 * (1.00037 + 2.7))  # no lattice of .001


def test_ranges_are_learned_in_the_unit_in_which_they_are_likeliest():
    """Steps of an even slope: least squares chose a unit for a third of such runs, in which what was rounded is bent."""
    critical, wrong = CriticalInterval(low=5.0), []
    for seed in (4, 5):
        u, new = stream(seed, "u").random((100, 2)), stream(seed, "new").random((4000, 2))
        y, truth = np.floor(6.0 * u.sum(axis=1)), 6.0 * new.sum(axis=1) >= 5.0
        p = Opened(QUICK, critical).fit(u, y, stream(1, "fit"))(new).probability(critical)
        wrong.append(float(((p > 0.5) != truth).mean()))
    assert np.mean(wrong) < 0.01


def test_rows_that_are_measured_have_the_evidence_of_a_process():
    u = stream(1, "measured").random((30, 2))
    y, hyper = np.sin(4.0 * u[:, 0]) + u[:, 1], Hyper(np.array([0.5, 0.7]), 1.2, 0.3, 0.03)
    k = hyper.covariance(u)[0] + hyper.noise**2 * np.eye(30)
    found, inverse, rest = believe(hyper, hyper.covariance(u)[0], y, y), np.linalg.inv(k), y - hyper.mean
    evidence = -0.5 * rest @ inverse @ rest - 0.5 * np.linalg.slogdet(2.0 * math.pi * k)[1]
    assert found.log_evidence == pytest.approx(evidence)
    assert found.beside == pytest.approx(rest - inverse @ rest / np.diag(inverse))
    assert found.wide == pytest.approx(1.0 / np.diag(inverse) - hyper.noise**2)


def test_the_slope_of_the_evidence_is_that_where_some_rows_end():
    u = stream(1, "ends").random((40, 2))
    y = np.maximum(np.sin(4.0 * u[:, 0]) + u[:, 1] - 0.8, 0.0)
    low, priors = np.where(y == 0.0, -np.inf, y), Priors((0.0, 1.0), (0.0, 1.0), (0.0, 2.0), (math.log(0.01), 2.0), ())
    theta = Hyper(np.array([0.4, 0.6]), 1.2, 0.3, 0.03).theta
    told = _log_posterior(theta, u, low, y, priors, None)[1]
    ends = [[_log_posterior(theta + sign * s, u, low, y, priors, None)[0] for sign in (1e-4, -1e-4)] for s in np.eye(5)]
    assert told == pytest.approx([(up - down) / 2e-4 for up, down in ends], abs=0.05)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_a_metric_that_ends_is_learned_from_few_runs_of_many_inputs(seed: int):
    """A distance that is 0 in every collision, of six inputs: values moved beyond the end were taken for a jump."""
    critical, (u, new) = CriticalInterval(high=0.0), (stream(seed, "u").random((60, 6)), stream(1, "new").random((4000, 6)))
    way = stream(seed, "way").standard_normal(6)

    def distance(u: Points) -> Vector:
        return np.asarray(np.maximum((u - 0.5) @ way + 0.3 + 0.4 * np.sin(5.0 * u[:, 0]), 0.0))

    predictor = Opened(QUICK, critical).fit(u, distance(u), stream(1, "fit"))
    p, told = predictor(new).probability(critical), ended(predictor(new))
    assert ((p > 0.5) != (distance(new) == 0.0)).mean() < 0.01
    assert np.minimum(p, 1.0 - p).mean() < 0.01
    assert np.abs(told.mu - distance(new)).max() < 0.5
    assert (told.mu >= 0.0).all()
