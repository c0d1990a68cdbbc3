"""A Gaussian process of two classes: P(yes | u) by a probit link, so that a small place where all say no is no chance.

Least squares on labels 0 and 1 have one noise for all of them, and smooth a few neighbouring no's away. Here the labels are
certain where the latent function is large, and drawn by chance where it is flat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from sbt.metamodels.expectation_propagation import Belief, Hyper, Priors, believe, fitted, latent
from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["Classifier", "classifier"]

_LENGTHS = (0.3, 0.1)  # in sqrt(d), from which the search starts, each with one latent spread:
_SPREAD = 3.0
_BOUNDS = ((-3.5, 4.0), (-4.0, math.log(10.0)), (-30.0, 30.0))  # of log lengths, log spread and mean
_LENGTH_SPREAD = math.sqrt(3.0)  # of the prior of log lengths, about sqrt(2) + log(d) / 2: that of the metamodel of y
_SPREAD_PRIOR = (math.log(2.0), 1.5)  # of the log latent spread
_MEAN_PRIOR = 8.0  # spread of that of the mean about 0
_LEARNED = 200  # rows that hyperparameters are found by; all are learned from
_EXPLAINED = 0.5  # of the log likelihood of chance that one start may leave, for which no other is tried
_WIDE = 2.0  # standard deviations to each end of an interval


@dataclass(frozen=True, eq=False)
class Classifier:
    """A fitted one: (n, d) points -> (n,) P(yes).

    Attributes:
        gain: log evidence above that of one P wherever; about 0 where the labels are of chance.
    """

    u: Points
    hyper: Hyper
    belief: Belief
    gain: float

    def __call__(self, points: Points) -> Vector:
        """Return (n,) P(yes)."""
        mean, variance = latent(points, self.u, self.hyper, self.belief)
        return np.asarray(ndtr(mean / np.sqrt(1.0 + variance)))

    def ends(self, points: Points) -> tuple[Vector, Vector]:
        """Return (n,) ends of the 95 % interval of P(yes)."""
        mean, variance = latent(points, self.u, self.hyper, self.belief)
        return np.asarray(ndtr(mean - _WIDE * np.sqrt(variance))), np.asarray(ndtr(mean + _WIDE * np.sqrt(variance)))


def classifier(u: Points, yes: Mask, rng: np.random.Generator) -> Classifier:
    """Return P(yes | u), learned from (m, d) points and their labels, of which both are met."""
    low, high, d = np.where(yes, 0.0, -np.inf), np.where(yes, np.inf, 0.0), u.shape[1]
    few = _subset(yes, rng)
    unexplained = _chance(yes[few])
    about = math.sqrt(2.0) + 0.5 * math.log(d)
    priors = Priors((about, _LENGTH_SPREAD), _SPREAD_PRIOR, (0.0, _MEAN_PRIOR), None, _BOUNDS)
    mean = float(ndtri(yes[few].mean())) * math.hypot(1.0, _SPREAD)
    found: list[tuple[Hyper, float]] = []
    for length in _LENGTHS:
        start = Hyper(np.full(d, length * math.sqrt(d)), _SPREAD, mean)
        found.append(fitted(u[few], low[few], high[few], start, priors))
        if found[-1][1] < _EXPLAINED * unexplained:
            break
    best, _ = min(found, key=lambda each: each[1])
    belief = believe(best, best.covariance(u)[0], low, high)
    return Classifier(u, best, belief, belief.log_evidence + _chance(yes))


def _chance(yes: Mask) -> float:
    """Return minus the log likelihood of labels that are drawn by chance, with the same probability wherever."""
    share = float(yes.mean())
    return float(-len(yes) * (share * math.log(share) + (1.0 - share) * math.log1p(-share)))


def _subset(yes: Mask, rng: np.random.Generator) -> np.ndarray:
    """Return the rows that hyperparameters are found by: all of the rarer label as far as they are few."""
    if len(yes) <= _LEARNED:
        return np.arange(len(yes))
    rare = np.flatnonzero(yes if yes.mean() < 0.5 else ~yes)
    rare = rng.permutation(rare)[: max(_LEARNED // 3, round(_LEARNED * len(rare) / len(yes)))]
    rest = rng.permutation(np.flatnonzero(yes if yes.mean() >= 0.5 else ~yes))[: _LEARNED - len(rare)]
    return np.sort(np.concatenate([rare, rest]))
