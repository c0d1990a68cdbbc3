"""The paper's way to the hyperparameters of a Gaussian process: GPyTorch's exact process, Adam, and early stopping."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sbt.metamodels.gp_algebra import Hyperparameters
from sbt.problem.arrays import Points, Vector

if TYPE_CHECKING:
    import gpytorch

__all__ = ["fit_early_stopped"]

_IMPROVEMENT = 0.01  # of the mean validation log likelihood that resets the patience
_ANY_SIZE = 10**6  # rows up to which GPyTorch factors the covariance, in place of conjugate gradients


def fit_early_stopped(
    nu: float, u: Points, z: Vector, score: Callable[[Hyperparameters], float], *,
    learning_rate: float, patience: int, max_epochs: int, device: torch.device,
) -> Hyperparameters:  # fmt: skip
    """Return the hyperparameters of the largest score, a mean validation log likelihood, on Adam's way up the likelihood.

    Args:
        nu: smoothness of the kernel.
        u: (n, d) rows.
        z: (n,) standardised y.
        score: of hyperparameters, on rows that are not among these.
        learning_rate: of Adam.
        patience: steps without an improvement after which it ends.
        max_epochs: steps after which it ends.
        device: where it is computed.

    Source:
        Winkelmann et al. (2022), section IV; Gardner et al. (2018), GPyTorch.
    """
    import gpytorch  # takes a second to load

    rows, values = (torch.as_tensor(a, dtype=torch.float64, device=device) for a in (u, z))
    likelihood = gpytorch.likelihoods.GaussianLikelihood().double().to(device)
    process = _process(nu, rows, values, likelihood).double().to(device)
    objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, process)
    adam = torch.optim.Adam(process.parameters(), lr=learning_rate)
    process.train()
    best, best_score, since = _hyperparameters(nu, process), -math.inf, 0
    with gpytorch.settings.max_cholesky_size(_ANY_SIZE):
        for _ in range(max_epochs):
            adam.zero_grad()
            loss = -objective(process(rows), values)
            loss.backward()
            adam.step()
            hyper = _hyperparameters(nu, process)
            value, since = score(hyper), since + 1
            if value > best_score + _IMPROVEMENT:
                best, best_score, since = hyper, value, 0
            if since >= patience:
                break
    return best


def _process(nu: float, rows: torch.Tensor, values: torch.Tensor, likelihood: Any) -> gpytorch.models.ExactGP:
    import gpytorch

    class Exact(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(rows, values, likelihood)
            self.mean_module = gpytorch.means.ConstantMean()
            self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.MaternKernel(nu, ard_num_dims=rows.shape[1]))

        def forward(self, x: torch.Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return Exact()


def _hyperparameters(nu: float, process: Any) -> Hyperparameters:
    kernel = process.covar_module
    return Hyperparameters(
        nu, kernel.base_kernel.lengthscale.detach().cpu().numpy().reshape(1, -1).copy(),
        np.array([float(kernel.outputscale.detach())]), float(process.likelihood.noise.detach()),
    )  # fmt: skip
