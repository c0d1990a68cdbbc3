"""A monotone warp of the safety metric around the edge of the critical interval.

Searches fit their metamodel to the warped metric: near the edge nothing changes, far from it an
outlier of 1e6 is a few units away. P(y in M_c) is the same before and after, because the warp is
increasing and the ends of the interval are warped with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtr, stdtr

from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval

__all__ = ["JointWarp", "LogWarp", "Warp", "gap_of", "warp_around"]

_SPACINGS, _WIDE = 8, 8.0
"""Spacings between the values nearest to the edge on either side, and the fewest of them that a gap is as wide as: before the
root that a speed of impact ends with there are 3 to 6."""
_CROSSED = 1e-6
"""Of the scale on its side, what a gap that is left out measures: in it nothing is likely, but nothing impossible."""
_BOTH = 0.75
"""Quantile of the distances to the edge that is the scale where runs lie on both sides of M_c: as they gather at a narrow one a
smaller scale makes a step of the warp. A quarter may be outliers."""
_FARTHEST, _LEAST = 300.0, 1e-300
"""Warped units, beyond which values are no numbers any more; the standard deviation of what has none, as a divisor."""
_TAILS = 4.0
"""Degrees of freedom of the side in a variance: once in some thousand points a process is surer of a side than it is right, and
then a value is wrong by the height of the jump."""


@dataclass(frozen=True)
class Warp:
    """w = asinh((y - edge) / scale), on either side of the edge with its own scale; without the gap in which no value lies.

    Args:
        edge: end of the critical interval, in the unit of y.
        scale: > 0; within it the warp is nearly straight.
        above: > 0, the scale of values above the edge; None: the same.
        gap: distances >= 0 below and above the edge that are left out.
        reach: warped values <= 0 and >= 0 beyond which the warp is straight, as sinh makes much of little that a process swings.

    >>> warp = Warp.around_edge(np.array([1.0, 5.0, 1e6]), CriticalInterval(high=0.0))
    >>> warp.interval(CriticalInterval(high=0.0)).high, bool(warp.values(np.array([1e6]))[0] < 14)
    (0.0, True)
    """

    edge: float
    scale: float
    above: float | None = None
    gap: tuple[float, float] = (0.0, 0.0)
    reach: tuple[float, float] = (-math.inf, math.inf)

    def reaching(self, y: Vector) -> Self:
        """Return the warp that is straight beyond the values y (n,) that runs had; between them it is the same."""
        warped = self.values(y)
        return replace(self, reach=(min(float(warped.min()), 0.0), max(float(warped.max()), 0.0)))

    @classmethod
    def around_edge(cls, y: Vector, critical: CriticalInterval, quantile: float = 0.25) -> Warp:
        """Return the warp for values y (n,), around the end of the interval that is nearer to their median.

        The scale is a quantile of the distances to the edge. A small one shrinks as runs gather at the edge, and
        with it the warp becomes a step; where they gather much, take a larger one.
        """
        ends = [end for end in (critical.low, critical.high) if math.isfinite(end)]
        middle = float(np.median(y)) if len(y) else ends[0]
        edge = min(ends, key=lambda end: abs(end - middle))
        distance = np.abs(y - edge)
        distance = distance[distance > 0]
        scale = float(np.quantile(distance, quantile)) if len(distance) else 1.0
        return cls(edge, scale)

    def scale_at(self, beyond: Vector) -> Vector:
        """Return the scale where y is so far beyond the edge (negative: below it), in any unit; shape kept."""
        return np.where(np.asarray(beyond) > 0.0, self.scale if self.above is None else self.above, self.scale)

    def _gap_at(self, beyond: Vector) -> Vector:
        """Return what is left out where y is so far beyond the edge, in any unit; shape kept."""
        return np.where(np.asarray(beyond) > 0.0, self.gap[1], self.gap[0])

    def _crossing(self, beyond: Vector) -> Vector:
        """Return how wide the gap is without itself, in the unit of y, where y is so far beyond the edge; shape kept."""
        return np.where(self._gap_at(beyond) > 0.0, _CROSSED * self.scale_at(beyond), 0.0)

    def kept(self, y: Vector) -> Vector:
        """Return how far y is beyond the edge without the gap, shape kept; in the gap next to 0."""
        beyond = np.asarray(y) - self.edge
        if self.gap == (0.0, 0.0):
            return beyond
        gap, crossing, far = self._gap_at(beyond), self._crossing(beyond), np.abs(beyond)
        across = crossing * np.divide(far, gap, out=np.zeros_like(far), where=gap > 0.0)
        return np.asarray(np.sign(beyond) * np.where(far > gap, far - gap + crossing, across))

    def values(self, y: Vector) -> Vector:
        """Return the warped y, shape kept."""
        kept = self.kept(y)
        scaled = kept / self.scale_at(kept)
        near = self._near(scaled)
        return np.asarray(np.arcsinh(near) + _beyond(scaled, near, 1.0 / np.hypot(1.0, near)))

    def _near(self, scaled: Vector) -> Vector:
        """Return sinh of warped values, as near as the warp is curved."""
        return np.clip(scaled, *np.sinh(self.reach))

    def _unwarped(self, warped: Points) -> Points:
        """Return how far the y of warped values is beyond the edge without the gap, shape kept."""
        near = np.clip(warped, *self.reach)
        return np.asarray(self.scale_at(warped) * (np.sinh(near) + _beyond(warped, near, np.cosh(near))))

    def back(self, warped: Vector) -> Vector:
        """Return the y of warped values, shape kept; finite ones so far away that they are no numbers any more are nearer."""
        warped = np.where(np.isinf(warped), warped, np.clip(warped, -_FARTHEST, _FARTHEST))
        kept = self._unwarped(warped)
        if self.gap == (0.0, 0.0):
            return np.asarray(self.edge + kept)
        gap, crossing, far = self._gap_at(warped), self._crossing(warped), np.abs(kept)
        across = gap * np.divide(far, crossing, out=np.zeros_like(far), where=crossing > 0.0)
        return np.asarray(self.edge + np.sign(warped) * np.where(far > crossing, far - crossing + gap, across))

    def moments(self, mean: Points, std: Points) -> tuple[Points, Points]:
        """Return mean and standard deviation of y where the warped y is Gaussian with these, shape kept.

        The mean is that of the warped mean, as an expectation of sinh is what its farthest tail makes of it, and the standard
        deviation half of what lies between a standard deviation on either side; of a gap there are the moments of the sides.
        """
        mean, std = np.clip(mean, -_FARTHEST, _FARTHEST), np.clip(std, _LEAST, _FARTHEST)
        low, high = mean - std, mean + std
        spread = 0.5 * (self._unwarped(high) - self._unwarped(low))
        middle = self.edge + self._unwarped(mean)
        if self.gap == (0.0, 0.0):
            return middle, spread
        above, beyond = ndtr(mean / std), stdtr(_TAILS, -np.abs(mean) / std)
        middle += above * self.gap[1] - (1.0 - above) * self.gap[0]
        return middle, spread + sum(self.gap) * np.sqrt(beyond * (1.0 - beyond))

    def log_slope(self, y: Vector) -> Vector:
        """Return (n,) the logarithm of the warp's derivative at y (n,)."""
        kept = self.kept(y)
        scale = self.scale_at(kept)
        slope = -0.5 * np.log1p(self._near(kept / scale) ** 2) - np.log(scale)
        gap, crossing = self._gap_at(kept), self._crossing(kept)
        inside = np.abs(kept) < crossing
        return np.asarray(slope + np.log(np.divide(crossing, gap, out=np.ones_like(scale), where=inside)))

    def learned(self, y: Vector) -> Vector:
        """Return what a metamodel learns: the warped y."""
        return self.values(y)

    def interval(self, critical: CriticalInterval) -> CriticalInterval:
        """Return the interval in warped values; infinite ends stay."""
        low, high = self.values(np.array([critical.low, critical.high]))
        return CriticalInterval(float(low), float(high))


@dataclass(frozen=True)
class LogWarp(Warp):
    """w = log(y / edge) of a positive metric: noise that is a share of the value is the same everywhere in this unit.

    >>> warp = LogWarp.around(2.0)
    >>> warp.values(np.array([0.2, 2.0, 20.0])).round(3).tolist(), float(warp.back(np.array([0.0]))[0])
    ([-2.303, 0.0, 2.303], 2.0)
    """

    @classmethod
    def around(cls, edge: float) -> LogWarp:
        """Return the warp around an edge > 0."""
        return cls(edge, edge)

    def reaching(self, y: Vector) -> Self:
        """Return the warp that is straight beyond the largest y (n,); below the least it stays positive."""
        return replace(self, reach=(-math.inf, max(float(self.values(y).max()), 0.0)))

    def values(self, y: Vector) -> Vector:
        """Return the warped y, shape kept; -inf and what is not positive are very small."""
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = np.maximum(np.asarray(y, dtype=np.float64), 0.0) / self.edge
            near = np.minimum(scaled, np.exp(self.reach[1]))
            warped = np.log(near) + _beyond(scaled, near, 1.0 / near)
        return np.asarray(np.where(np.isneginf(y), -np.inf, np.maximum(warped, -_FARTHEST)))

    def back(self, warped: Vector) -> Vector:
        """Return the y of warped values, shape kept."""
        warped = np.where(np.isinf(warped), warped, np.clip(warped, -_FARTHEST, _FARTHEST))
        near = np.clip(warped, *self.reach)
        return np.asarray(self.edge * (np.exp(near) + _beyond(warped, near, np.exp(near))))

    def moments(self, mean: Points, std: Points) -> tuple[Points, Points]:
        """Return the median of y and half of what lies between a standard deviation on either side, shape kept."""
        mean, std = np.clip(mean, -_FARTHEST, _FARTHEST), np.clip(std, _LEAST, _FARTHEST)
        low, middle, high = (self.back(at) for at in (mean - std, mean, mean + std))
        return middle, 0.5 * (high - low)

    def log_slope(self, y: Vector) -> Vector:
        """Return (n,) the logarithm of the warp's derivative at y (n,)."""
        return -np.minimum(self.values(y), self.reach[1]) - math.log(self.edge)


def _beyond(far: Points, near: Points, slope: Points) -> Points:
    """Return (far - near) slope, shape kept; 0 where both are the same, infinite ones too."""
    out = np.zeros(np.shape(far))
    np.subtract(far, near, out=out, where=far != near)
    return np.multiply(out, slope, out=out, where=out != 0.0)


@dataclass(frozen=True)
class JointWarp:
    """The warps of the metrics of a combination: warped, their margins have one unit, that of asinh.

    Args:
        parts: (q,) warps.
        critical: of the metrics, warped.
    """

    parts: tuple[Warp, ...]
    critical: CombinedInterval

    @classmethod
    def around_edges(cls, y: Points, critical: CombinedInterval) -> JointWarp:
        """Return the warp of each metric of y (n, q) around the end of its interval."""
        columns = [y[np.isfinite(y[:, k]), k] for k in range(y.shape[1])]
        parts = tuple(map(_around, columns, critical.leaves))
        leaves = [warp.interval(leaf) for warp, leaf in zip(parts, critical.leaves, strict=True)]
        return cls(parts, critical.with_leaves(leaves, (1.0,) * len(leaves)))

    def values(self, y: Points) -> Vector:
        """Return (n,) margins of the warped y (n, q), <= 0 where critical."""
        return self.critical.margin(self.learned(y))

    def learned(self, y: Points) -> Points:
        """Return (n, q) warped values of each metric."""
        return np.stack([warp.values(y[..., k]) for k, warp in enumerate(self.parts)], axis=-1)

    def interval(self, critical: CriticalInterval) -> CriticalInterval:
        """Return the combination in warped values."""
        del critical  # it is the one that the warp was made around
        return self.critical


def warp_around(y: Vector, critical: CriticalInterval) -> Warp | JointWarp:
    """Return the warp for values y (n,) of one metric, or (n, q) of the metrics of a combination."""
    if isinstance(critical, CombinedInterval):
        return JointWarp.around_edges(y, critical)
    return _around(y, critical)


def _around(y: Vector, critical: CriticalInterval) -> Warp:
    """Return the warp of one metric; where runs lie beyond both ends of M_c it is straighter: one passes from side to side."""
    both = (y < critical.low).any() and (y > critical.high).any()
    return Warp.around_edge(y, critical, _BOTH) if both else Warp.around_edge(y, critical)


def gap_of(y: Vector, critical: CriticalInterval) -> tuple[float, float]:
    """Return distances below and above the edge in which no y (n,) lies, less a usual spacing; 0 where there is no more.

    >>> y = np.concatenate([np.linspace(-1.0, -0.1, 10), np.linspace(3.0, 3.9, 10)])
    >>> [round(each, 2) for each in gap_of(y, CriticalInterval(high=0.0))]
    [0.1, 2.9]
    """
    if not critical.one_sided:
        return 0.0, 0.0
    beyond, inside = y - critical.edge, critical.contains(y)
    above = ~inside if critical.outward > 0 else inside
    sides = [np.sort(np.abs(beyond[side])) for side in (~above, above)]
    if min(map(len, sides)) <= _SPACINGS:
        return 0.0, 0.0
    spacings = [float(side[_SPACINGS] - side[0]) / _SPACINGS for side in sides if side[_SPACINGS] > side[0]]
    spacing, width = float(np.mean(spacings)) if spacings else np.inf, float(sides[0][0] + sides[1][0])
    if not _WIDE * spacing < width:
        return 0.0, 0.0
    left = 1.0 - spacing / width
    return left * float(sides[0][0]), left * float(sides[1][0])
