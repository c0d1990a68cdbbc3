"""Metrics of a scenario file: installed ones in traffic, one's own, and formulas."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sbt.config.scenario_model import MetricEntry
from sbt.errors import InputError
from sbt.metrics.pairwise import in_traffic
from sbt.metrics.stl import stl
from sbt.plugins import load
from sbt.problem.metric import Metric
from sbt.problem.plain import Json
from sbt.problem.trace import Trace

__all__ = ["actors_of", "metric_of", "metrics_of_several"]


def metric_of(entry: MetricEntry, folder: Path, ego: str) -> Metric:
    """Return the metric of an entry.

    An installed one is that of ego and each other (or `other`) in turn, the worst counts. One of the user's
    own files gets the whole trace, whose first actor is the ego.

    Raises:
        InputError: there is no such metric, it does not take the settings, or the formula is none.
    """
    if entry.stl is not None:
        settings = {"margin": 0.0, **entry.settings}
        if set(settings) != {"margin"} or isinstance(settings["margin"], bool) or not isinstance(settings["margin"], int | float):
            raise InputError(f"a formula has the keys stl, name, other and margin (m), but got {', '.join(entry.settings)}")
        return stl(entry.stl, entry.name or "stl", ego, entry.other, float(settings["margin"]))
    if entry.kind is None:
        raise InputError("a metric needs a kind or a formula (stl), but has neither")
    metric = _made(load("metrics", entry.kind, folder), entry.kind, entry.settings)
    if ".py:" in entry.kind:
        if entry.other is not None:
            raise InputError(f"other is for installed metrics, but '{entry.kind}' gets the whole trace")
        return Metric(**{**vars(metric), "name": entry.name or metric.name})
    return in_traffic(metric, ego, entry.other, entry.name or "")


def _made(found: Any, kind: str, settings: Json) -> Metric:
    """Return the metric that settings make of an installed one: by the function of its name in its module."""
    factory: Callable[..., Any] | None = found
    if isinstance(found, Metric):
        factory = getattr(sys.modules.get(found.function.__module__), found.name, None)
        if "passed" in _takes(factory):  # overtaking is no verdict in traffic
            settings = {"passed": found.without, **settings}
        if not settings:
            return found
    try:
        made = factory(**settings) if factory is not None and callable(factory) else None
    except TypeError as error:
        known = ", ".join(name for name in _takes(factory) if name not in ("ego", "other")) or "none"
        raise InputError(f"settings of {kind} must be among {known}, but got {', '.join(settings)} ({error})") from None
    if not isinstance(made, Metric):
        raise InputError(f"a metric must be a Metric, or a function of its settings that returns one, but '{kind}' is not")
    return made


def _takes(factory: Any) -> tuple[str, ...]:
    return tuple(inspect.signature(factory).parameters) if callable(factory) else ()


def actors_of(entry: MetricEntry) -> Iterator[str]:
    """Yield the ids that a metric needs: its `other`, and those that its formula names."""
    from sbt.metrics.stl_grammar import Binary, Signal, Unary, parse

    if entry.other is not None:
        yield entry.other
    terms: list[Any] = [] if entry.stl is None else [parse(entry.stl, lambda _: None)]
    while terms:
        match terms.pop():
            case Signal(name):
                if "." in name:
                    yield name.rpartition(".")[0]
            case Unary(_, of):
                terms.append(of)
            case Binary(_, left, right):
                terms += [left, right]


def metrics_of_several(of_each: Mapping[str, Metric]) -> tuple[Metric, ...]:
    """Return a metric over several vehicles under test, the worst counts, and that of each as `NAME_ID`.

    Args:
        of_each: the same metric of each vehicle, by its id.
    """
    first = next(iter(of_each.values()))
    each = {ego: replace(metric, name=f"{first.name}_{ego}", function=partial(_while_present, metric, ego))
            for ego, metric in of_each.items()}  # fmt: skip
    worst = max if first.direction == "high" else min
    return (replace(first, function=lambda trace: worst(metric.value(trace) for metric in each.values())), *each.values())


def _while_present(metric: Metric, ego: str, trace: Trace) -> float:
    """Return the metric from the arrival of its vehicle on the road to its end; `without` where it never was there."""
    trace = trace.seen_by(ego)
    at = np.flatnonzero(trace.present[:, trace.actors.index(ego)]) if ego in trace.actors else np.empty(0, dtype=int)
    return metric.value(trace.select(slice(int(at[0]), int(at[-1]) + 1))) if len(at) else metric.without
