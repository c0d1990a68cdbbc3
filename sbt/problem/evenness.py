"""Are recorded points spread evenly over a parameter space? Only then do shares of them tell of it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sbt.problem.arrays import Points, Vector
from sbt.problem.space import ParameterSpace

__all__ = ["spread_evenly"]

_MOST = 1000  # points whose cells are looked at; of more, so many drawn at random
_DRAWN, _TOO_FAR = 20, 4.0  # random sets to compare with, and standard deviations of theirs that tell a difference
_BY_CHANCE = 1e-3  # probability of a false alarm by the values of single inputs


def spread_evenly(space: ParameterSpace, x: Points) -> bool:
    """Return whether points (n, d) pass for even or random ones of the space, by each input alone and by the cells about them.

    Points that results chose crowd together: some cells, of what lies nearest to a point, are far smaller than others. Of few
    points of many inputs no test can tell; repeats of inputs tell no more than one of them.
    """
    from scipy.stats import kstwobign

    u, rng = np.clip(space.to_unit(x), 0.0, 1.0), np.random.Generator(np.random.PCG64(0))
    points, counts = np.unique(space.cube.snapped(u), axis=0, return_counts=True)
    worst = max(_distance(column) for column in _jittered(space, u, rng).T)
    if float(kstwobign.sf(np.sqrt(_independent(space, counts)) * worst)) * space.dimension < _BY_CHANCE:
        return False
    if len(points) > _MOST:
        some = rng.choice(len(points), _MOST, replace=False)
        points, counts = points[some], counts[some]
    n, probe = _independent(space, counts), space.cube.embedded(rng.random((4 * _MOST, space.dimension)))
    sets = (np.unique(space.cube.snapped(rng.random((n, space.dimension))), axis=0, return_counts=True) for _ in range(_DRAWN))
    drawn = np.array([_unevenness(space, *drawn, probe) for drawn in sets])
    return bool(_unevenness(space, points, counts, probe) <= drawn.mean() + _TOO_FAR * drawn.std(ddof=1) + 1e-9)


def _independent(space: ParameterSpace, counts: NDArray[np.int64]) -> int:
    """Return how many random points tell as much as these, of which (k,) are alike; fewer where more are than by chance."""
    values, n = dict((*space.cube.whole, *space.cube.nominal)), float(counts.sum())
    by_chance = n * (n - 1.0) / math.prod(values.values()) if len(values) == space.dimension else 0.0
    return max(round(n * min((n + by_chance) / float((counts**2).sum()), 1.0)), 1)


def _jittered(space: ParameterSpace, u: Points, rng: np.random.Generator) -> Points:
    """Return the points anywhere within the intervals of their whole numbers and choices, where random ones would be."""
    found = np.array(space.cube.snapped(u))
    for k, values in (*space.cube.whole, *space.cube.nominal):
        found[:, k] += (rng.random(len(u)) - 0.5) / values
    return found


def _distance(u: Vector) -> float:
    """Return the Kolmogorov-Smirnov distance of coordinates (n,) from even ones."""
    ordered, rank = np.sort(u), np.arange(len(u) + 1) / len(u)
    return float(max((rank[1:] - ordered).max(), (ordered - rank[:-1]).max()))


def _unevenness(space: ParameterSpace, points: Points, counts: NDArray[np.int64], probe: Points) -> float:
    """Return the logarithm of n times the sum of the squared shares of what lies nearest to each of n points, some of them alike.

    Args:
        space: that they are of.
        points: (k, d) different ones.
        counts: (k,) how many are alike.
        probe: (m, e) even or random points, embedded.
    """
    from scipy.spatial import cKDTree

    nearest = cKDTree(space.cube.embedded(points)).query(probe)[1]
    share = np.bincount(nearest, minlength=len(points)) / len(probe)
    return float(np.log(counts.sum() * (share**2 / counts).sum()))
