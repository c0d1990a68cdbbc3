"""A monotone warp of the safety metric around the edge of the critical interval.

Searches fit their metamodel to the warped metric: near the edge nothing changes, far from it an
outlier of 1e6 is a few units away. P(y in M_c) is the same before and after, because the warp is
increasing and the ends of the interval are warped with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval

__all__ = ["JointWarp", "Warp", "gap_of", "warp_around"]

_SPACINGS, _WIDE = 8, 8.0
"""Spacings between the values nearest to the edge on either side, and the fewest of them that a gap is as wide as: before the
root that a speed of impact ends with there are 3 to 6."""


@dataclass(frozen=True)
class Warp:
    """w = asinh((y - edge) / scale), on either side of the edge with its own scale; without the gap in which no value lies.

    Args:
        edge: end of the critical interval, in the unit of y.
        scale: > 0; within it the warp is nearly straight.
        above: > 0, the scale of values above the edge; None: the same.
        gap: distances >= 0 below and above the edge that are left out.

    >>> warp = Warp.around_edge(np.array([1.0, 5.0, 1e6]), CriticalInterval(high=0.0))
    >>> warp.interval(CriticalInterval(high=0.0)).high, bool(warp.values(np.array([1e6]))[0] < 14)
    (0.0, True)
    """

    edge: float
    scale: float
    above: float | None = None
    gap: tuple[float, float] = (0.0, 0.0)

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

    def kept(self, y: Vector) -> Vector:
        """Return how far y is beyond the edge without the gap, shape kept; 0 in it."""
        beyond = np.asarray(y) - self.edge
        return np.sign(beyond) * np.maximum(np.abs(beyond) - self._gap_at(beyond), 0.0)

    def values(self, y: Vector) -> Vector:
        """Return the warped y, shape kept."""
        kept = self.kept(y)
        return np.asarray(np.arcsinh(kept / self.scale_at(kept)))

    def back(self, warped: Vector) -> Vector:
        """Return the y of warped values, shape kept."""
        return np.asarray(self.edge + np.sign(warped) * self._gap_at(warped) + self.scale_at(warped) * np.sinh(warped))

    def stretch(self, mean: Points, std: Points) -> Points:
        """Return factors to means, and standard deviations, of y - edge from those of the warped y: P(y > edge) stays."""
        slope = self.scale_at(mean) * np.divide(np.sinh(mean), mean, out=np.ones_like(mean), where=np.abs(mean) > 1e-6)
        if self.gap == (0.0, 0.0):
            return np.asarray(slope)
        z = np.maximum(np.abs(mean), 1e-6 * std) / std
        return np.asarray(slope + self._gap_at(mean) * (2.0 * ndtr(z) - 1.0) / (z * std))

    def log_slope(self, y: Vector) -> Vector:
        """Return (n,) the logarithm of the warp's derivative at y (n,)."""
        kept = self.kept(y)
        scale = self.scale_at(kept)
        return np.asarray(-0.5 * np.log1p((kept / scale) ** 2) - np.log(scale))

    def learned(self, y: Vector) -> Vector:
        """Return what a metamodel learns: the warped y."""
        return self.values(y)

    def interval(self, critical: CriticalInterval) -> CriticalInterval:
        """Return the interval in warped values; infinite ends stay."""
        low, high = self.values(np.array([critical.low, critical.high]))
        return CriticalInterval(float(low), float(high))


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
        parts = tuple(Warp.around_edge(column, leaf) for column, leaf in zip(columns, critical.leaves, strict=True))
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
    return Warp.around_edge(y, critical)


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
