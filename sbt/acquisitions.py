"""Acquisition functions: how much a candidate is worth, as a log score.

(belief at n candidates, M_c, log p(x)) -> (n,) log scores, larger is better. Samplers draw with a
density proportional to exp(score). A plug-in is any function of this signature.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import ndtr

from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Acquisition", "boundary", "even", "expected_feasibility", "importance", "straddle"]

Acquisition = Callable[[Prediction, CriticalInterval, Vector], Vector]
"""(prediction, critical, log_density (n,)) -> (n,) log scores."""


def even(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Even coverage: log 1, whatever is believed.

    Args:
        prediction: belief about y at n points; only n is used.
        critical: M_c; not used.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) zeros.

    Source:
        Winkelmann et al. (2022), section VI: a_ES = 1.

    >>> even(Prediction.gaussian([0.1, 3.0], [1.0, 1.0]), CriticalInterval(high=0.0), np.zeros(2))
    array([0., 0.])
    """
    del critical, log_density
    return np.zeros(len(prediction))


def boundary(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Ambiguity of the classification: log(1 - 2 |P(y in M_c) - 0.5|).

    Largest where critical and uncritical are equally likely. Does not use the density. Computed as
    log 2 + min(log P, log(1 - P)), which is the same and does not round to -inf.

    Args:
        prediction: belief about y at n points.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x) at the same points; not used.

    Returns:
        (n,) log scores <= 0; -inf only where the probability itself is zero.

    Source:
        Winkelmann et al. (2022), eq. (3).

    >>> belief = Prediction.gaussian(mu=np.array([0.1, 3.0]), sigma=np.ones(2))
    >>> near, far = boundary(belief, CriticalInterval(high=0.0), np.zeros(2))
    >>> bool(near > far)
    True
    """
    del log_density
    log_p, log_not = prediction.log_probability(critical)
    return np.asarray(np.minimum(np.log(2.0) + np.minimum(log_p, log_not), 0.0))


def importance(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Probable criticality under the inputs' distribution: log P(y in M_c) + log p(x).

    The score is not bounded by 0 where p(x) exceeds 1; rejection needs it shifted by the largest log p(x).

    Args:
        prediction: belief about y at n points.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x) at the same points.

    Returns:
        (n,) log scores; -inf where p(x) = 0.

    Source:
        Winkelmann et al. (2022), eq. (4), after Dubourg et al. (2013).

    >>> belief = Prediction.gaussian(mu=np.array([0.0, 0.0]), sigma=np.ones(2))
    >>> importance(belief, CriticalInterval(high=0.0), np.log([1.0, 0.5])).round(3).tolist()
    [-0.693, -1.386]
    """
    return prediction.log_probability(critical)[0] + log_density


def straddle(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Ambiguity and uncertainty in one: log of max(1.96 sigma - |mu - z|, 0), z the nearest end of M_c.

    In the unit of y and so not bounded by 0: for greedy choices, not for rejection.

    Args:
        prediction: belief about y at n points; its moments are used.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) log scores; -inf where the 95 % interval holds no end of M_c.

    Source:
        Bryan et al. (2005), Active learning for identifying function threshold boundaries, eq. (5).
    """
    del log_density
    gap = np.min([np.abs(prediction.mu - z) for z in _ends(critical)], axis=0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.maximum(1.96 * prediction.sigma - gap, 0.0)))


def expected_feasibility(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Expected feasibility: log E[max(2 sigma - |y - z|, 0)], the largest over the ends z of M_c.

    In the unit of y and so not bounded by 0: for greedy choices, not for rejection.

    Args:
        prediction: belief about y at n points; its moments are used.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) log scores.

    Source:
        Bichon et al. (2008), doi 10.2514/1.34321, eq. (17), with epsilon = 2 sigma.
    """
    del log_density
    mu, sigma = prediction.mu, prediction.sigma
    best = np.zeros(len(mu))
    for z in _ends(critical):
        t = (z - mu) / sigma
        (at, below, above), (p_at, p_below, p_above) = _normal(t, t - 2.0, t + 2.0)
        value = 2.0 * (p_above - p_below) - (2.0 * at - below - above) - t * (2.0 * p_at - p_below - p_above)
        best = np.maximum(best, sigma * value)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.maximum(best, 0.0)))


def _normal(*t: Vector) -> tuple[list[Vector], list[Vector]]:
    """Return the standard normal densities and distribution functions."""
    return [np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) for x in t], [ndtr(x) for x in t]


def _ends(critical: CriticalInterval) -> list[float]:
    """Return the finite ends of the interval: where critical meets uncritical."""
    return [z for z in (critical.low, critical.high) if np.isfinite(z)]
