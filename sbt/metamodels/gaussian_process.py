"""Gaussian process regression with input-dependent noise; the best metamodel below about 500 runs.

Hyperparameters are found in `gp_fit`; here a process is conditioned on the rows, and learns how their noise depends on the input.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from sbt.errors import InputError
from sbt.metamodels.base import check_rows, gives_different, split_validation, standardise, without_repetitions
from sbt.metamodels.extra_trees import ExtraTrees
from sbt.metamodels.gp_algebra import (
    NOISE_FLOOR,
    Hyperparameters,
    Matrix,
    cholesky,
    diagonal,
    host,
    placed,
    solve,
    solve_right,
)
from sbt.metamodels.gp_fit import HEAVY_NOISE, LIKELY_NOISE, Objective, fit_kernels, fit_noise, fit_posterior
from sbt.metamodels.gp_paper import fit_early_stopped
from sbt.metamodels.gp_predictor import GaussianProcessPredictor, NoiseSpread, relative_variance
from sbt.metamodels.tails import student_widths
from sbt.metamodels.torch_tools import check_device, device_of, single_threaded
from sbt.problem.arrays import Points, Vector

__all__ = ["GaussianProcess", "GaussianProcessPredictor"]

_FOLDS = 5  # of the noise regression
_FEWEST_FOR_NOISE = 2 * _FOLDS  # rows: two a fold
_FEWEST_FOR_TWO = 20  # rows from which on two kernels are tried
_FOREST = ExtraTrees(trees=10, min_samples_split=20)  # of the noise: a smooth average, since squared residuals vary a lot
_RESIDUAL_FLOOR = 1e-4  # of squared standardised residuals, before the logarithm


@dataclass(frozen=True)
class GaussianProcess:
    """Settings of a Gaussian process (GP): constant mean, Matern kernel, one length scale per input, or two such kernels.

    Defaults: maximum a posteriori by L-BFGS under priors that scale with the dimension, on at most
    `fit_rows` rows, then conditioned on all rows; noise that depends on the input, from one regression
    on the leave-one-out residuals. The likelihood decides whether there is noise at all: half of its prior
    is that of a noisy metric, half is flat down to jitter; where rows look like noise alone, or equal ones differ, a fit from
    heavy noise competes. Without priors (the paper's preset): Adam on the
    marginal likelihood of the last 80 % of the rows, stopped early by the likelihood of the first 20 %.

    Args:
        nu: smoothness of the kernel: 0.5, 1.5 or 2.5.
        input_noise: let the noise depend on the input (from 10 rows on).
        fit_rows: most rows that hyperparameters are fitted on, >= 2; chosen by the rng.
        most_rows: most rows that the process is conditioned on, >= 2; chosen by the rng, which beats a choice by y
            (docs/measured/metamodels.md). Its memory grows with their square.
        student_t: predict a Student-t, from the leave-one-out residuals, instead of a Gaussian.
        priors: fit under priors by L-BFGS; otherwise by Adam with early stopping.
        learning_rate: step of Adam, > 0.
        patience: epochs without an improvement of 0.01 of the mean validation log likelihood, >= 1.
        max_epochs: most epochs of Adam, >= 1.
        device: auto (CUDA where there is one), cpu or cuda.
        certainly_noisy: the prior of the noise is that of a noisy metric alone, as for labels of a class.
        heavy_noise: the noise is large: its prior lies about half of the variance of y.
        kernels: 2: the sum of two kernels of other length scales where its posterior density is larger (from 20 rows and two
            inputs on; not with heavy noise, and not without priors); 1: never.

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
    kernels: int = 2

    CUBIC: ClassVar[bool] = True  # a fit costs the cube of its rows, a prediction their square: estimations give it few
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"nu": 0.5, "input_noise": False, "priors": False, "learning_rate": 0.1, "patience": 200}
    }

    def __post_init__(self) -> None:
        if self.nu not in (0.5, 1.5, 2.5):
            raise InputError(f"nu must be 0.5, 1.5 or 2.5, but got {self.nu}")
        if self.kernels not in (1, 2):
            raise InputError(f"kernels must be 1 or 2, but got {self.kernels}")
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
        return HEAVY_NOISE if self.heavy_noise else LIKELY_NOISE if self.certainly_noisy else None

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
            ones = np.ones(len(z))[training]

            def score(hyper: Hyperparameters) -> float:
                fitted = _condition(self, hyper, u[training], z[training], ones, None, 0.0, 1.0)
                return float(fitted(u[validation]).log_density(z[validation]).mean())

            hyper = fit_early_stopped(
                self.nu, u[training], z[training], score, learning_rate=self.learning_rate, patience=self.patience,
                max_epochs=self.max_epochs, device=device,
            )  # fmt: skip
            return _condition(self, hyper, u[training], z[training], ones, None, shift, scale)
        rows = rng.permutation(len(z))[: self.fit_rows]
        objective = Objective(
            self.nu, u[rows], z[rows], np.ones(len(rows)), device, noise_mode=self._noise_mode, certain=gives_different(u, y)
        )
        if self.kernels == 1 or self._noise_mode is not None or len(rows) < _FEWEST_FOR_TWO or u.shape[1] == 1:
            hyper = fit_posterior(objective)
        else:
            objective, hyper = fit_kernels(objective)
        if self._noise_mode is None:
            objective, hyper = fit_noise(objective, hyper)
        if not self.input_noise or len(z) < _FEWEST_FOR_NOISE:
            return _condition(self, hyper, u, z, np.ones(len(z)), None, shift, scale)
        spread, at_rows = _fit_noise_spread(hyper, u, z, rng, device)
        hyper = fit_posterior(replace(objective, spread=at_rows[rows]), hyper)
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
    """Return (n,) residuals of each row, predicted from the others, and (n,) variances of these; writes on `factor`."""
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
        residual, variance = _leave_one_out(1.0 * factor, z)
        widths = student_widths(residual / np.sqrt(variance))
    alpha = by_z - centre * by_one
    return GaussianProcessPredictor(hyper, u, host(factor), alpha, centre, spread, shift, scale, widths, settings.device)
