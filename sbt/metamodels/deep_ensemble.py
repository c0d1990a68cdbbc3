"""A deep ensemble: small networks that predict mean and variance; the best metamodel from about 1,000 runs on.

All members are trained at once: a layer is one batched matrix product. Each member keeps the weights
that did best on the rows it was not trained on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.metamodels.base import check_rows, standardise
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.torch_tools import (
    centred,
    check_device,
    device_of,
    equal_mixture,
    in_chunks,
    initial_layer,
    minibatches,
    single_threaded,
)
from sbt.problem.arrays import Points, Vector

__all__ = ["Ensemble", "EnsemblePredictor"]

_ROWS = 2500  # up to which the number of steps does not grow: a batch of 32 sees each of them 32 times
_CHUNK = 1024  # points predicted at once: hidden layers of all members stay in the cache
_CHECKS = 50  # validations in a training
_VALIDATION = 500  # most validation rows of a member: a likelihood is then known to a few hundredths
_MOST_DECAY = 0.1  # of the weights that a step may take


@dataclass(frozen=True)
class Ensemble:
    """Settings of a deep ensemble.

    Each member is validated on another share 1/members of the rows, so that together they learn from
    all of them. Beyond 2,500 rows, training takes more steps, in proportion to the rows.

    Args:
        members: number of networks k >= 2.
        layers: hidden layers of a network >= 1.
        width: units of a hidden layer >= 1.
        steps: minibatches >= 1 up to 2,500 rows.
        batch: rows of a minibatch >= 1.
        learning_rate: largest step of AdamW, > 0, on a one-cycle schedule.
        decay: weight decay of AdamW times the number of rows, >= 0: a prior that counts less with more rows.
        beta: exponent in [0, 1] of the variance that weights the loss; 0: likelihood, 1: squared error.
        sigma_floor: smallest sigma of a member, as a share > 0 of the standard deviation of y.
        device: auto (CUDA where there is one), cpu or cuda.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Lakshminarayanan et al. (2017); loss: Seitzer et al. (2022), eq. (4).
    """

    members: int = 10
    layers: int = 4
    width: int = 48
    steps: int = 2500
    batch: int = 32
    learning_rate: float = 3e-3
    decay: float = 200.0
    beta: float = 0.5
    sigma_floor: float = 0.01
    device: str = "cpu"

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {"wide": {"members": 5, "width": 96}}

    def __post_init__(self) -> None:
        for name, least in (("members", 2), ("layers", 1), ("width", 1), ("steps", 1), ("batch", 1)):
            if not getattr(self, name) >= least:
                raise InputError(f"{name} must be >= {least}, but got {getattr(self, name)}")
        if not (self.learning_rate > 0.0 and self.decay >= 0.0):
            raise InputError(f"learning_rate must be > 0 and decay >= 0, but got {self.learning_rate} and {self.decay}")
        if not (0.0 <= self.beta <= 1.0 and self.sigma_floor > 0.0):
            raise InputError(f"beta must be in [0, 1] and sigma_floor > 0, but got {self.beta} and {self.sigma_floor}")
        check_device(self.device)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> EnsemblePredictor:
        """Return the ensemble trained on u (n, d) and y (n,); see `Metamodel.fit`."""
        u, y = check_rows(u, y)
        z, shift, scale = standardise(y)
        with single_threaded():
            layers = _train(self, u, z, rng)
        return EnsemblePredictor(layers, shift, scale, self.sigma_floor, self.device)


@dataclass(frozen=True, eq=False)
class EnsemblePredictor:
    """A trained ensemble of k networks.

    Args:
        layers: weights (k, inputs, outputs) and biases (k, 1, outputs) of each layer, float32.
        shift: y = shift + scale z.
        scale: see `shift`.
        sigma_floor: smallest sigma of a member, standardised.
        device: auto, cpu or cuda.
    """

    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    shift: float
    scale: float
    sigma_floor: float
    device: str

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        device, k = device_of(self.device), len(self.layers[0][0])
        layers = [tuple(torch.from_numpy(a).to(device) for a in layer) for layer in self.layers]
        mean, variance = in_chunks(lambda v: _forward(layers, centred(v).to(device), self.sigma_floor), u, k, _CHUNK)
        return equal_mixture(mean, variance, self.shift, self.scale)


def _forward(layers: Any, x: torch.Tensor, sigma_floor: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (k, n) means and (k, n) variances at x (n, d) or (k, n, d), standardised."""
    hidden = x if x.ndim == 3 else x.expand(len(layers[0][0]), *x.shape)
    for weight, bias in layers[:-1]:
        hidden = torch.nn.functional.hardswish(torch.baddbmm(bias, hidden, weight))
    out = torch.baddbmm(layers[-1][1], hidden, layers[-1][0])
    return out[..., 0], torch.nn.functional.softplus(out[..., 1]) + sigma_floor**2


def _initial(settings: Ensemble, d: int, rng: np.random.Generator) -> list[list[NDArray[np.float32]]]:
    """Return random weights and biases of all layers."""
    k, sizes = settings.members, [d, *[settings.width] * settings.layers, 2]
    return [initial_layer(inputs, ((k, inputs, outputs), (k, 1, outputs)), rng) for inputs, outputs in pairwise(sizes)]


def _folds(members: int, n: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows (k, v) that validate each member and the rows (k, n - v) that train it."""
    order = rng.permutation(n)
    v = max(min(n // members, _VALIDATION), 1)
    own = [np.roll(order, -i * v) for i in range(members)]
    return np.stack([o[:v] for o in own]), np.stack([o[v:] for o in own])


def _train(
    settings: Ensemble, u: Points, z: Vector, rng: np.random.Generator
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]:
    """Return the layers after training, each member with the weights of its best validation likelihood."""
    device, n = device_of(settings.device), len(z)
    layers = [[torch.from_numpy(a).to(device).requires_grad_() for a in layer] for layer in _initial(settings, u.shape[1], rng)]
    parameters = [p for layer in layers for p in layer]
    x, target = centred(u).to(device), torch.from_numpy(z.astype(np.float32)).to(device)
    validation, training = _folds(settings.members, n, rng)
    steps = round(settings.steps * max(1.0, n / _ROWS))
    decay = min(settings.decay / n, _MOST_DECAY / settings.learning_rate)
    adam = torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=decay, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(adam, settings.learning_rate, total_steps=steps + 1)
    best, best_loss = [p.detach().clone() for p in parameters], torch.full((settings.members,), math.inf, device=device)
    batches = minibatches(training, settings.batch, rng)
    for step in range(1, steps + 1):
        rows = torch.from_numpy(next(batches)).to(device)
        loss = _loss(layers, x[rows], target[rows], settings, settings.beta).sum()
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        schedule.step()
        if step == steps or step % max(steps // _CHECKS, 1) == 0:
            with torch.no_grad():
                value = _loss(layers, x[validation], target[validation], settings, 0.0)
                better = value < best_loss
                best_loss = torch.where(better, value, best_loss)
                for snapshot, parameter in zip(best, parameters, strict=True):
                    snapshot[better] = parameter[better]
    arrays = [p.cpu().numpy() for p in best]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))


def _loss(layers: Any, x: torch.Tensor, target: torch.Tensor, settings: Ensemble, beta: float) -> torch.Tensor:
    """Return (k,) mean losses of the members at x (k, m, d), target (k, m)."""
    mean, variance = _forward(layers, x, settings.sigma_floor)
    loss = 0.5 * (variance.log() + (target - mean) ** 2 / variance)
    return (loss * variance.detach() ** beta if beta > 0.0 else loss).mean(dim=1)
