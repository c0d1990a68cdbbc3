"""The type of a conflict: the side of the ego and the course of the nearest road user at the smallest distance.

Runs that fail in the same way have the same type; falsification distinguishes failure modes by it.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.metrics.geometry import part_pairs, rectangle_distance
from sbt.metrics.longitudinal import FAR
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["METRIC_NAME", "STANDING", "conflict_type", "describe_conflict_type"]

METRIC_NAME = "conflict_type"
"""Name of the metric."""
_SIDES = ("ahead of ego", "left of ego", "behind ego", "right of ego")
_COURSES = ("same direction", "crossing from the right", "oncoming", "crossing from the left")
STANDING, _STANDS = 16, 0.1
"""Added where the ego stands, slower than this (m/s): who was hit at rest did not hit."""
_NOBODY = -1
"""Value if there is no other road user within 1 km."""


def conflict_type(ego: str = "ego") -> Metric:
    """Return the metric `conflict_type`: 4 side + course at the smallest distance, + 16 where ego stands; -1: nobody within 1 km.

    Side: 0 ahead, 1 left, 2 behind, 3 right of the ego's rectangle, by the side that the other is farther away from.
    Course: heading of the other relative to the ego's; 0 the same, 1 turned left by 45 to 135 degrees (it comes from
    the right), 2 oncoming, 3 turned right. Absent road users (NaN) do not count. If no actor has the name `ego`, the
    first actor is the ego.
    """

    def function(trace: Trace) -> float:
        column = trace.actors.index(ego) if ego in trace.actors else 0
        own = trace.actor(trace.actors[column])
        bent = np.array([name in trace.parts for name in trace.actors])
        reach = np.where(bent, 1.5, 0.5) * np.hypot(trace.length, trace.width)
        centres = np.hypot(trace.x - own.x[:, None], trace.y - own.y[:, None])  # (t, m)
        least = np.where(np.isfinite(centres), centres, np.inf).min(axis=0) - reach - reach[column]
        best, code = FAR, _NOBODY
        for k in np.argsort(least, kind="stable").tolist():  # the nearest ones first
            if k != column and least[k] < best:
                for part, other in part_pairs(own, trace.actor(trace.actors[k])):
                    distance, at = _nearest(part, other)
                    if distance < best:
                        best, code = distance, _code(part, other, at)
        return float(code)

    return Metric(
        METRIC_NAME, function, "", "low", _NOBODY,
        "side of ego and course of the nearest other, when nearest: 4 side + course, + 16 where ego stands, -1 nobody",
    )  # fmt: skip


def _nearest(ego: ActorTrace, other: ActorTrace) -> tuple[float, int]:
    """Return the smallest distance of the rectangles (m, inf if they are never present together) and its instant."""
    distance = rectangle_distance(ego, other)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    k = int(distance.argmin())
    return float(distance[k]), k


def _code(ego: ActorTrace, other: ActorTrace, k: int) -> int:
    cos, sin = math.cos(ego.heading[k]), math.sin(ego.heading[k])
    dx, dy = other.x[k] - ego.x[k], other.y[k] - ego.y[k]
    along, across = cos * dx + sin * dy, cos * dy - sin * dx
    turned = math.remainder(other.heading[k] - ego.heading[k], 2.0 * math.pi)
    c, s = abs(math.cos(turned)), abs(math.sin(turned))
    outside_along = abs(along) - 0.5 * (ego.length + c * other.length + s * other.width)
    outside_across = abs(across) - 0.5 * (ego.width + s * other.length + c * other.width)
    lengthwise = 0 if along >= 0 else 2
    side = lengthwise if outside_along >= outside_across else 1 if across > 0 else 3
    return 4 * side + round(turned / (0.5 * math.pi)) % 4 + (STANDING if abs(ego.speed[k]) < _STANDS else 0)


def describe_conflict_type(code: float) -> str:
    """Return a conflict type as text; "" for nobody.

    >>> describe_conflict_type(0.0), describe_conflict_type(29.0), describe_conflict_type(-1.0)
    ('ahead of ego, same direction', 'right of ego, crossing from the right, ego stands', '')
    """
    standing, kind = divmod(int(code), STANDING)
    return "" if code < 0 else f"{_SIDES[kind // 4]}, {_COURSES[kind % 4]}{', ego stands' if standing else ''}"


CONFLICT_TYPE = conflict_type()
