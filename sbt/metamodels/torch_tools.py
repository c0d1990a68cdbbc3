"""What the metamodels built on PyTorch share: one thread, a device by name, layers, minibatches, chunked prediction."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import scipy.linalg  # noqa: F401  loads the thread pool that `_THREADS` has to know
import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from sbt.errors import InputError
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector

__all__ = [
    "DEVICES", "centred", "check_device", "device_of", "equal_mixture", "in_chunks", "initial_layer", "minibatches",
    "single_threaded",
]  # fmt: skip

DEVICES = ("auto", "cpu", "cuda")
_THREADS = ThreadpoolController()  # knows the pools that are loaded by now


@contextmanager
def single_threaded() -> Iterator[None]:
    """Return a context with one thread in all pools, and CUDA's deterministic algorithms.

    Bits of fits and predictions then do not depend on the number of cores, and matrices of a few hundred
    rows are solved faster than threads are woken (0.9 s instead of 3.6 s for a GP of 500 rows, 2 cores).
    Where CUDA has no deterministic algorithm, PyTorch warns.
    """
    before, cuda = torch.get_num_threads(), torch.version.cuda is not None
    strictness = torch.get_deterministic_debug_mode()
    with _THREADS.limit(limits=1):
        torch.set_num_threads(1)  # the pool of MKL within PyTorch is hidden from threadpoolctl
        if cuda:
            torch.use_deterministic_algorithms(True, warn_only=True)
        try:
            yield
        finally:
            torch.set_num_threads(before)
            if cuda:
                torch.set_deterministic_debug_mode(strictness)


def centred(u: Points) -> torch.Tensor:
    """Return u (n, d) with mean 0 and variance 1 over the unit cube, float32."""
    return torch.from_numpy(((u - 0.5) * math.sqrt(12.0)).astype(np.float32))


def check_device(device: str) -> None:
    """Raise InputError where `device` is not one of `DEVICES`; the fit checks that it is available."""
    if device not in DEVICES:
        raise InputError(f"device must be auto, cpu or cuda, but got {device!r}")


def device_of(device: str) -> torch.device:
    """Return the device: `auto` is a CUDA device where there is one, otherwise the CPU.

    cuBLAS gives the same bits every time only with a workspace of fixed size, which the environment sets.

    Raises:
        InputError: `cuda` where there is none.
    """
    check_device(device)
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("device 'cuda' needs a CUDA device and a PyTorch built for it, but there is none; use auto or cpu")
    if device == "cpu" or not available:
        return torch.device("cpu")
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    return torch.device("cuda")


def initial_layer(inputs: int, shapes: tuple[tuple[int, ...], ...], rng: np.random.Generator) -> list[NDArray[np.float32]]:
    """Return random weights and biases of these shapes, uniform within +-1/sqrt(inputs) as PyTorch draws them."""
    bound = 1.0 / math.sqrt(inputs)
    return [rng.uniform(-bound, bound, shape).astype(np.float32) for shape in shapes]


def in_chunks(
    forward: Callable[[Points], tuple[torch.Tensor, torch.Tensor]], u: Points, k: int, size: int
) -> tuple[Points, Points]:
    """Return two (k, n) arrays that a network computes at u (n, d), `size` points at a time and without gradients.

    Args:
        forward: (m, d) points -> two (k, m) tensors.
        u: (n, d) points.
        k: components of the mixture.
        size: points at once, >= 1.
    """
    first, second = np.empty((k, len(u))), np.empty((k, len(u)))
    with single_threaded(), torch.inference_mode():
        for start in range(0, len(u), size):
            rows = slice(start, start + size)
            a, b = forward(u[rows])
            first[:, rows], second[:, rows] = a.cpu().numpy(), b.cpu().numpy()
    return first, second


def equal_mixture(mean: Points, variance: Points, shift: float, scale: float) -> Prediction:
    """Return the mixture of k equally likely networks, whose variance is the noise.

    Args:
        mean: (k, n) means, standardised: y = shift + scale z.
        variance: (k, n) variances, standardised.
        shift: see `mean`.
        scale: see `mean`.
    """
    noise: Vector = scale * np.sqrt(variance.mean(axis=0))
    return Prediction(shift + scale * mean, scale * np.sqrt(variance), np.full(len(mean), 1.0 / len(mean)), noise)


def minibatches(rows: NDArray[np.int64], size: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Yield (k, size) rows without end: each of the k lists in `rows` (k, m) reshuffled for every pass.

    With fewer rows than `size`, a minibatch is all of them.
    """
    count = rows.shape[1]
    size = min(size, count)
    while True:
        shuffled = rng.permuted(rows, axis=1)
        for first in range(0, count - size + 1, size):
            yield shuffled[:, first : first + size]
