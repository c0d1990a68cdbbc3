"""A prediction of a metric within the values that it has, such as a speed of impact that is 0 wherever nothing touches.

What is learned goes on beyond an end, and comes between steps, as P(y in M_c) is known better so; the metric itself never does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sbt.errors import InputError
from sbt.metamodels.joint import JointPrediction
from sbt.metamodels.over_traffic import OverTrafficPrediction
from sbt.metamodels.prediction import Prediction, Scale
from sbt.metamodels.warped_prediction import WarpedPrediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["EndedPrediction", "as_learned", "ended", "scale_of"]

_LEAST = 1e-9
"""Standard deviation of what surely lies beyond an end, over that of what is learned."""
_NODES = 32
"""Quantiles whose mean is that of a component in another unit."""


def ended(prediction: Prediction) -> Prediction:
    """Return the prediction of the metric itself, within its values; of a combination that of its margin.

    >>> scale = Scale(low=0.0)
    >>> told = ended(Prediction(np.array([[-5.0, 5.0]]), np.ones((1, 2)), np.ones(1), np.zeros(2), scale=scale))
    >>> told.mu.round(6).tolist(), told.quantile(0.95).round(2).tolist()
    ([0.0, 5.0], [0.0, 6.64])
    """
    if isinstance(prediction, JointPrediction) and prediction.critical is not None:
        return JointPrediction.of([ended(part) for part in prediction.parts], prediction.critical)
    if isinstance(prediction, OverTrafficPrediction):
        return prediction.with_values(ended(prediction.values)) if prediction.values is not None else prediction
    if isinstance(prediction, EndedPrediction):
        return prediction
    scale = scale_of(prediction)
    if scale == Scale():
        return prediction
    return EndedPrediction.of(prediction, scale) if scale.flag is None else _Flag.of(prediction, scale)


def scale_of(prediction: Prediction) -> Scale:
    """Return which values the metric has: none beyond an end of M_c either that it ends at."""
    scale = prediction.scale or Scale()
    return replace(scale, low=max(scale.low, prediction.lowest), high=min(scale.high, prediction.highest))


def as_learned(scale: Scale, y: Vector) -> Vector:
    """Return where values y (n,) of the metric lie among what is predicted."""
    return _at_steps(y, tuple((value, at) for at, value in scale.steps))


@dataclass(frozen=True, eq=False)
class EndedPrediction(Prediction):
    """A prediction of y whose mean and standard deviation are the moments of y cut off at its ends, at its steps.

    Args:
        beyond: the same as if y went on.
    """

    beyond: Prediction | None = None

    @classmethod
    def of(cls, beyond: Prediction, scale: Scale) -> EndedPrediction:
        """Return the prediction of y with this scale."""
        mean, std = _of_values(beyond, scale) if isinstance(beyond, WarpedPrediction) else _of_gaussians(beyond, scale)
        noise = np.minimum(beyond.noise, np.sqrt(beyond.weight @ std**2))
        return cls(mean, std, beyond.weight, noise, beyond.lowest, beyond.highest, scale, beyond)

    @cached_property
    def _both(self) -> tuple[Prediction, Scale]:
        if self.beyond is None or self.scale is None:
            raise InputError("a prediction that ends needs what is predicted beyond, and its scale, but got none")
        return self.beyond, self.scale

    def take(self, index: NDArray[Any] | slice) -> EndedPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        beyond, scale = self._both
        return type(self).of(beyond.take(index), scale)

    def log_density(self, y: Vector) -> Vector:
        """Return (n,) log density at y (n,), of an end as if y went on."""
        beyond, scale = self._both
        return beyond.log_density(as_learned(scale, y))

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,)."""
        beyond, scale = self._both
        y = np.asarray(y, dtype=np.float64)
        return np.where(y >= scale.high, 1.0, np.where(y < scale.low, 0.0, beyond.cdf(as_learned(scale, y))))

    def log_probability(self, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c)."""
        return self._both[0].log_probability(critical)

    def quantile(self, q: float) -> Vector:
        """Return (n,) y with P(Y <= y) = q, for q in (0, 1)."""
        beyond, scale = self._both
        return np.clip(_at_steps(beyond.quantile(q), scale.steps), scale.low, scale.high)


@dataclass(frozen=True, eq=False)
class _Flag(EndedPrediction):
    """Of two values, one of which is critical: it has the larger one with a probability."""

    @classmethod
    def of(cls, beyond: Prediction, scale: Scale) -> _Flag:
        """Return the prediction of the flag."""
        if scale.flag is None:
            raise InputError("a flag needs an interval with one of its values, but got none")
        p = beyond.probability(scale.flag)
        p = p if scale.flag.contains(np.array([scale.high]))[0] else 1.0 - p
        width = scale.high - scale.low
        std = np.maximum(width * np.sqrt(p * (1.0 - p)), width * _LEAST)
        noise = np.where(beyond.noise > 0.0, std, 0.0)  # what is left to chance of a rate is not told apart
        mean = scale.low + width * p
        return cls(mean[None], std[None], np.ones(1), noise, beyond.lowest, beyond.highest, scale, beyond)

    @property
    def _lower(self) -> Vector:
        scale = self._both[1]
        return (scale.high - self.mean[0]) / (scale.high - scale.low)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,)."""
        scale, y = self._both[1], np.asarray(y, dtype=np.float64)
        return np.where(y >= scale.high, 1.0, np.where(y < scale.low, 0.0, self._lower))

    def quantile(self, q: float) -> Vector:
        """Return (n,) the smallest y with P(Y <= y) >= q, for q in (0, 1)."""
        scale = self._both[1]
        return np.where(self._lower >= q, scale.low, scale.high)


def _at_steps(y: Points, steps: tuple[tuple[float, float], ...]) -> Points:
    """Return y, shape kept, what lies at and between steps moved to their values, and what lies beyond as far as the last."""
    if not steps:
        return y
    at, value = np.array(steps).T
    outside = np.where(y < at[0], value[0] - at[0], value[-1] - at[-1])
    return np.where((y < at[0]) | (y > at[-1]), y + outside, np.interp(y, at, value))


def _of_gaussians(beyond: Prediction, scale: Scale) -> tuple[Points, Points]:
    """Return mean and standard deviation (k, n) of Gaussians within a scale."""
    mean, std = beyond.mean, beyond.std
    if scale.steps:
        low, mean, high = (_at_steps(beyond.mean + k * beyond.std, scale.steps) for k in (-1.0, 0.0, 1.0))
        std = np.maximum(0.5 * (high - low), _LEAST * beyond.std)
    return _moments(mean, std, scale.low, scale.high)


def _of_values(beyond: WarpedPrediction, scale: Scale) -> tuple[Points, Points]:
    """Return mean and standard deviation (k, n) of what components in another unit are within a scale, without far tails.

    In the unit of the metric they are no Gaussians: most of one far below an end may seem to lie above it.
    """
    warped, back = beyond.in_unit
    first, second = np.zeros_like(beyond.mean), np.zeros_like(beyond.mean)
    middle = np.clip(_at_steps(back(warped.mean), scale.steps), scale.low, scale.high)
    for z in ndtri((np.arange(_NODES) + 0.5) / _NODES):
        off = np.clip(_at_steps(back(warped.mean + z * warped.std), scale.steps), scale.low, scale.high) - middle
        first, second = first + off / _NODES, second + off**2 / _NODES
    variance = np.maximum(second - first**2, (_LEAST * beyond.std) ** 2)
    return middle + first, np.sqrt(variance)


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
