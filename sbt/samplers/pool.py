"""Recorded rows as candidates, in a random order that belongs to the seed: the Sobol sequence of a table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sbt.problem.arrays import Mask, Points
from sbt.seeds import stream

__all__ = ["PoolSequence"]


@dataclass(frozen=True, eq=False)
class PoolSequence:
    """The rows of a pool that are left, addressed by position like a `SobolSequence`.

    The order is one permutation of the whole pool, so that a batch of even candidates continues where
    the previous one ended, whatever was chosen in between.

    Args:
        u: (n, d) unit-cube points of all rows.
        taken: (n,) rows that cannot be chosen any more.
        seed: campaign seed.
    """

    u: Points
    taken: Mask
    seed: int

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return self.u.shape[1]

    def __len__(self) -> int:
        """Return the number of rows that are left."""
        return len(self.rows)

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Indices of the rows that are left, in the order of the sequence: repeats of a point after all others."""
        order = stream(self.seed, "pool", len(self.u)).permutation(len(self.u))
        point = np.unique(self.u, axis=0, return_inverse=True)[1].reshape(-1)
        alike = np.argsort(point, kind="stable")
        repeat = np.empty(len(self.u), dtype=np.int64)
        repeat[alike] = np.arange(len(self.u)) - np.searchsorted(point[alike], point[alike])
        order = order[np.argsort(repeat[order], kind="stable")]
        return order[~self.taken[order]]

    def points(self, start: int, stop: int) -> Points:
        """Return the points at positions start, ..., stop - 1, fewer at the end of the pool."""
        return self.u[self.rows[start:stop]]
