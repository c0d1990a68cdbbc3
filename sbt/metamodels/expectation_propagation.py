"""A latent Gaussian process of which each row tells an interval: a label its sign, a rounded value what it was rounded from.

Rows are told by intervals of the latent function with a Gaussian noise on it; expectation propagation finds the Gaussian for each
of them that stands for what it says, all at once, and with it the evidence, whose gradient is written down. A row whose interval
has no width is what was measured: its Gaussian is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import OptimizeResult, minimize
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from sbt.problem.arrays import Points, Vector

__all__ = ["Belief", "Hyper", "Priors", "believe", "fitted", "latent", "latent_paths", "log_probability"]

_SWEEPS, _CLOSE, _DAMPED = 40, 1e-5, 0.8  # of expectation propagation: at most, change of log evidence that ends them, step
_STEPS, _ENOUGH = 40, 1e-4  # of L-BFGS: at most, and relative gain that ends them
_LEAST_REST = 1e-6  # of the precision of a belief, that other rows must have
_LOG_ROOT = 0.5 * math.log(2.0 * math.pi)
_CHUNK = 4096  # points predicted at once


@dataclass(frozen=True, eq=False)
class Belief:
    """Gaussian belief about the latent function at m rows, given hyperparameters.

    Attributes:
        precision, shift: (m,) of the Gaussian that stands for each row, and its mean above the latent one, times precision.
        pull: (m,) K^-1 (mean of the belief - mean).
        lower: Cholesky factor of I + root K root, where root is that of the precision.
        log_evidence: of the rows.
        beside, wide: (m,) mean above the latent one and variance of the latent function at each row by all others.
        by_noise: derivative of the log evidence by the log of the noise.
    """

    precision: Vector
    shift: Vector
    pull: Vector
    lower: Points
    log_evidence: float
    beside: Vector
    wide: Vector
    by_noise: float


@dataclass(frozen=True, eq=False)
class Hyper:
    """Hyperparameters: (d,) lengths, spread, mean and noise of the latent function (Matern 5/2)."""

    lengths: Vector
    spread: float
    mean: float
    noise: float = 1.0

    @classmethod
    def of(cls, theta: Vector) -> Hyper:
        """Return those of (d + 3,) logarithms, of the mean itself."""
        return cls(np.exp(theta[:-3]), math.exp(theta[-3]), float(theta[-2]), math.exp(theta[-1]))

    @property
    def theta(self) -> Vector:
        """(d + 3,) logarithms, of the mean itself."""
        return np.array([*np.log(self.lengths), math.log(self.spread), self.mean, math.log(self.noise)])

    def covariance(self, u: Points) -> tuple[Points, Points]:
        """Return the covariance (m, m) of the latent function at u (m, d), and minus its derivative by r^2 / 2."""
        k, slope = _matern(u / self.lengths, u / self.lengths)
        return self.spread**2 * k, self.spread**2 * slope


@dataclass(frozen=True)
class Priors:
    """Normal priors (mean, standard deviation) of log lengths, log spread, mean and log noise, and their bounds in this order.

    Without a prior of its noise that stays what it is at the start.
    """

    length: tuple[float, float]
    spread: tuple[float, float]
    mean: tuple[float, float]
    noise: tuple[float, float] | None
    bounds: Sequence[tuple[float, float]]

    def log_density(self, theta: Vector) -> tuple[float, Vector]:
        """Return the log density and its gradient (d + 3,)."""
        others = [self.spread, self.mean, self.noise or (float(theta[-1]), 1.0)]
        about, width = np.array([self.length] * (len(theta) - 3) + others).T
        z = (theta - about) / width
        return -0.5 * float(z @ z), -z / width


def fitted(u: Points, low: Vector, high: Vector, start: Hyper, priors: Priors) -> tuple[Hyper, float]:
    """Return hyperparameters of a largest posterior density, from others on, and minus its logarithm.

    Args:
        u: (m, d) rows.
        low: (m,) lower ends of the intervals in which the latent function with its noise lies.
        high: (m,) upper ends; equal to the lower one where the latent function was measured, with its noise.
        start: where L-BFGS starts.
        priors: of the hyperparameters.

    Source:
        Rasmussen and Williams (2006), Gaussian processes for machine learning, algorithms 3.6, 5.2 and section 3.6 (expectation
        propagation; here all sites at once, and intervals in place of signs).
    """
    d, sites = u.shape[1], None  # type: int, tuple[Vector, Vector] | None

    def objective(theta: Vector) -> tuple[float, Vector]:
        nonlocal sites
        value, slope, belief = _log_posterior(theta, u, low, high, priors, sites)
        sites = belief.precision, belief.shift
        return -value, -slope

    fixed = [(math.log(start.noise),) * 2] if priors.noise is None else []
    bounds = [priors.bounds[0]] * (d - 1) + [*priors.bounds, *fixed]
    found: OptimizeResult = minimize(
        objective, start.theta, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": _STEPS, "ftol": _ENOUGH}
    )
    return Hyper.of(found.x), float(found.fun)


def believe(
    hyper: Hyper, covariance: Points, low: Vector, high: Vector, start: tuple[Vector, Vector] | None = None
) -> Belief:  # fmt: skip
    """Return what expectation propagation believes, all rows at once, from the Gaussians of another belief on."""
    m, exact = len(low), low == high
    precision, shift = (np.zeros(m), np.zeros(m)) if start is None else start
    precision = np.where(exact, hyper.noise**-2.0, precision)
    shift = np.where(exact, (np.where(exact, low, 0.0) - hyper.mean) * precision, shift)
    k = np.flatnonzero(~exact) if exact.any() else slice(None)
    before = math.inf
    for sweep in range(_SWEEPS):
        lower, pull, middle, variance = _solved(covariance, precision, shift)
        rest = 1.0 / variance - precision  # without the row
        lost = rest < _LEAST_REST / variance  # what is left of it is rounding
        rest = np.where(lost, _LEAST_REST / variance, rest)
        beside = np.where(lost, middle, (middle / variance - shift) / rest)
        r, b, p, s = rest[k], beside[k], precision[k], shift[k]
        log_z, up, bent, by_noise = _moments(low[k] - hyper.mean - b, high[k] - hyper.mean - b, 1.0 / r, hyper.noise)
        log_evidence = (
            float(log_z.sum() + 0.5 * np.log1p(p / r).sum() - np.log(np.diag(lower)).sum())
            + 0.5 * float((s * middle[k]).sum() - (s**2 / (r + p)).sum())
            + 0.5 * float((b * r * (p * b - 2.0 * s) / (r + p)).sum())
            + _evidence_of_exact(precision[exact], shift[exact], middle[exact])
        )
        if abs(log_evidence - before) < _CLOSE or sweep == _SWEEPS - 1:
            break  # factor and Gaussians belong together
        before, about = log_evidence, b + up / r
        narrowed = np.maximum(1.0 / r - bent / r**2, 1e-12)
        found, aim = np.maximum(1.0 / narrowed - r, 1e-10), about / narrowed - b * r
        damped = 1.0 if sweep < 3 else _DAMPED
        precision, shift = precision.copy(), shift.copy()
        precision[k], shift[k] = p + damped * (found - p), s + damped * (aim - s)
    return Belief(precision, shift, pull, lower, log_evidence, beside, 1.0 / rest, float(by_noise.sum()))


def _evidence_of_exact(precision: Vector, shift: Vector, middle: Vector) -> float:
    """Return what rows add to the log evidence whose values are measured, with noise; `middle`: the mean that is believed."""
    return 0.5 * float((np.log(precision) - 2.0 * _LOG_ROOT + shift * (middle - shift / precision)).sum())


def log_probability(low: Vector, high: Vector) -> Vector:
    """Return log(ndtr(high) - ndtr(low)), shape kept, accurate in the tails; low < high."""
    flip = low + high > 0.0
    a, b = np.where(flip, -high, low), np.where(flip, -low, high)
    upper = log_ndtr(b)
    with np.errstate(divide="ignore"):
        return np.asarray(upper + np.log(-np.expm1(np.minimum(log_ndtr(a) - upper, -1e-300))))


def latent(points: Points, u: Points, hyper: Hyper, belief: Belief) -> tuple[Vector, Vector]:
    """Return mean and variance (n,) of the latent function, noise left out, at points (n, d) by rows u (m, d)."""
    means, variances = [np.empty(0)], [np.empty(0)]
    for k in range(0, len(points), _CHUNK):
        across = _matern(points[k : k + _CHUNK] / hyper.lengths, u / hyper.lengths)[0] * hyper.spread**2  # (n, m)
        rows = np.sqrt(belief.precision)[:, None] * across.T
        v = solve_triangular(belief.lower, rows, lower=True, check_finite=False)
        means.append(hyper.mean + across @ belief.pull)
        variances.append(np.maximum(hyper.spread**2 - (v**2).sum(axis=0), 0.0))
    return np.concatenate(means), np.concatenate(variances)


def latent_paths(points: Points, u: Points, hyper: Hyper, belief: Belief, n: int, rng: np.random.Generator) -> Points:
    """Return (n, m) draws of the latent function at points (m, d) by rows u; the cost is cubic in m."""
    at, scaled = points / hyper.lengths, u / hyper.lengths
    across = _matern(at, scaled)[0] * hyper.spread**2
    v = solve_triangular(belief.lower, np.sqrt(belief.precision)[:, None] * across.T, lower=True, check_finite=False)
    mean, covariance = hyper.mean + across @ belief.pull, _matern(at, at)[0] * hyper.spread**2 - v.T @ v
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(mean + rng.standard_normal((n, len(points))) @ root.T)


def _moments(low: Vector, high: Vector, variance: Vector, noise: float) -> tuple[Vector, Vector, Vector, Vector]:
    """Return log P of the interval, of a Gaussian about 0 with a noise, and three derivatives of it; all (m,).

    By its mean, minus the second one, and by the log of the noise.
    """
    width = np.sqrt(noise**2 + variance)
    a, b = low / width, high / width
    log_z = log_probability(a, b)
    with np.errstate(invalid="ignore", over="ignore"):
        at_a, at_b = (np.exp(-0.5 * np.minimum(z * z, 1e300) - _LOG_ROOT - log_z) for z in (a, b))
        drawn = np.where(np.isinf(b), 0.0, b * at_b) - np.where(np.isinf(a), 0.0, a * at_a)
    at = at_a - at_b
    return log_z, at / width, (drawn + at**2) / width**2, -drawn * (noise / width) ** 2


def _matern(a: Points, b: Points) -> tuple[Points, Points]:
    """Return the Matern 5/2 correlation of scaled points (n, m), and minus its derivative by r^2 / 2."""
    r = math.sqrt(5.0) * cdist(a, b)
    e = np.exp(-r)
    return (1.0 + r + r * r / 3.0) * e, 5.0 / 3.0 * (1.0 + r) * e


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
    theta: Vector, u: Points, low: Vector, high: Vector, priors: Priors, start: tuple[Vector, Vector] | None
) -> tuple[float, Vector, Belief]:
    """Return the log posterior density of hyperparameters, its gradient (d + 3,), and the belief."""
    d, hyper = u.shape[1], Hyper.of(theta)
    covariance, falling = hyper.covariance(u)
    belief = believe(hyper, covariance, low, high, start)
    root = np.sqrt(belief.precision)
    inverse = cho_solve((belief.lower, True), np.diag(root), check_finite=False) * root[:, None]
    weight = 0.5 * (np.outer(belief.pull, belief.pull) - inverse)
    prior, slopes = priors.log_density(theta)
    for k in range(d):
        slopes[k] += float((weight * falling * ((u[:, k, None] - u[None, :, k]) / hyper.lengths[k]) ** 2).sum())
    exact = low == high
    by_noise = belief.by_noise + 2.0 * hyper.noise**2 * float(np.diag(weight)[exact].sum())
    slopes[d:] += 2.0 * float((weight * covariance).sum()), float(belief.pull.sum()), by_noise
    return belief.log_evidence + prior, slopes, belief
