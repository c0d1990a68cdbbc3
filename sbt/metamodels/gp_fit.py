"""Hyperparameters of a Gaussian process: of largest posterior density, by L-BFGS.

Likelihood, priors and their gradient are written out: one Cholesky factor serves them all, and neither automatic
differentiation, which takes as long as the mathematics, nor conjugate gradients are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit

from sbt.metamodels.gp_algebra import NOISE_FLOOR, Hyperparameters, cholesky, diagonal, host, like, placed, solve
from sbt.problem.arrays import Points, Vector

__all__ = ["HEAVY_NOISE", "LIKELY_NOISE", "Objective", "fit_kernels", "fit_noise", "fit_posterior"]

LIKELY_NOISE, HEAVY_NOISE = -5.0, -0.7
"""Log variances: the mode of a noisy metric, and about half of y's, the mode where a simulator is known to be noisy."""
_NO_NOISE = math.log(NOISE_FLOOR)  # of a deterministic metric
_BOUNDS = (-12.0, 8.0)  # of the logarithm of every hyperparameter: beyond, the covariance cannot be factored
_LEAST_NOISE = 1e-4  # where there is certainly noise
_FIRST_LENGTH, _FIRST_NOISE = 0.3, 0.02  # where L-BFGS starts: length scales in sqrt(d), noise variance
_DOUBTFUL_NOISE = 0.02  # variance from which on a start without it competes, rougher than what was found:
_ROUGH_LENGTH, _ROUGH_NOISE = 0.1, 1e-4
_HEAVY_LENGTH, _HEAVY_START = 0.6, 0.5  # the same where noise is heavy: from short ones the fit takes noise for structure
_FIRST_LENGTHS, _FIRST_SCALES = (1.5, 0.4), (1.0, 0.2)  # the same of two kernels, and their variances
_SCALE_BOUNDS = (_BOUNDS[0], math.log(100.0))  # with larger ones the least noise would be lost in rounding
_SCALE_SPREAD = 2.0  # of the prior of log variances of two kernels
_COMPARED = 200  # rows that one kernel is compared with two on
_CLEARLY = 3.0  # by which a log posterior density must be larger
_EXPLAINED = 30.0  # log density above that of noise alone from which on it is not tried
_ITERATIONS, _TOLERANCE = 100, 1e-6  # of L-BFGS: about 30 are usual; of the log posterior per row
_PRIOR_SPREAD = math.sqrt(3.0)  # of the log length scales
_LOG_ROOT = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class Objective:
    """Minus the log posterior density of n rows as a function of the vector of log hyperparameters, per row.

    The vector has the q d log length scales, of more than one kernel the q log output scales (of one it is that of
    standardised y, 1), and the log of what the noise variance has above its floor.

    Args:
        nu: smoothness of the kernels.
        u: (n, d) rows.
        z: (n,) standardised y.
        spread: (n,) noise variance relative to the common one.
        device: where it is computed.
        noise_mode: log variance about which the noise is expected; None: there may be none.
        kernels: q, the number of kernels whose sum is fitted.
        certain: equal rows differ: there is noise.

    Source:
        Rasmussen & Williams (2006), algorithm 2.1, eqs. (4.17), (5.9); priors: Hvarfner et al. (2024), as in BoTorch
        since 0.12.
    """

    nu: float
    u: Points
    z: Vector
    spread: Vector
    device: torch.device
    noise_mode: float | None = None
    kernels: int = 1
    certain: bool = False

    @property
    def floor(self) -> float:
        """Least noise variance."""
        return NOISE_FLOOR if self.noise_mode is None else _LEAST_NOISE

    @cached_property
    def _rows(self) -> Points:
        return placed(self.u, self.device)

    def vector(self, hyper: Hyperparameters) -> Vector:
        """Return the vector of hyperparameters."""
        noise = max(hyper.noise, 1.001 * self.floor) - self.floor
        scales = np.log(hyper.outputscale) if self.kernels > 1 else np.empty(0)
        return np.concatenate([np.log(hyper.lengthscale).reshape(-1), scales, [math.log(noise)]])

    def hyperparameters(self, vector: Vector) -> Hyperparameters:
        """Return the hyperparameters of a vector."""
        q, d = self.kernels, self.u.shape[1]
        scales = np.exp(vector[q * d : -1]) if q > 1 else np.ones(1)
        return Hyperparameters(self.nu, np.exp(vector[: q * d]).reshape(q, d), scales, self.floor + math.exp(vector[-1]))

    def __call__(self, vector: Vector) -> tuple[float, Vector]:
        """Return the objective at a vector, and its gradient; the mean is profiled out, so it adds nothing to the gradient."""
        hyper, n, d = self.hyperparameters(vector), len(self.z), self.u.shape[1]
        parts = hyper.covariances_and_slopes(self._rows)
        total = parts[0][0]
        for covariance, _ in parts[1:]:
            total = total + covariance
        solved = solve(cholesky(total, hyper.noise * self.spread), self.z)
        slope = solved.inverse  # from here on, twice n times that by the covariance
        slope -= (solved.alpha[:, None] * solved.alpha).T  # symmetric; its memory is laid out as the inverse's
        by_noise = 0.5 / n * float(host(diagonal(slope)) @ self.spread)
        by_length, by_scale = [], []
        for k, (covariance, factors) in enumerate(parts):
            if len(parts) > 1:  # of the covariance there is the lower triangle: the diagonal counts half
                at_zero = 0.5 * float(hyper.outputscale[k]) * float(host(diagonal(slope)).sum())
                by_scale.append((float((slope * covariance).sum()) - at_zero) / n)
            factors *= slope
            at = self._rows * like(hyper.scaling[k], self._rows)
            at = at - at.mean(axis=0)  # differences of small numbers are exact
            sums = factors.sum(axis=0) + factors.sum(axis=1)
            by_length.append(host(sums @ (at * at) - 2.0 * (at * (factors @ at)).sum(axis=0)) / n)
        gradient = np.concatenate([*by_length, by_scale, [by_noise * (hyper.noise - self.floor)]])
        lengths, scales = vector[: len(parts) * d], vector[len(parts) * d : -1]
        away = (lengths - math.sqrt(2.0) - 0.5 * math.log(d)) / _PRIOR_SPREAD
        log_prior = float((-lengths - 0.5 * away**2 - math.log(_PRIOR_SPREAD) - _LOG_ROOT).sum())
        gradient[: len(lengths)] += (1.0 + away / _PRIOR_SPREAD) / n
        log_prior += float((-0.5 * (scales / _SCALE_SPREAD) ** 2 - math.log(_SCALE_SPREAD) - _LOG_ROOT).sum())
        gradient[len(lengths) : -1] += scales / _SCALE_SPREAD**2 / n
        of_noise, by_log_noise = _log_prior_of_noise(math.log(hyper.noise), self.noise_mode)
        gradient[-1] -= by_log_noise * (1.0 - self.floor / hyper.noise) / n
        return -(solved.log_likelihood + log_prior + of_noise) / n, gradient


def _log_prior_of_noise(log_noise: float, mode: float | None) -> tuple[float, float]:
    """Return the log prior density of the log noise variance, and its derivative.

    Half is that of noisy metrics, half is flat down to jitter. With a mode there is noise for certain, about there.

    The first alone costs a deterministic metric 80 nats: 100 smooth runs were then learned with noise of 2 % of the
    standard deviation of y, too much for a critical interval that is narrower.
    """
    away = log_noise - (LIKELY_NOISE if mode is None else mode)
    noisy = -0.5 * away**2 - _LOG_ROOT
    if mode is not None:
        return noisy, -away
    flat = -np.logaddexp(0.0, 2.0 * away) - math.log(LIKELY_NOISE - _NO_NOISE)
    share = expit(noisy - flat)
    return float(np.logaddexp(noisy, flat)) - math.log(2.0), float(-share * away - (1.0 - share) * 2.0 * expit(2.0 * away))


def fit_posterior(objective: Objective, start: Hyperparameters | None = None) -> Hyperparameters:
    """Return the hyperparameters of largest posterior density, by L-BFGS on their logarithms."""
    if start is not None:
        return _from(objective, start)[0]
    return _without_doubtful_noise(objective, *_from(objective, _first(objective)))[0]


def _without_doubtful_noise(objective: Objective, found: Hyperparameters, density: float) -> tuple[Hyperparameters, float]:
    """Return the hyperparameters, or those of one kernel found from a rough start without noise, and their density.

    What may be noise may as well be a function that bends between few rows, and L-BFGS stays where it starts: where it finds
    noise that no equal rows show, the rough start competes.
    """
    if objective.noise_mode is not None or objective.certain or found.noise < _DOUBTFUL_NOISE:
        return found, density
    one = replace(objective, kernels=1)
    rough = np.minimum(found.lengthscale.min(axis=0, keepdims=True), _ROUGH_LENGTH * math.sqrt(objective.u.shape[1]))
    other, by_other = _from(one, Hyperparameters(objective.nu, rough, np.ones(1), _ROUGH_NOISE))
    return (other, by_other) if by_other > density + _CLEARLY else (found, density)


def _from(objective: Objective, start: Hyperparameters) -> tuple[Hyperparameters, float]:
    """Return the hyperparameters that L-BFGS finds from a start, and their log posterior density."""
    first, scales = objective.vector(start), [_SCALE_BOUNDS] * objective.kernels if objective.kernels > 1 else []
    found = minimize(
        objective, first, jac=True, method="L-BFGS-B",
        bounds=[_BOUNDS] * start.lengthscale.size + scales + [(_NO_NOISE - 1.0, _BOUNDS[1])],
        options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE},
    )  # fmt: skip
    return objective.hyperparameters(found.x), -float(found.fun) * len(objective.z)


def _first(objective: Objective) -> Hyperparameters:
    """Return where L-BFGS starts."""
    d, heavy = objective.u.shape[1], objective.noise_mode == HEAVY_NOISE
    if objective.kernels > 1:
        lengths = np.repeat(np.array(_FIRST_LENGTHS)[:, None] * math.sqrt(d), d, axis=1)
        return Hyperparameters(objective.nu, lengths, np.array(_FIRST_SCALES), _FIRST_NOISE)
    length, noise = (_HEAVY_LENGTH, _HEAVY_START) if heavy else (_FIRST_LENGTH, _FIRST_NOISE)
    return Hyperparameters(objective.nu, np.full((1, d), length * math.sqrt(d)), np.ones(1), noise)


def fit_kernels(objective: Objective) -> tuple[Objective, Hyperparameters]:
    """Return the objective with one kernel or with two, whichever has the larger posterior density, and its hyperparameters.

    A function that bends slowly over the space and quickly somewhere, or along few inputs here and along others there, has no
    one length scale an input. Which it is, a share of many rows tells.
    """
    n = len(objective.z)
    some = replace(objective, u=objective.u[:_COMPARED], z=objective.z[:_COMPARED], spread=objective.spread[:_COMPARED])
    one, by_one = _from(some, _first(some))
    pair = replace(some, kernels=2)
    two, by_two = _from(pair, _first(pair))
    better = by_two > by_one + _CLEARLY
    found, _ = _without_doubtful_noise(some, *((two, by_two) if better else (one, by_one)))
    chosen = replace(objective, kernels=len(found.lengthscale))
    return chosen, found if n <= _COMPARED else fit_posterior(chosen, None if found is one else found)


def fit_noise(objective: Objective, hyper: Hyperparameters) -> tuple[Objective, Hyperparameters]:
    """Return the objective and its hyperparameters, or those of one kernel and heavy noise, whichever has the larger density.

    Noise can as well be taken for a function that bends between any two rows, and L-BFGS stays where it starts: 100 rows that
    were noise alone were learned with length scales of .05 of the space, and P(critical) was worse than its mean.

    Args:
        objective: without a mode of the noise. Where equal rows differ heavy noise is taken unless the other density is clearly
            larger. Otherwise it is only tried where the rows are explained hardly better than by noise alone.
        hyper: fitted to it.
    """
    n, plain = len(objective.z), -float(objective(objective.vector(hyper))[0]) * len(objective.z)
    if not objective.certain and plain > _EXPLAINED - n * (0.5 + _LOG_ROOT):
        return objective, hyper
    heavy = replace(objective, kernels=1, noise_mode=HEAVY_NOISE)
    found, density = _from(heavy, _first(heavy))
    return (heavy, found) if density > plain - _CLEARLY * objective.certain else (objective, hyper)
