"""Heavy tails: a Student-t as a mixture of Gaussians with one mean and several widths."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from sbt.problem.arrays import Vector

__all__ = ["student_mixture", "student_widths"]

_COMPONENTS = 7  # widths: the kurtosis of a Student-t with few degrees of freedom needs several
_DEGREES = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0)  # of freedom: from a finite variance on to nearly Gaussian
_FEWEST = 30  # standardised residuals: tails of fewer are not seen
_PRICE = 2.0  # of two more parameters, in log likelihood (Akaike's criterion)
_HEAVIEST = (1.0, 1.5, 2.0)  # further degrees of freedom, of noise without a finite variance
_LEVELS = (0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.05, 0.15, 0.35, 0.65, 1.0)
"""Quantiles of the precision that part a mixture's components: its tail is a Student-t's down to 1e-7."""


def student_widths(residual: Vector) -> Vector:
    """Return factors on sigma: the widths of equally likely Gaussians that fit standardised residuals best.

    Degrees of freedom and width are those of largest likelihood. One factor of 1, the Gaussian itself,
    where no Student-t is clearly more likely or the residuals are few.

    Args:
        residual: (n,) leave-one-out errors divided by their predicted standard deviations.

    Returns:
        (k,) factors > 0, k = 1 or 7.

    Source:
        Geweke (1993): a Student-t is a scale mixture of Gaussians; here at 7 quantiles of the scale.
    """
    best = np.ones(1)
    if len(residual) < _FEWEST:
        return best
    best_value = _log_likelihood(residual, best) + _PRICE
    level = (np.arange(_COMPONENTS) + 0.5) / _COMPONENTS
    for degrees in _DEGREES:
        shape = 1.0 / np.sqrt(gammaincinv(0.5 * degrees, level) / (0.5 * degrees))
        for width in np.geomspace(0.3, 1.5, 25):
            value = _log_likelihood(residual, width * shape)
            if value > best_value:
                best, best_value = width * shape, value
    return best


def student_mixture(residual: Vector) -> tuple[Vector, Vector] | None:
    """Return factors on sigma and their probabilities: Gaussians that together have the tail of a Student-t, far beyond the data.

    Args:
        residual: (n,) leave-one-out errors divided by their predicted standard deviations.

    Returns:
        (k,) factors > 0 and (k,) probabilities; None where no Student-t is clearly more likely than the Gaussian.

    Source:
        Geweke (1993); degrees of freedom and width of largest likelihood; more likely than the Gaussian by Schwarz's criterion,
        as a wrong tail costs an estimation more than no tail gains where it is light.
    """
    if len(residual) < _FEWEST:
        return None
    edges = np.array(_LEVELS)
    weight, level = np.diff(edges), np.sqrt(np.maximum(edges[:-1], 0.1 * edges[1:]) * edges[1:])
    best, best_value = None, _log_likelihood(residual, np.ones(1)) + np.log(len(residual))
    for degrees in (*_HEAVIEST, *_DEGREES):
        shape = 1.0 / np.sqrt(gammaincinv(0.5 * degrees, level) / (0.5 * degrees))
        for width in np.geomspace(0.1, 1.5, 40):
            value = _log_likelihood(residual, width * shape, weight)
            if value > best_value:
                best, best_value = width * shape, value
    return None if best is None else (best, weight)


def _log_likelihood(residual: Vector, widths: Vector, weight: Vector | None = None) -> float:
    """Return the log likelihood of Gaussians with mean 0, equally likely or with (k,) probabilities, but for a constant."""
    shares = np.full(len(widths), 1.0 / len(widths)) if weight is None else weight
    terms = -0.5 * (residual / widths[:, None]) ** 2 - np.log(widths)[:, None] + np.log(shares)[:, None]
    return float(np.logaddexp.reduce(terms, axis=0).sum())
