"""Inputs with choices in the standard-normal space: a choice owns an interval of its score as large as it is likely.

Within the interval a score says nothing more, so that a proposal may leave it as it is and change the masses of the
choices alone: its density over that of the inputs' distribution is q_k / p_k, exactly, whatever the order of the choices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sbt.problem.arrays import Points, Vector
from sbt.problem.space import ParameterSpace

__all__ = ["ChoiceScore", "choice_scores", "from_cube", "log_normal", "log_wide", "to_cube"]

_INSIDE = 1e-9
"""Distance of a coordinate from the faces of the cube: their normal scores are infinite."""


@dataclass(frozen=True, eq=False)
class ChoiceScore:
    """The normal score of an input with k choices.

    Args:
        column: of the score.
        edges: (k - 1,) scores between the choices.
        shares: (k,) their probabilities p.
    """

    column: int
    edges: Vector
    shares: Vector

    def cells(self, z: Points) -> NDArray[np.int64]:
        """Return (n,) positions of the choices at scores z (n, d)."""
        return np.searchsorted(self.edges, z[:, self.column], side="right").astype(np.int64)

    def log_ratio(self, masses: Points, z: Points) -> Points:
        """Return (..., n) log q / p at scores z (n, d), for masses q (..., k)."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(masses / self.shares)[..., self.cells(z)])

    def scores(self, cells: NDArray[np.int64], within: Vector) -> Vector:
        """Return (n,) scores in the intervals of choices (n,), by the share (n,) in (0, 1) of the interval that lies below."""
        edges = np.concatenate([[0.0], np.cumsum(self.shares)])
        above = np.concatenate([np.cumsum(self.shares[::-1])[::-1], [0.0]])
        p = self.shares[cells]
        below, beyond = edges[cells] + within * p, above[cells + 1] + (1.0 - within) * p
        score = np.where(below <= beyond, ndtri(np.maximum(below, 1e-300)), -ndtri(np.maximum(beyond, 1e-300)))
        inner = np.concatenate([[-np.inf], self.edges, [np.inf]])
        return np.clip(score, inner[cells], np.nextafter(inner[cells + 1], -np.inf))

    def share_below(self, z: Points) -> Vector:
        """Return (n,) shares of its interval below each score: the inverse of `scores`."""
        cells, score = self.cells(z), z[:, self.column]
        low = np.concatenate([[0.0], np.cumsum(self.shares)])[cells]
        high = np.concatenate([np.cumsum(self.shares[::-1])[::-1], [0.0]])[cells + 1]
        share = np.where(score <= 0, ndtr(score) - low, self.shares[cells] - (ndtr(-score) - high)) / self.shares[cells]
        return np.clip(share, 0.0, 1.0)


def choice_scores(space: ParameterSpace) -> tuple[ChoiceScore, ...]:
    """Return the scores of the inputs with choices."""
    return tuple(ChoiceScore(k, p.edges, p.shares) for k, p in enumerate(space.parameters) if p.choices)


def log_normal(z: Points, scale: Vector | float = 1.0) -> Vector:
    """Return (n,) log density of independent centred normals with standard deviations `scale`, at z (n, d)."""
    d = z.shape[1]
    scales = np.broadcast_to(np.asarray(scale, dtype=np.float64), (d,))
    squares: Vector = ((z / scales) ** 2).sum(axis=1)
    return -0.5 * squares - float(np.log(scales).sum()) - 0.5 * d * math.log(2.0 * math.pi)


def log_wide(z: Points, scales: Vector, choices: Sequence[ChoiceScore]) -> Vector:
    """Return (n,) log density of the wide distribution: normals with these scales (d,), choices equally likely."""
    found = log_normal(z, scales)
    for choice in choices:
        found = found + choice.log_ratio(np.full(len(choice.shares), 1.0 / len(choice.shares)), z)
    return found


def from_cube(v: Points, scales: Vector, choices: Sequence[ChoiceScore]) -> Points:
    """Return the scores of points v (n, d) of the cube in which the wide distribution is uniform."""
    inside = np.clip(v, _INSIDE, 1.0 - _INSIDE)
    z = ndtri(inside) * scales
    for choice in choices:
        at = inside[:, choice.column] * len(choice.shares)
        cells = np.minimum(at.astype(np.int64), len(choice.shares) - 1)
        z[:, choice.column] = choice.scores(cells, np.clip(at - cells, _INSIDE, 1.0 - _INSIDE))
    return np.asarray(z)


def to_cube(z: Points, scales: Vector, choices: Sequence[ChoiceScore]) -> Points:
    """Return the points of the cube in which the wide distribution is uniform, of scores z (n, d)."""
    v = np.asarray(ndtr(z / scales))
    for choice in choices:
        v[:, choice.column] = (choice.cells(z) + choice.share_below(z)) / len(choice.shares)
    return v
