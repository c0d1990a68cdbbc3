"""Metrics are learned in the unit in which runs are predicted best: P(critical) is the same before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt import testbeds
from sbt.metamodels.automatic import Auto
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.persistence import load, save
from sbt.metamodels.warp import Warp
from sbt.metamodels.warped import WarpedPredictor, better_warp
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

LOW = CriticalInterval(high=0.0)
PROCESS = GaussianProcess(nu=2.5, input_noise=False)


@pytest.mark.parametrize("above", [None, 0.1])
@pytest.mark.parametrize(("critical", "sign"), [(LOW, 1.0), (CriticalInterval(low=0.0), -1.0)])
def test_a_warped_predictor_keeps_the_probabilities(critical: CriticalInterval, sign: float, above: float | None, tmp_path: Path):
    rng = stream(3, "warped")
    u, warp = rng.random((40, 2)), Warp(0.0, 0.5, above)
    w = sign * (8.0 * u[:, 0] - 1.0 + u[:, 1])
    predictor = WarpedPredictor(PROCESS.fit(u, w, rng), warp)
    at = rng.random((300, 2))
    inner, p = predictor.predictor(at), predictor(at).probability(critical)
    np.testing.assert_allclose(p, inner.probability(critical), rtol=1e-9, atol=1e-300)
    np.testing.assert_allclose(predictor(at).mu, warp.back(inner.mu), rtol=1e-9)
    np.testing.assert_allclose(warp.values(warp.back(w)), w, rtol=1e-9)
    low, high = predictor.probability_bounds(at, critical)
    assert ((low <= p + 1e-9) & (p <= high + 1e-9)).all()
    drawn = critical.contains(predictor.sample_paths(at[:5], 400, rng)).mean(axis=0)
    np.testing.assert_allclose(drawn, p[:5], atol=0.12)
    save(predictor, tmp_path / "m.sbtmodel")
    np.testing.assert_array_equal(load(tmp_path / "m.sbtmodel")(at).mean, predictor(at).mean)


def test_a_warp_has_its_own_scale_on_either_side():
    warp, y = Warp(1.0, 2.0, 0.5), np.array([-np.inf, -7.0, 0.3, 1.0, 1.1, 4.0, np.inf])
    assert (np.diff(warp.values(y)) > 0.0).all()
    np.testing.assert_allclose(warp.back(warp.values(y)), y, rtol=1e-12)
    at = y[[1, 2, 4, 5]]
    slope = (warp.values(at + 1e-6) - warp.values(at - 1e-6)) / 2e-6
    np.testing.assert_allclose(warp.log_slope(at), np.log(slope), atol=1e-6)
    assert warp.interval(CriticalInterval(high=1.0)).high == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_metric_that_is_steeper_where_it_is_critical_is_learned_in_a_unit_with_two_scales(sign: float):
    """Of a process of the metric as it is the boundary lies next to the safe runs."""
    critical = LOW if sign > 0.0 else CriticalInterval(low=0.0)
    rng = stream(5, "steep")

    def metric(u):
        margin = np.hypot(u[:, 0] - 0.4, u[:, 1] - 0.6) - 0.25 - 0.05 * np.sin(9.0 * u[:, 0])
        return sign * np.where(margin > 0.0, margin, 30.0 * margin - 2.0)

    u, at = SobolSequence(2, 3).points(0, 60), rng.random((4000, 2))
    y, truth = metric(u), critical.contains(metric(at))
    warp = better_warp(PROCESS, u, y, critical)
    assert warp is not None
    assert warp.above is not None
    inside, outside = (warp.scale, warp.above) if sign > 0.0 else (warp.above, warp.scale)
    assert inside > outside
    auto = Auto(ensemble_rows=1000)
    learned = auto.with_target(critical).fit(u, y, rng), PROCESS.fit(u, y, rng)
    share = [predict(at).probability(critical).mean() for predict in learned]
    assert abs(share[0] - truth.mean()) < 0.5 * abs(share[1] - truth.mean())


def test_values_over_many_orders_are_learned_as_well_as_a_bowl():
    """From even runs, and as many near the edge."""
    name, rng = "steep_bowl_d4", stream(1, "bowl")
    near = 0.7 + 0.2 * rng.uniform(-1.0, 1.0, (60, 4))
    u, at = np.vstack([SobolSequence(4, 1).points(0, 60), near]), SobolSequence(4, 2).points(0, 4000)
    y, truth = testbeds.values(name, u), testbeds.values(name, at) <= 0.0
    warped, plain = Auto(ensemble_rows=1000).with_target(LOW).fit(u, y, rng), PROCESS.fit(u, y, rng)
    wrong = [float(np.abs(predict(at).probability(LOW) - truth).mean()) for predict in (warped, plain)]
    assert wrong[0] < 1e-3
    assert wrong[1] > 0.02, "what the metric as it is teaches"


def test_other_metrics_are_learned_as_they_are():
    rng = stream(2, "light")
    u = rng.random((200, 3))
    crowded = 0.5 + 1e-4 * rng.standard_normal((180, 3))
    for y in (u.sum(axis=1) - 0.5, np.sin(6.0 * u[:, 0]) + u[:, 1], rng.standard_normal(200), np.full(200, 3.0)):
        assert better_warp(PROCESS, u, y, LOW) is None
    beside = np.vstack([u, crowded])
    assert better_warp(PROCESS, beside, beside.sum(axis=1) - 1.5, LOW) is None, "runs crowd at the edge of a plain metric"
    assert better_warp(PROCESS, u, np.exp(30.0 * u[:, 0]), CriticalInterval(1.0, 2.0)) is None


def test_a_floor_beneath_the_edge_does_not_keep_a_metric_from_its_unit(tmp_path: Path):
    """`ttc_min` is 0 in a collision and critical up to .1: in its own unit F1 was .74, as no scale alike on both sides helps."""
    result = sbt.run(
        campaign="coverage", scenario="emergency_braking", budget=200, seed=3, store=tmp_path / "s", workers=2, report=False
    )
    runs, scenario = result.history, result.scenario
    y = runs.y("ttc_min")
    assert (y == 0.0).sum() >= 3, "a floor, beneath the edge"
    warp = better_warp(PROCESS, scenario.space.to_unit(runs.x), y, scenario.requirement.critical)
    assert warp is not None
    assert warp.above is not None
    assert warp.scale < warp.above
