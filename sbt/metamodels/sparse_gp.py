"""A sparse variational Gaussian process, for many runs: cost grows with the rows, not with their cube."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sbt.errors import InputError
from sbt.metamodels.sparse import SparseMixture, Training, train
from sbt.problem.arrays import Points, Vector

__all__ = ["SparseGaussianProcess"]

_ROWS = 2500  # from which on all steps are taken
_FEWEST = 20  # inducing points that few rows may have


@dataclass(frozen=True)
class SparseGaussianProcess:
    """Settings of a sparse variational Gaussian process (SVGP).

    Args:
        kernel: rq (rational quadratic), matern_0.5, matern_1.5 or matern_2.5; one length scale per input.
        inducing: most inducing points, >= 1; from 20 on not more than a fifth of the rows.
        objective: predictive (the likelihood of what is predicted; its variance depends on the input) or
            elbo (the evidence lower bound).
        learning_rate: first step of Adam, > 0, on a cosine schedule.
        batch: rows of a minibatch >= 1.
        steps: minibatches >= 1 from 2,500 rows on; with fewer rows fewer, in proportion, down to a fifth: more of
            them make it overconfident.
        device: auto (CUDA where there is one), cpu or cuda.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Hensman et al. (2015); objective: Jankowiak et al. (2020), Parametric Gaussian process regressors.
    """

    kernel: str = "matern_1.5"
    inducing: int = 200
    objective: Literal["predictive", "elbo"] = "predictive"
    learning_rate: float = 0.02
    batch: int = 512
    steps: int = 1000
    device: str = "cpu"

    def __post_init__(self) -> None:
        if not self.steps >= 1:
            raise InputError(f"steps must be >= 1, but got {self.steps}")
        self._training(2)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> SparseMixture:
        """Return the process trained on u (n, d) and y (n,); see `Metamodel.fit`."""
        return train(self._training(len(y)), u, y, rng)

    def _steps(self, n: int) -> float:
        return self.steps * min(max(n / _ROWS, 0.2), 1.0)

    def _training(self, n: int) -> Training:
        return Training(
            deep=False, kernel=self.kernel, inducing=min(self.inducing, max(n // 5, _FEWEST)), sites=1, objective=self.objective,
            penalty=1.0, learning_rate=self.learning_rate, batch=self.batch, patience=None,
            max_epochs=max(round(self._steps(n) / max(n // self.batch, 1)), 1), device=self.device,
        )  # fmt: skip
