"""Units in which metrics are learned: the same between the values of runs, straight beyond them."""

from __future__ import annotations

import numpy as np
import pytest

from sbt.metamodels.automatic import Auto
from sbt.metamodels.saturation import Opened
from sbt.metamodels.warp import LogWarp, Warp
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream

RUNS = np.array([-3.0, -0.2, 0.5, 1.0, 7.0])
WARPS = {
    "two scales": Warp(1.0, 0.3, above=0.7), "gap": Warp(1.0, 0.3, above=0.7, gap=(0.1, 0.2)), "one": Warp(1.0, 0.5),
    "logarithm": LogWarp.around(1.0),
}  # fmt: skip


@pytest.mark.parametrize("warp", WARPS.values(), ids=WARPS.keys())
def test_a_warp_is_straight_beyond_all_runs_and_the_same_between_them(warp: Warp):
    runs = np.abs(RUNS) if isinstance(warp, LogWarp) else RUNS
    reaching = warp.reaching(runs)
    between, beyond = np.linspace(runs.min(), runs.max(), 400), np.linspace(runs.max(), 60.0, 400)
    assert reaching.values(between) == pytest.approx(warp.values(between), abs=1e-12)
    assert np.diff(reaching.values(beyond)) == pytest.approx(np.diff(reaching.values(beyond))[0], rel=1e-9)
    far = np.concatenate([between, beyond, np.array([-9.0]) if not isinstance(warp, LogWarp) else np.array([1e-3])])
    assert reaching.back(reaching.values(far)) == pytest.approx(far, abs=1e-9)
    steps = reaching.values(far + 1e-6) - reaching.values(far - 1e-6)
    smooth = np.abs(far - warp.edge) > 0.3  # within a gap, and at the edge, the slope leaps
    assert np.log(steps[smooth] / 2e-6) == pytest.approx(reaching.log_slope(far)[smooth], abs=1e-3)
    ends = np.array([-np.inf, np.inf])
    assert reaching.back(reaching.values(ends)).tolist() == ([0.0, np.inf] if isinstance(warp, LogWarp) else ends.tolist())


def test_means_of_a_metric_of_two_scales_are_no_astronomical_numbers():
    """1e-3 on the one side, 1e6 on the other: in asinh of the distance to the edge a process swings by a few units."""
    u, new = SobolSequence(2, 1).points(0, 100), stream(1, "new").random((3000, 2))

    def metric(x: np.ndarray) -> np.ndarray:
        distance = np.hypot(x[:, 0] - 0.5, x[:, 1] - 0.4) - 0.25
        return np.where(x[:, 0] < 0.5, 1e-3, 1e6) * distance

    prediction = Opened(Auto(**Auto.PRESETS["quick"]), CriticalInterval(high=0.0)).fit(u, metric(u), stream(1, "fit"))(new)
    assert np.abs(prediction.mu).max() < 10.0 * np.abs(metric(u)).max()
    assert np.sqrt(np.mean((prediction.mu - metric(new)) ** 2)) < np.std(metric(new))
