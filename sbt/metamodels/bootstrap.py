"""Regressions drawn at random: each gives every run a random weight."""

from __future__ import annotations

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["drawn_regression", "out_of_bag"]

_TREES, _LEAF = 10, 4  # of a drawn forest: few trees, so that draws differ; runs in a leaf
_BAGGED = 200  # trees, each of which leaves out a third of the rows
_RIDGE = 3.0  # penalty of a slope in runs: one of 0 is worth three more


def drawn_regression(u: Points, y: Vector, at: Points, rng: np.random.Generator, *, trees: bool) -> Vector:
    """Return (m,) a line fitted to randomly weighted y, at points; with trees the sum of it and of a forest.

    Args:
        u: (n, d) rows.
        y: (n,) standardised.
        at: (m, d) points.
        rng: of the weights and the trees.
        trees: see above.

    Source:
        Rubin (1981), The Bayesian bootstrap.
    """
    weight = rng.exponential(size=len(u))
    columns = np.column_stack([u - 0.5, np.ones(len(u))])
    penalty = np.append(np.full(u.shape[1], _RIDGE), 1e-6)
    slope = np.linalg.solve((columns.T * weight) @ columns + np.diag(penalty), columns.T @ (weight * y))[:-1]
    line = np.asarray((at - 0.5) @ slope)
    if not trees:
        return line
    from sklearn.ensemble import ExtraTreesRegressor

    forest = ExtraTreesRegressor(_TREES, min_samples_leaf=_LEAF, random_state=int(rng.integers(2**31)), n_jobs=1)
    return line + np.asarray(forest.fit(u, y, sample_weight=weight).predict(at))


def out_of_bag(u: Points, y: Vector, rng: np.random.Generator, judged: Mask | None = None) -> float:
    """Return the share of the variance of y (n,) at the judged rows that a forest explains of rows its trees did not see.

    Args:
        u: (n, d) rows, all of which teach.
        y: (n,) values.
        rng: of the trees.
        judged: (n,) rows whose variance is meant: those that lie as the inputs are distributed; None: all.
    """
    from sklearn.ensemble import ExtraTreesRegressor

    state = int(rng.integers(2**31))
    forest = ExtraTreesRegressor(_BAGGED, min_samples_split=4, bootstrap=True, oob_score=True, random_state=state, n_jobs=1)
    rows = slice(None) if judged is None else judged
    missed = (y - forest.fit(u, y).oob_prediction_)[rows]
    return max(1.0 - float((missed**2).mean() / y[rows].var()), 0.0)
