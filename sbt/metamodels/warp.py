"""A monotone warp of the safety metric around the edge of the critical interval.

Searches fit their metamodel to the warped metric: near the edge nothing changes, far from it an
outlier of 1e6 is a few units away. P(y in M_c) is the same before and after, because the warp is
increasing and the ends of the interval are warped with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval

__all__ = ["JointWarp", "Warp", "warp_around"]


@dataclass(frozen=True)
class Warp:
    """w = asinh((y - edge) / scale), on either side of the edge with its own scale.

    Args:
        edge: end of the critical interval, in the unit of y.
        scale: > 0; within it the warp is nearly straight.
        above: > 0, the scale of values above the edge; None: the same.

    >>> warp = Warp.around_edge(np.array([1.0, 5.0, 1e6]), CriticalInterval(high=0.0))
    >>> warp.interval(CriticalInterval(high=0.0)).high, bool(warp.values(np.array([1e6]))[0] < 14)
    (0.0, True)
    """

    edge: float
    scale: float
    above: float | None = None

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

    def values(self, y: Vector) -> Vector:
        """Return the warped y, shape kept."""
        beyond = np.asarray(y) - self.edge
        return np.asarray(np.arcsinh(beyond / self.scale_at(beyond)))

    def back(self, warped: Vector) -> Vector:
        """Return the y of warped values, shape kept."""
        return np.asarray(self.edge + self.scale_at(warped) * np.sinh(warped))

    def log_slope(self, y: Vector) -> Vector:
        """Return (n,) the logarithm of the warp's derivative at y (n,)."""
        scale = self.scale_at(np.asarray(y) - self.edge)
        return np.asarray(-0.5 * np.log1p(((y - self.edge) / scale) ** 2) - np.log(scale))

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
