"""The metamodel as the estimator uses it: P(critical) at points of the standard-normal space.

The metric is warped by asinh about the critical edge, so that precision goes where critical meets
uncritical and a far tail does not decide the length scales. A ridge trend carries many inputs; a twin
without trend keeps it from being sure where it only extrapolates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sbt.metamodels.base import Metamodel, with_target
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.problem.space import ParameterSpace

__all__ = ["Coordinates", "LogProbability", "fit_log_probability"]

LogProbability = Callable[[Points], tuple[Vector, Vector]]
"""(n, d) normal scores to (n,) log P(critical) and (n,) log P(uncritical)."""

_REACH = 5.0
_TREND_KEPT = 0.5


@dataclass(frozen=True)
class Coordinates:
    """What the metamodel sees of a point of the standard-normal space.

    A uniform input is seen in its range, every other one as its normal score with -5 to 5 as the unit
    interval; derived features of the space follow.
    """

    space: ParameterSpace

    @property
    def bounded(self) -> Vector:
        """(d,) 1 where the input is uniform on its range, else 0."""
        return np.array([float(p.truncated is None) for p in self.space.parameters])

    def __call__(self, z: Points) -> Points:
        """Return (n, d + f) coordinates of normal scores z (n, d)."""
        correlation = self.space.correlation
        scores = z if correlation is None else z @ np.linalg.cholesky(np.asarray(correlation)).T
        own = np.where(self.bounded == 1, ndtr(scores), 0.5 + scores / (2.0 * _REACH))
        if not self.space.features:
            return np.ascontiguousarray(own)
        u = self.space.to_unit(self.space.from_normal(z))
        return np.column_stack([own, self.space.metamodel_inputs(u)[:, self.space.dimension :]])


def fit_log_probability(
    metamodel: Metamodel, coordinates: Coordinates, critical: CriticalInterval, z: Points, y: Vector, rng: np.random.Generator
) -> LogProbability:
    """Return P(critical) as learned from n >= 2 runs at normal scores z (n, d) with metrics y (n,)."""
    u, warp = coordinates(z), Warp.about(y, critical, quantile=0.5)
    t, inside = warp.values(y), warp.interval(critical)
    plain = with_target(metamodel, inside).fit(u, t, rng)
    trend = _trend(u, t)
    if trend is None:
        return lambda points: plain(coordinates(points)).log_probability(inside)
    rest = metamodel.fit(u, t - trend(u), rng)

    def both(points: Points) -> tuple[Vector, Vector]:
        features = coordinates(points)
        first = plain(features).log_probability(inside)
        second = _shifted(rest(features).mu, rest(features).sigma, trend(features), inside)
        larger = second[0] > first[0]
        return np.where(larger, second[0], first[0]), np.where(larger, second[1], first[1])

    return both


def _shifted(mu: Vector, sigma: Vector, trend: Vector, inside: CriticalInterval) -> tuple[Vector, Vector]:
    return Prediction.gaussian(mu + trend, sigma).log_probability(inside)


def _trend(u: Points, t: Vector) -> Callable[[Points], Vector] | None:
    """Return the quadratic or linear ridge trend of larger leave-one-out R2; None where neither exceeds 0.5."""
    best, best_score = None, _TREND_KEPT
    for basis in (_linear, _quadratic):
        b = basis(u)
        if len(t) < 4 or b.shape[1] > 4 * len(t):
            continue
        for ridge in (1e-6, 1e-4, 1e-2, 1.0):
            penalty = np.eye(b.shape[1]) * ridge * len(t)
            penalty[0, 0] = 1e-9
            solved = np.linalg.solve(b.T @ b + penalty, b.T)  # (p, n)
            leverage = np.einsum("np,pn->n", b, solved)
            left_out = (t - b @ (solved @ t)) / np.maximum(1.0 - leverage, 1e-6)
            score = 1.0 - float((left_out**2).sum() / max(((t - t.mean()) ** 2).sum(), 1e-300))
            if score > best_score:
                best, best_score = (basis, solved @ t), score
    if best is None:
        return None
    basis, coefficients = best
    return lambda points: np.asarray(basis(points) @ coefficients)


def _linear(u: Points) -> Points:
    return np.column_stack([np.ones(len(u)), 2.0 * u - 1.0])


def _quadratic(u: Points) -> Points:
    v = 2.0 * u - 1.0
    i, j = np.triu_indices(v.shape[1])
    return np.column_stack([np.ones(len(u)), v, v[:, i] * v[:, j]])
