"""The type of a conflict: on which side of the ego whom it is about was when it was decided, and on which course.

Runs that fail in the same way have the same type; falsification distinguishes failure modes by it. In traffic whoever is
nearest may have nothing to do with the failure, as a car that is overtaken while the ego closes in on its leader; and when the
two are nearest it may be over: an ego that brakes too late for a comfortable gap stands then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sbt.metrics.geometry import (
    Rectangles,
    contact_index,
    first_touch,
    overlap_depth,
    part_pairs,
    rectangle_at,
    rectangle_distance,
    touching_first,
)
from sbt.metrics.longitudinal import FAR
from sbt.metrics.moments import first_at_its_worst
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.requirement import CriticalInterval
from sbt.problem.trace import ActorTrace, Trace

__all__ = [
    "METRIC_NAME", "Decisive", "conflict", "conflict_type", "describe_conflict_type", "from_behind", "side_and_course",
    "without_standing",
]  # fmt: skip

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


Decisive = tuple[Metric, CriticalInterval]
"""A metric with the values of it that are critical."""


def conflict_type(ego: str = "ego", decisive: Sequence[Decisive] = ()) -> Metric:
    """Return the metric `conflict_type`: 4 side + course when it was decided; -1: nobody within 1 km.

    Side: 0 ahead, 1 left, 2 behind, 3 right of the ego's rectangle, by the side that the other is farther away from; in a
    contact, where the two begin to touch within the step.
    Course: heading of the other relative to the ego's; 0 the same, 1 turned left by 45 to 135 degrees (it comes from
    the right), 2 oncoming, 3 turned right. 16 more where ego stands, 32 more where one of `Trace.unreacting` comes from
    behind. Absent road users (NaN) do not count. If no actor has the name `ego`, the first actor is the ego.

    Args:
        ego: the road user under test.
        decisive: metrics that decide whether a run is critical: in a critical one the conflict is that with the other whose
            sole presence gives the same value, at the instant from which on the metric has it. Without them, or where no single
            one does, it is that with the nearest, at the smallest distance.
    """

    def function(trace: Trace) -> float:
        met = conflict(trace, ego, decisive)
        return float(_NOBODY if met is None else _code(*met[1:], unreacting=met[0] in trace.unreacting))

    return Metric(
        METRIC_NAME, function, "", "low", _NOBODY,
        "side of ego and course of whom a failure is about when it is decided, else of the nearest: 4 side + course, "
        "+ 16 ego stands, + 32 recorded, behind; -1 nobody",
    )  # fmt: skip


def conflict(trace: Trace, ego: str, decisive: Sequence[Decisive] = ()) -> tuple[str, ActorTrace, ActorTrace, int] | None:
    """Return whom a run's conflict is with, what of the two is nearest at the decisive instant, and the index of that instant.

    Args:
        trace: of the run.
        ego: the road user under test; the first actor where none has this name.
        decisive: as of `conflict_type`.

    Returns:
        None: nobody is within 1 km.
    """
    ego = ego if ego in trace.actors else trace.actors[0]
    trace = trace.seen_by(ego)
    others = _nearest_first(trace, ego)
    decided = _decided(trace, ego, list(others), decisive) if others else None
    if decided is not None:
        others = {decided[0]: others[decided[0]]}
        met = _nearest_of(trace, ego, others, decided[1])
        if met is not None:
            return met
    return _nearest_of(trace, ego, others)


def _nearest_of(
    trace: Trace, ego: str, others: Mapping[str, float], instant: int | None = None
) -> tuple[str, ActorTrace, ActorTrace, int] | None:
    """Return who is nearest, the parts of the two that are, and when: at an instant, or ever; None: nobody is there."""
    own, best, met = trace.actor(ego), FAR, None
    for name, least in others.items():
        if least < best:
            for part, other in part_pairs(own, trace.actor(name)):
                distance, at = _nearest(part, other, instant)
                if distance < best:
                    best, met = distance, (name, part, other, at)
    if met is None or best > 0.0:
        return met
    name, *_, at = met
    return (name, *touching_first(list(part_pairs(own, trace.actor(name))), at), at)


def _nearest_first(trace: Trace, ego: str) -> dict[str, float]:
    """Return the others, and the distance to each that its rectangle is never below (m), the nearest ones first."""
    own = trace.actors.index(ego)
    bent = np.array([name in trace.parts for name in trace.actors])
    reach = np.where(bent, 1.5, 0.5) * np.hypot(trace.length, trace.width)
    centres = np.hypot(trace.x - trace.x[:, own : own + 1], trace.y - trace.y[:, own : own + 1])  # (t, m)
    least = np.where(np.isfinite(centres), centres, np.inf).min(axis=0) - reach - reach[own]
    return {trace.actors[k]: float(least[k]) for k in np.argsort(least, kind="stable").tolist() if k != own}


def _decided(trace: Trace, ego: str, others: Sequence[str], decisive: Sequence[Decisive]) -> tuple[str, int | None] | None:
    """Return who alone makes the first critical metric what it is, the first of the others, and from which instant on.

    None: nobody does, or no metric is critical. No instant: the metric compares different times of the two.
    """
    for metric, interval in decisive:
        value = math.nan if metric.alone else metric.value(trace)
        if interval.contains(np.array([value]))[0]:
            for name in others:
                two = trace if len(trace.actors) == 2 else _two(trace, ego, name)
                if math.isclose(_value(metric, two), value, rel_tol=1e-9):
                    return name, None if metric.lagged else first_at_its_worst(two, metric) or 0
            return None
    return None


def _two(trace: Trace, ego: str, other: str) -> Trace:
    """Return the trace without anybody but these two."""
    two = trace.select(slice(None), {ego: ego, other: other})
    return replace(two, signals=trace.signals, reported=trace.reported, unreacting=trace.unreacting)


def _value(metric: Metric, two: Trace) -> float:
    """Return a metric of two; NaN where it needs somebody else."""
    try:
        return metric.value(two)
    except Exception:  # a metric of one's own that looks for another by name: it is not about this one
        return math.nan


def _nearest(ego: ActorTrace, other: ActorTrace, instant: int | None) -> tuple[float, int]:
    """Return the smallest distance of the rectangles (m, inf if they are not present together) and its instant.

    0 at that of the first contact, which may lie within the step before it.
    """
    distance, contact = rectangle_distance(ego, other), contact_index(ego, other)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    if contact is not None:
        distance[contact] = 0.0
    k = int(distance.argmin()) if instant is None else instant
    return float(distance[k]), k


def _code(ego: ActorTrace, other: ActorTrace, k: int, *, unreacting: bool) -> int:
    side, course = side_and_course(ego, other, k)
    standing = _STANDING if abs(ego.speed[k]) < _STANDS else 0
    return 4 * side + course + standing + (_UNREACTING if unreacting and (side, course) == _FROM_BEHIND else 0)


def from_behind(ego: ActorTrace, other: ActorTrace) -> bool:
    """Return whether the other is behind the ego at the last instant, in the same direction."""
    return side_and_course(ego, other, -1) == _FROM_BEHIND


def side_and_course(ego: ActorTrace, other: ActorTrace, k: int) -> tuple[int, int]:
    """Return side and course (see `conflict_type`) of another rectangle at an instant; of a contact, as they begin to touch.

    A step may drive them a car's width and more into each other, or past each other.
    """
    k %= len(ego.x)
    apart = np.flatnonzero(~(overlap_depth(ego, other)[: k + 1] > 0.0))
    begun = int(apart[-1]) + 1 if apart.size else 0
    touch = first_touch(ego, other, min(begun, k))
    return _side_and_course(*((rectangle_at(ego, k), rectangle_at(other, k)) if touch is None else touch[1:]))


def _side_and_course(ego: Rectangles, other: Rectangles) -> tuple[int, int]:
    heading, turned = float(ego.heading[0]), float(other.heading[0] - ego.heading[0])
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = float(other.x[0] - ego.x[0]), float(other.y[0] - ego.y[0])
    along, across = cos * dx + sin * dy, cos * dy - sin * dx
    turned = math.remainder(turned, 2.0 * math.pi)
    c, s = abs(math.cos(turned)), abs(math.sin(turned))
    outside_along = abs(along) - 0.5 * float(ego.length[0] + c * other.length[0] + s * other.width[0])
    outside_across = abs(across) - 0.5 * float(ego.width[0] + s * other.length[0] + c * other.width[0])
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
