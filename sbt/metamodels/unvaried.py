"""What is told of a metric that all runs gave the same value of: that a further run gives another one is not impossible.

A metamodel is sure of a constant, wherever it is asked. Where no run of fifty collided one in fifty may.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sbt.metamodels.base import Predictor, predicted
from sbt.metamodels.joint import JointPrediction, LogPair
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["UnvariedPrediction", "with_unvaried"]


@dataclass(frozen=True, eq=False)
class UnvariedPrediction(Prediction):
    """A prediction that knows one value of the metric, and of others that they are there with a probability.

    Args:
        value: of all runs.
        other: P(a further run has another one) in (0, 1).
    """

    value: float = 0.0
    other: float = 0.5

    def log_probability(self, critical: CriticalInterval) -> LogPair:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c): that of the one value in the set that it is in."""
        same, other = (np.full(len(self), np.log(p)) for p in (1.0 - self.other, self.other))
        return (same, other) if critical.contains(np.array([self.value]))[0] else (other, same)


def with_unvaried(predict: Predictor, values: Iterable[Vector], n: int) -> Predictor:
    """Return a predictor that doubts metrics of which it knows one value, by the rule of succession; itself where it knows more.

    Args:
        predict: of one metric, or of a combination of q.
        values: of each metric in all runs, NaN where a run has none.
        n: independent outcomes among them.

    Source:
        Laplace (1774): after n equal outcomes the next one is another with probability 1 / (n + 2).
    """
    doubts: list[Callable[[Prediction], Prediction]] = [_doubt(y, n) for y in values]
    if all(doubt is _none for doubt in doubts):
        return predict

    def told(at: Points) -> Prediction:
        found = predicted(predict, at)
        if isinstance(found, JointPrediction) and found.critical is not None:
            return JointPrediction.of([doubt(part) for doubt, part in zip(doubts, found.parts, strict=True)], found.critical)
        return doubts[0](found)

    return told


def _doubt(y: Vector, n: int) -> Callable[[Prediction], Prediction]:
    """Return what doubts the prediction of a metric y with n independent outcomes; nothing where it has several values."""
    known = y[np.isfinite(y)]
    if not len(known) or np.ptp(known) > 0.0:
        return _none
    value, other = float(known[0]), 1.0 / (min(n, len(known)) + 2.0)
    return lambda found: UnvariedPrediction(found.mean, found.std, found.weight, found.noise, value=value, other=other)


def _none(found: Prediction) -> Prediction:
    return found
