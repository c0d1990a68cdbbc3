"""Stretches of time in which two road users are both there, as traces of their own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.problem.trace import Trace

__all__ = ["joint_intervals"]


@per_trace
def joint_intervals(trace: Trace, ego: str, other: str) -> tuple[tuple[slice, Trace], ...]:
    """Return the instants and the trace (actors `ego` and `co`) of every interval in which both are present.

    An interval may be a single instant. Where one of them goes on while the other is gone is its way (`Trace.ways`).
    """
    return tuple(_joint_intervals(trace, ego, other))


def _joint_intervals(trace: Trace, ego: str, other: str) -> Iterator[tuple[slice, Trace]]:
    columns = [trace.actors.index(name) for name in (ego, other)]
    present = trace.present[:, columns].all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]]).astype(int)))
    for first, last in edges.reshape(-1, 2).tolist():
        yield slice(first, last), trace.select(slice(first, last), {ego: "ego", other: "co"})
