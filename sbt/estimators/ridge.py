"""A polynomial trend of a metric, by ridge regression: what carries many inputs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.problem.arrays import Points, Vector

__all__ = ["ridge_trend"]

_LEAST_R2 = 0.5  # leave-one-out R2 from which on a trend is taken: it explains more than it leaves
_RIDGES = (1e-6, 1e-4, 1e-2, 1.0)  # penalties relative to the number of rows


def ridge_trend(u: Points, t: Vector) -> Callable[[Points], Vector] | None:
    """Return the quadratic or linear ridge trend of larger leave-one-out R2; None where neither exceeds 0.5."""
    best, best_score = None, _LEAST_R2
    for basis in (_linear, _quadratic):
        b = basis(u)
        if len(t) < 4 or b.shape[1] > 4 * len(t):
            continue
        for ridge in _RIDGES:
            penalty = np.eye(b.shape[1]) * ridge * len(t)
            penalty[0, 0] = 1e-9
            solved = np.linalg.solve(b.T @ b + penalty, b.T)  # (p, n)
            leverage = np.einsum("np,pn->n", b, solved)
            left_out = (t - b @ (solved @ t)) / np.maximum(1.0 - leverage, 1e-6)
            score = 1.0 - float((left_out**2).sum() / max(((t - t.mean()) ** 2).sum(), 1e-300))
            if score > best_score:
                best, best_score = (basis, solved @ t), score
    if best is None:
        return None
    basis, coefficients = best
    return lambda points: np.asarray(basis(points) @ coefficients)


def _linear(u: Points) -> Points:
    return np.column_stack([np.ones(len(u)), 2.0 * u - 1.0])


def _quadratic(u: Points) -> Points:
    v = 2.0 * u - 1.0
    i, j = np.triu_indices(v.shape[1])
    return np.column_stack([np.ones(len(u)), v, v[:, i] * v[:, j]])
