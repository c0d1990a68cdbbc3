"""Linear algebra of a Gaussian process: NumPy and LAPACK on the CPU, PyTorch on a CUDA device; float64 on both.

A matrix is an array on the CPU and a tensor elsewhere; what is computed from it is of its kind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.linalg import blas, cho_solve, lapack
from scipy.spatial.distance import cdist

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector

__all__ = [
    "NOISE_FLOOR", "Hyperparameters", "Matrix", "Solved", "cholesky", "diagonal", "host", "inverse_diagonal", "inverse_factor",
    "inverse_lower", "like", "placed", "product", "solve", "solve_right", "squared_columns", "triangular",
]  # fmt: skip

Matrix = Any
"""float64: a NumPy array on the CPU, a tensor on another device."""
NOISE_FLOOR = 1e-8
"""Least noise variance relative to that of y: condition numbers stay below 1e-6 / machine epsilon at 2,000 rows."""
_CACHED = 2**15  # entries of a matrix that are computed at once: three arrays of them stay in the cache


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Kernel, a sum of q Matern kernels of other length scales, and noise variance, for standardised y.

    Attributes:
        nu: smoothness of the kernels.
        lengthscale: (q, d) of each kernel.
        outputscale: (q,) its variance.
        noise: variance.
    """

    nu: float
    lengthscale: Points
    outputscale: Vector
    noise: float

    @property
    def scaling(self) -> Points:
        """(q, d) factors on coordinates, with which each kernel depends on their distance alone."""
        return np.asarray(math.sqrt(2.0 * self.nu) / self.lengthscale)

    @property
    def variance(self) -> float:
        """Of the latent function."""
        return float(self.outputscale.sum())

    @property
    def roughness(self) -> Vector:
        """(d,) how fast the function varies along each input: the square root is one over a length scale for all kernels."""
        return np.asarray(self.outputscale @ self.lengthscale**-2.0 / self.variance)

    def covariance(self, a: Matrix, b: Matrix) -> Matrix:
        """Return the (n, m) covariance of the latent function at a (n, d) and b (m, d)."""
        scales = [like(scale, a) for scale in self.scaling]
        kernels = [(a * k, b * k, v) for k, v in zip(scales, self.outputscale.tolist(), strict=True)]
        if isinstance(a, torch.Tensor):
            return sum(variance * _matern(_distances(at, to), self.nu) for at, to, variance in kernels)
        found, rows = np.empty((len(a), len(b))), max(_CACHED // max(len(b), 1), 1)
        for start in range(0, len(found), rows):
            part = found[start : start + rows]
            for at, to, variance in kernels:
                correlation = _matern(cdist(at[start : start + rows], to), self.nu)
                if variance != 1.0:
                    correlation *= variance
                if at is kernels[0][0]:
                    part[:] = correlation
                else:
                    part += correlation
        return found

    def covariances_and_slopes(self, a: Matrix) -> list[tuple[Matrix, Matrix]]:
        """Return of each kernel the lower triangle of the (n, n) covariance at a (n, d), and f (n, n).

        The covariance of two points a and b has the derivative f (a_j - b_j)^2 by the logarithm of length scale j, of
        coordinates that are multiplied by `scaling`.
        """
        return [self._covariance_and_slope(a, k) for k in range(len(self.outputscale))]

    def _covariance_and_slope(self, a: Matrix, k: int) -> tuple[Matrix, Matrix]:
        n, at, variance = len(a), a * like(self.scaling[k], a), float(self.outputscale[k])
        if isinstance(a, torch.Tensor):
            covariance, slope = self._with_slope(_distances(at, at), variance)
            return covariance.tril_(), slope.tril_()
        both, rows = np.zeros((2, n, n)), max(_CACHED // max(n, 1), 1)
        for start in range(0, n, rows):
            part = both[:, start : start + rows, start:]
            part[:] = self._with_slope(cdist(at[start : start + rows], at[start:]), variance)
            part[..., :rows] = np.triu(part[..., :rows])
        return both[0].T, both[1].T

    def _with_slope(self, r: Matrix, variance: float) -> tuple[Matrix, Matrix]:
        """Return the covariance at distances r, and its derivative by r, divided by -r; writes on `r`."""
        decay = variance * (torch if isinstance(r, torch.Tensor) else np).exp(-r)
        if self.nu == 0.5:
            r[r == 0.0] = math.inf  # of equal points nothing depends on the length
            return decay, decay / r
        r += 1.0
        if self.nu == 1.5:
            return decay * r, decay
        decay /= 3.0
        slope = decay * r
        r += 1.0
        r *= slope
        r += decay
        return r, slope


def _distances(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _matern(r: Matrix, nu: float) -> Matrix:
    """Return the Matern correlation at r = sqrt(2 nu) times the scaled distance; writes on `r`.

    Source:
        Rasmussen & Williams (2006), eq. (4.17).
    """
    correlation = -r
    if isinstance(r, torch.Tensor):
        correlation.exp_()
    else:
        np.exp(correlation, out=correlation)
    if nu > 0.5:
        square = r * r if nu == 2.5 else None
        r += 1.0
        if square is not None:
            square *= 1.0 / 3.0
            r += square
        correlation *= r
    return correlation


def cholesky(covariance: Matrix, noise: Vector) -> Matrix:
    """Return the (n, n) lower Cholesky factor of covariance + diag(noise); writes on `covariance`.

    Where rounding made the sum indefinite, growing jitter is added to the diagonal.
    """
    total = host(diagonal(covariance)) + noise
    for jitter in (0.0, 1e-8, 1e-6, 1e-4, 1e-2):
        if isinstance(covariance, torch.Tensor):
            covariance.diagonal().copy_(like(total + jitter, covariance))
            factor, info = torch.linalg.cholesky_ex(covariance)
        else:
            np.fill_diagonal(covariance, total + jitter)
            factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
        if int(info) == 0:
            return factor
    raise InputError("the covariance of a Gaussian process must be positive definite, but is not, with jitter 0.01")


@dataclass(frozen=True, eq=False)
class Solved:
    """What the gradient and the leave-one-out residuals need of a factored covariance."""

    inverse: Matrix  # (n, n), its lower triangle at least
    alpha: Matrix  # (n,) inverse (z - its generalised least-squares mean)
    log_likelihood: float


def solve(factor: Matrix, z: Vector) -> Solved:
    """Return the inverse of the covariance whose factor this is, and the likelihood of z (n,); writes on `factor`."""
    log_det, right = 2.0 * float(np.log(host(diagonal(factor))).sum()), like(z, factor)
    if isinstance(factor, torch.Tensor):
        inverse: Matrix = torch.cholesky_inverse(factor)
        row_sums, alpha = inverse.sum(axis=1), inverse @ right
    else:
        inverse = lapack.dpotri(factor, lower=1, overwrite_c=1)[0]
        row_sums, alpha = (blas.dsymv(1.0, inverse, v, lower=1) for v in (np.ones(len(z)), right))
    centre = float(row_sums @ right / row_sums.sum())
    alpha = alpha - centre * row_sums
    fit = float((right - centre) @ alpha)
    return Solved(inverse, alpha, -0.5 * (fit + log_det + len(z) * math.log(2.0 * math.pi)))


def inverse_diagonal(factor: Matrix) -> Vector:
    """Return the (n,) diagonal of the inverse of the covariance whose factor this is."""
    if isinstance(factor, torch.Tensor):
        return host(torch.cholesky_inverse(factor).diagonal())
    return squared_columns(inverse_factor(factor))


def inverse_lower(factor: Points) -> Points:
    """Return the (n, n) inverse of the covariance whose factor this is; only its lower triangle is written."""
    return np.asarray(lapack.dpotri(factor, lower=1)[0])


def solve_right(factor: Matrix, right: Points) -> Points:
    """Return the inverse of the covariance whose factor this is, times `right` (n, k)."""
    if isinstance(factor, torch.Tensor):
        return host(torch.cholesky_solve(like(right, factor), factor))
    return np.asarray(cho_solve((factor, True), right))


def inverse_factor(factor: Points) -> Points:
    """Return the inverse of a lower factor (n, n)."""
    return np.asarray(lapack.dtrtri(factor, lower=1)[0])


def product(lower: Points, right: Points) -> Points:
    """Return a lower triangular matrix (n, n) times `right` (n, m); may write on `right`."""
    return np.asarray(blas.dtrmm(1.0, lower, right, lower=1, overwrite_b=1))


def triangular(factor: Matrix, right: Matrix) -> Matrix:
    """Return the inverse of the lower factor (n, n) times `right` (n, m); may write on `right`."""
    if isinstance(factor, torch.Tensor):
        return torch.linalg.solve_triangular(factor, right, upper=False)
    return blas.dtrsm(1.0, factor, right, lower=1, overwrite_b=1)


def squared_columns(matrix: Matrix) -> Vector:
    """Return the (m,) squared norms of the columns of a matrix (n, m)."""
    if isinstance(matrix, torch.Tensor):
        return host(matrix.square().sum(dim=0))
    return np.asarray(np.einsum("nm,nm->m", matrix, matrix))


def diagonal(matrix: Matrix) -> Matrix:
    """Return the diagonal, a view."""
    return matrix.diagonal() if isinstance(matrix, torch.Tensor) else np.diag(matrix)


def placed(array: Points, device: torch.device) -> Matrix:
    """Return an array as a matrix on the device: itself on the CPU."""
    return array if device.type == "cpu" else torch.from_numpy(array).to(device)


def like(array: Points, matrix: Matrix) -> Matrix:
    """Return an array as a matrix where `matrix` is."""
    return placed(array, matrix.device) if isinstance(matrix, torch.Tensor) else array


def host(matrix: Matrix) -> Points:
    """Return a matrix as an array: itself on the CPU."""
    return np.asarray(matrix.cpu().numpy()) if isinstance(matrix, torch.Tensor) else matrix
