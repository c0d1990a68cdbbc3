"""A prediction of a metric that ends, such as a speed of impact that is 0 wherever nothing touches.

What is learned goes on beyond such an end, as P(y in M_c) is known better so; the metric itself never lies there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sbt.errors import InputError
from sbt.metamodels.joint import JointPrediction
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["EndedPrediction", "ended"]

_LEAST = 1e-9
"""Standard deviation of what surely lies beyond an end, over that of what is learned."""


def ended(prediction: Prediction) -> Prediction:
    """Return the prediction of the metric itself, none of which lies beyond its ends; of a combination that of its margin.

    >>> told = ended(Prediction(np.array([[-5.0, 5.0]]), np.ones((1, 2)), np.ones(1), np.zeros(2), lowest=0.0))
    >>> told.mu.round(6).tolist(), told.quantile(0.95).round(2).tolist()
    ([0.0, 5.0], [0.0, 6.64])
    """
    if isinstance(prediction, JointPrediction) and prediction.critical is not None:
        return JointPrediction.of([ended(part) for part in prediction.parts], prediction.critical)
    if isinstance(prediction, EndedPrediction) or np.isinf([prediction.lowest, prediction.highest]).all():
        return prediction
    return EndedPrediction.of(prediction) if prediction.flag is None else _of_flag(prediction, prediction.flag)


@dataclass(frozen=True, eq=False)
class EndedPrediction(Prediction):
    """A prediction of y whose mean and standard deviation are the moments of y cut off at its ends.

    Args:
        beyond: the same as if y went on.
    """

    beyond: Prediction | None = None

    @classmethod
    def of(cls, beyond: Prediction) -> EndedPrediction:
        """Return the prediction of y that ends where this one knows it to end."""
        mean, std = _moments(beyond.mean, beyond.std, beyond.lowest, beyond.highest)
        noise = np.minimum(beyond.noise, np.sqrt(beyond.weight @ std**2))
        return cls(mean, std, beyond.weight, noise, beyond.lowest, beyond.highest, beyond=beyond)

    @cached_property
    def _beyond(self) -> Prediction:
        if self.beyond is None:
            raise InputError("a prediction that ends needs what is predicted beyond, but got none")
        return self.beyond

    def take(self, index: NDArray[Any] | slice) -> EndedPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        return EndedPrediction.of(self._beyond.take(index))

    def log_density(self, y: Vector) -> Vector:
        """Return (n,) log density at y (n,), of an end as if y went on."""
        return self._beyond.log_density(y)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,)."""
        y = np.asarray(y, dtype=np.float64)
        return np.where(y >= self.highest, 1.0, np.where(y < self.lowest, 0.0, self._beyond.cdf(y)))

    def log_probability(self, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c)."""
        return self._beyond.log_probability(critical)

    def quantile(self, q: float) -> Vector:
        """Return (n,) y with P(Y <= y) = q, for q in (0, 1)."""
        return np.clip(self._beyond.quantile(q), self.lowest, self.highest)


def _of_flag(prediction: Prediction, critical: CriticalInterval) -> EndedPrediction:
    """Return the prediction of a metric of two values, one of which is critical: it has the one with P(critical)."""
    p = prediction.probability(critical)
    p = p if critical.contains(np.array([prediction.highest]))[0] else 1.0 - p
    width = prediction.highest - prediction.lowest
    std = np.maximum(width * np.sqrt(p * (1.0 - p)), width * _LEAST)
    noise = np.where(prediction.noise > 0.0, std, 0.0)  # what is left to chance of a rate is not told apart
    ends = prediction.lowest, prediction.highest
    return _Flag((prediction.lowest + width * p)[None], std[None], np.ones(1), noise, *ends, critical, beyond=prediction)


@dataclass(frozen=True, eq=False)
class _Flag(EndedPrediction):
    """Of two values, the mean is by how much it is the larger one."""

    @property
    def _larger(self) -> Vector:
        return (self.mean[0] - self.lowest) / (self.highest - self.lowest)

    def take(self, index: NDArray[Any] | slice) -> EndedPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        critical = self.flag
        return self if critical is None else _of_flag(self._beyond.take(index), critical)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,)."""
        y = np.asarray(y, dtype=np.float64)
        return np.where(y >= self.highest, 1.0, np.where(y < self.lowest, 0.0, 1.0 - self._larger))

    def quantile(self, q: float) -> Vector:
        """Return (n,) the smallest y with P(Y <= y) >= q, for q in (0, 1)."""
        return np.where(1.0 - self._larger >= q, self.lowest, self.highest)


def _moments(mean: Points, std: Points, lowest: float, highest: float) -> tuple[Points, Points]:
    """Return mean and standard deviation of Gaussians that are cut off at both ends, where an end has what lies beyond it.

    Source:
        Tobin (1958), Estimation of relationships for limited dependent variables, Econometrica 26.
    """
    a, b = (lowest - mean) / std, (highest - mean) / std
    below, above = ndtr(a), ndtr(-b)
    inside = ndtr(b) - below
    at_a, at_b = _density(a), _density(b)
    low, high = np.where(below > 0.0, a, 0.0), np.where(above > 0.0, b, 0.0)  # an end at infinity has nothing beyond it
    first = at_a - at_b + low * below + high * above
    with np.errstate(invalid="ignore"):
        steep = np.where(np.isfinite(a), a * at_a, 0.0) - np.where(np.isfinite(b), b * at_b, 0.0)
    second = inside + steep + low**2 * below + high**2 * above
    cut = np.clip(mean + std * first, lowest, highest)
    return cut, std * np.sqrt(np.maximum(second - first**2, _LEAST**2))


def _density(z: Points) -> Points:
    return np.asarray(np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi))
