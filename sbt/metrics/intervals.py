"""Stretches of time in which two road users are both there, as traces of their own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.metrics.geometry import contact_index
from sbt.problem.trace import Trace

__all__ = ["joint_intervals"]


@per_trace
def joint_intervals(trace: Trace, ego: str, other: str) -> tuple[tuple[slice, Trace], ...]:
    """Return the instants and the trace (actors `ego` and `co`) of every interval in which both are present.

    An interval may be a single instant. Where one of them goes on while the other is gone is its way (`Trace.ways`). After the
    interval in which they touch nothing of the two counts any more.
    """
    return tuple(_joint_intervals(trace, ego, other))


def _joint_intervals(trace: Trace, ego: str, other: str) -> Iterator[tuple[slice, Trace]]:
    columns = [trace.actors.index(name) for name in (ego, other)]
    present = trace.present[:, columns].all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int)))
    intervals = edges.reshape(-1, 2).tolist()
    for k, (first, last) in enumerate(intervals, 1):
        part = trace.select(slice(first, last), {ego: "ego", other: "co"})
        yield slice(first, last), part
        if k < len(intervals) and contact_index(part.actor("ego"), part.actor("co")) is not None:
            return
