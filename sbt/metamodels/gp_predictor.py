"""A fitted Gaussian process: exact moments, on a device, and quick bounds of P(y in M_c) in plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sbt.metamodels.censored import Limit
from sbt.metamodels.extra_trees import ForestPredictor
from sbt.metamodels.gp_algebra import (
    NOISE_FLOOR,
    Hyperparameters,
    Matrix,
    cholesky,
    host,
    inverse_diagonal,
    inverse_factor,
    inverse_lower,
    like,
    placed,
    product,
    solve_right,
    squared_columns,
    triangular,
)
from sbt.metamodels.gp_limits import observations
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.torch_tools import device_of, single_threaded
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["GaussianProcessPredictor", "NoiseSpread", "relative_variance"]

_GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, are spread evenly: rows that are chosen by them hit no period
_CHUNK = 512  # points predicted at once: 2 MB a 500 rows
_INVERTED = 3000  # rows up to which the factor is inverted: 72 MB
_QUICK = 128  # points bounded at once: intermediate arrays stay in the cache
_ROUNDED = {np.float32: 1e-6, np.float64: 2e-15}  # of a correlation: at most a dozen roundings
_ROUGH = 1e-3  # error of the mean, relative to the std of y, up to which single precision will do
_CANCELLED = 2e-15  # of a squared distance, relative to the squares that it is the difference of: a few roundings
_LOG_CHI2 = 1.27036  # -E[log chi^2_1]: log of the mean of z^2 minus the mean of log z^2
_MOST_LIMITED = 1000  # rows of which a limit is known: up to 60 sweeps cost their cube each
_SAME = 1e-3  # of the standard deviation of y: values that differ less are the same
_CLIP = 6.9  # about log(1000): relative noise variances stay within [1e-3, 1e3]


@dataclass(frozen=True, eq=False)
class GaussianProcessPredictor:
    """A Gaussian process conditioned on n rows.

    Args:
        hyper: kernel, noise.
        u: (n, d) rows.
        factor: (n, n) lower Cholesky factor of their covariance, noise included.
        alpha: (n,) covariance^-1 (z - centre).
        centre: constant mean, in standardised units.
        spread: how the noise depends on the input; None: not.
        shift: y = shift + scale z.
        scale: see `shift`.
        widths: (k,) factors on sigma, equally likely: one factor of 1, or more for heavy tails.
        device: auto, cpu or cuda; where moments and draws are computed.
        row_noise: (n,) noise variance of each row, standardised; None: that of the process, with its spread.
    """

    hyper: Hyperparameters
    u: Points
    factor: Points
    alpha: Vector
    centre: float
    spread: NoiseSpread | None
    shift: float
    scale: float
    widths: Vector
    device: str = "cpu"
    row_noise: Vector | None = None

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        with single_threaded():
            chunks = [self._moments(u[i : i + _CHUNK]) for i in range(0, max(len(u), 1), _CHUNK)]
        mean, variance = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        spread = self.spread(u) if self.spread is not None and len(u) > 0 else np.ones(len(u))
        noise = self.hyper.noise * spread
        k, common = len(self.widths), math.sqrt(float(np.mean(self.widths**2)))
        return Prediction(
            mean=np.repeat((self.shift + self.scale * mean)[None], k, axis=0),
            std=self.widths[:, None] * (self.scale * np.sqrt(variance + noise)),
            weight=np.full(k, 1.0 / k),
            noise=common * (self.scale * np.sqrt(noise)),
        )

    def mu(self, u: Points) -> Vector:
        """Return the (m,) mean at u (m, d) alone: many times quicker than the prediction."""
        rows, _, alpha = self._placed
        with single_threaded():
            at = [like(u[i : i + _CHUNK], rows) for i in range(0, len(u), _CHUNK)]
            chunks = [host(alpha @ self.hyper.covariance(part, rows).T) for part in at]
        return np.asarray(self.shift + self.scale * (self.centre + np.concatenate([np.empty(0), *chunks])))

    def sketch(self, rows: int) -> GaussianProcessPredictor:
        """Return the process conditioned on so many of its rows, evenly spread over their order; itself up to twice as many.

        It guides searches, whose points the process itself then judges: a prediction costs the square of the rows.
        """
        n = len(self.u)
        if n <= 2 * rows:
            return self
        kept = np.flatnonzero(np.arange(n) * _GOLDEN % 1.0 < rows / n)
        u = self.u[kept]
        noise = self.hyper.noise * (np.ones(len(u)) if self.spread is None else self.spread(u))
        row_noise = None if self.row_noise is None else self.row_noise[kept]
        noise = noise if row_noise is None else row_noise
        with single_threaded():
            at = placed(u, device_of(self.device))
            factor = cholesky(self.hyper.covariance(at, at), np.maximum(noise, NOISE_FLOOR))
            alpha = solve_right(factor, self._learned[kept][:, None])[:, 0]
        return replace(self, u=u, factor=host(factor), alpha=alpha, row_noise=row_noise)

    def beyond(self, limit: Limit) -> GaussianProcessPredictor:
        """Return the process conditioned on its other rows and the limit; itself where noise is uneven, or rows are many."""
        z = self._learned.copy()
        which = limit.rows(self.u, self.shift + self.scale * (self.centre + z), _SAME * self.scale)
        tied = which >= 0
        if self.spread is not None or not 0 < tied.sum() <= _MOST_LIMITED or tied.all():
            return self
        hyper, noise = self.hyper, max(self.hyper.noise, NOISE_FLOOR)
        side = np.where(limit.at_most[which[tied]], 1.0, -1.0)
        with single_threaded():
            end = (limit.value[which[tied]] - self.shift) / self.scale - self.centre
            across = hyper.covariance(self.u[~tied], self.u[tied])
            factor = cholesky(hyper.covariance(self.u[~tied], self.u[~tied]), np.full(int((~tied).sum()), noise))
            mean = across.T @ solve_right(factor, z[~tied][:, None])[:, 0]
            covariance = hyper.covariance(self.u[tied], self.u[tied]) - across.T @ solve_right(factor, across)
            values, variances = observations(side * mean, covariance * np.outer(side, side), side * end, noise)
            z[tied], row_noise = side * values, np.full(len(z), noise)
            row_noise[tied] = variances
            factor = cholesky(hyper.covariance(self.u, self.u), row_noise)
            alpha = solve_right(factor, z[:, None])[:, 0]
        return replace(self, factor=factor, alpha=alpha, row_noise=row_noise)

    def leave_one_out(self, u: Points, y: Vector) -> Prediction:
        """Return the prediction of each row y (n,) at u (n, d) from all other rows, the hyperparameters kept; cubic in n.

        The rows are those that were given to the fit. Of repetitions that it learned once, each is predicted from the
        other inputs; what it did not learn (the validation rows of the paper's preset) is predicted from all that it did.

        Source:
            Rasmussen & Williams (2006), eqs. (5.10)-(5.12).
        """
        with single_threaded():
            root = self._inverse
            variance = 1.0 / (inverse_diagonal(self._placed[1]) if root is None else squared_columns(root))
        relative = self.spread(self.u) if self.spread is not None else np.ones(len(self.u))
        at = self._learned_as(u, y)
        own, k = at >= 0, len(self.widths)
        mean, sigma, noise = np.empty(len(y)), np.empty(len(y)), np.empty(len(y))
        learned = y[own]
        if self.row_noise is not None:  # what stands for a row is not what was measured there
            learned = (self.shift + self.scale * (self.centre + self._learned))[at[own]]
        mean[own] = learned - self.scale * (self.alpha * variance)[at[own]]
        if self.row_noise is not None:
            variance = np.maximum(variance - self.row_noise, 0.0) + self.hyper.noise
        sigma[own] = self.scale * np.sqrt(variance)[at[own]]
        noise[own] = self.scale * np.sqrt(self.hyper.noise * relative)[at[own]]
        if not own.all():
            others = self(u[~own])
            mean[~own], noise[~own] = others.mean[0], others.noise
            sigma[~own] = others.std[0] / self.widths[0]
        return Prediction(
            mean=np.repeat(mean[None], k, axis=0), std=self.widths[:, None] * sigma, weight=np.full(k, 1.0 / k), noise=noise,
        )  # fmt: skip

    def _learned_as(self, u: Points, y: Vector) -> NDArray[np.intp]:
        """Return (n,) which of the learned rows each row of u (n, d) and y (n,) is, -1 where it was not learned."""
        if np.array_equal(u, self.u):
            return np.arange(len(u))
        group = np.unique(np.vstack([self.u, u]), axis=0, return_inverse=True)[1].reshape(-1)
        left: dict[int, list[int]] = {}
        for row, g in enumerate(group[: len(self.u)]):
            left.setdefault(int(g), []).append(row)
        found, values = np.full(len(u), -1, dtype=np.intp), dict[int, tuple[int, float]]()
        for row in range(len(u))[::-1]:  # the last ones are learned where not all are
            g = int(group[len(self.u) + row])
            if left.get(g):
                values[g] = left[g].pop(), float(y[row])
            if g in values and values[g][1] == y[row]:
                found[row] = values[g][0]
        return found

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and (n,) upper bounds of P(y in M_c), from the mean and a bound of the variance.

        The variance given all rows is at most that given one of them, and P grows with it where the mean
        lies outside of M_c, shrinks where it lies inside. Many times quicker than the prediction.
        """
        scale, noise = self.hyper.variance, self.hyper.noise
        most = 1.0 if self.spread is None else self.spread.largest
        with single_threaded():
            scaled = [np.column_stack([b, np.ones(len(b)), (b**2).sum(axis=1)]) for b in (u * k for k in self.hyper.scaling)]
            shape = (min(_QUICK, len(u)), len(self.u))
            room = [np.empty(shape), *(np.empty(shape, self._precision) for _ in range(min(len(scaled), 2) + 1))]
            chunks = [self._quick([b[i : i + _QUICK] for b in scaled], room) for i in range(0, max(len(u), 1), _QUICK)]
        quick, nearest = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        rough = self.spread is None or noise * most <= 0.1 * scale or len(u) == 0  # an upper bound of a small noise will do
        at = np.full(len(u), most) if rough or self.spread is None else self.spread(u)
        mean = self.shift + self.scale * quick
        margin = self.scale * self._off * self._total_weight  # error of the mean
        latent = scale * (1.0 - np.maximum(nearest - self._off, 0.0) ** 2 * scale / (scale + noise * most))
        sigma = 1.000001 * self.scale * np.sqrt(latent + noise * at)
        outside = np.maximum(np.maximum(critical.low - mean, mean - critical.high) - margin, 0.0)  # distance to M_c, at least
        below, above = mean - critical.low - margin, critical.high - mean - margin
        inside = (below > 0.0) & (above > 0.0)
        low, high = np.zeros(len(u)), np.zeros(len(u))
        for width in self.widths:
            std = width * sigma
            high += np.where(outside > 0.0, ndtr(-outside / std), 1.0) / len(self.widths)
            if inside.any():  # rarely
                i, at_least = inside, np.zeros(len(u))
                at_least[i] = np.maximum(1.0 - ndtr(-below[i] / std[i]) - ndtr(-above[i] / std[i]), 0.0)
                low += at_least / len(self.widths)
        return low * (1.0 - 1e-9), np.minimum(high * (1.0 + 1e-9), 1.0)

    def _quick(self, scaled: list[Points], room: list[Any]) -> tuple[Vector, Vector]:
        """Return (m,) means, standardised, and (m,) correlations with the nearest row, of points (m, d + 2) scaled by kernel.

        Correlations are in single precision where that will do (not where weights are large, as without noise), with an
        error of at most `_off`; sums are in double precision. All is computed in `room`, a few arrays (at least m, n):
        new ones for every chunk cost a sixth more time.
        """
        across, weights, shares = self._prepared
        squares, r, *found = (part[: len(scaled[0])] for part in room)
        for k, (points, columns) in enumerate(zip(scaled, across, strict=True)):
            correlation = found[min(k, 1)]
            np.dot(points, columns, out=squares)
            np.copyto(r, squares, casting="same_kind")
            np.sqrt(r, out=r)
            np.exp(np.negative(r, out=correlation), out=correlation)
            if self.hyper.nu == 1.5:
                r += 1.0
                correlation *= r
            elif self.hyper.nu == 2.5:
                correlation *= r * r / self._precision(3.0) + r + self._precision(1.0)
            if len(scaled) > 1:
                correlation *= self._precision(shares[k])
            if k > 0:
                found[0] += correlation
        correlation = found[0]
        mean = self.centre + correlation @ weights
        if self._known is not None:
            correlation *= self._known
        nearest = correlation[np.arange(len(r)), correlation.argmax(axis=1)]  # quicker than max
        return mean, nearest.astype(np.float64)

    @cached_property
    def _known(self) -> Vector | None:
        """(n,) how much less rows tell than one with the noise of the process, of a correlation; None: none does."""
        if self.row_noise is None:
            return None
        scale, most = self.hyper.variance, 1.0 if self.spread is None else self.spread.largest
        usual = scale + self.hyper.noise * most
        return np.asarray(np.sqrt(usual / np.maximum(scale + self.row_noise, usual)), dtype=self._precision)

    @cached_property
    def _learned(self) -> Vector:
        """(n,) what stands for the rows, standardised, less the centre."""
        with single_threaded():
            return np.asarray(self.factor @ (self.factor.T @ self.alpha))

    @cached_property
    def _total_weight(self) -> float:
        """What an error of 1 in every correlation would make of the mean, standardised."""
        return self.hyper.variance * float(np.abs(self.alpha).sum())

    @cached_property
    def _precision(self) -> Any:
        return np.float32 if _ROUNDED[np.float32] * self._total_weight <= _ROUGH else np.float64

    @cached_property
    def _off(self) -> float:
        """Upper bound of the error of a correlation that `_quick` computes in the unit cube; nu 0.5 has a slope at distance 0."""
        cancelled = math.sqrt(2.0 * self._cancelled) if self.hyper.nu == 0.5 else 2.0 * self._cancelled
        return len(self.hyper.outputscale) * _ROUNDED[self._precision] + cancelled

    @cached_property
    def _cancelled(self) -> float:
        """Upper bound of the rounding error of squared distances, computed as differences; added, so that none is < 0."""
        return _CANCELLED * 8.0 * self.hyper.nu * float((self.hyper.lengthscale**-2.0).sum(axis=1).max())

    @cached_property
    def _prepared(self) -> tuple[list[Points], Vector, Vector]:
        """Return what squared distances of points and rows are made from, (d + 2, n) a kernel; (n,) weights; kernels' shares."""
        rows = [self.u * k for k in self.hyper.scaling]
        across = [np.column_stack([-2.0 * a, (a**2).sum(axis=1) + self._cancelled, np.ones(len(a))]).T for a in rows]
        variance = self.hyper.variance
        return [np.ascontiguousarray(a) for a in across], variance * self.alpha, self.hyper.outputscale / variance

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) functions drawn from the process, without noise, at u (m, d); the cost is cubic in m.

        Source:
            Rasmussen & Williams (2006), eq. (2.24) and appendix A.2.
        """
        rows, _, alpha = self._placed
        with single_threaded():
            at = like(u, rows)
            cross = self.hyper.covariance(rows, at)  # (rows, m)
            mean = self.centre + host(alpha @ cross)
            half = self._half(cross)
            latent = self.hyper.covariance(at, at) - half.T @ half
            root = host(cholesky(latent, np.full(len(u), 1e-8 * self.hyper.variance)))
            return self.shift + self.scale * (mean + rng.standard_normal((n, len(u))) @ root.T)

    def left_out(self, groups: Sequence[Sequence[int]]) -> list[tuple[Vector, Vector]]:
        """Return for each group of k rows (k,) residuals and (k,) standard deviations of what the other rows predict of them.

        Hyperparameters and the constant mean are those of all rows.

        Source:
            Rasmussen & Williams (2006), eqs. (5.10) to (5.12), for blocks of rows.
        """
        with single_threaded():
            inverse = inverse_lower(self.factor)
            found = []
            for rows in groups:
                at = np.asarray(rows, dtype=np.intp)
                block = np.linalg.inv(inverse[np.maximum.outer(at, at), np.minimum.outer(at, at)])
                found.append((self.scale * (block @ self.alpha[at]), self.scale * np.sqrt(np.diag(block))))
        return found

    def _moments(self, u: Points) -> tuple[Vector, Vector]:
        """Return (m,) mean and (m,) variance without noise, standardised."""
        rows, _, alpha = self._placed
        cross = self.hyper.covariance(like(u, rows), rows).T  # (n, m), column by column as BLAS wants it: nothing is copied
        mean = self.centre + host(alpha @ cross)
        variance = self.hyper.variance - squared_columns(self._half(cross))
        return mean, np.maximum(variance, 1e-10 * self.hyper.variance)

    def _half(self, cross: Matrix) -> Matrix:
        """Return the inverse of the factor times `cross` (n, m); may write on `cross`."""
        return triangular(self._placed[1], cross) if self._inverse is None else product(self._inverse, cross)

    @cached_property
    def _inverse(self) -> Points | None:
        """The inverse of the factor on the CPU, with which a product is quicker than a solve; None for many rows: memory."""
        placed_there = isinstance(self._placed[1], np.ndarray) and len(self.u) <= _INVERTED
        return inverse_factor(self.factor) if placed_there else None

    @cached_property
    def _placed(self) -> tuple[Matrix, Matrix, Matrix]:
        """Return rows, factor and alpha on the device."""
        device = device_of(self.device)
        return placed(self.u, device), placed(self.factor, device), placed(self.alpha, device)


@dataclass(frozen=True, eq=False)
class NoiseSpread:
    """Noise variance at a point relative to the common one, within [1e-3, 1e3]."""

    forests: tuple[ForestPredictor, ...]

    @cached_property
    def largest(self) -> float:
        """Upper bound of the relative noise variance, at points and at the rows that were cross-fitted."""
        return float(relative_variance(np.array([max(forest.largest_mu for forest in self.forests)]))[0])

    def __call__(self, u: Points) -> Vector:
        """Return the (n,) relative noise variance at u (n, d)."""
        return relative_variance(np.mean([forest.mu(u) for forest in self.forests], axis=0))


def relative_variance(log_ratio: Vector) -> Vector:
    """Return noise variances relative to the common one, from mean log squared residuals."""
    return np.exp(np.clip(log_ratio + _LOG_CHI2, -_CLIP, _CLIP))
