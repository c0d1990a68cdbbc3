"""The worst moment of a run by a metric, and with whom: what a film of the run must show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sbt.errors import RunError
from sbt.metrics.moments import first_at_its_worst
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["worst_moment"]


def worst_moment(trace: Trace, metric: Metric) -> tuple[int, int | None]:
    """Return the instant from which on the metric has its value, and the actor to whom it is due.

    Without an interaction it is the moment at which somebody is nearest to ego; nobody (None) where ego is alone.
    """
    distance = np.hypot(trace.x[:, 1:] - trace.x[:, :1], trace.y[:, 1:] - trace.y[:, :1])  # (t, m - 1)
    met = [j for j in range(1, len(trace.actors)) if np.isfinite(distance[:, j - 1]).any()]
    moment = first_at_its_worst(trace, metric)
    if not met:
        return moment or 0, None
    if moment is None:
        moment = int(np.nanargmin(np.nanmin(np.where(np.isnan(distance), np.inf, distance), axis=1)))
    there = [j for j in met if np.isfinite(distance[moment, j - 1])] or met
    due = there if metric.alone else _due_to(trace, metric, there)
    return moment, min(due, key=lambda j: (np.nan_to_num(distance[moment, j - 1], nan=np.inf), j))


def _due_to(trace: Trace, metric: Metric, among: Sequence[int]) -> Sequence[int]:
    """Return the actors with whom alone the metric is as bad as with all; all of them where that cannot be told."""
    if len(among) == 1:
        return among
    values: dict[int, float] = {}
    for j in among:
        pair = trace.select(slice(None), {name: name for name in (trace.actors[0], trace.actors[j])})
        try:
            values[j] = metric(replace(pair, signals=trace.signals))
        except RunError:  # a metric of somebody else
            continue
    if not values:
        return among
    worst = min(values.values()) if metric.direction == "low" else max(values.values())
    return [j for j, value in values.items() if value == worst]
