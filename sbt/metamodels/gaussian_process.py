"""Gaussian process regression with input-dependent noise; the best metamodel below about 500 runs.

GPyTorch provides the kernel, its constraints, priors and gradients. The exact marginal likelihood is
written out here: one Cholesky factor serves its value, its gradient and the leave-one-out residuals,
and nothing turns to conjugate gradients above 800 rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import gpytorch
import numpy as np
import torch
from gpytorch.constraints import GreaterThan, Positive
from gpytorch.priors import LogNormalPrior
from scipy.optimize import minimize

from sbt.errors import InputError
from sbt.metamodels.base import check_rows, split_validation, standardise, without_repetitions
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gp_algebra import (
    NOISE_FLOOR,
    Hyperparameters,
    Matrix,
    cholesky,
    diagonal,
    host,
    like,
    native,
    placed,
    solve,
    solve_right,
)
from sbt.metamodels.gp_predictor import GaussianProcessPredictor, NoiseSpread, relative_variance
from sbt.metamodels.tails import student_widths
from sbt.metamodels.torch_tools import check_device, device_of, single_threaded
from sbt.problem.arrays import Points, Vector

__all__ = ["GaussianProcess", "GaussianProcessPredictor"]

_BOUNDS = (-12.0, 8.0)  # of the logarithm of every hyperparameter: beyond, the covariance cannot be factored
_LIKELY_NOISE, _NO_NOISE = -5.0, math.log(NOISE_FLOOR)  # log variances: the mode of a noisy metric, and a deterministic one
_HEAVY_NOISE = -0.7  # log variance: half of y's, the mode where a simulator is known to be noisy
_LEAST_NOISE = 1e-4  # GPyTorch's own floor, where there are no priors or certainly noise
_FOLDS = 5  # of the noise regression
_FEWEST_FOR_NOISE = 2 * _FOLDS  # rows: two a fold
_FOREST = ExtraTrees(trees=10, min_samples_split=20)  # of the noise: a smooth average, since squared residuals vary a lot
_RESIDUAL_FLOOR = 1e-4  # of squared standardised residuals, before the logarithm
_FIRST_LENGTH, _FIRST_NOISE = 0.3, 0.02  # where L-BFGS starts: length scales in sqrt(d), noise variance
_HEAVY_LENGTH, _HEAVY_START = 0.6, 0.5  # the same where noise is heavy: from short ones the fit takes noise for structure
_ITERATIONS, _TOLERANCE = 100, 1e-6  # of L-BFGS: about 30 are usual; of the log posterior per row
_IMPROVEMENT = 0.01  # of the mean validation log likelihood that resets the patience


@dataclass(frozen=True)
class GaussianProcess:
    """Settings of a Gaussian process (GP): constant mean, Matern kernel, one length scale per input.

    Defaults: maximum a posteriori by L-BFGS under priors that scale with the dimension, on at most
    `fit_rows` rows, then conditioned on all rows; noise that depends on the input, from one regression
    on the leave-one-out residuals. The likelihood decides whether there is noise at all: half of its prior
    is that of a noisy metric, half is flat down to jitter. Without priors (the paper's preset): Adam on the
    marginal likelihood of the last 80 % of the rows, stopped early by the likelihood of the first 20 %.

    Args:
        nu: smoothness of the kernel: 0.5, 1.5 or 2.5.
        input_noise: let the noise depend on the input (from 10 rows on).
        fit_rows: most rows that hyperparameters are fitted on, >= 2; chosen by the rng.
        most_rows: most rows that the process is conditioned on, >= 2; chosen by the rng, which beats a choice by y
            (docs/metamodels.md). Its memory grows with their square.
        student_t: predict a Student-t, from the leave-one-out residuals, instead of a Gaussian.
        priors: fit under priors by L-BFGS; otherwise by Adam with early stopping.
        learning_rate: step of Adam, > 0.
        patience: epochs without an improvement of 0.01 of the mean validation log likelihood, >= 1.
        max_epochs: most epochs of Adam, >= 1.
        device: auto (CUDA where there is one), cpu or cuda.
        certainly_noisy: the prior of the noise is that of a noisy metric alone, as for labels of a class.
        heavy_noise: the noise is large: its prior lies about half of the variance of y.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Rasmussen & Williams (2006), algorithm 2.1, eqs. (5.9), (5.10)-(5.12); priors: Hvarfner et al.
        (2024), as in BoTorch since 0.12; preset: Winkelmann et al. (2022), table of hyperparameters.
    """

    nu: float = 1.5
    input_noise: bool = True
    fit_rows: int = 500
    most_rows: int = 10_000
    student_t: bool = False
    priors: bool = True
    learning_rate: float = 0.1
    patience: int = 200
    max_epochs: int = 2000
    device: str = "cpu"
    certainly_noisy: bool = False
    heavy_noise: bool = False

    CUBIC: ClassVar[bool] = True  # a fit costs the cube of its rows, a prediction their square: estimations give it few
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"nu": 0.5, "input_noise": False, "priors": False, "learning_rate": 0.1, "patience": 200}
    }

    def __post_init__(self) -> None:
        if self.nu not in (0.5, 1.5, 2.5):
            raise InputError(f"nu must be 0.5, 1.5 or 2.5, but got {self.nu}")
        if not (self.fit_rows >= 2 and self.most_rows >= 2 and self.patience >= 1 and self.max_epochs >= 1):
            raise InputError(
                "GaussianProcess needs fit_rows >= 2, most_rows >= 2, patience >= 1 and max_epochs >= 1, "
                f"but got {self.fit_rows}, {self.most_rows}, {self.patience} and {self.max_epochs}"
            )
        if not self.learning_rate > 0.0:
            raise InputError(f"learning_rate must be > 0, but got {self.learning_rate}")
        check_device(self.device)

    @property
    def for_noise(self) -> GaussianProcess:
        """The same process for a metric whose repetitions differ much."""
        return replace(self, heavy_noise=True)

    @property
    def with_input_noise(self) -> GaussianProcess:
        """The same process whose noise depends on the input."""
        return replace(self, input_noise=True)

    @property
    def _noise_mode(self) -> float | None:
        """Log variance about which the noise is expected; None: there may be none."""
        return _HEAVY_NOISE if self.heavy_noise else _LIKELY_NOISE if self.certainly_noisy else None

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> GaussianProcessPredictor:
        """Return the process conditioned on u (n, d) and y (n,); see `Metamodel.fit`."""
        u, y = without_repetitions(*check_rows(u, y))
        if len(y) > self.most_rows:
            rows = np.sort(rng.permutation(len(y))[: self.most_rows])
            u, y = u[rows], y[rows]
        with single_threaded():
            return self._fit(u, y, rng)

    def _fit(self, u: Points, y: Vector, rng: np.random.Generator) -> GaussianProcessPredictor:
        z, shift, scale = standardise(y)
        device = device_of(self.device)
        if not self.priors:
            validation, training = split_validation(len(z))
            hyper = _fit_early_stopped(self, u[training], z[training], u[validation], z[validation])
            return _condition(self, hyper, u[training], z[training], np.ones(len(z))[training], None, shift, scale)
        rows = rng.permutation(len(z))[: self.fit_rows]
        hyper = _fit_posterior(self.nu, u[rows], z[rows], np.ones(len(rows)), None, device, noise_mode=self._noise_mode)
        if not self.input_noise or len(z) < _FEWEST_FOR_NOISE:
            return _condition(self, hyper, u, z, np.ones(len(z)), None, shift, scale)
        spread, at_rows = _fit_noise_spread(hyper, u, z, rng, device)
        hyper = _fit_posterior(self.nu, u[rows], z[rows], at_rows[rows], hyper, device, noise_mode=self._noise_mode)
        return _condition(self, hyper, u, z, at_rows, spread, shift, scale)


def _fit_noise_spread(
    hyper: Hyperparameters, u: Points, z: Vector, rng: np.random.Generator, device: torch.device
) -> tuple[NoiseSpread, Vector]:
    """Return how the noise depends on the input, and (n,) its values at the rows.

    A regression on the log of squared leave-one-out residuals, relative to their variance. The values at
    the rows are cross-fitted: from its own residual the noise of a row would be too small where the process
    happens to fit it.
    """
    residual, variance = _leave_one_out(_factor(hyper, u, np.full(len(z), hyper.noise), device), z)
    log_ratio = np.log(residual**2 / variance + _RESIDUAL_FLOOR)
    fold = rng.permutation(len(z)) % _FOLDS
    at_rows, forests = np.zeros(len(z)), []
    for i in range(_FOLDS):
        rest = fold != i
        forest = _FOREST.fit(u[rest], log_ratio[rest], rng)
        at_rows[~rest] = forest.mu(u[~rest])
        forests.append(forest)
    return NoiseSpread(tuple(forests)), relative_variance(at_rows)


def _factor(hyper: Hyperparameters, u: Points, noise: Vector, device: torch.device) -> Matrix:
    """Return the (n, n) lower Cholesky factor of the covariance of rows with that noise variance."""
    rows = placed(u, device)
    return cholesky(hyper.covariance(rows, rows), np.maximum(noise, NOISE_FLOOR))


def _leave_one_out(factor: Matrix, z: Vector) -> tuple[Vector, Vector]:
    """Return (n,) residuals of each row, predicted from the others, and (n,) variances of those predictions."""
    solved = solve(factor, z)
    variance = 1.0 / host(diagonal(solved.inverse))
    return host(solved.alpha) * variance, variance


def _condition(
    settings: GaussianProcess,
    hyper: Hyperparameters,
    u: Points,
    z: Vector,
    at_rows: Vector,
    spread: NoiseSpread | None,
    shift: float,
    scale: float,
) -> GaussianProcessPredictor:
    """Return the predictor conditioned on all rows; `at_rows` is the relative noise variance there."""
    factor = _factor(hyper, u, hyper.noise * at_rows, device_of(settings.device))
    by_one, by_z = solve_right(factor, np.stack([np.ones(len(z)), z], axis=1)).T
    centre = float(by_one @ z / by_one.sum())
    widths = np.ones(1)
    if settings.student_t:
        residual, variance = _leave_one_out(factor, z)
        widths = student_widths(residual / np.sqrt(variance))
    alpha = by_z - centre * by_one
    return GaussianProcessPredictor(hyper, u, host(factor), alpha, centre, spread, shift, scale, widths, settings.device)


@dataclass(frozen=True, eq=False)
class _Model:
    """GPyTorch's kernel and likelihood: parameters (in logs), constraints, priors, gradients."""

    kernel: gpytorch.kernels.ScaleKernel
    likelihood: gpytorch.likelihoods.GaussianLikelihood
    floor: float
    priors: bool
    noise_mode: float | None

    @classmethod
    def build(cls, nu: float, dimension: int, device: torch.device, *, priors: bool, noise_mode: float | None = None) -> _Model:
        """Return a model on the device; with priors the output scale is fixed at 1, the variance of standardised y."""
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
        floor = NOISE_FLOOR if priors and noise_mode is None else _LEAST_NOISE
        likelihood = gpytorch.likelihoods.GaussianLikelihood(noise_constraint=GreaterThan(floor, **log))
        return cls(kernel.double().to(device), likelihood.double().to(device), floor, priors, noise_mode)

    def parameters(self) -> list[torch.nn.Parameter]:
        both = (*self.kernel.parameters(), *self.likelihood.parameters())
        return [p for p in both if p.requires_grad]

    def assign(self, hyper: Hyperparameters) -> None:
        """Set the parameters to the given values."""
        device = self.likelihood.noise.device
        noise = max(hyper.noise, 1.001 * self.floor)
        self.kernel.base_kernel.lengthscale = torch.from_numpy(hyper.lengthscale).to(device)
        self.kernel.outputscale = torch.tensor(hyper.outputscale, dtype=torch.float64, device=device)
        self.likelihood.noise = torch.tensor([noise], dtype=torch.float64, device=device)

    def hyperparameters(self) -> Hyperparameters:
        base = self.kernel.base_kernel
        return Hyperparameters(
            nu=float(base.nu),
            lengthscale=base.lengthscale.detach().cpu().numpy().ravel().copy(),
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
        solved = solve(cholesky(native(latent.detach().clone(memory_format=torch.contiguous_format)), noise.item() * spread), z)
        slope = (0.5 / n) * (solved.inverse - solved.alpha[:, None] * solved.alpha)
        by_noise = torch.full_like(noise, float(diagonal(slope) @ like(spread, slope)))
        penalties = [-prior.log_prob(value_of(module)).sum() / n for _, module, prior, value_of, _ in self.kernel.named_priors()]
        if self.priors:
            penalties.append(-_log_prior_of_noise(noise, self.noise_mode).sum() / n)
        for parameter in self.parameters():
            parameter.grad = None
        torch.autograd.backward(
            [latent, noise, *penalties],
            [torch.as_tensor(slope), by_noise, *map(torch.ones_like, penalties)],
        )
        return sum((p.item() for p in penalties), -solved.log_likelihood / n)


def _log_prior_of_noise(noise: torch.Tensor, mode: float | None) -> torch.Tensor:
    """Return the log prior density of the log noise variance: half is that of noisy metrics, half is flat down to jitter.

    With a mode there is noise for certain, about there.

    The first alone costs a deterministic metric 80 nats: 100 smooth runs were then learned with noise of 2 % of the
    standard deviation of y, too much for a critical interval that is narrower.
    """
    log_noise = noise.log()
    noisy = -0.5 * (log_noise - (_LIKELY_NOISE if mode is None else mode)) ** 2 - 0.5 * math.log(2.0 * math.pi)
    if mode is not None:
        return noisy
    flat = torch.nn.functional.logsigmoid(2.0 * (_LIKELY_NOISE - log_noise)) - math.log(_LIKELY_NOISE - _NO_NOISE)
    return torch.logaddexp(noisy, flat) - math.log(2.0)


def _fit_posterior(
    nu: float,
    u: Points,
    z: Vector,
    spread: Vector,
    start: Hyperparameters | None,
    device: torch.device,
    *,
    noise_mode: float | None,
) -> Hyperparameters:
    """Return the hyperparameters of largest posterior density, by L-BFGS on their logarithms."""
    model = _Model.build(nu, u.shape[1], device, priors=True, noise_mode=noise_mode)
    length, noise = (_HEAVY_LENGTH, _HEAVY_START) if noise_mode == _HEAVY_NOISE else (_FIRST_LENGTH, _FIRST_NOISE)
    first = np.full(u.shape[1], length * math.sqrt(u.shape[1]))
    model.assign(start if start is not None else Hyperparameters(nu, first, 1.0, noise))
    x, parameters = torch.from_numpy(u).to(device), model.parameters()

    def loss(vector: Vector) -> tuple[float, Vector]:
        torch.nn.utils.vector_to_parameters(torch.from_numpy(vector).to(device), parameters)
        value = model.backward(x, z, spread)
        return value, np.concatenate([p.grad.cpu().numpy().ravel() for p in parameters if p.grad is not None])

    initial = torch.nn.utils.parameters_to_vector(parameters).detach().cpu().numpy().copy()
    found = minimize(
        loss, initial, jac=True, method="L-BFGS-B", bounds=[_BOUNDS] * (len(initial) - 1) + [(_NO_NOISE - 1.0, _BOUNDS[1])],
        options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE},
    )  # fmt: skip
    torch.nn.utils.vector_to_parameters(torch.from_numpy(found.x).to(device), parameters)
    return model.hyperparameters()


def _fit_early_stopped(
    settings: GaussianProcess, u: Points, z: Vector, u_held_out: Points, z_held_out: Vector
) -> Hyperparameters:
    """Return the hyperparameters of largest validation likelihood on Adam's way, the paper's rule."""
    device = device_of(settings.device)
    model = _Model.build(settings.nu, u.shape[1], device, priors=False)
    half = math.log(2.0)  # GPyTorch's initial value of every positive parameter: softplus(0)
    model.assign(Hyperparameters(settings.nu, np.full(u.shape[1], half), half, half))
    adam = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
    x, ones = torch.from_numpy(u).to(device), np.ones(len(z))
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
        if value > best_value + _IMPROVEMENT:
            best, best_value, since = hyper, value, 0
        if since >= settings.patience:
            break
    return best
