"""A prediction by the warped metric: probabilities, densities and quantiles are those of the metric itself."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import LogWarp, Warp
from sbt.metamodels.warped_prediction import WarpedPrediction
from sbt.problem.requirement import CriticalInterval

WARPS = [Warp(2.0, 0.5), Warp(2.0, 0.5, above=4.0), Warp(-1.0, 1.0, gap=(0.0, 3.0)), Warp(0.0, 0.3, above=2.0, gap=(1.5, 0.2)),
         LogWarp.around(2.0)]  # fmt: skip


def _mixture() -> Prediction:
    mean, std = np.array([[-1.2, 0.1, 2.0], [-0.9, -0.2, 1.0]]), np.array([[0.3, 0.5, 0.2], [0.6, 0.1, 0.4]])
    return Prediction(mean, std, np.array([0.3, 0.7]), np.full(3, 0.05))


@pytest.mark.parametrize("warp", WARPS)
def test_probabilities_quantiles_and_densities_are_those_of_drawn_values(warp: Warp) -> None:
    rng, warped = np.random.default_rng(0), _mixture()
    prediction = WarpedPrediction.of(warped, warp)
    component = rng.choice(2, p=warped.weight, size=200_000)
    y = warp.back(warped.mean[component] + warped.std[component] * rng.standard_normal((200_000, 3)))
    for low, high in [(-np.inf, warp.edge), (warp.edge + 1.0, np.inf), (warp.edge - 1.0, warp.edge + 3.5)]:
        inside = ((y >= low) & (y <= high)).mean(axis=0)
        assert prediction.probability(CriticalInterval(low, high)) == pytest.approx(inside, abs=0.005)
    for q in (0.05, 0.5, 0.95):
        at = prediction.quantile(q)
        assert prediction.cdf(at) == pytest.approx(q, abs=1e-9)
        assert (y <= at).mean(axis=0) == pytest.approx(q, abs=0.005)
    for k in range(3):
        one = prediction.take(np.array([k]))
        ends = [float(one.quantile(q)[0]) for q in (1e-7, 1.0 - 1e-7)]
        cuts = sorted({*ends, warp.edge, *np.clip([warp.edge - warp.gap[0], warp.edge + warp.gap[1]], *ends)})
        parts = [quad(lambda v, p=one: np.exp(p.log_density(np.array([v]))[0]), *pair, limit=200)[0]
                 for pair in pairwise(cuts)]  # fmt: skip
        assert sum(parts) == pytest.approx(1.0, abs=1e-3)


def test_moments_are_those_of_values_on_both_sides_of_a_gap() -> None:
    """Where the warp is nearly straight, the mean is exact, and the standard deviation no smaller than it is."""
    rng, warp = np.random.default_rng(1), Warp(5.0, 100.0, gap=(1.0, 2.0))
    mean, std = np.array([[-0.02, 0.0, 0.005, 0.03]]), np.full((1, 4), 0.01)
    found = WarpedPrediction.of(Prediction(mean, std, np.ones(1), np.zeros(4)), warp)
    y = warp.back(mean + std * rng.standard_normal((400_000, 4)))
    assert found.mu == pytest.approx(y.mean(axis=0), abs=0.01)
    ratio = found.sigma / y.std(axis=0)
    assert (ratio >= 0.98).all()
    assert (ratio[1:3] < 1.2).all()
    # far from the gap nothing of it is left: in units of y the standard deviation is that of the metric
    far = WarpedPrediction.of(Prediction(np.array([[1.0]]), std[:, :1], np.ones(1), np.zeros(1)), warp)
    assert far.sigma == pytest.approx(0.01 * 100.0 * np.cosh(1.0), rel=0.01)


def test_what_is_derived_is_the_prediction_of_what_is_derived_of_the_warped_one() -> None:
    warp, warped = WARPS[3], _mixture()
    prediction, y, critical = WarpedPrediction.of(warped, warp), np.array([-2.0, 0.5, 3.0]), CriticalInterval(high=0.0)
    pieces = [prediction.take(np.array([k])) for k in range(3)]
    joined = pieces[0].joined(pieces[1:])
    assert joined.log_density(y) == pytest.approx(prediction.log_density(y))
    assert joined.sigma == pytest.approx(prediction.sigma)
    wider = prediction.widened(2.0)
    assert wider.probability(critical) == pytest.approx(warped.widened(2.0).probability(CriticalInterval(high=0.0)))
    rescaled = prediction.rescaled(1.5).warped
    assert rescaled is not None
    assert rescaled.mu == pytest.approx(warped.mu)
    assert rescaled.sigma == pytest.approx(1.5 * warped.sigma)
    tails = prediction.with_tails(np.array([1.0, 3.0]), np.array([0.9, 0.1]))
    assert tails.cdf(y) == pytest.approx(0.9 * prediction.cdf(y) + 0.1 * prediction.widened(3.0).cdf(y))
    assert (prediction.noise < prediction.sigma).all()


def test_an_end_of_the_metric_stays_one() -> None:
    warp = Warp(1.5, 0.5)
    prediction = replace(WarpedPrediction.of(Prediction.gaussian([-2.0, 1.0], [1.0, 1.0]), warp), lowest=0.0)
    assert prediction.probability(CriticalInterval(0.0, 1.5)) == pytest.approx(norm.cdf([2.0, -1.0]))
    assert prediction.take(np.array([0])).probability(CriticalInterval(0.0, 1.5)) == pytest.approx(norm.cdf(2.0))


def test_gaps_are_crossed_without_a_step() -> None:
    """The map is increasing, and there and back is where one was, also within the gap."""
    for warp in WARPS[:4]:
        y = np.linspace(warp.edge - 5.0, warp.edge + 5.0, 2001)
        values = warp.values(y)
        assert (np.diff(values) > 0.0).all()
        assert warp.back(values) == pytest.approx(y, abs=1e-6)
        slope = (warp.values(y + 1e-7) - warp.values(y - 1e-7)) / 2e-7
        smooth = np.abs(y - warp.edge)[:, None] - np.array([warp.gap[0], warp.gap[1], 0.0])
        apart = (np.abs(smooth) > 1e-3).all(axis=1) & (np.exp(warp.log_slope(y)) > 1e-3)
        assert np.exp(warp.log_slope(y))[apart] == pytest.approx(slope[apart], rel=1e-3)
