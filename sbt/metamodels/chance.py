"""Chance: with some probability a run of a noisy simulator falls anywhere among the runs, whatever its inputs.

A Gaussian has no tails for the collision that one seed in fifty ends in, wherever: where 2 % of runs were critical everywhere,
P(critical) was learned as 1e-6. So a noisy metric is a mixture of the process and of all runs, as far as the sides of the edge
that left-out rows fell on ask for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import mixture_score, stacking_weights
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Chance", "learned_chance"]

_VALUES = 8  # of either side, at its quantiles
_NARROW = 8.0  # a value's distance to the edge over its width: none spills over the edge
_PRICE = 2.0  # of two more parameters, in log likelihood (Akaike's criterion)
_PRIOR = 1.0  # rows: of equal weights of chance and process, and of an even rate


@dataclass(frozen=True, eq=False)
class Chance:
    """The same prediction at every point.

    Args:
        value: (k,) of the metric.
        width: (k,) standard deviations > 0.
        weight: (k,) sum 1.
    """

    value: Vector
    width: Vector
    weight: Vector

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d): all of its spread is noise."""
        n = len(u)
        mean, std = (np.repeat(of[:, None], n, axis=1) for of in (self.value, self.width))
        middle = self.weight @ self.value
        spread = float(np.sqrt(self.weight @ (self.width**2 + (self.value - middle) ** 2)))
        return Prediction(mean, std, self.weight, np.full(n, spread))


def learned_chance(
    left_out: Prediction, y: Vector, critical: CriticalInterval, shares: Vector
) -> tuple[Chance, float] | None:
    """Return chance and its weight in (0, 1); None where all runs lie on one side, or it explains them hardly better.

    Args:
        left_out: prediction of each row from all others.
        y: (n,) the metric.
        critical: M_c.
        shares: (n,) of the space that each row stands for: where rows crowd, they do not tell how often chance is critical.
    """
    inside = critical.contains(y)
    if inside.all() or not inside.any():
        return None
    n, side = len(y), inside.astype(np.float64)
    weight = n * shares / shares.sum()
    others = (weight @ side - weight * side + 0.5 * _PRIOR) / (n - weight + _PRIOR)
    own = np.where(inside, *left_out.log_probability(critical))
    scores = np.stack([own, np.log(np.where(inside, others, 1.0 - others))])
    mixed = stacking_weights(scores, _PRIOR)
    if float((mixture_score(scores, mixed) - own).sum()) < _PRICE:
        return None
    rate = float((weight @ side + 0.5 * _PRIOR) / (n + _PRIOR))
    ends = [end for end in (critical.low, critical.high) if np.isfinite(end)]
    value = np.concatenate([np.quantile(y[part], (np.arange(_VALUES) + 0.5) / _VALUES) for part in (inside, ~inside)])
    away = np.abs(value[:, None] - np.array(ends)).min(axis=1)
    floor = 1e-9 * max(float(np.std(y)), float(np.abs(y).max()) * 1e-6)
    return Chance(value, np.maximum(away, floor) / _NARROW, np.repeat([rate, 1.0 - rate], _VALUES) / _VALUES), float(mixed[1])
