"""Stacking: scores of models on held-out rows, and the weights of the best mixture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sbt.metamodels.base import Metamodel
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Bins", "cell_shares", "held_out_scores", "is_surely_better", "mixture_score", "stacking_weights", "surely_positive"]

_SURE = 3.0  # standard errors: with two, mixtures were taken that lost on whole campaigns (docs/measured/boundary.md)
_PROBES = 4096  # points that tell which part of the space a row stands for
_ROUNDS, _MOVED = 500, 1e-6  # of expectation maximisation: at most, and the change of a weight at which it ends


class Unit(Protocol):
    """An increasing map of the metric."""

    def values(self, y: Vector) -> Vector:
        """Return y (n,) in that unit; infinite ends stay."""
        ...


@dataclass(frozen=True)
class Bins:
    """Ranges of y that a score tells apart: on which side of the critical edge a run fell, and whether near it.

    The density of y, summed over all runs, says little about the edge: a model that knows the plateau of the runs
    without a conflict to a thousandth wins there, whatever it predicts for the few that matter. The probability of
    a range has no such spikes.

    Args:
        critical: M_c, in the unit of y.
        near: distance > 0 from an end of M_c that counts as near; infinite: only the sides are told apart.
        warp: in whose unit both are; None: in that of y.

    Source:
        The logarithmic score of a categorical outcome, which is proper: Gneiting & Raftery (2007), section 3.
    """

    critical: CriticalInterval
    near: float
    warp: Warp | None = None

    @classmethod
    def around_edge(cls, y: Vector, critical: CriticalInterval, warp: Warp | None = None) -> Bins:
        """Return the ranges for runs y (n,): the quarter of them that is nearest to the edge is near.

        No value lies on a cut: of a metric of two values only the side of the edge counts, nearness would favour one of them.
        """
        around = Warp.around_edge(y, critical)
        distance = np.abs(y - around.edge)
        farther = distance[distance > around.scale]
        if not (distance == around.scale).any():
            return cls(critical, around.scale, warp)
        return cls(critical, 0.5 * (around.scale + float(farther.min())) if len(farther) else np.inf, warp)

    @property
    def told(self) -> str:
        """The cuts in the unit of the metric, in words."""
        cuts = self.cuts if self.warp is None else self.warp.back(self.cuts)
        return ", ".join(f"{cut:.3g}" for cut in cuts)

    @property
    def cuts(self) -> Vector:
        """(m,) increasing ends of the ranges; the first and the last range reach to infinity.

        >>> Bins(CriticalInterval(0.0, 5.0), near=1.0).cuts.tolist()
        [-1.0, 0.0, 1.0, 4.0, 5.0, 6.0]
        """
        ends = [end for end in (self.critical.low, self.critical.high) if np.isfinite(end)]
        steps = (-self.near, 0.0, self.near) if np.isfinite(self.near) else (0.0,)
        return np.unique([end + step for end in ends for step in steps])

    def log_score(self, prediction: Prediction, y: Vector, unit: Unit | None = None) -> Vector:
        """Return (n,) log probabilities of the ranges that y (n,) fell into; M_c is closed; `unit`: of the prediction."""
        ends, score = np.array([-np.inf, *self.cuts, np.inf]), np.empty(len(y))
        ends = ends if unit is None else unit.values(ends)
        fell = np.searchsorted(self.cuts, y, side="right") - (y == self.critical.high)
        for k in np.unique(fell):
            mine = fell == k
            score[mine] = prediction.take(mine).log_probability(CriticalInterval(float(ends[k]), float(ends[k + 1])))[0]
        return score


def held_out_scores(
    models: Iterable[Metamodel], u: Points, y: Vector, folds: int, rng: np.random.Generator, bins: Bins | None,
    rows: int | None = None,
) -> tuple[Points, NDArray[np.intp]]:  # fmt: skip
    """Return (k, m) log scores of rows under k models fitted to the other folds, of their bin or log density, and (m,) the rows.

    All rows are scored, or as many folds of them as hold at least `rows`.
    """
    fold, compared = rng.permutation(len(y)) % folds, list(models)
    score = np.full((len(compared), len(y)), np.nan)
    for i in range(folds):
        if rows is not None and int((fold < i).sum()) >= rows:
            break
        out = fold == i
        for row, model in zip(score, compared, strict=True):
            prediction = model.fit(u[~out], y[~out], rng)(u[out])
            row[out] = prediction.log_density(y[out]) if bins is None else bins.log_score(prediction, y[out])
    scored = np.flatnonzero(~np.isnan(score).any(axis=0))
    return score[:, scored], scored


def cell_shares(u: Points, rng: np.random.Generator) -> Vector:
    """Return (n,) the share of the unit cube that is nearest to each row u (n, d): where rows crowd, one counts less.

    Equal rows divide theirs.

    >>> cell_shares(np.array([[0.1], [0.12], [0.9]]), np.random.Generator(np.random.PCG64(0))).round(1).tolist()
    [0.1, 0.4, 0.5]
    >>> cell_shares(np.array([[0.25], [0.75], [0.25]]), np.random.Generator(np.random.PCG64(0))).round(1).tolist()
    [0.3, 0.5, 0.3]
    """
    rows, group, count = np.unique(u, axis=0, return_inverse=True, return_counts=True)
    nearest = cKDTree(rows).query(rng.random((_PROBES, u.shape[1])))[1]
    share = np.bincount(nearest, minlength=len(rows)) / (_PROBES * count)
    return np.asarray(share[group.reshape(-1)])


def stacking_weights(log_score: Points, prior: float, counts: Vector | None = None) -> Vector:
    """Return the (k,) weights of the mixture of largest likelihood, by expectation maximisation.

    Args:
        log_score: (k, n) of each row under each model; -inf where a model excludes what happened.
        prior: weight of equal weights, in rows.
        counts: (n,) how often each row counts, >= 0, n in all; None: once.

    Source:
        Yao et al. (2018), Using stacking to average Bayesian predictive distributions.

    >>> stacking_weights(np.log([[0.9, 0.8, 0.9], [0.1, 0.1, 0.1]]), prior=0.0).round(2).tolist()
    [1.0, 0.0]
    """
    k = len(log_score)
    log_score = np.maximum(log_score, -1e300)
    density = np.exp(log_score - log_score.max(axis=0))
    n, weights = log_score.shape[1], np.full(k, 1.0 / k)
    times = np.ones(n) if counts is None else counts
    for _ in range(_ROUNDS):
        joint = weights[:, None] * density
        new = ((joint / joint.sum(axis=0)) @ times + prior / k) / (n + prior)
        moved, weights = np.abs(new - weights).max(), new
        if moved < _MOVED:
            break
    return np.asarray(weights / weights.sum())


def mixture_score(log_score: Points, weights: Vector) -> Vector:
    """Return the (n,) log scores of the mixture of k models with (k, n) scores and weights >= 0."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.logaddexp.reduce(log_score + np.log(weights)[:, None], axis=0))


def surely_positive(gain: Vector, errors: float) -> bool:
    """Return whether the mean of gains (n,) exceeds 0 by so many of its standard errors."""
    return float(gain.mean()) > errors * float(gain.std()) / len(gain) ** 0.5


def is_surely_better(log_score: Points, weights: Vector, shares: Vector | None = None) -> bool:
    """Return whether the mixture is better than the first of the k models by three standard errors of (k, n) scores.

    Args:
        log_score: (k, n) of each row under each model.
        weights: (k,) of the mixture.
        shares: (n,) of the space that each row stands for (see `cell_shares`); there, too, the mixture has to be better.

    >>> is_surely_better(np.log([[0.5, 0.5, 0.5, 0.5], [0.8, 0.7, 0.8, 0.7]]), np.array([0.0, 1.0]))
    True
    """
    gain = mixture_score(log_score, weights) - log_score[0]
    return surely_positive(gain, _SURE) and (shares is None or float(shares @ gain) > 0.0)
