"""P(critical) of a run from what is known of its pair of inputs and seed: forests, for many runs of which few are critical."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Protocol

import numpy as np
from scipy.special import expit, ndtr

from sbt.metamodels.extra_trees import ExtraTrees
from sbt.problem.arrays import Points, Vector

__all__ = ["Belief", "cross_fitted", "fit_belief", "fit_mean", "fit_score", "fit_trend", "within_reach"]

Belief = Callable[[Points], Vector]
"""(n, k) what is known of pairs to (n,) P(critical)."""


class Fit(Protocol):
    """`fit_belief`, `fit_mean` or `fit_score`."""

    def __call__(self, known: Points, told: Vector, rng: np.random.Generator, trees: int) -> Belief:
        """Return what was learned of (n, k) pairs from (n,) margins or statements."""
        ...


_TREES, _FEW_TREES = 40, 20  # of a forest; of one that only says what another is worth
_LEAF, _SPLIT = 3, 10  # runs in a leaf of the labels; in a node of the margins that is split
_NEAR = 0.25  # share of the runs whose margins are told apart: how near a run came matters, how far away it stayed does not
_SURE = 1e-5  # nearest to 0 and 1
_FOLDS = 3
_RIDGE, _FAR = 1.0, 5.0  # of the line; standard deviations beyond which what is known counts no more
_SURER = 1.0  # by how many standard errors the line must do better to count for more than e to 1
_BEYOND = 10.0  # quartile ranges from the median beyond which values are not told apart


def fit_belief(known: Points, told: Vector, rng: np.random.Generator, trees: int = _TREES) -> Belief:
    """Return P(critical) as learned from runs: forests of their verdicts and of their margins, and a line through the margins.

    The one forest knows nothing of near misses, the other takes leaves for normal: where events are rare, their mean is better
    than either (docs/measured/traffic.md). From few runs a line tells more than both; it counts by how it does on runs left out.

    Args:
        known: (n, k) of the pairs.
        told: (n,) margins of the runs, <= 0 critical.
        rng: the only source of randomness.
        trees: of a forest.
    """
    from sklearn.ensemble import ExtraTreesRegressor

    critical = (told <= 0.0).astype(np.float64)
    near = np.minimum(told, max(float(np.quantile(told, _NEAR)), 0.0))
    state = int(rng.integers(2**31))
    labels = ExtraTreesRegressor(trees, min_samples_leaf=_LEAF, random_state=state, n_jobs=1, bootstrap=True, oob_score=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a row that is in all samples: it is taken for safe
        labels.fit(known, critical)
    margins = ExtraTrees(trees=trees, min_samples_split=_SPLIT).fit(known, near, rng) if np.ptp(near) > 0.0 else None
    line, left_out = _fit_line(known, told)
    worse = (left_out - critical) ** 2 - (labels.oob_prediction_ - critical) ** 2
    weight = float(expit(-_SURER * worse.sum() / max(np.sqrt(len(told)) * worse.std(), 1e-12)))

    def belief(points: Points) -> Vector:
        p = np.asarray(labels.predict(points))
        if margins is not None:
            leaves = margins(points)
            p = 0.5 * (p + ndtr(-leaves.mean / leaves.std).mean(axis=0))
        return np.clip((1.0 - weight) * p + weight * line(points), _SURE, 1.0 - _SURE)

    return belief


def _fit_line(known: Points, told: Vector) -> tuple[Belief, Vector]:
    """Return P(critical) by a linear regression of margins with normal errors, and (n,) of each row as learned without it."""
    margins = within_reach(told[:, None])[:, 0]
    line, left_out = fit_trend(known, margins)
    std = max(float(np.sqrt(((margins - left_out) ** 2).mean())), 1e-12)
    return lambda points: ndtr(-line(points) / std), ndtr(-left_out / std)


def fit_trend(known: Points, told: Vector) -> tuple[Belief, Vector]:
    """Return a linear regression of values (n,) on what is known (n, k), and (n,) of each row as learned without it."""
    middle, scale = known.mean(axis=0), known.std(axis=0) + 1e-12

    def columns(points: Points) -> Points:
        return np.column_stack([np.ones(len(points)), np.clip((points - middle) / scale, -_FAR, _FAR)])

    a = columns(known)
    inverse = np.linalg.inv(a.T @ a + _RIDGE * np.eye(a.shape[1]))
    coefficients = inverse @ (a.T @ told)
    lever = np.minimum(np.einsum("ij,jk,ik->i", a, inverse, a), 1.0 - 1e-9)
    return lambda points: np.asarray(columns(points) @ coefficients), told - (told - a @ coefficients) / (1.0 - lever)


def fit_mean(known: Points, told: Vector, rng: np.random.Generator, trees: int = _TREES) -> Belief:
    """Return the mean of statements of P(critical) (n,) given less than they were made from, as before a coarse run."""
    mean = fit_score(known, told, rng, trees)
    return lambda points: np.clip(mean(points), _SURE, 1.0 - _SURE)


def fit_score(known: Points, told: Vector, rng: np.random.Generator, trees: int = _TREES) -> Belief:
    """Return the mean of scores (n,) as learned from what is known of pairs."""
    from sklearn.ensemble import ExtraTreesRegressor

    forest = ExtraTreesRegressor(trees, min_samples_leaf=_LEAF, random_state=int(rng.integers(2**31)), n_jobs=1)
    forest.fit(known, told)
    return lambda points: np.asarray(forest.predict(points))


def cross_fitted(fit: Fit, known: Points, told: Vector, rng: np.random.Generator) -> Vector:
    """Return (n,) what a fit says of each row that learned from the other folds."""
    fold, found = rng.permutation(len(told)) % _FOLDS, np.empty(len(told))
    for k in range(_FOLDS):
        mine = fold == k
        found[mine] = fit(known[~mine], told[~mine], rng, _FEW_TREES)(known[mine])
    return found


def within_reach(values: Points) -> Points:
    """Return columns (n, k) for trees, which choose thresholds evenly: far values at an end, missing ones at the top."""
    found = np.empty(values.shape)
    for k, column in enumerate(values.T):
        finite = column[np.isfinite(column)]
        low, middle, high = np.quantile(finite, [0.25, 0.5, 0.75]) if len(finite) else (0.0, 0.0, 0.0)
        reach = _BEYOND * (high - low) or float(np.abs(finite - middle).max(initial=1.0))
        found[:, k] = np.clip(np.nan_to_num(column, nan=np.inf), middle - reach, middle + reach)
    return found
