"""Acquisition functions: what a run at a candidate is worth, as a log score.

(prediction at n candidates, M_c, log p(x)) -> (n,) log scores, larger is better. A plug-in is any function of this
signature. How a campaign uses the scores is up to the function:

- drawn (the default): points are drawn with a density proportional to exp(score). The scores may have any finite
  upper bound; a bound of 0 (a probability of acceptance) spares the sampler the search for the largest one.
- greedy (declared with `greedy`): the candidates of the highest scores that lie apart. Any unit, any scale.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.special import ndtr

from sbt.errors import RAISED, InputError, described
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "Acquisition", "boundary", "even", "expected_feasibility", "greedy", "importance", "is_greedy", "log_scores", "straddle", "u",
]  # fmt: skip

Acquisition = Callable[[Prediction, CriticalInterval, Vector], Vector]
"""(prediction, critical, log_density (n,)) -> (n,) log scores."""

A = TypeVar("A", bound=Acquisition)
_STRADDLE_WIDTH = 1.96  # standard deviations: a central interval of 95 %, as Bryan et al. (2005) take it
_FEASIBILITY_WIDTH = 2.0  # standard deviations: epsilon of Bichon et al. (2008)


def greedy(acquisition: A) -> A:
    """Declare that an acquisition is for greedy selection; it is returned with the attribute `selection`.

    Without the decorator (an object with `__call__`, say) an attribute `selection = "greedy"` does the same.

    >>> @greedy
    ... def uncertainty(prediction, critical, log_density):
    ...     return np.log(prediction.sigma)
    >>> is_greedy(uncertainty), is_greedy(boundary)
    (True, False)
    """
    acquisition.selection = "greedy"  # type: ignore[attr-defined]
    return acquisition


def is_greedy(acquisition: Acquisition) -> bool:
    """Return whether an acquisition is declared greedy.

    Raises:
        InputError: its attribute `selection` is neither `draw` nor `greedy`.
    """
    selection = getattr(acquisition, "selection", "draw")
    if selection not in ("draw", "greedy"):
        raise InputError(f"selection of an acquisition must be 'draw' or 'greedy', but {_name(acquisition)} has {selection!r}")
    return bool(selection == "greedy")


def log_scores(acquisition: Acquisition, prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Return the (n,) checked log scores of an acquisition; its own errors name it and the line.

    Raises:
        InputError: it raises, or returns another shape, NaN or +inf.
    """
    n, name = len(prediction), _name(acquisition)
    try:
        found = np.asarray(acquisition(prediction, critical, log_density.copy()), dtype=np.float64)
    except RAISED as error:
        raise InputError(f"acquisition {name} must score {n} points, but raised {described(error)}") from error
    if found.shape != (n,):
        raise InputError(f"acquisition {name} must return shape ({n},), but returned {found.shape}")
    if not (found < np.inf).all():  # also NaN
        raise InputError(f"acquisition {name} must return scores < inf, but returned {found[~(found < np.inf)][0]}")
    return found


def even(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Even coverage: log 1, whatever is predicted.

    Args:
        prediction: of y at n points; only n is used.
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
        prediction: of y at n points.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x) at the same points; not used.

    Returns:
        (n,) log scores <= 0; -inf only where the probability itself is zero.

    Source:
        Winkelmann et al. (2022), eq. (3).

    >>> prediction = Prediction.gaussian(mu=np.array([0.1, 3.0]), sigma=np.ones(2))
    >>> near, far = boundary(prediction, CriticalInterval(high=0.0), np.zeros(2))
    >>> bool(near > far)
    True
    """
    del log_density
    log_p, log_not = prediction.log_probability(critical)
    return np.asarray(np.minimum(np.log(2.0) + np.minimum(log_p, log_not), 0.0))


def importance(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Probable criticality under the inputs' distribution: log P(y in M_c) + log p(x).

    The upper bound is the largest log p(x), which exceeds 0 on a small space.

    Args:
        prediction: of y at n points.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x) at the same points.

    Returns:
        (n,) log scores; -inf where p(x) = 0.

    Source:
        Winkelmann et al. (2022), eq. (4), after Dubourg et al. (2013).

    >>> prediction = Prediction.gaussian(mu=np.array([0.0, 0.0]), sigma=np.ones(2))
    >>> importance(prediction, CriticalInterval(high=0.0), np.log([1.0, 0.5])).round(3).tolist()
    [-0.693, -1.386]
    """
    return prediction.log_probability(critical)[0] + log_density


@greedy
def u(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Probability of misclassification, greedily: the score of `boundary`, the highest first.

    For a Gaussian prediction and an interval with one end the order is that of the learning function U = |mu - z| / sigma.

    Args:
        prediction: of y at n points.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) log scores <= 0.

    Source:
        Echard et al. (2011), AK-MCS, doi 10.1016/j.strusafe.2011.01.002.
    """
    return boundary(prediction, critical, log_density)


@greedy
def straddle(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Ambiguity and uncertainty in one, greedily: log of max(1.96 sigma - |mu - z|, 0), z the nearest end of M_c.

    Args:
        prediction: of y at n points; its moments are used.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) log scores, in the unit of y; -inf where the 95 % interval holds no end of M_c.

    Source:
        Bryan et al. (2005), Active learning for identifying function threshold boundaries, eq. (5).
    """
    del log_density
    gap = np.min([np.abs(prediction.mu - z) for z in _ends(critical)], axis=0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.maximum(_STRADDLE_WIDTH * prediction.sigma - gap, 0.0)))


@greedy
def expected_feasibility(prediction: Prediction, critical: CriticalInterval, log_density: Vector) -> Vector:
    """Expected feasibility, greedily: log E[max(2 sigma - |y - z|, 0)], the largest over the ends z of M_c.

    Args:
        prediction: of y at n points; its moments are used.
        critical: M_c, in the unit of y.
        log_density: (n,) log p(x); not used.

    Returns:
        (n,) log scores, in the unit of y.

    Source:
        Bichon et al. (2008), doi 10.2514/1.34321, eq. (17), with epsilon = 2 sigma.
    """
    del log_density
    mu, sigma = prediction.mu, prediction.sigma
    best = np.zeros(len(mu))
    for z in _ends(critical):
        t = (z - mu) / sigma
        (at, below, above), (p_at, p_below, p_above) = _normal(t, t - _FEASIBILITY_WIDTH, t + _FEASIBILITY_WIDTH)
        value = _FEASIBILITY_WIDTH * (p_above - p_below) - (2.0 * at - below - above) - t * (2.0 * p_at - p_below - p_above)
        best = np.maximum(best, sigma * value)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.maximum(best, 0.0)))


def _name(acquisition: Acquisition) -> str:
    return str(getattr(acquisition, "__name__", type(acquisition).__name__))


def _normal(*t: Vector) -> tuple[list[Vector], list[Vector]]:
    """Return the standard normal densities and distribution functions."""
    return [np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) for x in t], [ndtr(x) for x in t]


def _ends(critical: CriticalInterval) -> list[float]:
    """Return the finite ends of the interval: where critical meets uncritical."""
    return [z for z in (critical.low, critical.high) if np.isfinite(z)]
