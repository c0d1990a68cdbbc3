"""A Gaussian process of two classes: P(yes | u) by a probit link, so that a small place where all say no is no chance.

Least squares on labels 0 and 1 have one noise for all of them, and smooth a few neighbouring no's away. Here the labels are
certain where the latent function is large, and drawn by chance where it is flat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import OptimizeResult, minimize
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr, ndtr, ndtri

from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["Classifier", "classifier"]

_LENGTHS = (0.3, 0.1)  # in sqrt(d), from which L-BFGS starts, each with one latent spread:
_SPREAD = 3.0
_BOUNDS = ((-3.5, 4.0), (-4.0, math.log(10.0)), (-30.0, 30.0))  # of log lengths, log spread and mean
_LENGTH_SPREAD = math.sqrt(3.0)  # of the prior of log lengths, about sqrt(2) + log(d) / 2: that of the metamodel of y
_SPREAD_PRIOR = (math.log(2.0), 1.5)  # of the log latent spread
_MEAN_PRIOR = 8.0  # spread of that of the mean about 0
_LEARNED = 200  # rows that hyperparameters are found by; all are learned from
_SWEEPS, _CLOSE, _DAMPED = 40, 1e-5, 0.8  # of expectation propagation: at most, change of log evidence that ends them, step
_STEPS, _ENOUGH = 40, 1e-4  # of L-BFGS: at most, and relative gain that ends them
_EXPLAINED = 0.5  # of the log likelihood of chance that one start may leave, for which no other is tried
_LOG_ROOT = 0.5 * math.log(2.0 * math.pi)
_WIDE = 2.0  # standard deviations to each end of an interval
_CHUNK = 4096  # points predicted at once


@dataclass(frozen=True, eq=False)
class _Belief:
    """Gaussian belief about the latent function at m rows, given hyperparameters.

    Attributes:
        precision, shift: (m,) of the Gaussian that stands for each label, and its mean above the latent one, times precision.
        pull: (m,) K^-1 (mean of the belief - mean).
        lower: Cholesky factor of I + root K root, where root is that of the precision.
        log_evidence: of the labels.
    """

    precision: Vector
    shift: Vector
    pull: Vector
    lower: Points
    log_evidence: float


@dataclass(frozen=True, eq=False)
class Classifier:
    """A fitted one: (n, d) points -> (n,) P(yes).

    Attributes:
        gain: log evidence above that of one P wherever; about 0 where the labels are of chance.
    """

    u: Points
    lengths: Vector
    spread: float
    mean: float
    belief: _Belief
    gain: float

    def __call__(self, points: Points) -> Vector:
        """Return (n,) P(yes)."""
        latent, variance = self._latent(points)
        return np.asarray(ndtr(latent / np.sqrt(1.0 + variance)))

    def ends(self, points: Points) -> tuple[Vector, Vector]:
        """Return (n,) ends of the 95 % interval of P(yes)."""
        latent, variance = self._latent(points)
        return np.asarray(ndtr(latent - _WIDE * np.sqrt(variance))), np.asarray(ndtr(latent + _WIDE * np.sqrt(variance)))

    def _latent(self, points: Points) -> tuple[Vector, Vector]:
        """Return mean and variance of the latent function (n,)."""
        parts = [self._part(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)]
        return np.concatenate([m for m, _ in parts] or [np.empty(0)]), np.concatenate([v for _, v in parts] or [np.empty(0)])

    def _part(self, points: Points) -> tuple[Vector, Vector]:
        across = _matern(points / self.lengths, self.u / self.lengths)[0] * self.spread**2  # (n, m)
        rows = np.sqrt(self.belief.precision)[:, None] * across.T
        v = solve_triangular(self.belief.lower, rows, lower=True, check_finite=False)
        return self.mean + across @ self.belief.pull, np.maximum(self.spread**2 - (v**2).sum(axis=0), 0.0)


def classifier(u: Points, yes: Mask, rng: np.random.Generator) -> Classifier:
    """Return P(yes | u), learned from (m, d) points and their labels, of which both are met.

    Source:
        Rasmussen and Williams (2006), Gaussian processes for machine learning, algorithms 3.6, 5.2 and section 3.6 (expectation
        propagation; here all sites at once).
    """
    sign, d = np.where(yes, 1.0, -1.0), u.shape[1]
    few = _subset(yes, rng)
    unexplained = _chance(yes[few])
    best, value = np.empty(0), math.inf
    for length in _LENGTHS:
        if value < _EXPLAINED * unexplained:
            break
        found = _fitted(u[few], sign[few], length * math.sqrt(d))
        best, value = (found.x, float(found.fun)) if found.fun < value else (best, value)
    belief = _believe(_covariance(best, u)[0], float(best[-1]), sign, None)
    gain = belief.log_evidence + _chance(yes)
    return Classifier(u, np.exp(best[:d]), math.exp(best[d]), float(best[-1]), belief, gain)


def _chance(yes: Mask) -> float:
    """Return minus the log likelihood of labels that are drawn by chance, with the same probability wherever."""
    share = float(yes.mean())
    return float(-len(yes) * (share * math.log(share) + (1.0 - share) * math.log1p(-share)))


def _fitted(u: Points, sign: Vector, length: float) -> OptimizeResult:
    """Return hyperparameters of a largest posterior density, from a length on."""
    d = u.shape[1]
    known: tuple[Vector, Vector] | None = None

    def objective(theta: Vector) -> tuple[float, Vector]:
        nonlocal known
        value, slope, known = _log_posterior(theta, u, sign, known)
        return -value, -slope

    mean = float(ndtri((sign > 0.0).mean())) * math.hypot(1.0, _SPREAD)
    begin = np.array([math.log(length)] * d + [math.log(_SPREAD), mean])
    bounds = [_BOUNDS[0]] * d + [_BOUNDS[1], _BOUNDS[2]]
    return minimize(objective, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": _STEPS, "ftol": _ENOUGH})


def _subset(yes: Mask, rng: np.random.Generator) -> np.ndarray:
    """Return the rows that hyperparameters are found by: all of the rarer label as far as they are few."""
    if len(yes) <= _LEARNED:
        return np.arange(len(yes))
    rare = np.flatnonzero(yes if yes.mean() < 0.5 else ~yes)
    rare = rng.permutation(rare)[: max(_LEARNED // 3, round(_LEARNED * len(rare) / len(yes)))]
    rest = rng.permutation(np.flatnonzero(yes if yes.mean() >= 0.5 else ~yes))[: _LEARNED - len(rare)]
    return np.sort(np.concatenate([rare, rest]))


def _matern(a: Points, b: Points) -> tuple[Points, Points]:
    """Return the Matern 5/2 correlation of scaled points (n, m), and minus its derivative by r^2 / 2."""
    r = math.sqrt(5.0) * cdist(a, b)
    e = np.exp(-r)
    return (1.0 + r + r * r / 3.0) * e, 5.0 / 3.0 * (1.0 + r) * e


def _covariance(theta: Vector, u: Points) -> tuple[Points, Points]:
    scaled, variance = u / np.exp(theta[: u.shape[1]]), math.exp(2.0 * theta[-2])
    k, slope = _matern(scaled, scaled)
    return variance * k, variance * slope


def _believe(covariance: Points, mean: float, sign: Vector, start: tuple[Vector, Vector] | None) -> _Belief:
    """Return what expectation propagation believes, all labels at once."""
    precision, shift = (np.zeros(len(sign)), np.zeros(len(sign))) if start is None else start
    before = math.inf
    for k in range(_SWEEPS):
        lower, pull, middle, variance = _solved(covariance, precision, shift)
        rest = np.maximum(1.0 / variance - precision, 1e-10)  # without the label
        beside = (middle / variance - shift) / rest
        width = np.sqrt(1.0 + 1.0 / rest)
        z = sign * (beside + mean) / width
        r = np.exp(-0.5 * z * z - _LOG_ROOT - log_ndtr(z))
        about = beside + sign * r / (rest * width)
        narrowed = np.maximum(1.0 / rest - r * (z + r) / (rest * width) ** 2, 1e-12)
        log_evidence = (
            float(log_ndtr(z).sum() + 0.5 * np.log1p(precision / rest).sum() - np.log(np.diag(lower)).sum())
            + 0.5 * float((shift * middle).sum() - (shift**2 / (rest + precision)).sum())
            + 0.5 * float((beside * rest * (precision * beside - 2.0 * shift) / (rest + precision)).sum())
        )
        found = np.maximum(1.0 / narrowed - rest, 1e-10)
        aim = about / narrowed - beside * rest
        if abs(log_evidence - before) < _CLOSE:
            break
        before = log_evidence
        damped = 1.0 if k < 3 else _DAMPED
        precision, shift = precision + damped * (found - precision), shift + damped * (aim - shift)
    return _Belief(precision, shift, pull, lower, log_evidence)


def _solved(covariance: Points, precision: Vector, shift: Vector) -> tuple[Points, Vector, Vector, Vector]:
    """Return factor and pull of a belief, its mean above the latent one, and its variance."""
    root = np.sqrt(precision)
    b = root[:, None] * covariance * root
    b[np.diag_indices_from(b)] += 1.0
    lower = np.asarray(cholesky(b, lower=True, check_finite=False))
    half = solve_triangular(lower, root[:, None] * covariance, lower=True, check_finite=False)
    pull = shift - root * solve_triangular(lower, half @ shift, lower=True, trans=1, check_finite=False)
    return lower, pull, covariance @ pull, np.maximum(np.diag(covariance) - (half**2).sum(axis=0), 1e-12)


def _log_posterior(
    theta: Vector, u: Points, sign: Vector, start: tuple[Vector, Vector] | None
) -> tuple[float, Vector, tuple[Vector, Vector]]:
    """Return the log posterior density of hyperparameters, its gradient, and the labels' Gaussians to go on from."""
    d, mean = u.shape[1], float(theta[-1])
    covariance, falling = _covariance(theta, u)
    belief = _believe(covariance, mean, sign, start)
    root = np.sqrt(belief.precision)
    inverse = cho_solve((belief.lower, True), np.diag(root), check_finite=False) * root[:, None]
    weight, slopes = 0.5 * (np.outer(belief.pull, belief.pull) - inverse), np.empty(d + 2)
    for k in range(d):
        slopes[k] = float((weight * falling * ((u[:, k, None] - u[None, :, k]) / math.exp(theta[k])) ** 2).sum())
    slopes[d], slopes[d + 1] = 2.0 * float((weight * covariance).sum()), float(belief.pull.sum())
    lengths = theta[:d] - (math.sqrt(2.0) + 0.5 * math.log(d))
    spread = float(theta[d]) - _SPREAD_PRIOR[0]
    prior = -0.5 * float((lengths**2).sum()) / _LENGTH_SPREAD**2
    prior += -0.5 * (spread / _SPREAD_PRIOR[1]) ** 2 - 0.5 * (mean / _MEAN_PRIOR) ** 2
    slopes[:d] -= lengths / _LENGTH_SPREAD**2
    slopes[d] -= spread / _SPREAD_PRIOR[1] ** 2
    slopes[d + 1] -= mean / _MEAN_PRIOR**2
    return belief.log_evidence + float(prior), slopes, (belief.precision, belief.shift)
