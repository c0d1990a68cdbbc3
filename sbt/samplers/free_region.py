"""What deflation leaves of the unit cube: all but boxes around critical runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sbt.problem.arrays import Mask, Points

__all__ = ["FreeRegion"]


@dataclass(frozen=True, eq=False)
class FreeRegion:
    """The part of the cube that is not deflated: all but k boxes, in the embedded coordinates of `Cube`.

    A box holds runs of the same choices only: other ones are farther away than it reaches.

    Args:
        low, high: (k, e) ends of the boxes.
        radius: by which each box reaches beyond its critical runs.
    """

    low: Points
    high: Points
    radius: float

    @classmethod
    def without(cls, hits: Points, radius: float) -> FreeRegion:
        """Return what boxes around critical runs (n, e) leave; runs whose boxes touch share one box, their hull."""
        if len(hits) == 0:
            return cls(hits, hits, radius)
        count, group = connected_components(cdist(hits, hits, "chebyshev") <= 2.0 * radius, directed=False)
        members = [hits[group == k] for k in range(count)]
        return cls(
            np.array([m.min(axis=0) for m in members]) - radius, np.array([m.max(axis=0) for m in members]) + radius, radius
        )

    def __call__(self, u: Points, beyond: float = 0.0) -> Mask:
        """Return (n,) booleans: u is in no box, each grown by `beyond`."""
        inside = np.zeros(len(u), dtype=bool)
        for low, high in zip(self.low - beyond, self.high + beyond, strict=True):
            inside |= ((u >= low) & (u <= high)).all(axis=1)
        return ~inside
