"""Points on the predicted boundary: where P(y in M_c) crosses 0.5."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from sbt.problem.arrays import Points, Vector

__all__ = ["crossings"]

_HALVINGS = 30  # of a segment: to 1e-9 of its length


def crossings(probability: Callable[[Points], Vector], u: Points, most: int) -> Points:
    """Return up to `most` points where the probability crosses 0.5, found by bisection.

    Each point of the smaller class is joined to its nearest neighbour of the other one, and the line
    is halved 30 times.

    Args:
        probability: (n, d) points -> (n,) P(critical).
        u: (n, d) points of the unit cube to look from.
        most: how many pairs are bisected: the closest ones, between which the boundary is known best.

    Returns:
        (m, d) points, empty where all of `u` lies on one side.
    """
    inside = probability(u) > 0.5
    if inside.all() or not inside.any():
        return np.empty((0, u.shape[1]))
    few, many = (u[inside], u[~inside]) if inside.sum() <= (~inside).sum() else (u[~inside], u[inside])
    distance, partner = cKDTree(many).query(few)
    nearest = np.argsort(distance, kind="stable")[:most]
    a, b = few[nearest], many[partner[nearest]]
    side = probability(a) > 0.5
    for _ in range(_HALVINGS):
        middle = 0.5 * (a + b)
        same = (probability(middle) > 0.5) == side
        a, b = np.where(same[:, None], middle, a), np.where(same[:, None], b, middle)
    return 0.5 * (a + b)
