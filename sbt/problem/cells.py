"""Probabilities of whole numbers that a Gaussian copula joins: each owns a cell of normal scores.

Source:
    Genz (1992), Numerical Computation of Multivariate Normal Probabilities: one score after the other, each within its cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import ndtr, ndtri

from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter

__all__ = ["MOST_GIVEN", "MOST_JOINED", "JoinedCells", "log_cell_mass"]

MOST_JOINED, MOST_GIVEN = 3, 2
"""Whole numbers whose joint probability is computed; fewer where it is another one for each value of continuous inputs."""
_NODES = {2: 64, 3: 24}
"""Nodes of each score but the last, by the number of scores: relative errors below 1e-5 (3: 1e-4) at correlations up to .95."""
_FEW_NODES, _LOOSE = {2: 24, 3: 10}, {2: 0.25, 3: 0.5}
"""Of scores that leave each other a standard deviation above that: errors below 1e-8 (3: 3e-5)."""
_AT_ONCE = 2**15
_DEPENDENT = 1e-12
_LEAST = 1e-320

@dataclass(frozen=True, eq=False)
class JoinedCells:
    """The whole-number inputs that a Gaussian copula joins with other inputs.

    Args:
        parameters: all d inputs.
        correlation: (d, d) of their normal scores.
        columns: those of the whole-number inputs that have a correlation.
    """

    parameters: tuple[Parameter, ...]
    correlation: Points
    columns: tuple[int, ...]

    @classmethod
    def of(cls, parameters: tuple[Parameter, ...], correlation: Sequence[Sequence[float]]) -> JoinedCells | None:
        """Return them; None where there are none."""
        matrix = np.asarray(correlation, dtype=np.float64)
        joined = np.count_nonzero(matrix, axis=1) > 1
        columns = tuple(k for k, p in enumerate(parameters) if p.kind == "integer" and joined[k])
        return cls(parameters, matrix, columns) if columns else None

    @cached_property
    def others(self) -> tuple[int, ...]:
        """Columns of all other inputs."""
        return tuple(k for k in range(len(self.parameters)) if k not in self.columns)

    @cached_property
    def _given(self) -> tuple[Points, Points]:
        """The means (w, d - w) of the w scores for each score of the others, and their covariance (w, w) given these."""
        inside, across = (self.correlation[np.ix_(self.columns, at)] for at in (self.columns, self.others))
        if not self.others:
            return np.zeros((len(self.columns), 0)), inside
        slopes = cho_solve(cho_factor(self.correlation[np.ix_(self.others, self.others)]), across.T).T
        return slopes, inside - slopes @ across.T

    @cached_property
    def groups(self) -> tuple[NDArray[np.intp], ...]:
        """Positions in `columns` of those that depend on each other given the other inputs."""
        from scipy.sparse.csgraph import connected_components  # few need it, every worker would wait for it

        count, label = connected_components(np.abs(self._given[1]) > _DEPENDENT)
        return tuple(np.flatnonzero(label == k) for k in range(count))

    def _apart(self, group: NDArray[np.intp]) -> bool:
        """Return whether the other inputs say nothing of a group."""
        return bool((np.abs(self._given[0][group]) <= _DEPENDENT).all())

    @cached_property
    def too_many(self) -> tuple[str, ...]:
        """Names of inputs that are too many for their joint probability to be computed."""
        groups = (group for group in self.groups if len(group) > (MOST_JOINED if self._apart(group) else MOST_GIVEN))
        return tuple(self.parameters[self.columns[k]].name for k in next(groups, ()))

    def log_density(self, x: Points, scores: Points) -> Vector:
        """Return (n,) log p(x) within the ranges, constraints aside; scores (n, d) are those of each input alone."""
        others, (slopes, covariance) = list(self.others), self._given
        alone = [p.log_density(x[:, k]) for k, p in enumerate(self.parameters)]
        log_p = np.sum([np.zeros(len(x)), *(alone[k] for k in others)], axis=0)
        log_p += log_copula(self.correlation[np.ix_(others, others)], scores[:, others])
        for group in self.groups:
            columns = [self.columns[k] for k in group]
            rows = place = np.arange(len(x))
            if self._apart(group):
                rows, place = _unlike(x[:, columns], [self.parameters[k] for k in columns])
            cells = [self.parameters[k].cell(x[rows, k]) for k in columns]
            mean = scores[rows][:, others] @ slopes[group].T
            lower, upper = (np.column_stack([cell[side] for cell in cells]) - mean for side in (0, 1))
            log_p += log_cell_mass(lower, upper, covariance[np.ix_(group, group)])[place]
        return np.where(np.isfinite(np.sum([alone[k] for k in self.columns], axis=0)), log_p, -np.inf)


def _unlike(x: Points, parameters: Sequence[Parameter]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of different whole numbers (n, m), and for each row that among them."""
    code = np.zeros(len(x))
    for k, p in enumerate(parameters):
        code = code * (p.high - p.low + 1.0) + np.clip(x[:, k], p.low, p.high) - p.low
    _, rows, place = np.unique(code, return_index=True, return_inverse=True)
    return rows, place


def log_copula(correlation: Points, scores: Points) -> Vector:
    """Return (n,) log density of a Gaussian copula at normal scores (n, d)."""
    if scores.shape[1] == 0:
        return np.zeros(len(scores))
    factor = cho_factor(correlation, lower=True)
    whitened = np.sum(scores * cho_solve(factor, scores.T).T, axis=1)
    return 0.5 * ((scores**2).sum(axis=1) - whitened) - float(np.log(np.diag(factor[0])).sum())


def log_cell_mass(lower: Points, upper: Points, covariance: Points) -> Vector:
    """Return (n,) log P(lower < Z < upper) of a normal vector Z with mean 0, by a fixed quadrature.

    Args:
        lower: (n, m) lower ends of each cell, infinite ones as well, m at most `MOST_JOINED`.
        upper: (n, m) upper ends.
        covariance: (m, m) of Z.

    Returns:
        (n,) log probabilities, of the least that float64 knows where they are less.

    >>> quadrant = np.array([[0.0, 0.0]]), np.array([[np.inf, np.inf]])
    >>> round(float(np.exp(log_cell_mass(*quadrant, np.array([[1.0, 0.5], [0.5, 1.0]])))[0]), 9)
    0.333333333
    """
    scale, m = np.sqrt(np.diag(covariance)), len(covariance)
    lower, upper, correlation = lower / scale, upper / scale, covariance / np.outer(scale, scale)
    p = _between(lower, upper)[2]
    if m > 1:
        left = 1.0 / np.sqrt(np.diag(np.linalg.inv(correlation)).max())
        nodes, weights = _nodes((_FEW_NODES if left > _LOOSE[m] else _NODES)[m], m)
        parts = np.array_split(np.arange(len(p)), -(-len(p) * len(weights) // _AT_ONCE) or 1)
        order = np.argsort(p, axis=1)
        p = np.vstack([_each_given_those_before(lower[k], upper[k], order[k], correlation, nodes) @ weights for k in parts])
    return np.log(np.maximum(p[:, 0], _LEAST))


def _each_given_those_before(
    lower: Points, upper: Points, order: NDArray[np.intp], correlation: Points, nodes: Points
) -> Points:  # fmt: skip
    """Return (n, q) probabilities of cells at nodes (q, m - 1) of all scores but the last, in an order (n, m).

    The least likely cell of a row comes first.
    """
    factor = np.linalg.cholesky(correlation[order[:, :, None], order[:, None, :]])[..., None]  # (n, m, m, 1)
    lower, upper = (np.take_along_axis(ends, order, axis=1)[..., None] for ends in (lower, upper))  # (n, m, 1)
    z: list[Points] = []
    p = np.ones((len(order), len(nodes)))
    for k in range(order.shape[1]):
        mean = np.zeros_like(p)
        for j, before in enumerate(z):
            mean += factor[:, k, j] * before
        above, first, mass = _between((lower[:, k] - mean) / factor[:, k, k], (upper[:, k] - mean) / factor[:, k, k])
        p *= mass
        if k < nodes.shape[1]:
            score = ndtri(np.maximum(first + nodes[:, k] * mass, _LEAST))
            z.append(np.where(above, -score, score))
    return p


def _between(lower: Points, upper: Points) -> tuple[NDArray[np.bool_], Points, Points]:
    """Return whether intervals of a standard normal score are turned to the lower tail, what is below them there, and in them."""
    above = lower > 0.0  # the lower tail is told more exactly
    first, last = (ndtr(np.where(above, -a, b)) for a, b in ((upper, lower), (lower, upper)))
    return above, first, last - first


@lru_cache
def _nodes(n: int, m: int) -> tuple[Points, Points]:
    """Return nodes (n^(m - 1), m - 1) in the unit cube and their weights (n^(m - 1), 1): Gauss-Legendre, denser near the sides.

    Scores of an infinite cell are no smooth function of their share there.
    """
    t, weight = np.polynomial.legendre.leggauss(n)
    t = 0.5 * (t + 1.0)
    weight = 15.0 * weight * (t * (1.0 - t)) ** 2
    axis = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
    nodes, weights = (np.stack(np.meshgrid(*[each] * (m - 1)), axis=-1).reshape(-1, m - 1) for each in (axis, weight))
    return nodes, weights.prod(axis=1)[:, None]
