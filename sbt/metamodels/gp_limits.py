"""Expectation propagation: what a Gaussian process makes of rows of which only a limit is known."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import log_ndtr

from sbt.metamodels.gp_algebra import NOISE_FLOOR, cholesky, squared_columns, triangular
from sbt.problem.arrays import Points, Vector

__all__ = ["observations"]

_SWEEPS, _DAMPING, _CLOSE = 60, 0.6, 1e-4
_LEAST = 1e-6
"""Precision of an observation, in one over the variance of y."""
_LEAST_SHARE = 1e-10
"""Of a variance that other rows leave: below, it is rounding."""


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
    covariance = covariance + NOISE_FLOOR * np.eye(len(mean))
    precision = np.full(len(mean), _LEAST)
    weighted = precision * np.minimum(mean, limit)
    for _ in range(_SWEEPS):
        root = np.sqrt(precision)[:, None]
        scaled = root * covariance
        half = triangular(cholesky(scaled * root.T, np.ones(len(mean))), scaled)
        variance = np.maximum(np.diag(covariance) - squared_columns(half), _LEAST_SHARE * np.diag(covariance))
        change = weighted - precision * mean
        marginal = mean + covariance @ change - half.T @ (half @ change)
        cavity = np.maximum(1.0 / variance - precision, 1e-12)
        centre, spread = (marginal / variance - weighted) / cavity, 1.0 / cavity
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
