"""A deep sigma-point process: a deep Gaussian process whose mixture is learned instead of sampled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sbt.errors import InputError
from sbt.metamodels.sparse import SparseMixture, Training, train
from sbt.problem.arrays import Points, Vector

__all__ = ["DeepSigmaPointProcess"]


@dataclass(frozen=True)
class DeepSigmaPointProcess:
    """Settings of a deep sigma-point process (DSPP): one hidden process per input, then one for y.

    The likelihood of the mixture itself is maximised, with learned sites and weights. Several are trained and
    mixed, each stopped by another fifth of the rows.

    Args:
        members: processes, 1 to 5; 1: the first 20 % of the rows stop it, as in the paper.
        kernel: rq (rational quadratic), matern_0.5, matern_1.5 or matern_2.5; one length scale per input.
        inducing: most inducing points of a process, >= 1.
        sites: quadrature sites >= 1, the Gaussians of a process (the paper's "mixture components").
        learning_rate: step of Adam, > 0.
        penalty: weight > 0 of the KL divergence to the prior (Jankowiak et al. take 0.05 to 1, on more rows).
        batch: rows of a minibatch >= 1.
        patience: epochs >= 1 without an improvement of 0.01 of the validation log likelihood; None: all rows train,
            for `max_epochs`, with a learning rate that falls to 0.
        max_epochs: most epochs >= 1.
        device: auto (CUDA where there is one), cpu or cuda.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Jankowiak et al. (2020), Deep sigma point processes; preset: Winkelmann et al. (2022), table of
        hyperparameters.
    """

    members: int = 3
    kernel: str = "rq"
    inducing: int = 100
    sites: int = 9
    learning_rate: float = 0.01
    penalty: float = 2.0
    batch: int = 1024
    patience: int | None = 50
    max_epochs: int = 2000
    device: str = "cpu"

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "members": 1, "kernel": "rq", "inducing": 100, "sites": 9, "learning_rate": 0.01, "penalty": 0.05, "patience": 200,
        }
    }  # fmt: skip

    def __post_init__(self) -> None:
        if not self.penalty > 0.0:
            raise InputError(f"penalty must be > 0, but got {self.penalty}")
        self._training()

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> SparseMixture:
        """Return the processes trained on u (n, d) and y (n,); see `Metamodel.fit`."""
        return train(self._training(), u, y, rng)

    def _training(self) -> Training:
        return Training(
            deep=True, kernel=self.kernel, inducing=self.inducing, sites=self.sites, objective="predictive",
            penalty=self.penalty, learning_rate=self.learning_rate, batch=self.batch, patience=self.patience,
            max_epochs=self.max_epochs, device=self.device, members=self.members,
        )  # fmt: skip
