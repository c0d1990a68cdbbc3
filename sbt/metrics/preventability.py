"""Whether the reference drivers can judge a failure: they keep their lane and brake for those who go the same way."""

from __future__ import annotations

import numpy as np

from sbt.metrics.conflict_types import conflict_type
from sbt.metrics.geometry import rectangle_distance
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["APPLICABLE", "METRIC_NAME", "applicability", "why_not"]

METRIC_NAME = "applicability"
"""Name of the metric."""
APPLICABLE = 0.0
"""Its value where the drivers can judge."""
_REASONS = (
    "",
    "no other road user is involved: the drivers only brake for others",
    "the other comes from behind: the drivers only brake for who is ahead",
    "the other crosses ego's course: the models are of traffic in the same direction",
    "the other is oncoming: the models are of traffic in the same direction",
    "the other is a pedestrian: the models are of vehicles",
    "ego turns: the models are of driving along a lane",
)
_NOBODY, _BEHIND, _CROSSING, _ONCOMING, _PEDESTRIAN, _TURNING = range(1, 7)
_PERSON = 1.0
"""Rectangles of at most this length and width are persons (m)."""
_TURN = np.radians(30.0)
_BEFORE = 5.0
"""Time before the smallest distance in which a turn of the ego by more than 30 degrees counts (s)."""


def applicability(ego: str = "ego") -> Metric:
    """Return the metric `applicability`: 0 where the reference drivers can judge the conflict of a run, or a code.

    The conflict is that with the road user at the smallest distance, and classified as by `conflict_type`.
    """
    classified = conflict_type(ego)

    def function(trace: Trace) -> float:
        code = int(classified.value(trace))
        if code < 0:
            return float(_NOBODY)
        own, other, at = _nearest(trace, ego)
        side, course = divmod(code, 4)
        if max(other.length, other.width) <= _PERSON:
            return float(_PEDESTRIAN)
        if course:
            return float(_ONCOMING if course == 2 else _CROSSING)
        before = own.heading[(trace.time >= trace.time[at] - _BEFORE) & (trace.time <= trace.time[at])]
        if np.ptp(np.unwrap(before)) > _TURN:
            return float(_TURNING)
        return float(_BEHIND) if side == 2 else APPLICABLE

    return Metric(METRIC_NAME, function, "", "low", APPLICABLE, "0: the reference drivers can judge the run; or why not")


def why_not(code: float) -> str:
    """Return why the drivers cannot judge; "" where they can.

    >>> why_not(0.0), why_not(3.0)
    ('', "the other crosses ego's course: the models are of traffic in the same direction")
    """
    return _REASONS[int(code)]


def _nearest(trace: Trace, ego: str) -> tuple[ActorTrace, ActorTrace, int]:
    """Return the ego, the road user that comes nearest, and the instant."""
    column = trace.actors.index(ego) if ego in trace.actors else 0
    own, best = trace.actor(trace.actors[column]), (float("inf"), column, 0)
    for k, name in enumerate(trace.actors):
        if k != column:
            distance = rectangle_distance(own, trace.actor(name))
            distance = np.where(np.isfinite(distance), distance, np.inf)
            at = int(distance.argmin())
            best = min(best, (float(distance[at]), k, at))
    return own, trace.actor(trace.actors[best[1]]), best[2]
