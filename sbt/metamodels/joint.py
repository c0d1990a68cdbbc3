"""A metamodel of several metrics at once: one of each, and P(critical) of their combination.

The prediction is one of the margin, a single number: whoever looks at a prediction needs no more than before. P is that of
metrics which are independent of each other at a point, given the runs; the scores on held-out runs tell whether they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sbt.errors import InputError
from sbt.metamodels.base import Metamodel, Predictor, check_rows, predicted, sample_paths
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.saturation import Opened
from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "JointMetamodel", "JointPrediction", "JointPredictor", "LogPair", "in_units", "joined_log_probability", "metamodel_for",
]  # fmt: skip

_LEAST = 1e-6
"""Of a metric's standard deviation: its noise, at least, where that of another one is asked for."""
LogPair = tuple[Vector, Vector]
"""(n,) log P(critical) and (n,) log P(uncritical)."""


def metamodel_for(metamodel: Metamodel, critical: CriticalInterval, *, target_aware: bool = True) -> Metamodel:
    """Return the metamodel that learns what `critical` is asked of: itself, or one of each metric of a combination."""
    if isinstance(critical, CombinedInterval):
        return JointMetamodel(metamodel, critical, target_aware)
    return Opened(metamodel, critical, target_aware)


def joined_log_probability(critical: CombinedInterval, pairs: Sequence[LogPair]) -> LogPair:
    """Return log P and log(1 - P) of a combination from those of its q metrics, independent of each other."""

    def any_of(a: LogPair, b: LogPair) -> LogPair:
        return np.minimum(np.logaddexp(a[0], a[1] + b[0]), 0.0), a[1] + b[1]

    def all_of(a: LogPair, b: LogPair) -> LogPair:
        return a[0] + b[0], np.minimum(np.logaddexp(a[1], a[0] + b[1]), 0.0)

    return critical.fold(pairs, any_of, all_of)


@dataclass(frozen=True)
class JointMetamodel:
    """A metamodel for each metric of a combination.

    Args:
        metamodel: settings of each.
        critical: of the metrics; with a scale, or what is usual among the rows that are learned.
        target_aware: each is told where its critical edge is.
    """

    metamodel: Metamodel
    critical: CombinedInterval
    target_aware: bool = True

    def fit(self, u: Points, y: Points, rng: np.random.Generator) -> JointPredictor:
        """Return the predictor learned from u (n, d) and the metrics y (n, q); each learns from the rows that have it.

        Raises:
            InputError: fewer than two rows have one of the metrics.
        """
        scale, leaves = self.critical.scale or self.critical.usual(y), self.critical.leaves
        if y.shape != (len(u), len(leaves)):
            raise InputError(f"a combination of {len(leaves)} metrics needs y ({len(u)}, {len(leaves)}), but got {y.shape}")
        fitted = []
        for k, leaf in enumerate(leaves):
            metamodel = metamodel_for(self.metamodel, leaf, target_aware=self.target_aware)
            fitted.append(metamodel.fit(*check_rows(u[np.isfinite(y[:, k])], y[np.isfinite(y[:, k]), k]), rng))
        return JointPredictor(tuple(fitted), self.critical.with_leaves(leaves, scale))


@dataclass(frozen=True)
class JointPredictor:
    """A predictor of the margin of a combination.

    Args:
        parts: (q,) predictors of the metrics.
        critical: of the metrics, with the scale of each margin.
    """

    parts: tuple[Predictor, ...]
    critical: CombinedInterval

    def __call__(self, u: Points) -> JointPrediction:
        """Return the prediction of the margin at u (n, d)."""
        return JointPrediction.of([predicted(part, u) for part in self.parts], self.critical)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the margin as a function, at u (m, d)."""
        return self.critical.margin(np.stack([sample_paths(part, u, n, rng) for part in self.parts], axis=-1))


@dataclass(frozen=True, eq=False)
class JointPrediction(Prediction):
    """A prediction of the margin of a combination: its probabilities from those of the metrics.

    Mean and standard deviation are the moments of the margin; quantiles and densities are those of a Gaussian of these moments.

    Args:
        parts: (q,) predictions of the metrics at the same n points, independent of each other.
        critical: of the metrics, with the scale of each margin.
    """

    parts: tuple[Prediction, ...] = ()
    critical: CombinedInterval | None = None

    @classmethod
    def of(cls, parts: Sequence[Prediction], critical: CombinedInterval) -> JointPrediction:
        """Return the prediction of the margin of these metrics.

        Source:
            Clark (1961), The greatest of a finite set of random variables, Operations Research 9: the moments.
        """
        units = critical.scale or (1.0,) * len(parts)
        means = [leaf.margin(part.mu) / unit for part, leaf, unit in zip(parts, critical.leaves, units, strict=True)]

        def moments(spreads: list[Vector]) -> _Moments:
            margins = [(mean, spread / unit) for mean, spread, unit in zip(means, spreads, units, strict=True)]
            return critical.fold(margins, lambda a, b: _negated(_clark(_negated(a), _negated(b))), _clark)

        mean, std = moments([part.sigma for part in parts])
        noise = moments([np.maximum(part.noise, _LEAST * part.sigma) for part in parts])[1]  # what is left where means are known
        noise = np.where(np.any([part.noise > 0.0 for part in parts], axis=0), np.minimum(noise, std), 0.0)
        return cls(mean[None], std[None], np.ones(1), noise, parts=tuple(parts), critical=critical)

    @cached_property
    def _whole(self) -> CombinedInterval:
        if self.critical is None:
            raise InputError("a joint prediction needs the combination that it is of, but got none")
        return self.critical

    def take(self, index: NDArray[Any] | slice) -> JointPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        return JointPrediction.of([part.take(index) for part in self.parts], self._whole)

    def widened(self, factor: float) -> JointPrediction:
        """Return the prediction with every standard deviation of a component multiplied."""
        return JointPrediction.of([part.widened(factor) for part in self.parts], self._whole)

    def joined(self, others: Sequence[Prediction]) -> JointPrediction:
        """Return the prediction at these points and, behind them, at those of the others."""
        all_parts = [self.parts, *(other.parts for other in others if isinstance(other, JointPrediction))]
        return JointPrediction.of([first.joined(rest) for first, *rest in zip(*all_parts, strict=True)], self._whole)

    def log_probability(self, critical: CriticalInterval) -> LogPair:
        """Return (n,) log P(margin in the interval) and (n,) log P(not in it); the critical interval is [-inf, 0]."""
        below, above = self._at_most(critical.high)
        if np.isinf(critical.low):
            return below, above
        less, more = self._at_most(critical.low)
        if np.isinf(critical.high):
            return more, less
        with np.errstate(divide="ignore"):
            return below + np.log(-np.expm1(np.minimum(less - below, 0.0))), np.logaddexp(less, above)

    def _at_most(self, margin: float) -> LogPair:
        """Return (n,) log P(the margin is at most this) and the log of the rest."""
        pairs = []
        for part, leaf, unit in zip(self.parts, self._whole.leaves, self._whole.scale or (), strict=True):
            low, high = leaf.low - margin * unit, leaf.high + margin * unit
            empty = (np.full(len(part), -np.inf), np.zeros(len(part)))
            everything = (empty[1], empty[0])
            if np.isinf(low) and np.isinf(high):
                pairs.append(everything)
            else:
                pairs.append(part.log_probability(CriticalInterval(low, high)) if low <= high else empty)
        return joined_log_probability(self._whole, pairs)


def in_units(predict: Predictor, critical: CriticalInterval) -> Predictor:
    """Return a predictor of margins in the units of a critical set, as those of runs are told; of one metric itself."""
    if not isinstance(critical, CombinedInterval) or critical.scale is None:
        return predict
    scale = critical.scale

    def told(u: Points) -> Prediction:
        found = predicted(predict, u)
        if not isinstance(found, JointPrediction) or found.critical is None:
            return found
        return JointPrediction.of(found.parts, found.critical.with_leaves(found.critical.leaves, scale))

    return told


_Moments = tuple[Vector, Vector]


def _negated(moments: _Moments) -> _Moments:
    return -moments[0], moments[1]


def _clark(a: _Moments, b: _Moments) -> _Moments:
    """Return mean and standard deviation of the larger of two independent Gaussians (n,)."""
    (m1, s1), (m2, s2) = a, b
    spread = np.sqrt(s1**2 + s2**2)
    z = (m1 - m2) / spread
    first, second, density = ndtr(z), ndtr(-z), np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    mean = m1 * first + m2 * second + spread * density
    # about the mean, so that large means do not cancel
    d1, d2 = m1 - mean, m2 - mean
    variance = (d1**2 + s1**2) * first + (d2**2 + s2**2) * second + (d1 + d2) * spread * density
    return mean, np.sqrt(np.maximum(variance, (1e-6 * np.minimum(s1, s2)) ** 2))
