"""The type of a conflict: the side of the ego and the course of the nearest road user at the smallest distance.

Runs that fail in the same way have the same type; falsification distinguishes failure modes by it.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.metrics.geometry import part_pairs, rectangle_distance
from sbt.metrics.longitudinal import FAR
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["METRIC_NAME", "conflict_type", "describe_conflict_type", "from_behind", "without_standing"]

METRIC_NAME = "conflict_type"
"""Name of the metric."""
_SIDES = ("ahead of ego", "left of ego", "behind ego", "right of ego")
_COURSES = ("same direction", "crossing from the right", "oncoming", "crossing from the left")
_STANDING, _STANDS = 16, 0.1
"""Added where the ego stands, slower than this (m/s): who was hit at rest did not hit."""
_UNREACTING = 32
"""Added where a recorded road user, who does not react, comes from behind."""
_FROM_BEHIND = (2, 0)
"""Side and course of one who drives into the ego from behind."""
_NOBODY = -1
"""Value if there is no other road user within 1 km."""


def conflict_type(ego: str = "ego") -> Metric:
    """Return the metric `conflict_type`: 4 side + course at the smallest distance; -1: nobody within 1 km.

    Side: 0 ahead, 1 left, 2 behind, 3 right of the ego's rectangle, by the side that the other is farther away from.
    Course: heading of the other relative to the ego's; 0 the same, 1 turned left by 45 to 135 degrees (it comes from
    the right), 2 oncoming, 3 turned right. 16 more where ego stands, 32 more where one of `Trace.unreacting` comes from
    behind. Absent road users (NaN) do not count. If no actor has the name `ego`, the first actor is the ego.
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
                        best, code = distance, _code(part, other, at, unreacting=trace.actors[k] in trace.unreacting)
        return float(code)

    return Metric(
        METRIC_NAME, function, "", "low", _NOBODY,
        "side of ego and course of the nearest other: 4 side + course, + 16 ego stands, + 32 recorded, behind; -1 nobody",
    )  # fmt: skip


def _nearest(ego: ActorTrace, other: ActorTrace) -> tuple[float, int]:
    """Return the smallest distance of the rectangles (m, inf if they are never present together) and its instant."""
    distance = rectangle_distance(ego, other)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    k = int(distance.argmin())
    return float(distance[k]), k


def _code(ego: ActorTrace, other: ActorTrace, k: int, *, unreacting: bool) -> int:
    side, course = _side_and_course(ego, other, k)
    standing = _STANDING if abs(ego.speed[k]) < _STANDS else 0
    return 4 * side + course + standing + (_UNREACTING if unreacting and (side, course) == _FROM_BEHIND else 0)


def from_behind(ego: ActorTrace, other: ActorTrace) -> bool:
    """Return whether the other is behind the ego at the last instant, in the same direction."""
    return _side_and_course(ego, other, -1) == _FROM_BEHIND


def _side_and_course(ego: ActorTrace, other: ActorTrace, k: int) -> tuple[int, int]:
    cos, sin = math.cos(ego.heading[k]), math.sin(ego.heading[k])
    dx, dy = other.x[k] - ego.x[k], other.y[k] - ego.y[k]
    along, across = cos * dx + sin * dy, cos * dy - sin * dx
    turned = math.remainder(other.heading[k] - ego.heading[k], 2.0 * math.pi)
    c, s = abs(math.cos(turned)), abs(math.sin(turned))
    outside_along = abs(along) - 0.5 * (ego.length + c * other.length + s * other.width)
    outside_across = abs(across) - 0.5 * (ego.width + s * other.length + c * other.width)
    lengthwise = 0 if along >= 0 else 2
    side = lengthwise if outside_along >= outside_across else 1 if across > 0 else 3
    return side, round(turned / (0.5 * math.pi)) % 4


def without_standing(codes: Vector) -> Vector:
    """Return conflict types without the difference whether ego stands: one that just stopped fails as one that is about to."""
    stands = (codes >= 0) & (codes // _STANDING % 2 == 1)
    return np.where(stands, codes - _STANDING, codes)


def describe_conflict_type(code: float) -> str:
    """Return a conflict type as text; "" for nobody.

    >>> describe_conflict_type(0.0), describe_conflict_type(29.0), describe_conflict_type(-1.0)
    ('ahead of ego, same direction', 'right of ego, crossing from the right, ego stands', '')
    >>> describe_conflict_type(40.0)
    'behind ego, same direction, recorded and does not react'
    """
    if code < 0:
        return ""
    bits, kind = divmod(int(code), _STANDING)
    stands = ", ego stands" if bits % 2 else ""
    return f"{_SIDES[kind // 4]}, {_COURSES[kind % 4]}{stands}{', recorded and does not react' if bits // 2 else ''}"


CONFLICT_TYPE = conflict_type()
