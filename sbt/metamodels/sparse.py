"""Sparse variational Gaussian processes, one layer or two: what `svgp`, `dgp` and `dspp` have in common.

A layer is a Gaussian process that is known through its values at inducing points (whitened variational
posterior). A second layer takes the first one's output at `sites`: standard normal numbers (sampled deep
GP) or learned quadrature points (deep sigma-point process). Each site is one Gaussian of the mixture.
The sites are the same at all points, so that a prediction does not depend on the other points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.metamodels.base import check_rows, split_validation, standardise
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.torch_tools import check_device, device_of, in_chunks, minibatches, single_threaded
from sbt.problem.arrays import Points, Vector

__all__ = ["KERNELS", "SparseLayer", "SparseMixture", "SparsePredictor", "Training", "train"]

KERNELS = ("rq", "matern_0.5", "matern_1.5", "matern_2.5")
_NOISE_FLOOR = 1e-4  # variance relative to that of y: keeps the likelihood finite
_JITTER = 1e-6  # on the diagonal of correlations, as GPyTorch takes for variational processes in double precision
_IMPROVEMENT = 0.01  # of the validation log likelihood that resets the patience
_DIGITS = 10  # of z: training would amplify the last bits, which depend on the unit of y
_CHUNK = 4096  # pairs of point and site predicted at once: their covariance with 200 inducing points takes 7 MB
_QUIET = 1e-3  # variance of a hidden process at first, predictive objective: from 1 on it drowns the inputs and stays there
_DRAWS = 10  # of the hidden layer, a training step; GPyTorch's default
_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Training:
    """How a sparse Gaussian process is trained.

    Args:
        deep: two layers, the first with one process per input; otherwise one.
        kernel: one of `KERNELS`, with one length scale per input.
        inducing: most inducing points of a process, >= 1 (not more than rows).
        sites: Gaussians of the mixture, >= 1; 1 without a second layer.
        objective: `elbo` (sampled hidden layer) or `predictive` (likelihood of the mixture itself).
        penalty: weight of the KL divergence in the objective.
        learning_rate: step of Adam, > 0.
        batch: rows of a minibatch >= 1.
        patience: epochs >= 1 without an improvement of 0.01 of the validation log likelihood; None: no
            validation, all rows train for `max_epochs`.
        max_epochs: most epochs >= 1.
        device: auto, cpu or cuda.
        members: processes that are mixed, 1 to 5, each stopped by another fifth of the rows, the first by the first.

    Raises:
        InputError: a value outside its range.
    """

    deep: bool
    kernel: str
    inducing: int
    sites: int
    objective: Literal["elbo", "predictive"]
    penalty: float
    learning_rate: float
    batch: int
    patience: int | None
    max_epochs: int
    device: str
    members: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.members <= 5:
            raise InputError(f"members must be 1 to 5, but got {self.members}")
        if self.kernel not in KERNELS:
            raise InputError(f"kernel must be one of {', '.join(KERNELS)}, but got {self.kernel!r}")
        if self.objective not in ("elbo", "predictive"):
            raise InputError(f"objective must be elbo or predictive, but got {self.objective!r}")
        for name in ("inducing", "sites", "batch", "max_epochs"):
            if not getattr(self, name) >= 1:
                raise InputError(f"{name} must be >= 1, but got {getattr(self, name)}")
        if self.patience is not None and not self.patience >= 1:
            raise InputError(f"patience must be >= 1 or null, but got {self.patience}")
        if not self.learning_rate > 0.0:
            raise InputError(f"learning_rate must be > 0, but got {self.learning_rate}")
        check_device(self.device)


@dataclass(frozen=True, eq=False)
class SparseLayer:
    """h Gaussian processes of d inputs with m inducing points each; arrays, or tensors in training.

    Args:
        inducing: (h, m, d) points.
        log_lengthscale: (h, 1, d).
        log_outputscale: (h,) log variance of the process.
        log_shape: (h,) log shape of the rational quadratic kernel; not used by the others.
        slope: (d, h) of the linear mean.
        offset: (h,) of the linear mean.
        mean: (h, m) whitened variational mean.
        root: (h, m, m) lower root of the whitened variational covariance.
    """

    inducing: Any
    log_lengthscale: Any
    log_outputscale: Any
    log_shape: Any
    slope: Any
    offset: Any
    mean: Any
    root: Any


@dataclass(frozen=True, eq=False)
class SparsePredictor:
    """A trained sparse Gaussian process; plain float64 arrays.

    Args:
        layers: one layer, or two.
        kernel: one of `KERNELS`.
        sites: (k, h) where the second layer takes the first one's output, in its standard deviations.
        weight: (k,) of the sites.
        noise: variance, standardised.
        shift: y = shift + scale z.
        scale: see `shift`.
        device: auto, cpu or cuda.
    """

    layers: tuple[SparseLayer, ...]
    kernel: str
    sites: _Array
    weight: Vector
    noise: float
    shift: float
    scale: float
    device: str

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        device, k = device_of(self.device), len(self.weight)
        layers = tuple(_as_tensors(layer, device) for layer in self.layers)
        sites = torch.from_numpy(self.sites)[:, None, :].to(device)
        mean, variance = in_chunks(
            lambda v: _forward(layers, self.kernel, _centre(v).to(device), sites), u, k, max(_CHUNK // k, 1)
        )
        return Prediction(
            mean=self.shift + self.scale * mean,
            std=self.scale * np.sqrt(variance + self.noise),
            weight=self.weight,
            noise=np.full(len(u), self.scale * math.sqrt(self.noise)),
        )


@dataclass(frozen=True, eq=False)
class SparseMixture:
    """Trained processes, equally likely."""

    processes: tuple[SparsePredictor, ...]

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        k = len(self.processes)
        return Prediction.mixture_of([process(u) for process in self.processes], np.full(k, 1.0 / k))


def train(how: Training, u: Points, y: Vector, rng: np.random.Generator) -> SparseMixture:
    """Return processes trained on u (n, d) and y (n,); see `Metamodel.fit`."""
    u, y = check_rows(u, y)
    z, shift, scale = standardise(y)
    fifth, z = split_validation(len(y))[0].stop, z.round(_DIGITS)
    turned = [np.roll(np.arange(len(y)), -i * fifth) for i in range(how.members)]
    with single_threaded():
        return SparseMixture(tuple(SparsePredictor(shift=shift, scale=scale, **_train(how, u[i], z[i], rng)) for i in turned))


def _train(how: Training, u: Points, z: Vector, rng: np.random.Generator) -> dict[str, Any]:
    """Return the state of one process trained on u (n, d) and standardised z (n,)."""
    validation = training = slice(0, len(z))
    if how.patience is not None:
        validation, training = split_validation(len(z))
    model = _Model.build(how, u[training], rng)
    return _optimise(model, how, (u[training], z[training]), (u[validation], z[validation]), rng)


@dataclass(frozen=True, eq=False)
class _Model:
    """A process in training: tensors."""

    layers: tuple[SparseLayer, ...]
    sites: torch.Tensor  # (k, h): drawn once (elbo) or learned (predictive)
    log_weight: torch.Tensor  # (k,)
    log_noise: torch.Tensor
    learned: list[torch.Tensor]

    @classmethod
    def build(cls, how: Training, u: Points, rng: np.random.Generator) -> _Model:
        device, d = device_of(how.device), u.shape[1]
        at = _centre(u[rng.permutation(len(u))[: how.inducing]]).numpy()
        quiet = _QUIET if how.objective == "predictive" else 1.0
        hidden, last = _initial(at, quiet, np.eye(d), 0.1), _initial(at, 1.0, np.zeros((d, 1)), 1.0)
        initial = (hidden, last) if how.deep else (last,)
        layers = tuple(_as_tensors(layer, device) for layer in initial)
        shape = (how.sites, d if how.deep else 1)
        sites = torch.from_numpy(rng.standard_normal(shape)).to(device)
        log_weight = torch.zeros(how.sites, dtype=torch.float64, device=device)
        log_noise = torch.tensor(math.log(0.1), dtype=torch.float64, device=device)
        learned = [getattr(layer, f.name) for layer in layers for f in fields(layer)] + [log_noise]
        if how.objective == "predictive":
            learned += [sites, log_weight]
        return cls(layers, sites, log_weight, log_noise, [p.requires_grad_() for p in learned])

    @property
    def noise(self) -> torch.Tensor:
        return self.log_noise.exp() + _NOISE_FLOOR

    def state(self, how: Training) -> dict[str, Any]:
        """Return the fields of a predictor, copied."""
        weight = torch.softmax(self.log_weight.detach(), 0).cpu().numpy()
        return {
            "layers": tuple(
                SparseLayer(**{f.name: getattr(layer, f.name).detach().cpu().numpy().copy() for f in fields(layer)})
                for layer in self.layers
            ),
            "kernel": how.kernel,
            "sites": self.sites.detach().cpu().numpy().copy(),
            "weight": weight / weight.sum(),
            "noise": float(self.noise.detach()),
            "device": how.device,
        }


def _initial(at: _Array, variance: float, slope: _Array, spread: float) -> SparseLayer:
    """Return processes before training: inducing points at (m, d), mean slope (d, h), variational root `spread`."""
    (m, d), h = at.shape, slope.shape[1]
    return SparseLayer(
        inducing=np.repeat(at[None], h, axis=0),
        log_lengthscale=np.full((h, 1, d), 0.5 * math.log(d)),
        log_outputscale=np.full(h, math.log(variance)),
        log_shape=np.zeros(h),
        slope=slope,
        offset=np.zeros(h),
        mean=np.zeros((h, m)),
        root=np.repeat(spread * np.eye(m)[None], h, axis=0),
    )


def _optimise(
    model: _Model, how: Training, rows: tuple[Points, Vector], held_out: tuple[Points, Vector], rng: np.random.Generator
) -> dict[str, Any]:
    """Train by Adam; return the state of the best validation likelihood, or the last one without validation."""
    device, n = device_of(how.device), len(rows[1])
    x, z = _centre(rows[0]).to(device), torch.from_numpy(rows[1]).to(device)
    adam = torch.optim.Adam(model.learned, lr=how.learning_rate)
    batches = minibatches(np.arange(n)[None], how.batch, rng)
    per_epoch = max(n // how.batch, 1)
    if how.patience is None:
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, how.max_epochs * per_epoch)
    best, best_value, mark, since = model.state(how), -math.inf, -math.inf, 0
    for _ in range(how.max_epochs):
        for _ in range(per_epoch):
            index = torch.from_numpy(next(batches)[0]).to(device)
            loss = _loss(model, how, x[index], z[index], n, rng)
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
            _stay_in_bounds(model)
            if how.patience is None:
                schedule.step()
        if how.patience is not None:
            state = model.state(how)
            prediction = SparsePredictor(shift=0.0, scale=1.0, **state)(held_out[0])
            value, since = float(prediction.log_density(held_out[1]).mean()), since + 1
            if value > best_value:
                best, best_value = state, value
            if value > mark + _IMPROVEMENT:
                mark, since = value, 0
            if since >= how.patience:
                break
    return best if how.patience is not None else model.state(how)


def _stay_in_bounds(model: _Model) -> None:
    """Keep the hyperparameters where the covariance can be factored."""
    with torch.no_grad():
        for layer in model.layers:
            for parameter in (layer.log_lengthscale, layer.log_outputscale, layer.log_shape):
                parameter.clamp_(-6.0, 6.0)
        model.log_noise.clamp_(-12.0, 6.0)


def _loss(model: _Model, how: Training, x: torch.Tensor, z: torch.Tensor, n: int, rng: np.random.Generator) -> torch.Tensor:
    """Return the negative objective per row.

    Source:
        Salimbeni & Deisenroth (2017), eq. (15); predictive: Jankowiak et al. (2020), DSPP, eq. (10).
    """
    noise, complexity = model.noise, sum(_divergence(layer) for layer in model.layers) / n
    if how.objective == "predictive":
        mean, variance = _forward(model.layers, how.kernel, x, model.sites[:, None, :])
        total = variance + noise
        log_density = -0.5 * ((z - mean) ** 2 / total + total.log() + math.log(2.0 * math.pi))
        log_weight = torch.log_softmax(model.log_weight, 0)[:, None]
        return -(log_weight + log_density).logsumexp(0).mean() + how.penalty * complexity
    shape = (_DRAWS if how.deep else 1, len(z), model.sites.shape[1])
    draws = torch.from_numpy(rng.standard_normal(shape)).to(x.device)
    mean, variance = _forward(model.layers, how.kernel, x, draws)
    expected = -0.5 * (((z - mean) ** 2 + variance) / noise + noise.log() + math.log(2.0 * math.pi))
    return -expected.mean() + how.penalty * complexity


def _forward(layers: tuple[SparseLayer, ...], kernel: str, x: torch.Tensor, sites: torch.Tensor) -> tuple[Any, Any]:
    """Return (k, n) means and variances at x (n, d); sites (k, n or 1, h)."""
    mean, variance = _apply(layers[0], kernel, x)  # (h, n)
    if len(layers) == 1:
        return mean.expand(len(sites), -1), variance.expand(len(sites), -1)
    hidden = mean.T + variance.T.sqrt() * sites  # (k, n, h)
    mean, variance = _apply(layers[1], kernel, hidden.reshape(-1, hidden.shape[-1]))  # (1, k n)
    return mean.reshape(hidden.shape[:2]), variance.reshape(hidden.shape[:2])


def _apply(layer: SparseLayer, kernel: str, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (h, n) means and variances of the processes at x (n, d).

    Source:
        Hensman et al. (2015), eqs. (8)-(10), whitened.
    """
    lengthscale, outputscale = layer.log_lengthscale.exp(), layer.log_outputscale.exp()[:, None]
    points, at = layer.inducing / lengthscale, x / lengthscale  # (h, m, d), (h, n, d)
    identity = torch.eye(points.shape[1], dtype=x.dtype, device=x.device)
    own = _correlation(kernel, points, points, layer.log_shape) + _JITTER * identity
    factor = torch.linalg.cholesky(outputscale[..., None] * own)
    cross = outputscale[..., None] * _correlation(kernel, points, at, layer.log_shape)
    half = torch.linalg.solve_triangular(factor, cross, upper=False)  # (h, m, n)
    mean = (layer.mean[:, None, :] @ half)[:, 0] + (x @ layer.slope + layer.offset).T
    spread = layer.root.tril().mT @ half
    variance = outputscale - (half**2).sum(1) + (spread**2).sum(1)
    return mean, variance.clamp_min(1e-9)


def _correlation(kernel: str, a: torch.Tensor, b: torch.Tensor, log_shape: torch.Tensor) -> torch.Tensor:
    """Return (h, n, m) correlations of scaled points a (h, n, d) and b (h, m, d)."""
    square = (a**2).sum(-1)[..., None] + (b**2).sum(-1)[:, None, :] - 2.0 * a @ b.mT
    square = square.clamp_min(0.0)
    if kernel == "rq":
        shape = log_shape.exp()[:, None, None]
        return (1.0 + square / (2.0 * shape)) ** -shape
    nu = float(kernel.removeprefix("matern_"))
    r = (2.0 * nu * square + 1e-15).sqrt()
    polynomial: Any = {0.5: 1.0, 1.5: 1.0 + r, 2.5: 1.0 + r + r**2 / 3.0}[nu]
    return polynomial * torch.exp(-r)


def _divergence(layer: SparseLayer) -> torch.Tensor:
    """Return the KL divergence of the whitened variational posterior from the prior."""
    root = layer.root.tril()
    diagonal = root.diagonal(dim1=-2, dim2=-1)
    value: torch.Tensor = 0.5 * ((root**2).sum() + (layer.mean**2).sum() - diagonal.numel()) - diagonal.abs().log().sum()
    return value


def _centre(u: Points) -> torch.Tensor:
    """Return u (n, d) with mean 0 and variance 1 over the unit cube."""
    return torch.from_numpy((u - 0.5) * math.sqrt(12.0))


def _as_tensors(layer: SparseLayer, device: torch.device) -> SparseLayer:
    return SparseLayer(**{f.name: torch.from_numpy(getattr(layer, f.name)).to(device) for f in fields(layer)})
