"""Heavy tails: a Student-t as a mixture of Gaussians with one mean and several widths."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from sbt.problem.arrays import Vector

__all__ = ["student_widths"]

_COMPONENTS = 7  # widths: the kurtosis of a Student-t with few degrees of freedom needs several
_DEGREES = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0)  # of freedom: from a finite variance on to nearly Gaussian
_FEWEST = 30  # standardised residuals: tails of fewer are not seen
_PRICE = 2.0  # of two more parameters, in log likelihood (Akaike's criterion)


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


def _log_likelihood(residual: Vector, widths: Vector) -> float:
    """Return the log likelihood of equally likely Gaussians with mean 0, but for a constant."""
    terms = -0.5 * (residual / widths[:, None]) ** 2 - np.log(widths)[:, None] - np.log(len(widths))
    return float(np.logaddexp.reduce(terms, axis=0).sum())
