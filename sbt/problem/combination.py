"""Several requirements in one: violated where any of them is, or where all are.

A run is told by its margin, as of a formula of signal temporal logic: the least margin of `any`, the largest of `all`,
each in units of what is usual for its metric, so that seconds and metres compare. Critical is a margin <= 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any, TypeVar

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval, Measured, Requirement

__all__ = ["KINDS", "MARGIN", "CombinedInterval", "CombinedRequirement", "all_of", "any_of", "from_plain", "to_plain"]

KINDS = ("any", "all")
"""Ways to combine: violated where any of the requirements is, or where all are."""

MARGIN = CriticalInterval(high=0.0)
"""Where the margin of a combination is critical."""

T = TypeVar("T")
_PILOT = 50  # first runs that say what is usual: further ones gather where a campaign looks, and must not move the scale
_USUAL = 0.25  # quantile of their distances to the edge, as of the warp of the search: most runs may lie far away


@dataclass(frozen=True)
class CombinedInterval(CriticalInterval):
    """M_c of several metrics: values (..., q) that are critical by any, or by all, of q parts; of the margin [-inf, 0].

    Args:
        how: one of `KINDS`.
        parts: intervals of one metric each, or combinations themselves.
        scale: (q,) > 0, the unit of each metric's margin; None: what is usual among the first 50 of the values.

    Raises:
        InputError: another kind, or no parts.

    Source:
        Donze and Maler (2010), Robust satisfaction of temporal logic over real-valued signals: minimum and maximum.

    >>> either = CombinedInterval(how="any", parts=(CriticalInterval(high=1.0), CriticalInterval(low=5.0)))
    >>> either.contains(np.array([[0.5, 0.0], [2.0, 6.0], [2.0, 0.0]])).tolist()
    [True, True, False]
    """

    low: float = -math.inf
    high: float = 0.0
    how: str = "any"
    parts: tuple[CriticalInterval, ...] = ()
    scale: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.how not in KINDS or not self.parts:
            raise InputError(f"requirements are combined by {' or '.join(KINDS)}, at least one, but got {self.how} {self.parts}")

    @cached_property
    def leaves(self) -> tuple[CriticalInterval, ...]:
        """(q,) the intervals of one metric each."""
        return tuple(leaf for part in self.parts for leaf in (part.leaves if isinstance(part, CombinedInterval) else (part,)))

    def fold(self, leaves: Sequence[T], any_of: Callable[[T, T], T], all_of: Callable[[T, T], T]) -> T:
        """Return what the leaves' values (q) come to, joined two by two by one function in `any` and by the other in `all`."""
        joined, start = [], 0
        for part in self.parts:
            if isinstance(part, CombinedInterval):
                n = len(part.leaves)
                joined.append(part.fold(leaves[start : start + n], any_of, all_of))
            else:
                n = 1
                joined.append(leaves[start])
            start += n
        return reduce(any_of if self.how == "any" else all_of, joined)

    def known(self, y: Vector) -> Mask:
        """Return (n,) booleans: the margin is known; one violated requirement of `any` says enough, and one met of `all`."""
        return np.isfinite(self.margin(y))

    def contains(self, y: Vector) -> Mask:
        """Return (n,) booleans: y (n, q) in M_c; an unknown value (NaN) is not contained."""
        inside = [leaf.contains(y[..., k]) for k, leaf in enumerate(self.leaves)]
        return self.fold(inside, np.logical_or, np.logical_and)

    def margin(self, y: Vector) -> Vector:
        """Return (n,) signed distances of y (n, q) to M_c in units of what is usual, <= 0 where critical; NaN where not known."""
        margins = self.leaf_margins(y) / np.asarray(self.scale or self.usual(y))
        return self.fold([margins[..., k] for k in range(margins.shape[-1])], _least, _largest)

    def leaf_margins(self, y: Points) -> Points:
        """Return (..., q) signed distances of y (..., q) to the interval of each metric, in the metric's unit."""
        return np.stack([leaf.margin(y[..., k]) for k, leaf in enumerate(self.leaves)], axis=-1)

    def usual(self, y: Points) -> tuple[float, ...]:
        """Return (q,) the distance to the edge of each interval that is usual among the first 50 of y (n, q); 1 without any."""
        distance = np.abs(self.leaf_margins(y[:_PILOT]))
        columns = [column[np.isfinite(column) & (column > 0)] for column in distance.T]
        return tuple(float(np.quantile(column, _USUAL)) if len(column) else 1.0 for column in columns)

    def with_leaves(self, leaves: Sequence[CriticalInterval], scale: Sequence[float]) -> CombinedInterval:
        """Return the same combination of other intervals, of margins in these units."""
        left = iter(leaves)

        def renewed(whole: CombinedInterval) -> CombinedInterval:
            parts = tuple(renewed(part) if isinstance(part, CombinedInterval) else next(left) for part in whole.parts)
            return CombinedInterval(how=whole.how, parts=parts)

        found = renewed(self)
        return CombinedInterval(how=found.how, parts=found.parts, scale=tuple(scale))


def _least(a: Vector, b: Vector) -> Vector:
    """Return the smaller margin; where one is not known, the other one if it is critical."""
    return np.where(np.isnan(a) | np.isnan(b), np.where(np.fmin(a, b) <= 0, np.fmin(a, b), np.nan), np.minimum(a, b))


def _largest(a: Vector, b: Vector) -> Vector:
    """Return the larger margin; where one is not known, the other one if it is uncritical."""
    return np.where(np.isnan(a) | np.isnan(b), np.where(np.fmax(a, b) > 0, np.fmax(a, b), np.nan), np.maximum(a, b))


@dataclass(frozen=True)
class CombinedRequirement(Requirement):
    """A requirement that is violated where any, or all, of several are.

    Args:
        metric: how it is written, such as `any(ttc_min, pet)`; given by the others.
        how: one of `KINDS`.
        items: requirements on one metric each, or combinations themselves.
        scale: (q,) units of the margins of the metrics; None: what is usual among the runs that are asked of.

    Raises:
        InputError: no items, one name or one metric twice.

    >>> either = any_of(Requirement("ttc", high=1.0), Requirement("speed", low=10.0, name="fast"))
    >>> either.is_critical({"ttc": 3.0, "speed": 12.0}), either.metric, either.violated({"ttc": 3.0, "speed": 12.0})
    (True, 'any(ttc, fast)', ('fast',))
    """

    metric: str = ""
    low: float = -math.inf
    high: float = 0.0
    name: str = ""
    how: str = "any"
    items: tuple[Requirement, ...] = ()
    scale: tuple[float, ...] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.how not in KINDS or not self.items:
            rule = f"requirements are combined by {' or '.join(KINDS)}, and there must be at least one"
            raise InputError(f"{rule}, but got {self.how} of {len(self.items)}")
        other = next((item for item in self.items if not isinstance(item, Requirement)), None)
        if other is not None:
            raise InputError(f"what is combined must be requirements, but got {other!r}")
        object.__setattr__(self, "metric", f"{self.how}({', '.join(item.label for item in self.items)})")
        for what, names in (("metric", [p.metric for p in self.parts]), ("name", [p.label for p in self.parts])):
            twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
            if twice is not None:
                why = "" if what == "name" else ": its P(critical) is that of metrics that are independent of each other"
                raise InputError(f"combined requirements must have different {what}s, but got '{twice}' twice{why}")

    @cached_property
    def critical(self) -> CombinedInterval:
        """The critical set M_c of the metrics together."""
        return CombinedInterval(how=self.how, parts=tuple(item.critical for item in self.items), scale=self.scale)

    def in_units_of(self, runs: Measured) -> CombinedRequirement:
        """Return the requirement whose margins, of whatever runs, are in the units that those of these runs have."""
        return replace(self, scale=self.critical.usual(self.values(runs)))

    @property
    def parts(self) -> tuple[Requirement, ...]:
        """(q,) the requirements on one metric that it is made of."""
        return tuple(part for item in self.items for part in item.parts)

    @property
    def combined(self) -> bool:
        """Whether it is made of several."""
        return True

    def values(self, runs: Measured) -> Points:
        """Return (n, q) the metrics of runs, NaN where a run has none."""
        return np.column_stack([part.values(runs) for part in self.parts])

    def told(self, runs: Measured) -> Vector:
        """Return (n,) margins of runs."""
        return self.margins(runs)

    def is_critical(self, metrics: Mapping[str, float]) -> bool:
        """Return whether the metrics of one run violate it."""
        judged = [item.is_critical(metrics) for item in self.items]
        return any(judged) if self.how == "any" else all(judged)

    @property
    def told_as(self) -> str:
        """What the number of `told` is called."""
        return f"margin of {self.metric}"

    def told_of(self, metrics: Mapping[str, float]) -> float:
        """Return the margin of one run, every metric in its own unit: <= 0 where it is critical."""
        plain = self.critical.with_leaves(self.critical.leaves, (1.0,) * len(self.parts))
        return float(plain.margin(np.array([metrics[part.metric] for part in self.parts])))


def any_of(*items: Requirement, name: str = "") -> CombinedRequirement:
    """Return the requirement that is violated where any of these is."""
    return CombinedRequirement(how="any", items=items, name=name)


def all_of(*items: Requirement, name: str = "") -> CombinedRequirement:
    """Return the requirement that is violated where all of these are."""
    return CombinedRequirement(how="all", items=items, name=name)


def from_plain(data: Mapping[str, Any]) -> Requirement:
    """Return a requirement from plain data: {metric, low, high, name}, or {any: [...]} or {all: [...]} of such."""
    name = str(data.get("name", ""))
    for how in KINDS:
        if how in data:
            return CombinedRequirement(how=how, items=tuple(from_plain(item) for item in data[how]), name=name)
    return Requirement(data["metric"], float(data["low"]), float(data["high"]), name)


def to_plain(requirement: Requirement) -> dict[str, Any]:
    """Return a requirement as JSON data, which `from_plain` reads; infinite ends are texts."""
    named = {"name": requirement.name} if requirement.name else {}
    if isinstance(requirement, CombinedRequirement):
        return {requirement.how: [to_plain(item) for item in requirement.items], **named}
    low, high = (v if math.isfinite(v) else str(v) for v in (requirement.low, requirement.high))
    return {"metric": requirement.metric, "low": low, "high": high, **named}
