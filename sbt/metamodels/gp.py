"""Gaussian process regression with input-dependent noise; the best metamodel below about 500 runs.

GPyTorch provides the kernel, its constraints, priors and gradients. The exact marginal likelihood is
written out here: one Cholesky factor serves its value, its gradient and the leave-one-out residuals,
and nothing turns to conjugate gradients above 800 rows. The fitted predictor is plain NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import gpytorch
import numpy as np
import torch
from gpytorch.constraints import GreaterThan, Positive
from gpytorch.priors import LogNormalPrior
from scipy.linalg import cho_solve, lapack, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from sbt.arrays import Points, Vector
from sbt.errors import InputError
from sbt.metamodels.base import check_rows, split_validation, standardise
from sbt.metamodels.et import ExtraTrees, ForestPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.tails import student_widths
from sbt.metamodels.torch_tools import single_threaded

__all__ = ["GaussianProcess", "GaussianProcessPredictor", "matern"]

_CHUNK = 2048  # points predicted at once
_BOUNDS = (-12.0, 8.0)  # of the logarithm of every hyperparameter
_NOISE_FLOOR = 1e-4  # variance relative to that of y: keeps the covariance well conditioned
_FOLDS = 5  # of the noise regression
_FEWEST_FOR_NOISE = 2 * _FOLDS  # rows
_FOREST = ExtraTrees(trees=10, min_samples_split=20)
_LOG_CHI2 = 1.27036  # -E[log chi^2_1]: what the mean of log z^2 lacks to the log of the mean of z^2


@dataclass(frozen=True)
class GaussianProcess:
    """Settings of a Gaussian process (GP): constant mean, Matern kernel, one length scale per input.

    Defaults: maximum a posteriori by L-BFGS under priors that scale with the dimension, on at most
    `fit_rows` rows, then conditioned on all rows; noise that depends on the input, from one regression
    on the leave-one-out residuals. Without priors (the paper's preset): Adam on the marginal likelihood
    of the last 80 % of the rows, stopped early by the likelihood of the first 20 %.

    Args:
        nu: smoothness of the kernel: 0.5, 1.5 or 2.5.
        input_noise: let the noise depend on the input (from 10 rows on).
        fit_rows: most rows that hyperparameters are fitted on, >= 2; chosen by the rng.
        student_t: believe in a Student-t, from the leave-one-out residuals, instead of a Gaussian.
        priors: fit under priors by L-BFGS; otherwise by Adam with early stopping.
        learning_rate: step of Adam, > 0.
        patience: epochs without an improvement of 0.01 of the mean validation log likelihood, >= 1.
        max_epochs: most epochs of Adam, >= 1.

    Raises:
        InputError: a value outside its range.

    Source:
        Rasmussen & Williams (2006), algorithm 2.1, eqs. (5.9), (5.10)-(5.12); priors: Hvarfner et al.
        (2024), as in BoTorch since 0.12; preset: Winkelmann et al. (2022), table of hyperparameters.
    """

    nu: float = 1.5
    input_noise: bool = True
    fit_rows: int = 500
    student_t: bool = False
    priors: bool = True
    learning_rate: float = 0.1
    patience: int = 200
    max_epochs: int = 2000

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"nu": 0.5, "input_noise": False, "priors": False, "learning_rate": 0.1, "patience": 200}
    }

    def __post_init__(self) -> None:
        if self.nu not in (0.5, 1.5, 2.5):
            raise InputError(f"nu must be 0.5, 1.5 or 2.5, but got {self.nu}")
        if not (self.fit_rows >= 2 and self.patience >= 1 and self.max_epochs >= 1):
            raise InputError(
                "GaussianProcess needs fit_rows >= 2, patience >= 1 and max_epochs >= 1, "
                f"but got {self.fit_rows}, {self.patience} and {self.max_epochs}"
            )
        if not self.learning_rate > 0.0:
            raise InputError(f"learning_rate must be > 0, but got {self.learning_rate}")

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> GaussianProcessPredictor:
        """Return the process conditioned on u (n, d) and y (n,); see `Metamodel.fit`."""
        u, y = check_rows(u, y)
        with single_threaded():
            return self._fit(u, y, rng)

    def _fit(self, u: Points, y: Vector, rng: np.random.Generator) -> GaussianProcessPredictor:
        z, shift, scale = standardise(y)
        if not self.priors:
            validation, training = split_validation(len(z))
            hyper = _fit_early_stopped(self, u[training], z[training], u[validation], z[validation])
            return _condition(self, hyper, u[training], z[training], np.ones(len(z))[training], None, shift, scale)
        rows = rng.permutation(len(z))[: self.fit_rows]
        hyper = _fit_posterior(self.nu, u[rows], z[rows], np.ones(len(rows)), None)
        if not self.input_noise or len(z) < _FEWEST_FOR_NOISE:
            return _condition(self, hyper, u, z, np.ones(len(z)), None, shift, scale)
        spread, at_rows = _fit_noise_spread(hyper, u, z, rng)
        hyper = _fit_posterior(self.nu, u[rows], z[rows], at_rows[rows], hyper)
        return _condition(self, hyper, u, z, at_rows, spread, shift, scale)


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
    """

    hyper: _Hyperparameters
    u: Points
    factor: Points
    alpha: Vector
    centre: float
    spread: _NoiseSpread | None
    shift: float
    scale: float
    widths: Vector

    def __call__(self, u: Points) -> Prediction:
        """Return the belief at u (n, d)."""
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

    def draws(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) functions drawn from the process, without noise, at u (m, d); the cost is cubic in m."""
        with single_threaded():
            cross = self.hyper.covariance(self.u, u)  # (rows, m)
            mean = self.centre + self.alpha @ cross
            half = solve_triangular(self.factor, cross, lower=True, overwrite_b=True, check_finite=False)
            latent = self.hyper.covariance(u, u) - half.T @ half
            root = _factor(latent, np.full(len(u), 1e-8 * self.hyper.outputscale))
            return self.shift + self.scale * (mean + rng.standard_normal((n, len(u))) @ root.T)

    def _moments(self, u: Points) -> tuple[Vector, Vector]:
        """Return (m,) mean and (m,) variance without noise, standardised."""
        cross = self.hyper.covariance(self.u, u)  # (n, m)
        mean = self.centre + self.alpha @ cross
        half = solve_triangular(self.factor, cross, lower=True, overwrite_b=True, check_finite=False)
        variance = self.hyper.outputscale - np.einsum("nm,nm->m", half, half)
        return mean, np.maximum(variance, 1e-10 * self.hyper.outputscale)


def matern(distance: Points, nu: float) -> Points:
    """Return the Matern correlation at scaled distances >= 0, for nu 0.5, 1.5 or 2.5.

    Source:
        Rasmussen & Williams (2006), eq. (4.17).
    """
    r = math.sqrt(2.0 * nu) * distance
    polynomial = {0.5: 1.0, 1.5: 1.0 + r, 2.5: 1.0 + r + r**2 / 3.0}[nu]
    return np.asarray(polynomial * np.exp(-r))


@dataclass(frozen=True, eq=False)
class _Hyperparameters:
    """Kernel and noise variance, for standardised y."""

    nu: float
    lengthscale: Vector  # (d,)
    outputscale: float
    noise: float

    def covariance(self, a: Points, b: Points) -> Points:
        """Return the (n, m) covariance of the latent function at a (n, d) and b (m, d)."""
        return self.outputscale * matern(cdist(a / self.lengthscale, b / self.lengthscale), self.nu)


@dataclass(frozen=True, eq=False)
class _NoiseSpread:
    """Noise variance at a point relative to the common one, within [1e-3, 1e3]."""

    forests: tuple[ForestPredictor, ...]

    def __call__(self, u: Points) -> Vector:
        return _relative(np.mean([forest.mu(u) for forest in self.forests], axis=0))


def _relative(log_ratio: Vector) -> Vector:
    return np.exp(np.clip(log_ratio + _LOG_CHI2, -6.9, 6.9))


def _fit_noise_spread(hyper: _Hyperparameters, u: Points, z: Vector, rng: np.random.Generator) -> tuple[_NoiseSpread, Vector]:
    """Return how the noise depends on the input, and (n,) its values at the rows.

    A regression on the log of squared leave-one-out residuals, relative to their variance. The values at
    the rows are cross-fitted: a row's own residual says nothing about its noise, or the process would
    trust the rows it happens to fit.
    """
    solved = _solve(_factor(hyper.covariance(u, u), np.full(len(z), hyper.noise)), z)
    variance = 1.0 / np.diag(solved.inverse)
    log_ratio = np.log((solved.alpha * variance) ** 2 / variance + 1e-4)
    fold = rng.permutation(len(z)) % _FOLDS
    at_rows, forests = np.zeros(len(z)), []
    for i in range(_FOLDS):
        rest = fold != i
        forest = _FOREST.fit(u[rest], log_ratio[rest], rng)
        at_rows[~rest] = forest.mu(u[~rest])
        forests.append(forest)
    return _NoiseSpread(tuple(forests)), _relative(at_rows)


def _condition(
    settings: GaussianProcess, hyper: _Hyperparameters, u: Points, z: Vector, at_rows: Vector, spread: _NoiseSpread | None,
    shift: float, scale: float,
) -> GaussianProcessPredictor:  # fmt: skip
    """Return the predictor conditioned on all rows; `at_rows` is the relative noise variance there."""
    factor = _factor(hyper.covariance(u, u), hyper.noise * at_rows)
    by_one, by_z = cho_solve((factor, True), np.stack([np.ones(len(z)), z], axis=1)).T
    centre = float(by_one @ z / by_one.sum())
    widths = np.ones(1)
    if settings.student_t:
        solved = _solve(factor, z)
        widths = student_widths(solved.alpha / np.sqrt(np.diag(solved.inverse)))
    return GaussianProcessPredictor(hyper, u, factor, by_z - centre * by_one, centre, spread, shift, scale, widths)


def _factor(covariance: Points, noise: Vector) -> Points:
    """Return the (n, n) lower Cholesky factor of covariance + diag(noise); writes on `covariance`.

    Where rounding made the sum indefinite, growing jitter is added to the diagonal.
    """
    diagonal = np.diag(covariance) + noise
    for jitter in (0.0, 1e-8, 1e-6, 1e-4, 1e-2):
        np.fill_diagonal(covariance, diagonal + jitter)
        factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
        if info == 0:
            return np.asarray(factor)
    raise InputError("the covariance of a Gaussian process must be positive definite, but is not, with jitter 0.01")


@dataclass(frozen=True, eq=False)
class _Solved:
    """What the gradient and the leave-one-out residuals need of a factored covariance."""

    inverse: Points  # (n, n)
    alpha: Vector  # (n,) inverse (z - its generalised least-squares mean)
    log_likelihood: float


def _solve(factor: Points, z: Vector) -> _Solved:
    """Return the inverse of the covariance whose factor this is, and the likelihood of z."""
    lower = np.tril(lapack.dpotri(factor, lower=1)[0])
    inverse = lower + np.tril(lower, -1).T
    row_sums = inverse.sum(axis=1)
    centre = float(row_sums @ z / row_sums.sum())
    alpha = inverse @ z - centre * row_sums
    log_det = 2.0 * float(np.log(np.diag(factor)).sum())
    fit = float((z - centre) @ alpha)
    return _Solved(inverse, alpha, -0.5 * (fit + log_det + len(z) * math.log(2.0 * math.pi)))


@dataclass(frozen=True, eq=False)
class _Model:
    """GPyTorch's kernel and likelihood: parameters (in logs), constraints, priors, gradients."""

    kernel: gpytorch.kernels.ScaleKernel
    likelihood: gpytorch.likelihoods.GaussianLikelihood

    @classmethod
    def build(cls, nu: float, dimension: int, *, priors: bool) -> _Model:
        """Return a model; with priors the output scale is fixed at 1, the variance of standardised y."""
        log = {"transform": torch.exp, "inv_transform": torch.log}
        scale_prior = LogNormalPrior(math.sqrt(2.0) + 0.5 * math.log(dimension), math.sqrt(3.0))
        base = gpytorch.kernels.MaternKernel(
            nu,
            ard_num_dims=dimension,
            lengthscale_prior=scale_prior if priors else None,
            lengthscale_constraint=Positive(**log),
        )
        kernel = gpytorch.kernels.ScaleKernel(base, outputscale_constraint=Positive(**log))
        kernel.raw_outputscale.requires_grad_(not priors)
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            noise_prior=LogNormalPrior(-4.0, 1.0) if priors else None,
            noise_constraint=GreaterThan(_NOISE_FLOOR, **log),
        )
        return cls(kernel.double(), likelihood.double())

    def parameters(self) -> list[torch.nn.Parameter]:
        both = (*self.kernel.parameters(), *self.likelihood.parameters())
        return [p for p in both if p.requires_grad]

    def assign(self, hyper: _Hyperparameters) -> None:
        """Set the parameters to the given values."""
        self.kernel.base_kernel.lengthscale = torch.from_numpy(hyper.lengthscale)
        self.kernel.outputscale = torch.tensor(hyper.outputscale, dtype=torch.float64)
        noise = max(hyper.noise, 1.001 * _NOISE_FLOOR)
        self.likelihood.noise = torch.tensor([noise], dtype=torch.float64)

    def hyperparameters(self) -> _Hyperparameters:
        base = self.kernel.base_kernel
        return _Hyperparameters(
            nu=float(base.nu),
            lengthscale=base.lengthscale.detach().numpy().ravel().copy(),
            outputscale=float(self.kernel.outputscale.detach()),
            noise=float(self.likelihood.noise.detach()),
        )

    def backward(self, x: torch.Tensor, z: Vector, spread: Vector) -> float:
        """Return -(log likelihood + log priors) / n and set the gradients of the parameters.

        The gradient by the covariance is written down (Rasmussen & Williams, eq. 5.9); PyTorch carries it
        on through the kernel. The mean is profiled out, so it adds nothing to the gradient.
        """
        n = len(z)
        latent, noise = self.kernel.forward(x, x), self.likelihood.noise
        solved = _solve(_factor(latent.detach().numpy().copy(), noise.item() * spread), z)
        slope = (0.5 / n) * (solved.inverse - np.outer(solved.alpha, solved.alpha))
        penalties = [
            -prior.log_prob(value_of(module)).sum() / n
            for part in (self.kernel, self.likelihood)
            for _, module, prior, value_of, _ in part.named_priors()
        ]
        for parameter in self.parameters():
            parameter.grad = None
        torch.autograd.backward(
            [latent, noise, *penalties],
            [torch.from_numpy(slope), torch.tensor([np.diag(slope) @ spread]), *map(torch.ones_like, penalties)],
        )
        return sum((p.item() for p in penalties), -solved.log_likelihood / n)


def _fit_posterior(nu: float, u: Points, z: Vector, spread: Vector, start: _Hyperparameters | None) -> _Hyperparameters:
    """Return the hyperparameters of largest posterior density, by L-BFGS on their logarithms."""
    model = _Model.build(nu, u.shape[1], priors=True)
    first = np.full(u.shape[1], 0.3 * math.sqrt(u.shape[1]))
    model.assign(start if start is not None else _Hyperparameters(nu, first, 1.0, 0.02))
    x, parameters = torch.from_numpy(u), model.parameters()

    def loss(vector: Vector) -> tuple[float, Vector]:
        torch.nn.utils.vector_to_parameters(torch.from_numpy(vector), parameters)
        value = model.backward(x, z, spread)
        return value, np.concatenate([p.grad.numpy().ravel() for p in parameters if p.grad is not None])

    initial = torch.nn.utils.parameters_to_vector(parameters).detach().numpy().copy()
    found = minimize(
        loss, initial, jac=True, method="L-BFGS-B", bounds=[_BOUNDS] * len(initial),
        options={"maxiter": 100, "ftol": 1e-6},
    )  # fmt: skip
    torch.nn.utils.vector_to_parameters(torch.from_numpy(found.x), parameters)
    return model.hyperparameters()


def _fit_early_stopped(
    settings: GaussianProcess, u: Points, z: Vector, u_held_out: Points, z_held_out: Vector
) -> _Hyperparameters:
    """Return the hyperparameters of largest validation likelihood on Adam's way, the paper's rule."""
    model = _Model.build(settings.nu, u.shape[1], priors=False)
    half = math.log(2.0)  # GPyTorch's initial value of every positive parameter: softplus(0)
    model.assign(_Hyperparameters(settings.nu, np.full(u.shape[1], half), half, half))
    adam = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
    x, ones = torch.from_numpy(u), np.ones(len(z))
    best, best_value, since = model.hyperparameters(), -math.inf, 0
    for _ in range(settings.max_epochs):
        model.backward(x, z, ones)
        adam.step()
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.clamp_(*_BOUNDS)
        hyper = model.hyperparameters()
        value = _condition(settings, hyper, u, z, ones, None, 0.0, 1.0)(u_held_out).log_density(z_held_out).mean()
        since += 1
        if value > best_value + 0.01:
            best, best_value, since = hyper, value, 0
        if since >= settings.patience:
            break
    return best
