"""Metrics that end at the critical edge: a distance that is 0 in every collision, where critical is "at most 0".

Their critical runs all have the value of the edge, so that a metamodel of the metric is as unsure inside the critical region as
on its boundary. What is learned in their place goes on beyond the edge, as deep as the nearest uncritical runs are far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from sbt.metamodels.base import Metamodel, Predictor
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Opened", "opened", "scored"]

_FEWEST = 2
"""Critical runs with the value of the edge: one may be there by chance."""
_LEAST = 0.25
"""Least depth beyond the edge, in the median margin of the uncritical runs that are nearest to critical ones."""
_CHUNK = 512


def opened(u: Points, y: Vector, critical: CriticalInterval) -> Vector:
    """Return y with the values at the edge of M_c moved into it, where no run lies beyond the edge; else y itself.

    The depth of a run is the least, over the uncritical ones, of slope times distance less their margin, with the median slope
    from uncritical runs to the nearest critical one: a function of this slope is that deep there.

    Args:
        u: (n, d) metamodel inputs.
        y: (n,) finite values of the metric, in any unit in which `critical` is given.
        critical: M_c; with two finite ends nothing is moved.

    >>> u = np.array([[0.0], [0.2], [0.3], [0.4], [0.5]])
    >>> opened(u, np.array([0.0, 0.0, 0.1, 0.2, 0.3]), CriticalInterval(high=0.0)).round(2).tolist()
    [-0.2, -0.02, 0.1, 0.2, 0.3]
    """
    if math.isfinite(critical.low) == math.isfinite(critical.high):
        return y
    margin = critical.margin(y)
    tied = margin == 0.0
    if tied.sum() < _FEWEST or (margin < 0.0).any():
        return y
    rows, depth = np.flatnonzero(tied), np.ones(int(tied.sum()))
    if len(rows) < len(y):
        m = margin[~tied]
        nearest, least = np.full(len(m), np.inf), np.empty(len(rows), dtype=np.intp)
        for start in range(0, len(rows), _CHUNK):
            distance = cdist(u[rows[start : start + _CHUNK]], u[~tied])
            nearest = np.minimum(nearest, distance.min(axis=0))
            least[start : start + _CHUNK] = distance.argmin(axis=1)
        apart = nearest > 0.0
        slope = float(np.median(m[apart] / nearest[apart])) if apart.any() else 0.0
        for start in range(0, len(rows), _CHUNK):
            distance = cdist(u[rows[start : start + _CHUNK]], u[~tied])
            depth[start : start + _CHUNK] = (slope * distance - m).min(axis=1)
        depth = np.maximum(depth, _LEAST * float(np.median(m[least])))
    moved = np.array(y, dtype=np.float64)
    moved[rows] += depth if math.isfinite(critical.low) else -depth
    return moved


def scored(y: Vector, mu: Vector, critical: CriticalInterval) -> Vector:
    """Return the values that predictions mu (n,) are scored by: of a run at the edge, where none lies beyond, its side alone."""
    margin = critical.margin(y)
    at_edge = margin == 0.0
    if not at_edge.any() or (margin < 0.0).any():
        return y
    return np.where(at_edge & critical.contains(mu), mu, y)


@dataclass(frozen=True)
class Opened:
    """A metamodel that learns metrics which end at the critical edge as if they went on.

    Args:
        metamodel: learns them.
        critical: M_c.
    """

    metamodel: Metamodel
    critical: CriticalInterval

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> Predictor:
        """Return the predictor; see `Metamodel.fit`."""
        return self.metamodel.fit(u, opened(u, y, self.critical), rng)
