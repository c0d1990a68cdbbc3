"""Level sets in 8 to 12 inputs that all count: several regions, rough hills, a sum of waves.

The inputs are uniform on the unit cube; the critical shares were computed with 8 scrambled Sobol sequences of 2^20 points.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.testbeds.problem import Function, Problem, Truth, parameters_of

__all__ = ["PROBLEMS"]

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_SLOW, _FAST = 1.0, 0.4  # length of a half axis in units of the squared distance: alternating from centre to centre
_HILLS, _WIDTH = 60, 0.3
_WEIGHT = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.02])


def scattered(n: int, d: int) -> Points:
    """Return (n, d) numbers in [0, 1): the multiples of the golden ratio, modulo 1."""
    return np.reshape(np.mod(np.arange(1.0, n * d + 1.0) * _GOLDEN, 1.0), (n, d))


def ellipsoids(x: Points, count: int) -> Vector:
    """The smallest of `count` quadratic forms about different centres: as many ellipsoidal regions, with kinks between them.

    Source:
        Constructed.
    """
    d = x.shape[1]
    centre, axis = 0.2 + 0.6 * scattered(count, d), np.where(scattered(count, d)[::-1] < 0.5, _SLOW, _FAST)
    return np.min([(((x - c) / a) ** 2).sum(axis=1) for c, a in zip(centre, axis, strict=True)], axis=0)


def hills(x: Points) -> Vector:
    """60 Gaussian hills and hollows of standard deviation 0.3: more structure than some hundred runs can learn.

    Source:
        Constructed.
    """
    spots = scattered(_HILLS, x.shape[1] + 1)
    square = (x**2).sum(axis=1)[:, None] - 2.0 * x @ spots[:, 1:].T + (spots[:, 1:] ** 2).sum(axis=1)
    return np.exp(-square / (2.0 * _WIDTH**2)) @ (2.0 * spots[:, 0] - 1.0)


def waves(x: Points) -> Vector:
    """A sum of one sine an input, of amplitudes from 1 to 0.02 and shifted phases.

    Source:
        Constructed.
    """
    return np.sin(1.5 * np.pi * (x - 0.025 * np.arange(12.0))) @ _WEIGHT


def _level(name: str, title: str, d: int, function: Function, high: float, share: float, error: float) -> Problem:
    inputs = parameters_of({f"x{k + 1}": (0.0, 1.0) for k in range(d)})
    return Problem(name, title, inputs, function, CriticalInterval(high=high), Truth(share, error, None, share, error))


PROBLEMS = (
    _level("ellipsoids_d8", "Four ellipsoids", 8, partial(ellipsoids, count=4), 0.82, 0.049783, 3.2e-05),
    _level("ellipsoids_d10", "Three ellipsoids", 10, partial(ellipsoids, count=3), 1.5, 0.106836, 3.9e-05),
    _level("hills_d8", "60 hills", 8, hills, -0.24, 0.1039, 4.2e-05),
    _level("waves_d12", "A sum of twelve waves", 12, waves, -0.64, 0.050748, 1.8e-05),
)  # fmt: skip
