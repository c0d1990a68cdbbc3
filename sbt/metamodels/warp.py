"""A monotone warp of the safety metric around the edge of the critical interval.

Searches fit their metamodel to the warped metric: near the edge nothing changes, far from it an
outlier of 1e6 is a few units away. P(y in M_c) is the same before and after, because the warp is
increasing and the ends of the interval are warped with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Warp"]


@dataclass(frozen=True)
class Warp:
    """w = asinh((y - edge) / scale).

    Args:
        edge: end of the critical interval, in the unit of y.
        scale: > 0; within it the warp is nearly straight.

    >>> warp = Warp.around_edge(np.array([1.0, 5.0, 1e6]), CriticalInterval(high=0.0))
    >>> warp.interval(CriticalInterval(high=0.0)).high, bool(warp.values(np.array([1e6]))[0] < 14)
    (0.0, True)
    """

    edge: float
    scale: float

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

    def values(self, y: Vector) -> Vector:
        """Return the warped y, shape kept."""
        return np.arcsinh((np.asarray(y) - self.edge) / self.scale)

    def interval(self, critical: CriticalInterval) -> CriticalInterval:
        """Return the interval in warped values; infinite ends stay."""
        low, high = self.values(np.array([critical.low, critical.high]))
        return CriticalInterval(float(low), float(high))
