"""Metrics in traffic: ego and each of the others in turn, the worst counts.

In recorded traffic road users come and go: where one is not there its states are NaN. A metric of two
road users is computed for every stretch of time in which both are there, as of the actors `ego` and `co`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sbt.errors import InputError
from sbt.metrics.cache import per_trace
from sbt.metrics.longitudinal import D_MIN, FAR, HORIZON, TTC_MIN, d_min, ttc_min
from sbt.metrics.signals import ACTOR_SIGNALS, PAIR_SIGNALS, signal
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["in_traffic", "stretches", "without_verdict", "worst_signal"]

_WITHOUT = {
    "gap": FAR, "ttc": HORIZON, "thw": HORIZON, "mttc": HORIZON, "ttc2d": HORIZON, "distance": FAR,
    "rss_longitudinal": FAR, "rss_lateral": FAR, "drac": 0.0, "mdrac": 0.0, "btn": 0.0,
}  # fmt: skip
"""Signals of two of which one knows what is worst, with their value where nobody is there."""
_HIGH = ("drac", "mdrac", "btn")


@per_trace
def stretches(trace: Trace, ego: str, other: str) -> tuple[tuple[slice, Trace], ...]:
    """Return the instants and the trace (actors `ego` and `co`) of every stretch in which both are there.

    A single instant is no stretch, unless the trace has no other. Kept, as all metrics of a run want the same.
    """
    return tuple(_stretches(trace, ego, other))


def _stretches(trace: Trace, ego: str, other: str) -> Iterator[tuple[slice, Trace]]:
    at = [trace.actors.index(name) for name in (ego, other)]
    there = trace.present[:, at].all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    for first, last in edges.reshape(-1, 2).tolist():
        if last - first > 1 or len(trace.time) == 1:
            i = slice(first, last)
            yield i, _part(trace, i, at)


def _part(trace: Trace, i: slice, at: list[int]) -> Trace:
    """Return some instants of one or two actors, called ego and co."""
    return Trace(
        trace.time[i], ("ego", "co")[: len(at)], trace.x[i][:, at], trace.y[i][:, at], trace.heading[i][:, at],
        trace.speed[i][:, at], trace.acceleration[i][:, at], trace.length[at], trace.width[at], trace.ended,
    )  # fmt: skip


def in_traffic(metric: Metric, ego: str, other: str | None = None, name: str = "") -> Metric:
    """Return a metric of `ego` and `co` as one of an ego among others.

    Args:
        metric: of the actors `ego` and `co`, or of ego alone.
        ego: its name in the traces.
        other: the one that counts; None: all of them, the worst.
        name: of the new metric; "" as before.

    Returns:
        A metric that is `without` where nobody is there. It raises a `RunError` where `other` never is.
    """

    def function(trace: Trace) -> float:
        if metric.alone:
            return metric.function(_part(trace, slice(None), [trace.actors.index(ego)]))
        if other is not None:
            trace.actor(other)
        values = [
            metric.function(part)
            for one in trace.actors
            if one != ego and other in (None, one)
            for _, part in stretches(trace, ego, one)
        ]
        worst = max if metric.direction == "high" else min
        return worst(values, default=metric.without)

    return replace(metric, name=name or metric.name, function=function)


def without_verdict(metric: Metric) -> Metric:
    """Return an installed metric as one that does not judge overtaking, which is no verdict in traffic."""
    if metric is TTC_MIN:
        return ttc_min(passed=HORIZON)
    return d_min(passed=FAR) if metric is D_MIN else metric


def worst_signal(trace: Trace, name: str, ego: str, margin: float = 0.0) -> Vector:
    """Return a named signal of an ego in traffic: bare ones of two are the worst over all others at every instant.

    Args:
        trace: t instants.
        name: as of `sbt.metrics.signals.signal`; `NAME.gap` is of ego and NAME.
        ego: its name in the trace.
        margin: lateral clearance below which another is in ego's path (m).

    Returns:
        (t,) numbers; NaN for an actor's own signal while it is not there.

    Raises:
        InputError: a bare signal of two of which one cannot say what is worst.
        RunError: there is no such actor in the trace.
    """
    actor, _, what = name.rpartition(".")
    if name == "time" or what in ACTOR_SIGNALS:
        return signal(trace, name, ego)
    if what not in _WITHOUT and not actor:
        raise InputError(f"in traffic '{what}' needs a road user, such as lead.{what}; bare ones are {', '.join(_WITHOUT)}")
    if actor:
        trace.actor(actor)
    worst: Callable[[Vector, Vector], Vector] = np.maximum if what in _HIGH else np.minimum
    result = np.full(len(trace.time), _WITHOUT.get(what, np.nan))
    for other in [actor] if actor else [a for a in trace.actors if a != ego]:
        for i, part in stretches(trace, ego, other):
            values = PAIR_SIGNALS[what](part, "ego", "co", margin)
            result[i] = worst(result[i], values) if what in _WITHOUT else values
    return result
