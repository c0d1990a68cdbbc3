"""A requirement: a safety metric and the closed interval of values that violate it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Protocol

import numpy as np

from sbt.errors import InputError, must_be
from sbt.problem.arrays import FARTHEST, Mask, Vector

__all__ = ["CriticalInterval", "Measured", "Requirement", "as_passed", "as_reached", "within_scale", "without_placeholders"]


_BEYOND = 0.1  # of the range of finite values: far enough to be told from them, near enough to leave them their scale
_PLACEHOLDERS, _OTHERS = 2, 3
"""Fewest runs with the value that stands for none, and fewest different values beside it."""
_FAR_ALONE = 10.0
"""Ranges of the other values that it is away, at least, where it alone is critical."""


class Measured(Protocol):
    """Runs whose metrics are known by name, such as a history."""

    def y(self, metric: str) -> Vector:
        """Return (n,) values of a metric, NaN where a run has none."""
        ...


@dataclass(frozen=True)
class CriticalInterval:
    """M_c = [low, high], closed; either end may be infinite.

    Raises:
        InputError: not low <= high, a NaN, or both ends infinite.

    Source:
        Winkelmann et al. (2022), section V-A.

    >>> CriticalInterval(-5.0, 0.5).contains(np.array([-6.0, -5.0, 0.5, 0.6])).tolist()
    [False, True, True, False]
    """

    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        for end in (self.low, self.high):
            must_be("an end of a critical interval must be a number", end, Real)
        if not self.low <= self.high:
            raise InputError(f"a critical interval needs low <= high, but got [{self.low}, {self.high}]")
        if math.isinf(self.low) and math.isinf(self.high):
            raise InputError(f"a critical interval needs at least one finite end, but got [{self.low}, {self.high}]")
        if any(math.isfinite(end) and abs(end) > FARTHEST for end in (self.low, self.high)):
            rule = f"finite ends of a critical interval must be within {FARTHEST:g} (an end may be infinite)"
            raise InputError(f"{rule}, but got [{self.low}, {self.high}]")

    @property
    def one_sided(self) -> bool:
        """Whether one end alone is finite."""
        return math.isfinite(self.low) != math.isfinite(self.high)

    @property
    def edge(self) -> float:
        """The finite end; of two, the upper one."""
        return self.high if math.isfinite(self.high) else self.low

    @property
    def outward(self) -> float:
        """Direction in which values beyond `edge` are uncritical: 1 or -1."""
        return 1.0 if math.isfinite(self.high) else -1.0

    def known(self, y: Vector) -> Mask:
        """Return (n,) booleans: y tells whether the run is critical, and how far from it."""
        return np.isfinite(y)

    def contains(self, y: Vector) -> Mask:
        """Return (n,) booleans: y in M_c. NaN is not contained."""
        return (np.asarray(y) >= self.low) & (np.asarray(y) <= self.high)

    def margin(self, y: Vector) -> Vector:
        """Return (n,) the signed distance of y to M_c, <= 0 where critical, in the unit of y; NaN stays NaN.

        An infinite y beyond an open end is infinitely deep.
        """
        y = np.asarray(y, dtype=np.float64)
        nowhere = np.where(np.isnan(y), np.nan, -np.inf)
        below = self.low - y if math.isfinite(self.low) else nowhere
        return np.maximum(below, y - self.high if math.isfinite(self.high) else nowhere)


def as_reached(critical: CriticalInterval, y: Vector) -> CriticalInterval:
    """Return M_c without the end that the metric ends at: some y (n,) has its very value, and none lies beyond.

    "A time to collision of 0 to 1.5 s" is "at most 1.5 s" then, and "a collision flag of 1" is "at least 1": what is predicted
    beyond 0, or 1, is no other value.

    >>> as_reached(CriticalInterval(0.0, 1.5), np.array([0.0, 0.0, 0.7, 4.0]))
    CriticalInterval(low=-inf, high=1.5)
    >>> as_reached(CriticalInterval(0.0, 1.5), np.array([-1.0, 0.0, 0.0, 4.0]))
    CriticalInterval(low=0.0, high=1.5)
    """
    if not (math.isfinite(critical.low) and math.isfinite(critical.high)):
        return critical
    ends_low = (y == critical.low).any() and not (y < critical.low).any()
    ends_high = (y == critical.high).any() and not (y > critical.high).any()
    if ends_low == ends_high:
        return critical
    return CriticalInterval(high=critical.high) if ends_low else CriticalInterval(low=critical.low)


def as_passed(critical: CriticalInterval, y: Vector) -> CriticalInterval:
    """Return M_c without an end that no y (n,) lies beyond, where some lie beyond the other; else `as_reached`.

    A "speed of impact of 0.1 to 100 m/s" is "at least 0.1 m/s" as long as there is no faster one.

    >>> as_passed(CriticalInterval(0.1, 100.0), np.array([0.0, 0.0, 7.0, 31.0]))
    CriticalInterval(low=0.1, high=inf)
    """
    if not (math.isfinite(critical.low) and math.isfinite(critical.high)):
        return critical
    below, above = bool((y < critical.low).any()), bool((y > critical.high).any())
    if below == above:
        return as_reached(critical, y)
    return CriticalInterval(low=critical.low) if below else CriticalInterval(high=critical.high)


def without_placeholders(y: Vector, critical: CriticalInterval) -> Vector:
    """Return metrics in which the value that stands for none is infinite, such as a time to collision of 999 s where none comes.

    It is the largest or the smallest one of two runs or more, farther from all other values and the ends of M_c than these are
    from each other; three others must differ, or all be on its side of M_c: a flag has two values. What every
    critical run has, and no other, may be what a collision counts: it is one only if it is ten times as far.

    >>> without_placeholders(np.array([0.4, 2.0, 3.1, 999.0, 999.0]), CriticalInterval(high=1.5)).tolist()
    [0.4, 2.0, 3.1, inf, inf]
    """
    for sign in (1.0, -1.0):
        known = sign * y[np.isfinite(y)]
        last = known.max(initial=-np.inf)
        others, ends = known[known < last], sign * np.array([end for end in (critical.low, critical.high) if math.isfinite(end)])
        few = len(np.unique(others)) < _OTHERS and not (len(others) and others.min() > ends.max())
        if len(known) - len(others) < _PLACEHOLDERS or few:
            continue
        scale = np.concatenate([others, ends])
        alone = critical.contains(np.array([sign * last]))[0] and not critical.contains(sign * others).any()
        if last - scale.max() > (_FAR_ALONE if alone else 1.0) * np.ptp(scale):
            y = np.where(sign * y == last, sign * np.inf, y)
    return y


def within_scale(y: Vector, critical: CriticalInterval) -> Vector:
    """Return (n,) metrics with inf and -inf a tenth of the range beyond all that is finite, values and ends of M_c.

    A metric without a value, such as the time to a collision that never comes, lies at an end of its scale: a run of which
    something is known. Which runs are critical does not change.

    >>> within_scale(np.array([1.0, 3.0, np.inf, np.nan]), CriticalInterval(high=2.0)).tolist()
    [1.0, 3.0, 3.2, nan]
    """
    if not np.isinf(y).any():
        return y
    known = np.array([*y[np.isfinite(y)], *(end for end in (critical.low, critical.high) if math.isfinite(end))])
    low, high = float(known.min()), float(known.max())
    room = _BEYOND * (high - low) or 1.0
    return np.where(np.isposinf(y), high + room, np.where(np.isneginf(y), low - room, y))


@dataclass(frozen=True)
class Requirement:
    """The name of a safety metric and the closed interval of its values that violate the requirement.

    Args:
        metric: name of the safety metric.
        low, high: ends of the critical interval, in the unit of the metric; one of them may be infinite.
        name: what it is called beside others; "": as the metric.

    Raises:
        InputError: no critical interval.

    >>> Requirement("ttc_min", high=1.0).is_critical({"ttc_min": 0.4})
    True
    """

    metric: str
    low: float = -math.inf
    high: float = math.inf
    name: str = ""

    def __post_init__(self) -> None:
        must_be("a requirement's metric must be text", self.metric, str)
        for name in ("low", "high"):
            value = getattr(self, name)
            must_be(f"a requirement's {name} must be a number", value, Real)
            object.__setattr__(self, name, float(value))
        CriticalInterval(self.low, self.high)

    @cached_property
    def critical(self) -> CriticalInterval:
        """The critical interval M_c."""
        return CriticalInterval(self.low, self.high)

    @property
    def label(self) -> str:
        """What it is called: its name, or else its metric."""
        return self.name or self.metric

    @property
    def parts(self) -> tuple[Requirement, ...]:
        """The requirements on one metric that it is made of: itself."""
        return (self,)

    @property
    def combined(self) -> bool:
        """Whether it is made of several."""
        return False

    def values(self, runs: Measured) -> Vector:
        """Return what is learned of runs: (n,) the metric, NaN for a run without it; (n, q) of a combination of q.

        Infinities, and values that stand for none, are ends of the scale: see `within_scale`, `without_placeholders`.
        """
        return within_scale(without_placeholders(runs.y(self.metric), self.critical), self.critical)

    def told(self, runs: Measured) -> Vector:
        """Return (n,) the one number that a run is told by: the metric, of a combination its margin; NaN where there is none."""
        return runs.y(self.metric)

    @property
    def told_as(self) -> str:
        """What the number of `told` is called."""
        return self.metric

    def told_of(self, metrics: Mapping[str, float]) -> float:
        """Return the number that one run is told by; of a combination its margin, every metric in its own unit."""
        return metrics[self.metric]

    def violated(self, metrics: Mapping[str, float]) -> tuple[str, ...]:
        """Return the names of the requirements on one metric that the metrics of one run violate."""
        return tuple(part.label for part in self.parts if part.is_critical(metrics))

    def critical_runs(self, runs: Measured) -> Mask:
        """Return (n,) booleans: the run violates the requirement; False for a run without the metric."""
        return self.critical.contains(self.values(runs))

    def margins(self, runs: Measured) -> Vector:
        """Return (n,) signed distances to M_c, <= 0 where critical; NaN for a run without the metric."""
        return self.critical.margin(self.values(runs))

    def in_units_of(self, runs: Measured) -> Requirement:
        """Return the requirement whose margins, of whatever runs, are in the units that those of these runs have."""
        del runs  # the unit of the metric
        return self

    def depths(self, runs: Measured) -> Vector:
        """Return (n,) margins by which runs are ranked: an end of M_c that no run lies beyond does not count (`as_passed`)."""
        y = self.values(runs)
        return as_passed(self.critical, y).margin(y)

    def is_critical(self, metrics: Mapping[str, float]) -> bool:
        """Return whether the metrics of one run violate the requirement."""
        return self.low <= metrics[self.metric] <= self.high
