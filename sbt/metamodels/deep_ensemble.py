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
_BETA_2, _EPSILON = 0.999, 1e-8  # of Adam, the usual ones


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
    first = [torch.from_numpy(a).to(device) for layer in _initial(settings, u.shape[1], rng) for a in layer]
    flat, slope, best = (torch.cat([a.reshape(-1) for a in first]) for _ in range(3))
    layers, slopes, kept = (_views(vector, first) for vector in (flat, slope, best))
    x, target = centred(u).to(device), torch.from_numpy(z.astype(np.float32)).to(device)
    validation, training = _folds(settings.members, n, rng)
    x_held_out, held_out = x[validation], target[validation]
    steps = round(settings.steps * max(1.0, n / _ROWS))
    adam = _Adam(flat, min(settings.decay / n, _MOST_DECAY / settings.learning_rate))
    best_loss = torch.full((settings.members,), math.inf, device=device)
    batches = minibatches(training, settings.batch, rng)
    with torch.no_grad():
        for step in range(1, steps + 1):
            rows = torch.from_numpy(next(batches)).to(device)
            _backward(layers, slopes, x[rows], target[rows], settings)
            adam.step(slope, *_one_cycle(step - 1, steps, settings.learning_rate))
            if step == steps or step % max(steps // _CHECKS, 1) == 0:
                mean, variance = _forward(layers, x_held_out, settings.sigma_floor)
                value = (0.5 * (variance.log() + (held_out - mean) ** 2 / variance)).mean(dim=1)
                better = value < best_loss
                best_loss = torch.where(better, value, best_loss)
                for now, snapshot in zip(layers, kept, strict=True):
                    for a, b in zip(now, snapshot, strict=True):
                        b[better] = a[better]
    return tuple((weight.cpu().numpy().copy(), bias.cpu().numpy().copy()) for weight, bias in kept)


_Layers = list[tuple[torch.Tensor, torch.Tensor]]


def _views(vector: torch.Tensor, like: list[torch.Tensor]) -> _Layers:
    """Return weights and biases of the layers, shaped as `like`, that share the memory of one vector."""
    parts = [part.view(a.shape) for part, a in zip(torch.split(vector, [a.numel() for a in like]), like, strict=True)]
    return list(zip(parts[::2], parts[1::2], strict=True))


def _backward(layers: _Layers, slopes: _Layers, x: torch.Tensor, target: torch.Tensor, settings: Ensemble) -> None:
    """Write to `slopes` the derivative of the sum of the members' mean losses at x (k, m, d), target (k, m).

    The loss is 0.5 (log variance + error^2 / variance) variance^beta, the last factor a constant. Written down, because a step
    is so small that automatic differentiation takes twice as long as the step itself.

    Source:
        Seitzer et al. (2022), eq. (4).
    """
    hidden, sums = [x], []
    for weight, bias in layers[:-1]:
        sums.append(torch.baddbmm(bias, hidden[-1], weight))
        hidden.append(torch.nn.functional.hardswish(sums[-1]))
    out = torch.baddbmm(layers[-1][1], hidden[-1], layers[-1][0])
    error, raw = out[..., 0] - target, out[..., 1]
    variance = torch.nn.functional.softplus(raw) + settings.sigma_floor**2
    factor = variance ** (settings.beta - 1.0) / x.shape[1]
    by_out = torch.empty_like(out)
    torch.mul(error, factor, out=by_out[..., 0])
    torch.mul(0.5 * (1.0 - error**2 / variance) * factor, torch.sigmoid(raw), out=by_out[..., 1])
    for k in range(len(layers) - 1, -1, -1):
        torch.bmm(hidden[k].mT, by_out, out=slopes[k][0])
        torch.sum(by_out, dim=1, keepdim=True, out=slopes[k][1])
        if k > 0:
            by_out = torch.ops.aten.hardswish_backward(torch.bmm(by_out, layers[k][0].mT), sums[k - 1])


class _Adam:
    """AdamW on one vector; `torch.optim` imports a compiler, which takes a second, and costs as much as the step itself.

    Source:
        Kingma & Ba (2015), algorithm 1; decoupled decay: Loshchilov & Hutter (2019), algorithm 2.
    """

    def __init__(self, vector: torch.Tensor, decay: float):
        self._vector, self._decay, self._steps = vector, decay, 0
        self._mean, self._square, self._room = (torch.zeros_like(vector) for _ in range(3))

    def step(self, slope: torch.Tensor, rate: float, momentum: float) -> None:
        """Take a step of this rate, with the momentum as beta_1, and beta_2 = 0.999."""
        self._steps += 1
        self._mean.lerp_(slope, 1.0 - momentum)
        self._square.mul_(_BETA_2).addcmul_(slope, slope, value=1.0 - _BETA_2)
        torch.sqrt(self._square, out=self._room)
        self._room.mul_((1.0 - _BETA_2**self._steps) ** -0.5).add_(_EPSILON)
        self._vector.mul_(1.0 - rate * self._decay)
        self._vector.addcdiv_(self._mean, self._room, value=-rate / (1.0 - momentum**self._steps))


def _one_cycle(step: int, steps: int, most: float) -> tuple[float, float]:
    """Return learning rate and momentum of a step >= 0: up along a cosine over 30 % of the steps, then down to nearly nothing.

    Source:
        Smith & Topin (2019), as PyTorch's OneCycleLR has it by default.
    """
    peak = 0.3 * (steps + 1) - 1.0
    rising = step <= peak
    start, end = ((most / 25.0, 0.95), (most, 0.85)) if rising else ((most, 0.85), (most / 25.0e4, 0.95))
    left = 0.5 * (1.0 + math.cos(math.pi * (step / peak if rising else (step - peak) / (steps - peak))))
    return end[0] + (start[0] - end[0]) * left, end[1] + (start[1] - end[1]) * left
