"""Predictions of the safety metric at n points: a Gaussian mixture per point.

One component for a Gaussian process, one per tree, network or Monte Carlo draw otherwise. Everything
is vectorised over points and computed in logs, so that the tails stay finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfcx, log_ndtr, ndtr, ndtri

from sbt.errors import InputError
from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Prediction", "PredictionError", "Scale", "reached_beyond"]

_Matrix = NDArray[np.float64]
_LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
_NEWTON_STEPS, _ROUNDING = 100, 1e-13  # of a quantile: at most, and the relative step at which it ends


@dataclass(frozen=True)
class Scale:
    """Which values a metric has; what is predicted may lie beyond (`sbt.metamodels.ended`).

    Args:
        low, high: its ends.
        steps: (predicted, value) pairs, increasing: where a metric comes in steps, those at the edge were learned elsewhere.
        flag: an interval with one of the ends, where there are no other values.
    """

    low: float = -np.inf
    high: float = np.inf
    steps: tuple[tuple[float, float], ...] = ()
    flag: CriticalInterval | None = None


class PredictionError(InputError):
    """A prediction that is none: of a wrong shape, not finite, without a spread."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A mixture of k Gaussians at each of n points, in the unit of the safety metric y.

    Args:
        mean: (k, n) means.
        std: (k, n) standard deviations > 0.
        weight: (k,) weights >= 0 that sum to 1, the same at all points.
        noise: (n,) the irreducible (aleatoric) part of `sigma`, a standard deviation >= 0.
        lowest, highest: where the metric ends: what is predicted beyond is that value, of which P(y in M_c) knows.
        scale: which values the metric has, for what is told of it; None: any.

    Raises:
        InputError: wrong shapes, a mean that is not finite, std <= 0, or weights that do not sum to 1.

    >>> prediction = Prediction.gaussian(mu=np.array([0.0, 3.0]), sigma=np.ones(2))
    >>> prediction.probability(CriticalInterval(high=0.0)).round(4).tolist()
    [0.5, 0.0013]
    """

    mean: _Matrix
    std: _Matrix
    weight: Vector
    noise: Vector
    lowest: float = -np.inf
    highest: float = np.inf
    scale: Scale | None = None

    def __post_init__(self) -> None:
        if self.mean.ndim != 2 or self.mean.shape[0] == 0:
            raise PredictionError(f"mean must have shape (k, n) with k >= 1, but got {self.mean.shape}")
        k, n = self.mean.shape
        for name, shape in (("std", (k, n)), ("weight", (k,)), ("noise", (n,))):
            if getattr(self, name).shape != shape:
                raise PredictionError(f"{name} must have shape {shape}, but got {getattr(self, name).shape}")
        if not np.isfinite(self.mean).all():
            raise PredictionError(f"mean must be finite, but got {self.mean[~np.isfinite(self.mean)][0]}")
        if not ((self.std > 0) & (self.std < np.inf)).all():
            raise PredictionError(f"std must be finite and > 0, but got {_first_bad(self.std)}")
        if not ((self.noise >= 0) & (self.noise < np.inf)).all():
            raise PredictionError("noise must be finite and >= 0, but got NaN, infinity or a negative value")
        if not ((self.weight >= 0).all() and abs(self.weight.sum() - 1.0) < 1e-9):
            raise PredictionError(f"weight must be >= 0 and sum to 1, but got the sum {self.weight.sum()}")

    @classmethod
    def gaussian(cls, mu: ArrayLike, sigma: ArrayLike, noise: ArrayLike | None = None) -> Prediction:
        """Return one Gaussian a point; without `noise` all of `sigma` (n,) counts as epistemic."""
        mean, std = np.atleast_2d(np.asarray(mu, float)), np.atleast_2d(np.asarray(sigma, float))
        for name, given in (("mu", mean), ("sigma", std)):
            if given.ndim > 2 or len(given) > 1:
                raise PredictionError(f"{name} must have shape (n,), one value a point, but got {given.shape}")
        aleatoric = np.zeros(mean.shape[1]) if noise is None else np.asarray(noise, float)
        return cls(mean, std, np.ones(1), aleatoric)

    @classmethod
    def mixture_of(cls, predictions: Sequence[Prediction], weights: ArrayLike) -> Prediction:
        """Return the mixture of predictions at the same points, with `weights` >= 0 that sum to 1."""
        shares = np.asarray(weights, float)
        if len(predictions) == 0 or shares.shape != (len(predictions),):
            raise InputError(f"a mixture needs one weight a prediction, but got {shares.shape} weights")
        return cls(
            np.concatenate([p.mean for p in predictions]),
            np.concatenate([p.std for p in predictions]),
            np.concatenate([share * p.weight for share, p in zip(shares, predictions, strict=True)]),
            np.sqrt(shares @ np.stack([p.noise**2 for p in predictions])),
        )

    def __len__(self) -> int:
        """Return the number of points n."""
        return int(self.mean.shape[1])

    @property
    def mu(self) -> Vector:
        """Mean of the mixture, (n,): the paper's mu."""
        mean: Vector = self.weight @ self.mean
        return mean

    @property
    def sigma(self) -> Vector:
        """Standard deviation of the mixture (moment-matched), (n,): the paper's sigma."""
        if len(self.weight) == 1:
            return np.asarray(self.std[0])
        variance: Vector = self.weight @ (self.std**2 + (self.mean - self.mu) ** 2)
        return np.sqrt(variance)

    @property
    def epistemic(self) -> Vector:
        """The part of `sigma` that more runs reduce, (n,), a standard deviation."""
        return np.sqrt(np.maximum(self.sigma**2 - self.noise**2, 0.0))

    def take(self, index: NDArray[Any] | slice) -> Prediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        return replace(self, mean=self.mean[:, index], std=self.std[:, index], noise=self.noise[index])

    def widened(self, factor: float) -> Prediction:
        """Return the prediction with every standard deviation of a component multiplied."""
        return replace(self, std=factor * self.std)

    def rescaled(self, factor: float) -> Prediction:
        """Return the prediction with `sigma` multiplied; the mean stays."""
        mean = self.mu + factor * (self.mean - self.mu)
        return replace(self, mean=mean, std=factor * self.std, noise=factor * self.noise)

    def with_tails(self, factor: Vector, probability: Vector) -> Prediction:
        """Return the prediction with every component in several widths: its standard deviation times each factor (m,).

        Args:
            factor: > 0.
            probability: (m,) of each factor, sum 1.
        """
        std = (factor[:, None, None] * self.std).reshape(-1, len(self))
        weight = (probability[:, None] * self.weight).ravel()
        return replace(self, mean=np.tile(self.mean, (len(factor), 1)), std=std, weight=weight / weight.sum())

    def joined(self, others: Sequence[Prediction]) -> Prediction:
        """Return the prediction at these points and, behind them, at those of the others, which have the same weights."""
        every = (self, *others)
        mean, std = (np.concatenate([getattr(p, name) for p in every], axis=1) for name in ("mean", "std"))
        return replace(self, mean=mean, std=std, noise=np.concatenate([p.noise for p in every]))

    def log_density(self, y: Vector) -> Vector:
        """Return (n,) log density of the mixture at y (n,)."""
        return self._mix(_log_gauss(self._paired(y), self.mean, self.std))

    def log_density_gaussian(self, y: Vector) -> Vector:
        """Return (n,) log density of the moment-matched Gaussian at y (n,).

        Source:
            Winkelmann et al. (2022), eq. (1): one factor of the likelihood.
        """
        return _log_gauss(self._paired(y), self.mu, self.sigma)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) of the mixture at y (n,)."""
        mass: Vector = self.weight @ ndtr((self._paired(y) - self.mean) / self.std)
        return np.minimum(mass, 1.0)

    def log_probability(self, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c), both accurate in the tails.

        Source:
            Winkelmann et al. (2022), section V-A: P from the cumulative distribution function.
        """
        inside, outside = _log_interval(self.mean, self.std, self._open(critical))
        return np.minimum(self._mix(inside), 0.0), np.minimum(self._mix(outside), 0.0)

    def _open(self, critical: CriticalInterval) -> CriticalInterval:
        """Return M_c without ends that the metric does not go beyond."""
        return reached_beyond(critical, self.lowest, self.highest)

    def probability(self, critical: CriticalInterval) -> Vector:
        """Return (n,) P(y in M_c), in [0, 1]."""
        return np.exp(self.log_probability(critical)[0])

    def quantile(self, q: float) -> Vector:
        """Return (n,) y with P(Y <= y) = q, for q in (0, 1).

        Exact for one Gaussian; for a mixture by bracketed Newton steps on the logarithm of the nearer tail.

        Raises:
            InputError: q not in (0, 1).
        """
        if not 0.0 < q < 1.0:
            raise InputError(f"a quantile needs 0 < q < 1, but got {q}")
        at = self.mean + self.std * ndtri(q)  # (k, n)
        if len(self.weight) == 1:
            return np.asarray(at[0])
        if q > 0.5:
            mirrored = Prediction(-self.mean, self.std, self.weight, self.noise)
            return -mirrored._lower_quantile(float(np.log1p(-q)), -at)
        return self._lower_quantile(float(np.log(q)), at)

    def _lower_quantile(self, log_q: float, at: _Matrix) -> Vector:
        """Solve log P(Y <= y) = log_q between the smallest and the largest component quantile."""
        found: Vector = self.weight @ at
        p, y, low, high, rows = self, found, at.min(axis=0), at.max(axis=0), np.arange(len(self))  # of points still to be solved
        for _ in range(_NEWTON_STEPS):
            log_cdf = p._mix(log_ndtr((y - p.mean) / p.std))
            below = log_cdf < log_q
            low, high = np.where(below, y, low), np.where(below, high, y)
            with np.errstate(over="ignore", invalid="ignore"):
                newton = y - (log_cdf - log_q) * np.exp(log_cdf - p.log_density(y))
            inside = (newton > low) & (newton < high)
            new = np.where(inside, newton, 0.5 * (low + high))
            left = np.abs(new - y) > _ROUNDING * (np.abs(y) + p.std.min(axis=0))
            found[rows] = new
            if not left.any():
                break
            p, y, low, high, rows = p.take(left), new[left], low[left], high[left], rows[left]
        return found

    def _mix(self, log_terms: _Matrix) -> Vector:
        """Return the (n,) logarithm of the weighted sum of exp((k, n) terms)."""
        if len(self.weight) == 1:
            return np.asarray(log_terms[0])
        with np.errstate(divide="ignore"):
            terms = log_terms + np.log(self.weight)[:, None]
            top = terms.max(axis=0)
            top[np.isneginf(top)] = 0.0
            return np.asarray(np.log(np.exp(terms - top).sum(axis=0)) + top)

    def _paired(self, y: Vector) -> Vector:
        """Return y as (n,) float64, one value a point."""
        values = np.asarray(y, dtype=np.float64)
        if values.shape != (len(self),):
            raise InputError(f"y must have shape ({len(self)},), one value a point, but got {values.shape}")
        return values


def reached_beyond(critical: CriticalInterval, lowest: float, highest: float) -> CriticalInterval:
    """Return M_c without ends that a metric in [lowest, highest] does not go beyond."""
    low = -np.inf if critical.low <= lowest else critical.low
    return CriticalInterval(low, np.inf if critical.high >= highest else critical.high)


def _first_bad(std: _Matrix) -> float:
    return float(std[~((std > 0) & (std < np.inf))][0])


def _log_gauss(y: Vector, mean: _Matrix, std: _Matrix) -> _Matrix:
    """Return log N(y; mean, std^2), broadcast over components."""
    return np.asarray(-0.5 * ((y - mean) / std) ** 2 - np.log(std) - _LOG_SQRT_2PI)


def _log_interval(mean: _Matrix, std: _Matrix, critical: CriticalInterval) -> tuple[_Matrix, _Matrix]:
    """Return the logs of the Gaussian masses inside and outside of the interval, (k, n) each."""
    if np.isinf(critical.low):
        return _log_tails((critical.high - mean) / std)
    if np.isinf(critical.high):
        return _log_tails((mean - critical.low) / std)
    low, high = (critical.low - mean) / std, (critical.high - mean) / std
    return _log_between(low, high), np.logaddexp(log_ndtr(low), log_ndtr(-high))


def _log_tails(z: _Matrix) -> tuple[_Matrix, _Matrix]:
    """Return log Phi(z) and log Phi(-z) for the price of one `log_ndtr`."""
    small = log_ndtr(-np.abs(z))
    large = np.log1p(-np.exp(small))
    return np.where(z < 0, small, large), np.where(z < 0, large, small)


def _log_between(low: _Matrix, high: _Matrix) -> _Matrix:
    """Return log(Phi(high) - Phi(low)) for low <= high, without cancellation.

    Where both ends lie on one side of the mean, the interval is mirrored to the lower tail, where
    log Phi(z) = -z^2/2 + log(erfcx(-z/sqrt 2)/2) makes the difference of the logs exact.
    """
    mirror = low + high > 0
    a, b = np.where(mirror, -high, low), np.where(mirror, -low, high)  # a + b <= 0, so a <= 0
    out = np.empty_like(a)
    across = b > 0
    out[across] = np.log1p(-(ndtr(a[across]) + ndtr(-b[across])))
    a, b = a[~across], b[~across]
    ratio = erfcx(-a * np.sqrt(0.5)) / erfcx(-b * np.sqrt(0.5))  # both positive, ratio <= 1
    with np.errstate(divide="ignore"):
        gap = np.minimum(0.5 * (b - a) * (b + a) + np.log(ratio), 0.0)  # log Phi(a) - log Phi(b)
        out[~across] = log_ndtr(b) + np.log(-np.expm1(gap))
    return out
