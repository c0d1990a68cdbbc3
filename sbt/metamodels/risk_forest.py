"""P(critical) of many noisy runs of which few are critical: two forests, calibrated on runs that their trees had not seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit

from sbt.metamodels.joint import LogPair
from sbt.problem.arrays import Mask, Points, Vector

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor

__all__ = ["Risk", "fit_risk"]

Risk = Callable[[Points], LogPair]
"""(n, m) metamodel inputs to (n,) log P(critical) and (n,) log of the rest."""

_TREES = 60  # of each forest
_SCORE_LEAF, _LABEL_LEAF = 3, 2  # runs in a leaf of the two forests
_FEWEST, _EVENT = 10, 5  # runs to learn from; critical and safe ones among them, below which labels alone teach nothing
_PENALTY = 0.3  # on squared slopes of standardised scores


def fit_risk(inputs: Points, score: Vector, critical: Mask, rng: np.random.Generator) -> Risk:
    """Return P(critical) as learned from runs.

    One forest learns how near a run came, which tells of rare failures before there are many; one learns which runs were
    critical. What both say of rows that a tree had not drawn is turned into P by a logistic regression (stacking). With few
    critical (or safe) runs the first forest alone ranks, and the mean P is that of the runs.

    Args:
        inputs: (n, m) of the runs.
        score: (n,) how near a run came, smaller is nearer; of ranks, so that single values do not decide.
        critical: (n,) which were critical.
        rng: the only source of randomness.

    Source:
        Geurts et al. (2006), Extremely randomized trees; Breiman (1996), Out-of-bag estimation; Wolpert (1992), Stacked
        generalization; Platt (1999).
    """
    n, hits = len(score), int(critical.sum())
    base = float(np.log((hits + 0.5) / (n - hits + 0.5)))
    if n < _FEWEST or np.ptp(score) == 0.0:
        return lambda points: _pair(np.full(len(points), base))
    states = rng.integers(2**31, size=2)
    near = _nearness(inputs, score, int(states[0]))
    few = min(hits, n - hits) < _EVENT
    event = score <= np.partition(score, _clipped(hits, n) - 1)[_clipped(hits, n) - 1] if few else critical
    labels = None if few else _labels(inputs, critical, int(states[1]))
    unseen = [near.oob_prediction_]
    if labels is not None:
        unseen.append(_log_odds(np.nan_to_num(labels.oob_decision_function_[:, 1]), n))
    columns = np.column_stack(unseen)
    shift, scale = columns.mean(axis=0), np.maximum(columns.std(axis=0), 1e-12)
    weight = _logistic((columns - shift) / scale, event)
    weight[-1] += _intercept(_linear((columns - shift) / scale, weight), hits + 0.5, n + 1.0)

    def risk(points: Points) -> LogPair:
        found = [near.predict(points)]
        if labels is not None:
            found.append(_log_odds(labels.predict_proba(points)[:, 1], n))
        return _pair(_linear((np.column_stack(found) - shift) / scale, weight))

    return risk


def _nearness(inputs: Points, score: Vector, state: int) -> ExtraTreesRegressor:
    from sklearn.ensemble import ExtraTreesRegressor

    forest = ExtraTreesRegressor(
        _TREES, min_samples_leaf=_SCORE_LEAF, bootstrap=True, oob_score=True, random_state=state, n_jobs=1
    )  # fmt: skip
    return forest.fit(inputs, score)


def _labels(inputs: Points, critical: Mask, state: int) -> ExtraTreesClassifier:
    from sklearn.ensemble import ExtraTreesClassifier

    forest = ExtraTreesClassifier(
        _TREES, min_samples_leaf=_LABEL_LEAF, bootstrap=True, oob_score=True, random_state=state, n_jobs=1
    )  # fmt: skip
    return forest.fit(inputs, critical)


def _clipped(hits: int, n: int) -> int:
    """Return a number of runs that is neither few nor all but few."""
    return min(max(hits, _EVENT), n - _EVENT)


def _log_odds(p: Vector, n: int) -> Vector:
    """Return (n,) log odds of shares of a leaf, never beyond what n runs can tell."""
    least = 0.5 / n
    return np.asarray(np.log((p + least) / (1.0 - p + least)))


def _linear(columns: Points, weight: Vector) -> Vector:
    return np.asarray(columns @ weight[:-1] + weight[-1])


def _logistic(columns: Points, event: Mask) -> Vector:
    """Return the (k + 1,) slopes and intercept of a logistic regression with a ridge penalty on its slopes."""
    if event.all() or not event.any():
        return np.zeros(columns.shape[1] + 1)  # nothing to tell apart; the intercept comes from the share
    from sklearn.linear_model import LogisticRegression

    fitted = LogisticRegression(C=1.0 / _PENALTY, solver="newton-cholesky", tol=1e-8).fit(columns, event)
    return np.append(fitted.coef_[0], fitted.intercept_[0])


def _intercept(log_odds: Vector, hits: float, n: float) -> float:
    """Return what is added to the log odds of runs, so that their mean P is `hits` of n."""
    target, reach = float(np.log(hits / (n - hits))), float(np.abs(log_odds).max(initial=0.0)) + 1.0
    return float(brentq(lambda shift: expit(log_odds + shift).mean() - hits / n, target - reach, target + reach))


def _pair(log_odds: Vector) -> LogPair:
    return -np.logaddexp(0.0, -log_odds), -np.logaddexp(0.0, log_odds)
