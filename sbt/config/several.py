"""From the keys `any` and `all` of a requirement to the requirement that they describe."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sbt.config.requirement_model import RequirementChange, RequirementItem
from sbt.config.source import Problems, must_be_measured
from sbt.problem.combination import CombinedRequirement
from sbt.problem.requirement import Requirement

__all__ = ["combined_requirement"]


def combined_requirement(
    change: RequirementChange, measured: Sequence[str], own: Requirement | None, problems: Problems
) -> CombinedRequirement | None:
    """Return the requirement that `any` or `all` describes; None where there are problems, which are added.

    Args:
        change: the keys of `requirement`.
        measured: metrics that every run gives.
        own: the scenario's own requirement, whose interval a metric may keep; None: there is none yet.
        problems: where what is wrong is collected.
    """
    intervals = {} if own is None else {part.metric: (part.low, part.high) for part in own.parts}
    before = len(problems.found)
    made = _combined(change, "", ("requirement",), measured, intervals, problems)
    return made if len(problems.found) == before else None


def _combined(
    change: RequirementChange, name: str, path: tuple[str | int, ...], measured: Sequence[str],
    intervals: dict[str, tuple[float, float]], problems: Problems,
) -> CombinedRequirement | None:  # fmt: skip
    if change.combined is None:
        return None
    how, items = change.combined
    made = [_item(item, (*path, how, k), measured, intervals, problems) for k, item in enumerate(items)]
    known = tuple(item for item in made if item is not None)
    if len(known) < len(made):
        return None
    return problems.attempt((*path, how), lambda: CombinedRequirement(how=how, items=known, name=name))


def _item(
    item: RequirementItem, path: tuple[str | int, ...], measured: Sequence[str], intervals: dict[str, tuple[float, float]],
    problems: Problems,
) -> Requirement | None:  # fmt: skip
    """Return one of several requirements; None where there is a problem, which is added."""
    name = item.name or ""
    if item.combined is not None:
        return _combined(item, name, path, measured, intervals, problems)
    if item.stl is not None:
        if (name or "stl") not in measured:  # the formula is wrong, which has been said
            return None
        return Requirement(name or "stl", *(item.critical or (-math.inf, 0.0)))
    if item.metric is None:
        problems.add(path, "one of several requirements must have a metric, a formula (stl), any or all, but has none")
        return None
    if item.metric not in measured:
        problems.add((*path, "metric"), must_be_measured(item.metric, measured))
        return None
    interval = item.critical or intervals.get(item.metric)
    if interval is None:
        problems.add(path, f"critical: [low, high] is required with the metric {item.metric}")
        return None
    return Requirement(item.metric, *interval, name=name)
