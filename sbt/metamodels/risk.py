"""P(critical) of many noisy runs of which few are critical: forests and a Gaussian process, stacked on runs they had not seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, log_expit, log_ndtr, ndtri

from sbt.metamodels.joint import LogPair
from sbt.problem.arrays import Mask, Points, Vector

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor

__all__ = ["Learner", "Risk", "fit_process", "fit_risk", "fit_risk_scored"]

Learner = Callable[[Points], Vector]
"""(n, m) metamodel inputs to (n,) scores, or log odds."""
Risk = Callable[[Points], LogPair]
"""(n, m) metamodel inputs to (n,) log P(critical) and (n,) log of the rest."""

_TREES = 60  # of each forest
_SCORE_LEAF, _LABEL_LEAF = 3, 2  # runs in a leaf of the two forests
_FEWEST, _EVENT = 10, 5  # runs to learn from; critical and safe ones among them, below which labels alone teach nothing
_PENALTY = 0.3  # on squared slopes of standardised scores
_PROCESS_ROWS, _FITTED_ROWS = 1000, 300  # that the process is conditioned on, and that its length scales are fitted to
_SURELY = 2.0  # standard errors by which the process makes the events likelier, from which on it takes part
_WIDEST = 3.0  # standard deviations of a column, beyond which the process takes it for as far
_SKEWED = 2.0  # skewness of a column from which on only the order of its values counts
_SURE = 12.0  # log odds of the process, beyond which a Gaussian tail tells nothing


def fit_risk(inputs: Points, score: Vector, margin: Vector, critical: Mask, rng: np.random.Generator) -> Risk:
    """Return P(critical) as learned from runs.

    One forest learns how near a run came, which tells of rare failures before there are many; one learns which runs were
    critical; a Gaussian process learns the margin, which is better where little of it is noise. What they say of rows that
    they had not seen is turned into P by a logistic regression (stacking); the process takes part where critical runs surely
    become likelier by it. With few critical (or safe) runs the forest of labels is left out, and the mean P is that of the runs.
    Of a skewed column only the order of its values counts.

    Args:
        inputs: (n, m) of the runs.
        score: (n,) how near a run came, smaller is nearer; of ranks, so that single values do not decide.
        margin: (n,) signed distances to the critical interval, <= 0 where critical; infinite or NaN where a run has none.
        critical: (n,) which were critical.
        rng: the only source of randomness.

    Source:
        Geurts et al. (2006), Extremely randomized trees; Breiman (1996), Out-of-bag estimation; Wolpert (1992), Stacked
        generalization; Platt (1999).
    """
    return fit_risk_scored(inputs, score, margin, critical, rng)[0]


def fit_risk_scored(
    inputs: Points, score: Vector, margin: Vector, critical: Mask, rng: np.random.Generator
) -> tuple[Risk, Vector]:
    """Return what `fit_risk` does, and (n,) log P, by what had not seen it, of whether a run was critical.

    With few critical (or safe) runs it is that of whether it is one of the five nearest (or all but the five farthest).
    """
    n, hits = len(score), int(critical.sum())
    base = float(np.log((hits + 0.5) / (n - hits + 0.5)))
    if n < _FEWEST or np.ptp(score) == 0.0:
        return (lambda points: _pair(np.full(len(points), base))), _log_likelihood(np.full(n, base), critical)
    placed = _placement(inputs)
    inputs, states = placed(inputs), rng.integers(2**31, size=2)
    few = min(hits, n - hits) < _EVENT
    event = score <= np.partition(score, _clipped(hits, n) - 1)[_clipped(hits, n) - 1] if few else critical
    learners, unseen = _forests(inputs, score, None if few else critical, states.tolist())
    weight = _logistic(unseen, event)
    process = fit_process(inputs, margin, rng)
    if process is not None:
        both = np.column_stack([unseen, process[1]])
        with_process = _logistic(both, event)
        gain = _log_likelihood(_linear(both, with_process), event) - _log_likelihood(_linear(unseen, weight), event)
        if gain.sum() > _SURELY * np.sqrt(n) * gain.std():
            learners, unseen, weight = (*learners, process[0]), both, with_process
    told = _log_likelihood(_linear(unseen, weight), event)
    weight[-1] += _intercept(_linear(unseen, weight), hits + 0.5, n + 1.0)

    def risk(points: Points) -> LogPair:
        at = placed(points)
        return _pair(_linear(np.column_stack([learner(at) for learner in learners]), weight))

    return risk, told


def _placement(inputs: Points) -> Callable[[Points], Points]:
    """Return what replaces values of skewed columns by normal scores of their ranks among these rows (n, m).

    Trees split a column anywhere between its ends, and a process measures distances along it: most of a skewed one is one place.
    """
    centred = inputs - inputs.mean(axis=0)
    skewness = np.abs((centred**3).mean(axis=0)) / np.maximum(centred.std(axis=0), 1e-100) ** 3
    steps = {}
    for column in np.flatnonzero(skewness > _SKEWED):
        values, count = np.unique(inputs[:, column], return_counts=True)
        steps[column] = values, ndtri((np.cumsum(count) - 0.5 * count) / len(inputs))

    def placed(points: Points) -> Points:
        found = np.array(points, dtype=np.float64)
        for column, (values, place) in steps.items():
            found[:, column] = np.interp(found[:, column], values, place)
        return found

    return placed


def _forests(inputs: Points, score: Vector, critical: Mask | None, states: list[int]) -> tuple[tuple[Learner, ...], Points]:
    """Return forests of the scores and, where there are labels, of these, and (n, k) what they say of rows not drawn."""
    near, n = _nearness(inputs, score, states[0]), len(score)
    if critical is None:
        return (near.predict,), near.oob_prediction_[:, None]
    labels = _labels(inputs, critical, states[1])
    unseen = _log_odds(np.nan_to_num(labels.oob_decision_function_[:, 1]), n)
    return (near.predict, lambda points: _log_odds(labels.predict_proba(points)[:, 1], n)), np.column_stack(
        [near.oob_prediction_, unseen]
    )


def fit_process(inputs: Points, margin: Vector, rng: np.random.Generator) -> tuple[Learner, Vector] | None:
    """Return log odds of critical by a Gaussian process of the margins, and (n,) those of rows predicted from all others.

    Margins are learned as arcsinh(margin / median distance to the edge), with one noise for all; rows without one are predicted.

    Args:
        inputs: (n, m) of the runs, in any units.
        margin: (n,) signed distances to the critical interval; infinite or NaN where a run has none.
        rng: the only source of randomness.

    Returns:
        None where fewer than ten runs have a margin, or all the same one.
    """
    from sbt.metamodels.gaussian_process import GaussianProcess  # PyTorch

    known = np.isfinite(margin)
    scale = float(np.median(np.abs(margin[known]))) if known.any() else 0.0
    if known.sum() < _FEWEST or scale == 0.0 or np.ptp(margin[known]) == 0.0:
        return None
    centre, spread = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-300)

    def placed(points: Points) -> Points:  # a uniform column covers the unit interval
        return np.asarray(0.5 + np.clip((points - centre) / spread, -_WIDEST, _WIDEST) / np.sqrt(12.0))

    def log_odds(mean: Vector, std: Vector) -> Vector:
        ratio = -mean / std
        return np.clip(log_ndtr(ratio) - log_ndtr(-ratio), -_SURE, _SURE)

    def predicted(points: Points) -> Vector:
        found = fitted(placed(points))
        return log_odds(found.mean[0], found.std[0])

    u, t = placed(inputs[known]), np.arcsinh(margin[known] / scale)
    fitted = GaussianProcess(kernels=1, input_noise=False, most_rows=_PROCESS_ROWS, fit_rows=_FITTED_ROWS).fit(u, t, rng)
    unseen, left_out = np.empty(len(margin)), fitted.leave_one_out(u, t)
    unseen[known] = log_odds(left_out.mean[0], left_out.std[0])
    if not known.all():
        unseen[~known] = predicted(inputs[~known])
    return predicted, unseen


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


def _log_likelihood(log_odds: Vector, event: Mask) -> Vector:
    """Return (n,) log likelihoods of what happened."""
    return np.asarray(log_expit(np.where(event, log_odds, -log_odds)))


def _logistic(columns: Points, event: Mask) -> Vector:
    """Return the (k + 1,) slopes and intercept of a logistic regression with a ridge penalty on standardised slopes."""
    if event.all() or not event.any():
        return np.zeros(columns.shape[1] + 1)  # nothing to tell apart; the intercept comes from the share
    from sklearn.linear_model import LogisticRegression

    shift, scale = columns.mean(axis=0), np.maximum(columns.std(axis=0), 1e-12)
    fitted = LogisticRegression(C=1.0 / _PENALTY, solver="newton-cholesky", tol=1e-8).fit((columns - shift) / scale, event)
    slopes = fitted.coef_[0] / scale
    return np.append(slopes, fitted.intercept_[0] - slopes @ shift)


def _intercept(log_odds: Vector, hits: float, n: float) -> float:
    """Return what is added to the log odds of runs, so that their mean P is `hits` of n."""
    target, reach = float(np.log(hits / (n - hits))), float(np.abs(log_odds).max(initial=0.0)) + 1.0
    return float(brentq(lambda shift: expit(log_odds + shift).mean() - hits / n, target - reach, target + reach))


def _pair(log_odds: Vector) -> LogPair:
    return -np.logaddexp(0.0, -log_odds), -np.logaddexp(0.0, log_odds)
