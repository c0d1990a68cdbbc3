"""Heavy tails: a Student-t as a mixture of Gaussians with one mean and several widths."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
    level = (np.arange(_COMPONENTS) + 0.5) / _COMPONENTS
    weight = np.full(_COMPONENTS, 1.0 / _COMPONENTS)
    found = _likeliest(residual, _DEGREES, np.geomspace(0.3, 1.5, 25), level, weight, _PRICE)
    return np.ones(1) if found is None else found


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
    edges = np.array(_LEVELS)
    weight, level = np.diff(edges), np.sqrt(np.maximum(edges[:-1], 0.1 * edges[1:]) * edges[1:])
    price = math.log(max(len(residual), 1))
    found = _likeliest(residual, (*_HEAVIEST, *_DEGREES), np.geomspace(0.1, 1.5, 40), level, weight, price)
    return None if found is None else (found, weight)


def _likeliest(
    residual: Vector, degrees: Sequence[float], widths: Vector, level: Vector, weight: Vector, price: float
) -> Vector | None:
    """Return the factors of largest likelihood among Student-t of these degrees of freedom and widths.

    None where the Gaussian is as likely but for a price, or residuals are few.
    """
    if len(residual) < _FEWEST:
        return None
    best, most = None, _log_likelihood(residual, np.ones(1), np.ones(1)) + price
    for each in degrees:
        shape = 1.0 / np.sqrt(gammaincinv(0.5 * each, level) / (0.5 * each))
        for width in widths:
            value = _log_likelihood(residual, width * shape, weight)
            if value > most:
                best, most = width * shape, value
    return best


def _log_likelihood(residual: Vector, widths: Vector, weight: Vector) -> float:
    """Return the log likelihood of Gaussians with mean 0 and (k,) probabilities, but for a constant."""
    terms = -0.5 * (residual / widths[:, None]) ** 2 - np.log(widths)[:, None] + np.log(weight)[:, None]
    return float(np.logaddexp.reduce(terms, axis=0).sum())
