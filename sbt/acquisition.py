"""Acquisition functions: how much a candidate is worth, as a log score.

(belief at n candidates, M_c, log p(x)) -> (n,) log scores, larger is better. Samplers draw with a
density proportional to exp(score). A plug-in is any function of this signature.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.arrays import Vector
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval

__all__ = ["Acquisition", "boundary", "even", "importance"]

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
