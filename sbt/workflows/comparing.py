"""The times to collision that a scenario could require, side by side on runs of it: which of them invents conflicts there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from sbt.errors import RunError
from sbt.metrics.closeness import Worst, worst_pair
from sbt.metrics.longitudinal import HORIZON, ttc_min
from sbt.metrics.planar import TTC_2D_MIN
from sbt.metrics.traffic import TTC_PATH_MIN
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace

__all__ = ["compared_times"]

_CANDIDATES = (TTC_PATH_MIN, TTC_2D_MIN, ttc_min(passed=HORIZON))
_RUNS = 9
"""Runs that are compared at most."""
_USUAL = 1.0
"""Time below which a run is counted where the requirement is about something else (s)."""


def compared_times(scenario: LogicalScenario, jobs: Sequence[tuple[Values, int]]) -> Iterator[tuple[str, str]]:
    """Yield, for each candidate, its name and how many runs it calls critical, and how many of these by roads that never meet.

    Only where the ego is in traffic: in scenarios with a named opponent the metrics are chosen for it.
    """
    if scenario.simulate is None or scenario.roles.other is not None:
        return
    traces = [trace for values, seed in jobs[:_RUNS] if (trace := _simulated(scenario, values, seed)) is not None]
    names = {metric.name for metric in _CANDIDATES}
    bounds = (part.high for part in scenario.requirement.parts if part.metric in names and math.isfinite(part.high))
    bound = next(bounds, _USUAL)
    for metric in _CANDIDATES if traces else ():
        worst = [worst_pair(trace, metric, scenario.roles.ego) for trace in traces]
        yield metric.name, _said(worst, bound)


def _simulated(scenario: LogicalScenario, values: Values, seed: int) -> Trace | None:
    try:
        return scenario.simulate(values, seed) if scenario.simulate is not None else None
    except RunError:
        return None


def _said(worst: Sequence[Worst], bound: float) -> str:
    least = min(worst, key=lambda one: one.value)
    below = [one for one in worst if one.value <= bound]
    apart = [one for one in below if one.clearance > 0]
    text = f"{len(below)} of {len(worst)} runs at most {bound:g} s"
    if least.other:
        text += f", least {least.value:.2g} s with '{least.other}'"
    if apart:
        example = max(apart, key=lambda one: one.clearance)
        text += (
            f"; {len(apart)} of these {len(below)} with somebody whose path never meets that of the ego (another road or lane):"
            f" '{example.other}' stays {example.clearance:.1f} m away from it"
        )
    return text
