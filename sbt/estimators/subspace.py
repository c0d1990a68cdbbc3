"""A few directions of many inputs: what the metric depends on is learned there, the rest follows its own distribution.

With z = B' v + rest, v = B z the coordinates in the subspace, the rest is standard normal and independent of v. A
proposal that changes the density of v alone has weights that depend on v alone, in however many inputs.

Source:
    Uribe, Papaioannou, Marzouk, Straub (2021), Cross-entropy-based importance sampling with failure-informed dimension
    reduction, SIAM/ASA Journal on Uncertainty Quantification 9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.metamodels.base import Metamodel, fitted
from sbt.problem.arrays import Points, Vector

__all__ = ["Subspace", "find_subspace", "inputs_that_matter", "unit"]

_REACH = 5.0  # coordinates from -5 to 5 are the unit interval of the metamodel: 6e-7 of the distribution lies beyond
_RIDGES = (1e-8, 1e-6, 1e-4, 1e-2, 1e-1, 1.0)  # penalties relative to the number of rows
_FOLDS = 4  # of the score
_MOST_INPUTS = 6  # beside the direction: a metamodel and a mixture of seven coordinates are learned from a few hundred runs
_RELEVANT = 0.05  # squared inverse length scale of an input that matters, relative to the largest
_ROWS = 400  # that length scales are learned from: about a second


@dataclass(frozen=True, eq=False)
class Subspace:
    """An orthonormal basis (m, d) of the coordinates that matter, in the standard-normal space."""

    basis: Points

    def reduce(self, z: Points) -> Points:
        """Return the coordinates (n, m) of points z (n, d)."""
        return np.asarray(z @ self.basis.T)

    def lift(self, v: Points, rng: np.random.Generator) -> Points:
        """Return points (n, d) of coordinates v (n, m), the rest drawn from its distribution."""
        free = rng.standard_normal((len(v), self.basis.shape[1]))
        return free + (v - self.reduce(free)) @ self.basis


def unit(v: Points) -> Points:
    """Return the metamodel's inputs (n, m) at coordinates v (n, m)."""
    return 0.5 + v / (2.0 * _REACH)


def find_subspace(z: Points, t: Vector, inputs: tuple[int, ...], other: Vector | None = None) -> Subspace:
    """Return the span of the linear trend of t (n,), or of `other` (n,), at z (n, d), and of the axes of some inputs.

    The trend is the ridge regression of smallest leave-one-out error, relative to the variance of what it explains.
    """
    axes = np.eye(z.shape[1])[list(inputs)]
    rows = list(axes)
    direction = min((_slope(z, values) for values in (t, other) if values is not None), key=lambda found: found[1])[0]
    rest = direction - (axes @ direction) @ axes
    if float(rest @ rest) > 1e-6 * max(float(direction @ direction), 1e-300):
        rows.append(rest / np.linalg.norm(rest))
    return Subspace(np.array(rows))


def inputs_that_matter(metamodel: Metamodel, z: Points, t: Vector, rng: np.random.Generator) -> tuple[tuple[int, ...], float]:
    """Return the inputs whose own axes the subspace needs, and the share of the variance of t explained there.

    The share is that of the metamodel on rows that neither it nor the trend has seen. Axes are taken where they explain
    more than the trend alone.

    Args:
        metamodel: learns t in the subspace.
        z: (n, d) runs from the inputs' distribution.
        t: (n,) their (warped) metric.
        rng: the only source of randomness.
    """
    fold = rng.permutation(len(t)) % _FOLDS

    def explained(choose: Callable[[Points, Vector], tuple[int, ...]]) -> float:
        error = np.empty(len(t))
        for k in range(_FOLDS):
            rest = fold != k
            space = find_subspace(z[rest], t[rest], choose(z[rest], t[rest]))
            predictor = fitted(metamodel, unit(space.reduce(z[rest])), t[rest], rng)
            error[~rest] = t[~rest] - predictor(unit(space.reduce(z[~rest]))).mu
        return 1.0 - float((error**2).mean() / max(float(t.var()), 1e-300))

    alone = explained(lambda *_: ())
    with_axes = explained(lambda rows, values: _relevant(rows, values, rng)) if alone < 1.0 - _RELEVANT else -np.inf
    return (_relevant(z, t, rng), with_axes) if with_axes > alone else ((), alone)


def _slope(z: Points, t: Vector) -> tuple[Vector, float]:
    """Return the coefficients (d,) of the ridge regression of smallest leave-one-out error, and its share of the variance."""
    b = np.column_stack([np.ones(len(z)), z])
    best, best_error, gram = np.zeros(z.shape[1]), np.inf, b.T @ b
    for ridge in _RIDGES:
        penalty = np.eye(b.shape[1]) * ridge * len(t)
        penalty[0, 0] = 1e-9
        solved = np.linalg.solve(gram + penalty, b.T)
        left_out = (t - b @ (solved @ t)) / np.maximum(1.0 - np.einsum("np,pn->n", b, solved), 1e-6)
        error = float((left_out**2).mean())
        if error < best_error:
            best, best_error = (solved @ t)[1:], error
    return np.asarray(best), best_error / max(float(t.var()), 1e-300)


def _relevant(z: Points, t: Vector, rng: np.random.Generator) -> tuple[int, ...]:
    """Return the inputs of the shortest length scales of a Gaussian process."""
    from sbt.metamodels.gaussian_process import GaussianProcess

    rows = rng.permutation(len(t))[:_ROWS]
    predictor = GaussianProcess(nu=2.5, input_noise=False, kernels=1).fit(unit(z[rows]), t[rows], rng)
    weight = predictor.hyper.roughness
    order = np.argsort(-weight, kind="stable")[:_MOST_INPUTS]
    return tuple(sorted(int(k) for k in order if weight[k] > _RELEVANT * weight.max()))
