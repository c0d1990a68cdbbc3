"""When a metric of a run took its value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["first_at_its_worst", "metric_so_far"]


def metric_so_far(trace: Trace, metric: Metric, instants: Sequence[int]) -> Vector:
    """Return the metric of the run up to each of these increasing instants, NaN where it has no value yet.

    A metric over the paths that were driven uses the whole paths at every instant. As a metric never recovers,
    nothing is computed between two instants of the same value.

    >>> import numpy as np
    >>> from sbt.problem.trace import Trace
    >>> x = np.array([[0.0], [3.0], [1.0]])
    >>> run = Trace(np.arange(3.0), ("ego",), x, x, x, x, x, np.ones(1), np.ones(1))
    >>> metric_so_far(run, Metric("furthest", lambda t: float(t.x.max())), [0, 1, 2]).tolist()
    [0.0, 3.0, 3.0]
    """
    if metric.over_time is not None:
        worst = np.minimum if metric.direction == "low" else np.maximum
        return np.asarray(worst.accumulate(metric.over_time(trace))[list(instants)])
    values = np.full(len(instants), np.nan)
    ends = sorted({0, len(instants) - 1})
    values[ends] = [_until(trace, metric, instants[k]) for k in ends]
    spans = [(ends[0], ends[-1])]
    while spans:
        first, last = spans.pop()
        if values[first] == values[last]:
            values[first:last] = values[last]
        elif last - first > 1:
            middle = (first + last) // 2
            values[middle] = _until(trace, metric, instants[middle])
            spans += [(first, middle), (middle, last)]
    return values


def _until(trace: Trace, metric: Metric, k: int) -> float:
    """Return the metric of the trace up to instant k, NaN if it has none."""
    try:
        return metric(trace.select(slice(0, k + 1)))
    except Exception:  # too short for a metric of one's own
        return float("nan")


def first_at_its_worst(trace: Trace, metric: Metric) -> int | None:
    """Return the first instant at which the metric so far is that of the run; None where it is so from the beginning.

    Found by bisection, as a metric never recovers.
    """
    last = len(trace.time) - 1
    if metric.over_time is not None:
        values = metric_so_far(trace, metric, range(last + 1))
        reached = int(np.argmax(values == values[-1]))
        return reached if reached > 0 else None
    final = _until(trace, metric, last)
    before, reached = -1, last
    while reached - before > 1:
        middle = (before + reached) // 2
        before, reached = (before, middle) if _until(trace, metric, middle) == final else (middle, reached)
    return reached if reached > 0 else None
