"""What an earlier campaign of another setup knows, as a trend under the metamodel of a new one.

The old campaign's metric is learned once; the new one learns what its runs leave of it, y - rho mu_old. Both are warped
alike, around the critical edge. Whether the trend is used at all, and with which rho, is decided by leave-one-out.

Source:
    Winkelmann, Vasconi, Mueller (2022), Transfer importance sampling, ITSC 2022, arXiv 2204.07619; the autoregressive
    form: Kennedy and O'Hagan (2000), doi 10.1093/biomet/87.1.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from sbt.metamodels.base import Metamodel, Predictor, fitted, named_errors, predicted, without_repetitions
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector

__all__ = ["Transfer", "Trend", "trended"]

_UNSURE = 0.5
"""Standard deviation of the difference between the setups before any run, in warped units: half of the median distance to the
edge. It spreads the first draws around the old boundary."""
_FEWEST = 6
"""Runs from which on rho is chosen by leave-one-out; below it is 1."""
_FOLDS = 4
"""Of the cross-validation of metamodels that cannot leave one row out in closed form."""
_REACH = 5.0
"""Warped value of the earlier metric at which the unit interval of its column ends: 74 times the scale of the warp."""
_FLOOR = 0.02
"""Least standard deviation of a left-out prediction, in warped units: surer ones score by luck."""


@dataclass(frozen=True, eq=False)
class Trend:
    """The metric of an earlier campaign.

    Attributes:
        warp: around the critical edge, by the earlier campaign's values.
        mean: (n, d) normal scores of the new campaign to (n,) warped metric of the earlier one.
    """

    warp: Warp
    mean: Callable[[Points], Vector]

    def beside(self, coordinates: Callable[[Points], Points]) -> Callable[[Points], Points]:
        """Return the coordinates (n, e) of normal scores and the trend as one more column, in the unit interval near the edge."""
        return lambda z: np.column_stack([coordinates(z), 0.5 + self.mean(z) / (2.0 * _REACH)])


@dataclass(frozen=True, eq=False)
class Transfer:
    """What an earlier campaign of another setup tells a new one.

    Attributes:
        trends: of each metric of the requirement.
        hits: (k, d) normal scores of its critical runs in the new inputs: where to look first, no known failures.
    """

    trends: tuple[Trend, ...]
    hits: Points


@runtime_checkable
class _LeavesOut(Protocol):
    def leave_one_out(self, u: Points, y: Vector) -> Prediction:
        """Return predictions of the rows that it was fitted to, each without its own."""
        ...


def trended(
    metamodel: Metamodel, trend: Trend, u: Points, z: Points, t: Vector, rng: np.random.Generator
) -> Callable[[Points, Points], Prediction] | None:
    """Return the belief about the warped metric at coordinates (n, e) and normal scores (n, d); None where it is better without.

    Args:
        metamodel: learns what the trend leaves.
        trend: of the earlier campaign.
        u: (n, e) coordinates of the new runs.
        z: (n, d) their normal scores.
        t: (n,) their metric, warped as the trend is.
        rng: the only source of randomness.
    """
    if len(t) < 2:
        return lambda _, scores: Prediction.gaussian(trend.mean(scores), np.full(len(scores), _UNSURE))
    old = trend.mean(z)
    slopes = (1.0,) if len(t) < _FEWEST else (1.0, _slope(old, t), 0.0)
    scored = [(_score(metamodel, u, t - rho * old, rng), rho) for rho in slopes]
    (_, predict), rho = max(scored, key=lambda item: item[0][0])
    if rho == 0.0:
        return None

    def belief(inputs: Points, scores: Points) -> Prediction:
        with named_errors(metamodel, len(t)):
            rest = predicted(predict, inputs)
        return Prediction.gaussian(rest.mu + rho * trend.mean(scores), rest.sigma)

    return belief


def _slope(old: Vector, t: Vector) -> float:
    """Return the least-squares slope of t over old, drawn towards 1 by as much as one run with twice the spread."""
    centred, prior = old - old.mean(), 4.0 * float(old.var()) + 1e-12
    return (float(centred @ (t - t.mean())) + prior) / (float(centred @ centred) + prior)


def _score(metamodel: Metamodel, u: Points, rest: Vector, rng: np.random.Generator) -> tuple[float, Predictor]:
    """Return the mean log density of each row as predicted from the others, and the metamodel of all."""
    u, rest = without_repetitions(u, rest)  # each input counts once
    predict = fitted(metamodel, u, rest, rng)
    if isinstance(predict, _LeavesOut):
        left = predict.leave_one_out(u, rest)
        return _log_density(left, rest), predict
    fold = rng.permutation(len(rest)) % _FOLDS
    found = np.empty(len(rest))
    for k in range(_FOLDS):
        other = fitted(metamodel, u[fold != k], rest[fold != k], rng)
        with named_errors(metamodel, len(rest)):
            left = predicted(other, u[fold == k])
        found[fold == k] = _log_densities(left, rest[fold == k])
    return float(found.mean()), predict


def _log_density(prediction: Prediction, y: Vector) -> float:
    return float(_log_densities(prediction, y).mean())


def _log_densities(prediction: Prediction, y: Vector) -> Vector:
    return Prediction.gaussian(prediction.mu, np.maximum(prediction.sigma, _FLOOR)).log_density(y)
