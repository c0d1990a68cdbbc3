"""How much each input matters to P(critical), by the metamodel, with intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval
from sbt.report.projection import Predict, probability
from sbt.samplers.sobol import SobolSequence

__all__ = ["Influence", "influence_of"]

_POINTS = 512
_MOST = 2.0
"""Of an index without one of the points; beyond 1 it is an error of the sampling."""
_Z = 1.96
"""Of the 95 % intervals, in standard errors."""


@dataclass(frozen=True, eq=False)
class Influence:
    """Total Sobol indices of P(critical) over the ranges: (d,) value, low and high end of the 95 % interval, in [0, 1]."""

    total: Vector
    low: Vector
    high: Vector

    @property
    def relative(self) -> Vector:
        """(d,) total indices, the largest 1."""
        return self.total / max(float(self.total.max()), 1e-300)


def influence_of(predict: Predict, critical: CriticalInterval, dimension: int) -> Influence | None:
    """Return the share of the variance of P(critical) that an input takes part in; None where P is the same everywhere.

    By Jansen's formula. The interval tells the error of the sampling only, not that of the metamodel.

    Source:
        Jansen, Analysis of variance designs for model output (1999), doi 10.1016/S0010-4655(98)00154-4; intervals by
        the jackknife over the points, Efron and Stein (1981), doi 10.1214/aos/1176345462.
    """
    both = SobolSequence(2 * dimension, seed=0).points(0, _POINTS)
    first, second = both[:, :dimension], both[:, dimension:]
    here = probability(predict, critical, first)
    changes = np.empty((dimension, _POINTS))
    for k in range(dimension):
        moved = first.copy()
        moved[:, k] = second[:, k]
        changes[k] = (probability(predict, critical, moved) - here) ** 2
    if not changes.any() or np.var(here) < 1e-18:
        return None

    total = 0.5 * changes.mean(axis=1) / np.var(here)
    variance = _means_without_each(here**2) - _means_without_each(here) ** 2
    without = np.minimum(0.5 * _means_without_each(changes) / np.maximum(variance, 1e-300), _MOST)  # one point may have it all
    error = np.sqrt((_POINTS - 1) * np.var(without, axis=1))
    return Influence(*(np.clip(total + z * error, 0.0, 1.0) for z in (0.0, -_Z, _Z)))


def _means_without_each(values: Vector) -> Vector:
    """Return the mean over the last axis without each of its values."""
    n = values.shape[-1]
    found: Vector = (values.sum(axis=-1, keepdims=True) - values) / (n - 1)
    return found
