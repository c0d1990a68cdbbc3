"""A two-layer deep Gaussian process, sampled: the paper's DGP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sbt.metamodels.sparse import SparseMixture, Training, train
from sbt.problem.arrays import Points, Vector

__all__ = ["DeepGaussianProcess"]


@dataclass(frozen=True)
class DeepGaussianProcess:
    """Settings of a deep Gaussian process (DGP): one hidden process per input, then one for y.

    Prediction is a mixture of `samples` draws of the hidden layer. Several are trained and mixed, each stopped by
    another fifth of the rows. The paper's 9 "mixture components" belong to a deep sigma-point process: `dspp`.

    Args:
        members: processes, 1 to 5; 1: the first 20 % of the rows stop it, as in the paper.
        kernel: rq (rational quadratic), matern_0.5, matern_1.5 or matern_2.5; one length scale per input.
        inducing: most inducing points of a process, >= 1.
        samples: draws of the hidden layer >= 1, the Gaussians of a process.
        learning_rate: step of Adam, > 0.
        batch: rows of a minibatch >= 1.
        patience: epochs >= 1 without an improvement of 0.01 of the validation log likelihood.
        max_epochs: most epochs >= 1.
        device: auto (CUDA where there is one), cpu or cuda.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Salimbeni & Deisenroth (2017); preset: Winkelmann et al. (2022), table of hyperparameters.
    """

    members: int = 3
    kernel: str = "rq"
    inducing: int = 100
    samples: int = 20
    learning_rate: float = 0.01
    batch: int = 1024
    patience: int = 50
    max_epochs: int = 2000
    device: str = "cpu"

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"members": 1, "kernel": "rq", "inducing": 100, "samples": 50, "learning_rate": 0.01, "patience": 200}
    }

    def __post_init__(self) -> None:
        self._training()

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> SparseMixture:
        """Return the processes trained on u (n, d) and y (n,); see `Metamodel.fit`."""
        return train(self._training(), u, y, rng)

    def _training(self) -> Training:
        return Training(
            deep=True, kernel=self.kernel, inducing=self.inducing, sites=self.samples, objective="elbo",
            penalty=1.0, learning_rate=self.learning_rate, batch=self.batch, patience=self.patience,
            max_epochs=self.max_epochs, device=self.device, members=self.members,
        )  # fmt: skip
