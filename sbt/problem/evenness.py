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
_BY_CHANCE, _LARGE = 1e-3, 0.05  # probability of a false alarm by the values of single inputs; least distance that counts
_AT_ONCE, _TIMES = 100_000, 40  # random points that are drawn at once, until enough are feasible, and how often at most
_LEFT_OUT = 0.2  # of an input, which is no step between levels where it is twice as wide as they are
_EQUAL = 1e-3  # of a step: how far levels of a grid may be off


def spread_evenly(space: ParameterSpace, x: Points) -> bool:
    """Return whether points (n, d) pass for even or random ones of the space, by each input alone and by the cells about them.

    Points that results chose crowd together: some cells, of what lies nearest to a point, are far smaller than others. Of few
    points of many inputs no test can tell; repeats of inputs tell no more than one of them, nor do levels. Grids are even.
    """
    from scipy.stats import kstwobign

    u, rng = np.clip(space.to_unit(x), 0.0, 1.0), np.random.Generator(np.random.PCG64(0))
    points, counts = np.unique(space.cube.snapped(u), axis=0, return_counts=True)
    drawn = _feasible(space, (_DRAWN + 4) * _MOST, rng)
    if len(drawn) < _MOST or _is_grid(space, points, counts):
        return True
    some_like = _independent(space, counts)
    for column, even in zip(_jittered(space, u, rng).T, _jittered(space, drawn, rng).T, strict=True):
        column = column if not space.constraints else np.searchsorted(np.sort(even), column) / len(even)
        levels, distance = np.unique(column), _distance(column)
        if _lacks_levels(levels, len(points)):
            return False
        n = min(some_like, len(levels))
        if distance > _LARGE and float(kstwobign.sf(np.sqrt(n) * distance)) * space.dimension < _BY_CHANCE:
            return False
    if len(points) > _MOST:
        some = rng.choice(len(points), _MOST, replace=False)
        points, counts = points[some], counts[some]
    n, probe = min(_independent(space, counts), _MOST), space.cube.embedded(drawn[: 4 * _MOST])
    rows = (rng.choice(len(drawn), n, replace=False) for _ in range(_DRAWN))
    sets = (np.unique(space.cube.snapped(drawn[some]), axis=0, return_counts=True) for some in rows)
    by_chance = np.array([_unevenness(space, *each, probe) for each in sets])
    return bool(_unevenness(space, points, counts, probe) <= by_chance.mean() + _TOO_FAR * by_chance.std(ddof=1) + 1e-9)


def _feasible(space: ParameterSpace, n: int, rng: np.random.Generator) -> Points:
    """Return n random points (n, d) of the unit cube that satisfy the constraints, fewer of a space that is too narrow."""
    if not space.constraints:
        return rng.random((n, space.dimension))
    found, have = [np.empty((0, space.dimension))], 0
    for _ in range(_TIMES):
        u = rng.random((_AT_ONCE, space.dimension))
        found.append(u[space.feasible(space.from_unit(u))])
        have += len(found[-1])
        if have >= n:
            break
    return np.concatenate(found)[:n]


def _is_grid(space: ParameterSpace, points: Points, counts: NDArray[np.int64]) -> bool:
    """Return whether points (k, d) are all combinations of equally spaced levels over the space, each as often (k,)."""
    levels = [np.unique(column) for column in points.T]
    if math.prod(len(each) for each in levels) != len(points) or counts.min() < counts.max() or max(map(len, levels)) < 2:
        return False
    values = dict((*space.cube.whole, *space.cube.nominal))
    for k, each in enumerate(levels):
        step = (each[-1] - each[0]) / max(len(each) - 1, 1)
        evenly = len(each) > 1 and np.abs(np.diff(each) - step).max() <= _EQUAL * step
        if k in values and len(each) == values[k]:
            continue
        if not evenly or each[0] > step or each[-1] < 1.0 - step:
            return False
    return True


def _independent(space: ParameterSpace, counts: NDArray[np.int64]) -> int:
    """Return how many random points tell as much as these, of which (k,) are alike; fewer where more are than by chance."""
    values, n = dict((*space.cube.whole, *space.cube.nominal)), float(counts.sum())
    by_chance = n * (n - 1.0) / math.prod(values.values()) if len(values) == space.dimension else 0.0
    return max(round(n * min((n + by_chance) / float((counts**2).sum()), 1.0)), 1)


def _lacks_levels(levels: Vector, n: int) -> bool:
    """Return whether the few levels (m,) of n points leave out a part of an input."""
    if 2 * len(levels) > n:
        return False
    steps = np.diff(levels)
    widest = max(float(steps.max(initial=0.0)), float(levels[0]), 1.0 - float(levels[-1]))
    return len(levels) < 2 or widest > max(2.0 * float(np.median(steps)), _LEFT_OUT)


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
