"""A Bayesian neural network by concrete dropout: the paper's BNN, and a smaller one that is about as good.

A draw of the dropout masks is one network. A predictor keeps its draws: each is one Gaussian of the
mixture, and the same function at all points.
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
from sbt.metamodels.base import check_rows, split_validation, standardise
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

__all__ = ["BayesianNetwork", "BayesianNetworkPredictor"]

_CHUNK = 256  # points predicted at once: the widest layer of the paper takes 42 MB for 50 networks
_TEMPERATURE = 0.1  # of the relaxed masks; as Gal et al. (2017)
_DRAWS = 10  # masks of a validation: a few, for its cost
_CHECK = 250  # minibatches between two validations
_LOG_VARIANCE = (2.0 * math.log(0.01), 10.0)  # bounds, standardised: sigma is at least a hundredth of that of y
_IMPROVEMENT = 0.1  # of the validation log likelihood that resets the patience
_DROPPED = 0.1  # share of the units that is dropped at first, as Gal et al. (2017) start
_Array = NDArray[np.float32]


@dataclass(frozen=True)
class BayesianNetwork:
    """Settings of a Bayesian neural network (BNN) with concrete dropout.

    Mean and variance of y come from the network (hardswish); the share of dropped units is learned for
    each layer. The last 80 % of the rows train it; the first 20 % choose the step whose weights are kept.

    Args:
        widths: units of the hidden layers, each >= 1.
        tau: model precision tau > 0: how much the rows count against the prior.
        length_scale: prior length scale l > 0 of the weights.
        batch: rows of a minibatch >= 1.
        learning_rate: first step of Adam, > 0.
        decay: factor in (0, 1] on the learning rate ...
        decay_every: ... after so many minibatches, >= 1.
        patience: minibatches >= 1 without an improvement of 0.1 of the validation log likelihood.
        max_steps: most minibatches >= 1.
        samples: draws of the masks >= 1, the Gaussians of the mixture.
        device: auto (CUDA where there is one), cpu or cuda.

    Raises:
        InputError: a value outside its range; at the fit, a device that is not available.

    Source:
        Gal et al. (2017), Concrete dropout, eqs. (3)-(5); preset: Winkelmann et al. (2022), table of
        hyperparameters.
    """

    widths: tuple[int, ...] = (96, 96, 96, 96)
    tau: float = 1.0
    length_scale: float = 0.0005
    batch: int = 32
    learning_rate: float = 3e-3
    decay: float = 0.5
    decay_every: int = 1000
    patience: int = 2000
    max_steps: int = 5000
    samples: int = 50
    device: str = "cpu"

    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "widths": (180, 110, 430, 830, 160),
            "tau": 7.0,
            "length_scale": 0.0005,
            "batch": 8,
            "learning_rate": 0.001,
            "decay": 0.2,
            "decay_every": 10_000,
            "patience": 20_000,
            "max_steps": 1_000_000,
            "samples": 50,
        }
    }

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))  # a list, from YAML
        if not (len(self.widths) >= 1 and min(self.widths) >= 1):
            raise InputError(f"widths must be one or more numbers >= 1, but got {self.widths}")
        for name in ("batch", "decay_every", "patience", "max_steps", "samples"):
            if not getattr(self, name) >= 1:
                raise InputError(f"{name} must be >= 1, but got {getattr(self, name)}")
        for name in ("tau", "length_scale", "learning_rate", "decay"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be > 0, but got {getattr(self, name)}")
        if not self.decay <= 1.0:
            raise InputError(f"decay must be in (0, 1], but got {self.decay}")
        check_device(self.device)

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> BayesianNetworkPredictor:
        """Return the network trained on u (n, d) and y (n,); see `Metamodel.fit`."""
        u, y = check_rows(u, y)
        z, shift, scale = standardise(y)
        validation, training = split_validation(len(z))
        with single_threaded():
            layers, logits = _train(self, (u[training], z[training]), (u[validation], z[validation]), rng)
        masks = tuple(
            _mask(torch.tensor(p), torch.from_numpy(rng.random((self.samples, 1, len(w))).astype(np.float32))).numpy()
            for (w, _), p in zip(layers, logits, strict=True)
        )
        return BayesianNetworkPredictor(layers, masks, shift, scale, self.device)


@dataclass(frozen=True, eq=False)
class BayesianNetworkPredictor:
    """A trained network and k draws of its masks.

    Args:
        layers: weights (inputs, outputs) and biases (outputs,) of each layer, float32.
        masks: (k, 1, inputs) factors on the inputs of each layer, float32.
        shift: y = shift + scale z.
        scale: see `shift`.
        device: auto, cpu or cuda.
    """

    layers: tuple[tuple[_Array, _Array], ...]
    masks: tuple[_Array, ...]
    shift: float
    scale: float
    device: str

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        device = device_of(self.device)
        layers = [tuple(torch.from_numpy(a).to(device) for a in layer) for layer in self.layers]
        masks = [torch.from_numpy(mask).to(device) for mask in self.masks]
        mean, log_variance = in_chunks(lambda v: _forward(layers, masks, centred(v).to(device)), u, len(masks[0]), _CHUNK)
        return equal_mixture(mean, np.exp(log_variance), self.shift, self.scale)


def _mask(logit: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
    """Return relaxed dropout masks, divided by the share that is kept.

    Source:
        Gal et al. (2017), eq. (5).
    """
    uniform = uniform.clamp(1e-6, 1.0 - 1e-6)
    dropped = torch.sigmoid((logit + uniform.log() - (-uniform).log1p()) / _TEMPERATURE)
    return (1.0 - dropped) / torch.sigmoid(-logit)


def _forward(layers: Any, masks: Any, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return means and log variances (..., n) at x (n, d), standardised, with masks (..., n or 1, inputs)."""
    for i, ((weight, bias), mask) in enumerate(zip(layers, masks, strict=True)):
        x = (x if i == 0 else torch.nn.functional.hardswish(x)) * mask @ weight + bias
    return x[..., 0], x[..., 1].clamp(*_LOG_VARIANCE)


def _train(
    settings: BayesianNetwork, rows: tuple[Points, Vector], held_out: tuple[Points, Vector], rng: np.random.Generator
) -> tuple[tuple[tuple[_Array, _Array], ...], list[float]]:
    """Return layers and dropout logits of the best validation likelihood."""
    device, n = device_of(settings.device), len(rows[1])
    sizes = [rows[0].shape[1], *settings.widths, 2]
    layers = [
        tuple(torch.from_numpy(part).to(device).requires_grad_() for part in initial_layer(a, ((a, b), (b,)), rng))
        for a, b in pairwise(sizes)
    ]
    logits = [torch.full((), math.log(_DROPPED / 0.9), device=device, requires_grad=True) for _ in layers]
    parameters = [*(p for layer in layers for p in layer), *logits]
    x, target = centred(rows[0]).to(device), torch.from_numpy(rows[1].astype(np.float32)).to(device)
    x_out, target_out = centred(held_out[0]).to(device), torch.from_numpy(held_out[1].astype(np.float32)).to(device)
    source = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    adam = torch.optim.Adam(parameters, lr=settings.learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.StepLR(adam, settings.decay_every, settings.decay)
    batches = minibatches(np.arange(n)[None], settings.batch, rng)
    best, best_value, mark, since = [p.detach().clone() for p in parameters], -math.inf, -math.inf, 0
    for step in range(1, settings.max_steps + 1):
        index = torch.from_numpy(next(batches)[0]).to(device)
        masks = _draw(logits, sizes, len(index), source)
        mean, log_variance = _forward(layers, masks, x[index])
        loss = ((target[index] - mean) ** 2 * torch.exp(-log_variance) + log_variance).mean()
        adam.zero_grad()
        (loss + _complexity(settings, layers, logits, n)).backward()  # type: ignore[no-untyped-call]
        adam.step()
        schedule.step()
        if step % _CHECK == 0 or step == settings.max_steps:
            value, since = _validate(layers, logits, sizes, x_out, target_out, source), since + _CHECK
            if value > best_value:
                best, best_value = [p.detach().clone() for p in parameters], value
            if value > mark + _IMPROVEMENT:
                mark, since = value, 0
            if since >= settings.patience:
                break
    arrays = [p.cpu().numpy() for p in best[: 2 * len(layers)]]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True)), [float(p) for p in best[2 * len(layers) :]]


def _draw(logits: list[torch.Tensor], sizes: list[int], n: int, source: torch.Generator) -> list[torch.Tensor]:
    """Return masks (n, inputs) of each layer, one a row."""
    uniform = torch.rand((n, sum(sizes[:-1])), generator=source, device=source.device)
    return [_mask(p, part) for p, part in zip(logits, torch.split(uniform, sizes[:-1], dim=1), strict=True)]


def _complexity(settings: BayesianNetwork, layers: Any, logits: list[torch.Tensor], n: int) -> torch.Tensor:
    """Return the divergence from the prior, per row, on the scale of twice the negative log likelihood.

    Source:
        Gal et al. (2017), eqs. (3), (4), as in the authors' code: weights l^2 / (tau n), masks 2 / (tau n).
    """
    total = torch.zeros((), device=logits[0].device)
    for (weight, _), logit in zip(layers, logits, strict=True):
        p = torch.sigmoid(logit)
        entropy = p * p.log() + (1.0 - p) * (1.0 - p).log()
        squares = settings.length_scale**2 * (weight**2).sum() / (1.0 - p)
        total = total + (squares + 2.0 * len(weight) * entropy) / (settings.tau * n)
    return total


def _validate(
    layers: Any, logits: list[torch.Tensor], sizes: list[int], x: torch.Tensor, target: torch.Tensor, source: torch.Generator
) -> float:
    """Return the mean log likelihood of the mixture of a few draws."""
    with torch.no_grad():
        masks = _draw(logits, sizes, _DRAWS, source)
        mean, log_variance = _forward(layers, [mask[:, None, :] for mask in masks], x)
        terms = -0.5 * ((target - mean) ** 2 * torch.exp(-log_variance) + log_variance + math.log(2.0 * math.pi))
        return float((terms.logsumexp(0) - math.log(_DRAWS)).mean())
