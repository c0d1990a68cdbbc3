"""Pairwise metrics and signals in traffic: computed for the ego and every other road user, of which the worst counts.

In recorded traffic road users come and go, and their states are NaN while they are absent. A pairwise metric is
computed on every interval of time in which both road users are present, as the actors `ego` and `co`; one that compares
different times, such as the post-encroachment time, on all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sbt.errors import InputError
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import D_MIN, FAR, HORIZON, TTC_MIN, d_min, ttc_min
from sbt.metrics.signals import ACTOR_SIGNALS, PAIR_SIGNALS, signal
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["in_traffic", "without_overtaking", "worst_signal"]

_ABSENT = {
    "gap": FAR, "ttc": HORIZON, "thw": HORIZON, "mttc": HORIZON, "ttc2d": HORIZON, "distance": FAR,
    "rss_longitudinal": FAR, "rss_lateral": FAR, "drac": 0.0, "mdrac": 0.0, "btn": 0.0,
}  # fmt: skip
"""Pairwise signals that can be compared between road users, with their value while nobody else is present."""
_HIGH_IS_WORST = ("drac", "mdrac", "btn")


def in_traffic(metric: Metric, ego: str, other: str | None = None, name: str = "") -> Metric:
    """Return a metric of `ego` and `co` as a metric of an ego in traffic.

    Args:
        metric: of the actors `ego` and `co`, or of the ego alone.
        ego: its name in the traces.
        other: the road user to be considered; None: all others, of which the worst counts.
        name: of the new metric; "": that of the given one.

    Returns:
        A metric whose value is `without` while nobody else is present. It raises a `RunError` if a named
        `other` is not in the trace.
    """

    def function(trace: Trace) -> float:
        if metric.alone:
            return metric.value(trace.select(slice(None), {ego: "ego"}))
        if other is not None:
            trace.actor(other)
        values = [
            metric.value(part)
            for actor in trace.actors
            if actor != ego and other in (None, actor)
            for part in _parts(metric, trace, ego, actor)
        ]
        worst = max if metric.direction == "high" else min
        return worst(values, default=metric.without)

    times = None if metric.over_time is None else partial(_over_time, metric, metric.over_time, ego, other)
    return replace(metric, name=name or metric.name, function=function, over_time=times)


def _parts(metric: Metric, trace: Trace, ego: str, other: str) -> list[Trace]:
    """Return the traces of ego and another, `co`, of which a metric is to be computed."""
    if metric.lagged:
        return [trace.select(slice(None), {ego: "ego", other: "co"})]
    return [part for _, part in joint_intervals(trace, ego, other)]


def _over_time(metric: Metric, of_pair: Callable[[Trace], Vector], ego: str, other: str | None, trace: Trace) -> Vector:
    """Return the (t,) values of a metric over time in traffic: the worst of those who are there."""
    if metric.alone:
        return of_pair(trace.select(slice(None), {ego: "ego"}))
    worst = np.maximum if metric.direction == "high" else np.minimum
    values = np.full(len(trace.time), metric.without)
    for actor in trace.actors:
        if actor != ego and other in (None, actor):
            for instants, part in joint_intervals(trace, ego, actor):
                values[instants] = worst(values[instants], of_pair(part))
    return values


def without_overtaking(metric: Metric) -> Metric:
    """Return an installed metric; `ttc_min` and `d_min` in the variant that reports no interaction for an overtaking ego.

    In a test, having overtaken before the other enters the path is a result of its own; in traffic it is not.
    """
    if metric is TTC_MIN:
        return ttc_min(passed=HORIZON)
    return d_min(passed=FAR) if metric is D_MIN else metric


def worst_signal(trace: Trace, name: str, ego: str, margin: float = 0.0) -> Vector:
    """Return a named signal of an ego in traffic; a pairwise signal without an actor is the worst over all others.

    Args:
        trace: t instants.
        name: as in `sbt.metrics.signals.signal`; `NAME.gap` refers to the ego and the actor NAME.
        ego: its name in the trace.
        margin: lateral clearance below which another road user is in the ego's path (m).

    Returns:
        (t,) numbers; NaN for a signal of a single actor while it is absent.

    Raises:
        InputError: a pairwise signal without an actor cannot be compared between road users.
        RunError: there is no such actor in the trace.
    """
    actor, _, what = name.rpartition(".")
    if name == "time" or what in ACTOR_SIGNALS:
        return signal(trace, name, ego)
    if what not in _ABSENT and not actor:
        raise InputError(f"in traffic '{what}' needs a road user, such as lead.{what}; bare ones are {', '.join(_ABSENT)}")
    if actor:
        trace.actor(actor)
    worst: Callable[[Vector, Vector], Vector] = np.maximum if what in _HIGH_IS_WORST else np.minimum
    result = np.full(len(trace.time), _ABSENT.get(what, np.nan))
    for other in [actor] if actor else [a for a in trace.actors if a != ego]:
        for instants, part in joint_intervals(trace, ego, other):
            values = PAIR_SIGNALS[what](part, "ego", "co", margin)
            result[instants] = worst(result[instants], values) if what in _ABSENT else values
    return result
