"""With whom a metric of two has its worst value in traffic, and whether the paths of the two meet at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metrics.intervals import joint_intervals
from sbt.metrics.paths import HORIZON, path_of
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["Worst", "path_clearance", "worst_pair"]

_SPACING = 0.5
"""Distance of the points at which paths are compared (m)."""
_SWEEP = 1.0
"""What the corners of two cars reach beyond half their widths in tight turns (m)."""


@dataclass(frozen=True)
class Worst:
    """The worst value of a metric over all pairs of the ego and another.

    Args:
        value: of the metric.
        other: the other road user; "" where nobody came near.
        clearance: between what the two sweep along their paths (m); 0 where the paths meet.
    """

    value: float
    other: str = ""
    clearance: float = 0.0


def worst_pair(trace: Trace, metric: Metric, ego: str) -> Worst:
    """Return the worst value of a metric of the actors `ego` and `co` over all others, and with whom it is."""
    found = [
        (metric.value(part), name, part) for name in trace.actors if name != ego for _, part in joint_intervals(trace, ego, name)
    ]
    if not found:
        return Worst(metric.without)
    value, name, part = (max if metric.direction == "high" else min)(found, key=lambda one: one[0])
    return Worst(value, name, path_clearance(part.actor("ego"), part.actor("co")))


def path_clearance(a: ActorTrace, b: ActorTrace) -> float:
    """Return the distance (m) between what two actors sweep along their paths and ways; 0 where these meet.

    Both must be there all the time. Times do not count: two that pass the same place one after the other meet.
    """
    from scipy.spatial import KDTree

    distance, _ = KDTree(_points(a)).query(_points(b))
    return max(0.0, float(np.min(distance)) - 0.5 * (a.width + b.width) - _SWEEP)


def _points(actor: ActorTrace) -> np.ndarray:
    """Return (n, 2) points along a path, from the rear at its beginning to where straight on leads after its end within 5 s."""
    x, y, heading = path_of(actor)
    half = 0.5 * actor.length
    gone = actor.way is not None and len(actor.way) and np.isnan(actor.way[-1, 0])
    on = half if gone else half + HORIZON * float(np.max(np.abs(actor.speed)))
    x = np.concatenate([[x[0] - half * np.cos(heading[0])], x, [x[-1] + on * np.cos(heading[-1])]])
    y = np.concatenate([[y[0] - half * np.sin(heading[0])], y, [y[-1] + on * np.sin(heading[-1])]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.arange(0.0, along[-1] + _SPACING, _SPACING)
    return np.stack([np.interp(at, along, x), np.interp(at, along, y)], axis=1)
