"""The metamodel as the estimator uses it: P(critical) at points of the standard-normal space.

The metric is warped by asinh around the critical edge, so that precision goes where critical meets
uncritical and a far tail does not decide the length scales. A ridge trend carries many inputs; a second fit
without trend limits its confidence where it only extrapolates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sbt.metamodels.base import Metamodel, Predictor, check_prediction, named_errors, with_target
from sbt.metamodels.joint import joined_log_probability
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.cube import Cube
from sbt.problem.requirement import CriticalInterval
from sbt.problem.space import ParameterSpace

__all__ = ["Coordinates", "JointLogProbability", "LogProbability", "fit_log_probability"]

LogProbability = Callable[[Points], tuple[Vector, Vector]]
"""(n, d) normal scores to (n,) log P(critical) and (n,) log P(uncritical)."""

_REACH = 5.0  # normal scores from -5 to 5 are the unit interval: 6e-7 of the distribution lies beyond
_QUANTILE = 0.5  # of the distances to the edge: the scale of the warp; a smaller one becomes a step as runs gather there
_LEAST_R2 = 0.5  # leave-one-out R2 from which on a trend is taken: it explains more than it leaves
_RIDGES = (1e-6, 1e-4, 1e-2, 1.0)  # penalties relative to the number of rows


@dataclass(frozen=True)
class Coordinates:
    """From points of the standard-normal space to the inputs of the metamodel.

    A uniform input is taken on its range, every other one as its normal score with -5 to 5 as the unit
    interval, whole numbers at the middle of their cell, choices on an axis for each; derived features of the space follow.
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
        for k, p in enumerate(self.space.parameters):
            if p.kind == "integer":
                scores = scores.copy() if scores is z else scores
                scores[:, k] = p.to_normal(p.from_normal(scores[:, k]))
        own = np.where(self.bounded == 1, ndtr(scores), 0.5 + scores / (2.0 * _REACH))
        for k, p in enumerate(self.space.parameters):
            if p.choices:
                own[:, k] = p.to_unit(p.from_normal(scores[:, k]))
        own = Cube(nominal=self.space.cube.nominal).embedded(own)
        if not self.space.features:
            return np.ascontiguousarray(own)
        u = self.space.to_unit(self.space.from_normal(z))
        return np.column_stack([own, self.space.metamodel_inputs(u)[:, own.shape[1] :]])


@dataclass(frozen=True)
class JointLogProbability:
    """P(critical) of a combination from those of its metrics.

    Args:
        critical: which combination.
        parts: (q,) P(critical) of each metric.
    """

    critical: CombinedInterval
    parts: tuple[LogProbability, ...]

    def __call__(self, points: Points) -> tuple[Vector, Vector]:
        """Return (n,) log P(critical) and (n,) log P(uncritical)."""
        return joined_log_probability(self.critical, [part(points) for part in self.parts])


def fit_log_probability(
    metamodel: Metamodel, coordinates: Coordinates, critical: CriticalInterval, z: Points, y: Vector, rng: np.random.Generator
) -> LogProbability:
    """Return P(critical) as learned from n >= 2 runs at normal scores z (n, d) with metrics y (n,).

    Of a combination y is (n, q): each metric is learned by itself.

    Where a trend was found, the larger P of two fits: to the metric, and to what the trend leaves of it.
    """
    if isinstance(critical, CombinedInterval):
        parts = [
            fit_log_probability(metamodel, coordinates, leaf, z[np.isfinite(column)], column[np.isfinite(column)], rng)
            for leaf, column in zip(critical.leaves, y.T, strict=True)
        ]
        return JointLogProbability(critical, tuple(parts))
    u, warp = coordinates(z), Warp.around_edge(y, critical, quantile=_QUANTILE)
    t, inside = warp.values(y), warp.interval(critical)

    def fit(model: Metamodel, values: Vector) -> Predictor:
        with named_errors(metamodel, len(y)):
            predictor = model.fit(u, values, rng)

        def predict(inputs: Points) -> Prediction:
            with named_errors(metamodel, len(y)):
                return check_prediction(predictor(inputs), len(inputs))

        return predict

    plain = fit(with_target(metamodel, inside), t)
    trend = _trend(u, t)
    if trend is None:
        return lambda points: plain(coordinates(points)).log_probability(inside)
    residual = fit(metamodel, t - trend(u))

    def larger_of_both(points: Points) -> tuple[Vector, Vector]:
        inputs = coordinates(points)
        first, rest = plain(inputs).log_probability(inside), residual(inputs)
        second = Prediction.gaussian(rest.mu + trend(inputs), rest.sigma).log_probability(inside)
        larger = second[0] > first[0]
        return np.where(larger, second[0], first[0]), np.where(larger, second[1], first[1])

    return larger_of_both


def _trend(u: Points, t: Vector) -> Callable[[Points], Vector] | None:
    """Return the quadratic or linear ridge trend of larger leave-one-out R2; None where neither exceeds 0.5."""
    best, best_score = None, _LEAST_R2
    for basis in (_linear, _quadratic):
        b = basis(u)
        if len(t) < 4 or b.shape[1] > 4 * len(t):
            continue
        for ridge in _RIDGES:
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
