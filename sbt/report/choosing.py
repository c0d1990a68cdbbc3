"""Which runs of a campaign a report shows as films, and why."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.modes import worst_first
from sbt.problem.space import ParameterSpace
from sbt.report.words import Findings

__all__ = ["runs_to_film"]

_MOST = 24
_SECONDS = 20.0
"""Films are made while the runs took at most so long together when they were recorded (s): the same log, the same films."""
_NEIGHBOURS = 3
"""Without failure modes, the nearest safe run of so many critical ones is shown."""


def runs_to_film(found: Findings, space: ParameterSpace, *, most: int = _MOST, seconds: float = _SECONDS) -> dict[int, str]:
    """Return the indices of runs worth a film, each with the reason, in the order of their worth.

    Every failure mode with its nearest safe neighbour, the uncritical run closest to the limit, then critical runs, worst first;
    of repetitions with the same inputs the first.
    """
    history, ok = found.history, found.history.ok
    chosen: dict[int, str] = {}
    shown: set[bytes] = set()
    for run, role in _ranked(found, space):
        if len(chosen) >= most:
            break
        row = int(np.searchsorted(history.index, run))
        inputs, took = history.x[row].tobytes(), float(history.seconds[row])
        if ok[row] and inputs not in shown and took <= seconds:
            seconds -= took
            chosen[run] = role
            shown.add(inputs)
    return chosen


def _ranked(found: Findings, space: ParameterSpace) -> Iterator[tuple[int, str]]:
    history, requirement = found.history, found.requirement
    modes = found.conclusion.failure_modes if isinstance(found.conclusion, FalsificationConclusion) else ()
    for k, mode in enumerate(modes, 1):
        yield mode.representative, f"failure mode {k}"
        if mode.nearest_safe is not None:
            yield mode.nearest_safe.run, f"nearest safe run to failure mode {k}"
    if not history.ok.any():
        return
    critical, margin = found.critical, np.where(history.ok, requirement.depths(history), np.inf)
    order = worst_first(history, margin)
    worst = order[critical[order]]
    safe = np.flatnonzero(history.ok & ~critical)
    if not modes and len(worst):
        yield int(history.index[worst[0]]), "most critical run"
    if len(safe):
        nearest = safe[np.argmin(margin[safe])]
        yield int(history.index[nearest]), "uncritical run closest to the limit"
    if not modes and len(safe):
        u = np.clip(space.to_unit(history.x), 0.0, 1.0)
        for row in worst[:_NEIGHBOURS]:
            neighbour = safe[np.argmin(((u[safe] - u[row]) ** 2).sum(axis=1))]
            yield int(history.index[row]), "critical run"
            yield int(history.index[neighbour]), f"nearest safe run to run {history.index[row]}"
    for row in worst:
        yield int(history.index[row]), "critical run"
    for row in safe[np.argsort(margin[safe], kind="stable")][:4]:
        yield int(history.index[row]), "uncritical run close to the limit"
