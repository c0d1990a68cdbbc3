"""Runs of which it is only known that the metric lies beyond a limit.

A distance of 0 in every collision, or a speed of impact of 0 in every run without one, is a value that the metric ends with: what
a smooth function that goes on would have been there is on the other side of that value, how far is not known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.special import log_ndtr

from sbt.metamodels.base import Predictor
from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["Limit", "beyond", "observations"]

_SWEEPS, _DAMPING, _CLOSE = 60, 0.6, 1e-4
_LEAST = 1e-6
"""Precision of an observation, in one over the variance of y."""
_JITTER = 1e-8


@dataclass(frozen=True, eq=False)
class Limit:
    """What is known of k rows: the metric, as a function that goes on, is at most, or at least, so much.

    Args:
        u: (k, d) the rows.
        learned: (k,) the values that a predictor was fitted to there.
        value: (k,) the limit there.
        at_most: (k,) the metric lies below; otherwise above.
    """

    u: Points
    learned: Vector
    value: Vector
    at_most: Mask

    def moved(self, to: Callable[[Vector], Vector]) -> Limit:
        """Return the limit in another unit."""
        return replace(self, learned=to(self.learned), value=to(self.value))

    def rows(self, u: Points, y: Vector, within: float) -> NDArray[np.intp]:
        """Return (n,) which of the rows each of u (n, d) is that was learned with y (n,), -1 where it is none.

        Of a noisy simulator other runs at the same inputs may have ended beside the limit.
        """
        known: dict[bytes, list[int]] = {}
        for k, row in enumerate(np.ascontiguousarray(self.u)):
            known.setdefault(row.tobytes(), []).append(k)
        found = np.full(len(u), -1, dtype=np.intp)
        for i, row in enumerate(np.ascontiguousarray(u)):
            same = [k for k in known.get(row.tobytes(), ()) if abs(self.learned[k] - y[i]) <= within]
            found[i] = same[0] if same else -1
        return found


@runtime_checkable
class _Limited(Protocol):
    def beyond(self, limit: Limit) -> Self:
        """Return the predictor that knows the limit."""


def beyond(predictor: Predictor, limit: Limit | None) -> Predictor:
    """Return a predictor that knows a limit in place of the values that it was fitted to there; itself where it cannot."""
    return predictor.beyond(limit) if limit is not None and isinstance(predictor, _Limited) else predictor


def observations(mean: Vector, covariance: Points, limit: Vector, noise: float) -> tuple[Vector, Vector]:
    """Return (k,) values, and variances of their noise, that tell a process about as much as "it is at most `limit`" does.

    Args:
        mean: (k,) of the function, given all other rows.
        covariance: (k, k) of it.
        limit: (k,) what it is at most, but for the noise.
        noise: variance of what was measured about the function.

    Source:
        Rasmussen & Williams (2006), section 3.6 (expectation propagation); Groot & Lucas (2012), Gaussian process regression
        with censored data using expectation propagation.

    >>> value, variance = observations(np.zeros(1), np.eye(1), np.zeros(1), 1e-9)
    >>> float(round(value[0] / (1.0 + variance[0]), 3)), float(round(variance[0] / (1.0 + variance[0]), 3))  # of half a Gaussian
    (-0.798, 0.363)
    """
    k = len(mean)
    precision = np.full(k, _LEAST)
    weighted = precision * np.minimum(mean, limit)
    prior = _inverse(covariance + _JITTER * np.eye(k))
    shifted = prior @ mean
    for _ in range(_SWEEPS):
        posterior = _inverse(prior + np.diag(precision))
        variance = np.diag(posterior)
        cavity = np.maximum(1.0 / variance - precision, 1e-12)
        centre, spread = ((posterior @ (shifted + weighted)) / variance - weighted) / cavity, 1.0 / cavity
        width = np.sqrt(spread + noise)
        z = (limit - centre) / width
        ratio = np.exp(-0.5 * z**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(z))
        matched = np.maximum(spread - spread**2 / width**2 * ratio * (z + ratio), 1e-10 * spread)
        wanted = np.maximum(1.0 / matched - cavity, _LEAST)
        aim = (centre - spread / width * ratio) / matched - centre * cavity
        moved = np.abs(wanted - precision) / (wanted + cavity)
        precision, weighted = precision + _DAMPING * (wanted - precision), weighted + _DAMPING * (aim - weighted)
        if moved.max() < _CLOSE:
            break
    return weighted / precision, 1.0 / precision


def _inverse(matrix: Points) -> Points:
    """Return the inverse of a symmetric positive definite matrix (k, k), with jitter where rounding made it indefinite."""
    for jitter in (0.0, 1e-8, 1e-6, 1e-4, 1e-2):
        factor, failed = lapack.dpotrf(matrix + jitter * np.trace(matrix) / len(matrix) * np.eye(len(matrix)), lower=1, clean=1)
        if not failed:
            inverse = np.tril(lapack.dpotri(factor, lower=1)[0])
            return np.asarray(inverse + np.tril(inverse, -1).T)
    raise np.linalg.LinAlgError("the covariance of censored rows must be positive definite, but is not, with jitter 0.01")
