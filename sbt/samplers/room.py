"""Where points may lie, and uniform ones there: of a narrow place, of what is left where a place holds none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points
from sbt.problem.cube import CONTINUOUS, Cube

__all__ = ["Room", "fill_uniformly", "spread_out"]

_MOST_TRIES, _MOST_AT_ONCE = 2**18, 2**14  # to find admissible points: 260 where a thousandth is feasible
_FARTHEST_OF, _FARTHEST_OF_FEW = 30, 3  # uniform points, the farthest of which fills a gap: around the edges, and plainly


@dataclass(frozen=True, eq=False)
class Room:
    """A part of the unit cube, as a function.

    Args:
        admits: (n, d) points to (n,) booleans.
        larger: takes its place where no point of it can be found.
    """

    admits: Callable[[Points], Mask]
    larger: Callable[[Points], Mask] | Room

    def __call__(self, u: Points) -> Mask:
        """Return (n,) booleans: the point is in it."""
        return self.admits(u)


def fill_uniformly(admissible: Callable[[Points], Mask] | Room, n: int, d: int, rng: np.random.Generator) -> Points:
    """Return (n, d) uniform admissible points, of at most 260,000 tries; of a `Room` without any, those of the larger one.

    Where fewer are found they come again.

    Raises:
        InputError: none is found.
    """
    found, tries, size = np.empty((0, d)), 0, max(100, n)
    while len(found) < n and tries < _MOST_TRIES:
        u = rng.random((size, d))
        found = np.vstack([found, u[admissible(u)]])
        tries, size = tries + size, min(2 * size, _MOST_AT_ONCE)
    if n and len(found) == 0:
        if isinstance(admissible, Room):
            return fill_uniformly(admissible.larger, n, d, rng)
        raise InputError(f"the constraints must admit some of the points looked at, but admitted none of {tries:,}")
    return found[:n] if len(found) >= n else np.vstack([found, found[rng.integers(0, len(found), n - len(found))]])


def spread_out(
    admissible: Callable[[Points], Mask], others: Points, n: int, rng: np.random.Generator, cube: Cube = CONTINUOUS
) -> Points:
    """Return (n, d) points that fill the gaps among the others (m, d): each the farthest of some uniform admissible ones.

    Of 30 points distances go around the edges of the cube: without that the farthest ones are corners. A crowd at one edge then
    keeps them from the opposite one, too, so that every second point is the farthest of three by plain distances.
    """
    d = others.shape[1]
    found = np.empty((0, d))
    for k in range(n):
        plain = k % 2 == 1 if n > 1 else bool(rng.integers(2))
        candidates = fill_uniformly(admissible, _FARTHEST_OF_FEW if plain else _FARTHEST_OF, d, rng)
        there = cube.embedded(np.vstack([others, found]))
        apart = np.abs(cube.embedded(candidates)[:, None, :] - there[None])
        nearest = ((apart if plain else np.minimum(apart, 1.0 - apart)) ** 2).sum(axis=2).min(axis=1)
        found = np.vstack([found, candidates[int(np.argmax(nearest))]])
    return found
