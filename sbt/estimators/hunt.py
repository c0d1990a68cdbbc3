"""The mode hunt of an estimation: points where another critical region may be, known ones left out.

The points train the metamodel. They have no density, so they never enter an estimate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.arrays import Mask, Points, Vector

__all__ = ["BASIN", "greedy", "outside"]

BASIN = 0.22
"""Chebyshev radius of the surrounding of a critical run that is left out, of the width of the box."""
_REPULSION = 0.1


def outside(u: Points, centres: Points, radius: float = BASIN) -> Mask:
    """Return (n,) booleans: farther than `radius` (Chebyshev) from every centre."""
    if len(centres) == 0:
        return np.ones(len(u), dtype=bool)
    return np.asarray(np.min([np.abs(u - c).max(axis=1) for c in centres], axis=0) > radius)


def greedy(u: Points, log_score: Callable[[Points], Vector], seen: Points, n: int, even: int) -> list[int]:
    """Return n rows of u (m, d): first by score, kept apart from each other, then `even` that fill space.

    Args:
        u: candidates.
        log_score: (m, d) to (m,) log scores, larger is better.
        seen: (k, d) points that were run.
        n: rows to choose, the even ones included.
        even: rows that are farthest from everything instead.
    """
    score, taken = log_score(u), []
    reach = _REPULSION * np.sqrt(u.shape[1])
    distance = np.full(len(u), np.inf)
    for point in seen:
        distance = np.minimum(distance, np.linalg.norm(u - point, axis=1))
    for k in range(min(n, len(u))):
        with np.errstate(divide="ignore"):
            apart = np.log(-np.expm1(-0.5 * (distance / reach) ** 2))
        value = np.where(np.isinf(distance), 0.0, distance) if k >= n - even else np.maximum(score, -1e300) + 2.0 * apart
        value[taken] = -np.inf
        best = int(np.argmax(value))
        taken.append(best)
        distance = np.minimum(distance, np.linalg.norm(u - u[best], axis=1))
    return taken
