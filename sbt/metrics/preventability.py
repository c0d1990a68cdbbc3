"""Whether the reference drivers can judge a failure: they keep their lane and brake for those who go the same way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbt.metrics.conflict_types import Decisive, conflict, side_and_course
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

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


def applicability(ego: str = "ego", decisive: Sequence[Decisive] = (), also_tested: Sequence[str] = ()) -> Metric:
    """Return the metric `applicability`: 0 where the reference drivers can judge the conflict of a run, or a code.

    Args:
        ego: the road user under test.
        decisive: metrics that decide whose the conflict is, as of `conflict_type`.
        also_tested: further vehicles under test, whose places the drivers take too: one that can be judged is enough.
    """

    def function(trace: Trace) -> float:
        codes = [_code(trace, one, decisive) for one in (ego, *(name for name in also_tested if name in trace.actors))]
        return APPLICABLE if APPLICABLE in codes else codes[0]

    return Metric(METRIC_NAME, function, "", "low", APPLICABLE, "0: the reference drivers can judge the run; or why not")


def _code(trace: Trace, ego: str, decisive: Sequence[Decisive]) -> float:
    trace = trace.seen_by(ego)
    met = conflict(trace, ego, decisive)
    if met is None:
        return float(_NOBODY)
    _, own, other, at = met
    side, course = side_and_course(own, other, at)
    if max(other.length, other.width) <= _PERSON:
        return float(_PEDESTRIAN)
    if course:
        return float(_ONCOMING if course == 2 else _CROSSING)
    before = own.heading[(trace.time >= trace.time[at] - _BEFORE) & (trace.time <= trace.time[at])]
    if np.ptp(np.unwrap(before)) > _TURN:
        return float(_TURNING)
    return float(_BEHIND) if side == 2 else APPLICABLE


def why_not(code: float) -> str:
    """Return why the drivers cannot judge; "" where they can.

    >>> why_not(0.0), why_not(3.0)
    ('', "the other crosses ego's course: the models are of traffic in the same direction")
    """
    return _REASONS[int(code)]
