"""Greedy batches: the candidates of highest score that lie apart, and the most representative ones.

Distances are measured in the inputs' influence on the metamodel's mean: an input without influence
separates nothing. `select_diverse` multiplies the score of a candidate by its squared distance to the nearest
run, which favours corners; `select_representative` sums this product over all points that a run would serve.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube

__all__ = ["influence_on_mean", "propose_greedily", "refine_diverse", "select_diverse", "select_representative"]

_CANDIDATES = 4096  # uniform ones; the refinement adds up to 2,880
_KEEP, _CHILDREN, _ROUNDS = 60, 16, 3  # best candidates of a round, steps from each, rounds
_SCORED = 1024  # candidates of largest rough score that are scored, where there is a rough score
_STEP, _NARROWER = 0.1, 2.5  # first step in the unit cube, by how much it shrinks from round to round
_FLIPPED = 0.2  # chance that a step takes another choice: each of three is tried at every good candidate
_PROBES = 128  # pairs of points that an influence is estimated from: its relative error is about 1 / sqrt(2 x 128)
_AT_ONCE, _LOOKED_AT = 256, 16  # points whose gain is computed at once: at first, and again
_LEAST = 0.05  # of the largest influence: an input the metamodel calls irrelevant may not be


def propose_greedily(
    score: Callable[[Points], Vector],
    existing: Points,
    n: int,
    scale: Vector,
    rng: np.random.Generator,
    *,
    snap: Callable[[Points], Points] = lambda u: u,
    admissible: Callable[[Points], Mask] | None = None,
    cube: Cube = CONTINUOUS,
    uniform: Points | None = None,
    rough: Callable[[Points], Vector] | None = None,
) -> tuple[Points, int]:
    """Return (<= n, d) points of the highest scores that lie apart, and the number of candidates scored.

    Args:
        score: (m, d) points -> (m,) log scores; the candidates are uniform ones, refined around the best.
        existing: (k, d) runs to keep away from.
        n: how many points.
        scale: (d,) influence of the inputs.
        rng: the only source of randomness.
        snap: points to those that will be run (integers); distances and constraints are those of the latter.
        admissible: (m, d) points -> (m,) booleans; None: all are.
        cube: which coordinates take single values.
        uniform: (k, d) uniform admissible candidates; None: drawn by the rng.
        rough: about the score and many times quicker: it says which candidates the score looks at. None: at all.
    """
    first = rng.random((_CANDIDATES, existing.shape[1])) if uniform is None else uniform
    within = score if admissible is None else _within(score, admissible, snap)
    if rough is None:
        u, value = refine_diverse(within, first, scale, rng, cube)
    else:
        u, value = refine_diverse(rough if admissible is None else _within(rough, admissible, snap), first, scale, rng, cube)
        u = u[np.argsort(-value, kind="stable")[: max(_SCORED, 4 * n)]]
        value = within(u)
    u = snap(u)
    return u[select_diverse(cube.embedded(u), value, cube.embedded(existing), n, cube.spread(scale))], len(u)


def _within(
    score: Callable[[Points], Vector], admissible: Callable[[Points], Mask], snap: Callable[[Points], Points]
) -> Callable[[Points], Vector]:
    """Return the score, -inf where what would be run is not admissible."""
    return lambda u: np.where(admissible(snap(u)), score(u), -np.inf)


def influence_on_mean(predict: Callable[[Points], Prediction], dimension: int, rng: np.random.Generator) -> Vector:
    """Return (d,) how much each input moves the mean, the largest 1 and none below 0.05.

    The root mean squared change of mu when one input is drawn anew, the others unchanged: the square root of
    the total effect.

    Source:
        Jansen (1999), doi 10.1016/S0010-4655(98)00154-4.
    """
    base = rng.random((_PROBES, dimension))
    changed = np.repeat(base[None], dimension, axis=0)  # (d, m, d)
    for k, fresh in enumerate(rng.random((dimension, _PROBES))):
        changed[k, :, k] = fresh
    mu = predict(np.concatenate([base, changed.reshape(-1, dimension)])).mu
    effect = np.sqrt(np.mean((mu[_PROBES:].reshape(dimension, _PROBES) - mu[:_PROBES]) ** 2, axis=1))
    largest = effect.max()
    return np.maximum(effect / largest, _LEAST) if largest > 0 else np.ones(dimension)


def refine_diverse(
    score: Callable[[Points], Vector], u: Points, scale: Vector, rng: np.random.Generator, cube: Cube = CONTINUOUS
) -> tuple[Points, Vector]:
    """Return candidates (m, d) and their log scores (m,): the given ones and ever closer ones around good ones.

    The candidates that are refined are good and apart, so that one region does not take all.

    Args:
        score: (m, d) points -> (m,) log scores.
        u: (n, d) candidates to begin with.
        scale: (d,) influence of the inputs; steps are longer where there is little.
        rng: the only source of randomness.
        cube: which coordinates take single values; a step takes another choice with probability 0.2.
    """
    found, value = u, score(u)
    width = _STEP / scale
    for _ in range(_ROUNDS):
        at = cube.embedded(found)
        best = found[select_diverse(at, value, np.empty((0, at.shape[1])), _KEEP, cube.spread(scale))]
        step = width * rng.standard_normal((len(best) * _CHILDREN, u.shape[1]))
        parents = np.repeat(best, _CHILDREN, axis=0)
        near = cube.flipped(np.clip(parents + step, 1e-9, 1 - 1e-9), parents, _FLIPPED, rng)
        found, value = np.concatenate([found, near]), np.concatenate([value, score(near)])
        width = width / _NARROWER
    return found, value


def select_diverse(u: Points, log_score: Vector, existing: Points, n: int, scale: Vector) -> np.ndarray:
    """Return the indices (<= n) of candidates selected one by one by log score plus log squared distance.

    Args:
        u: (m, d) candidates.
        log_score: (m,) of each by itself.
        existing: (k, d) points that the distance is measured to, beside those selected before.
        n: how many to select.
        scale: (d,) what a unit of each input counts in the distance.

    Returns:
        (<= n,) indices of candidates with a score above -inf that are nobody's duplicate.

    Source:
        The product of misclassification probability and squared distance to the nearest run: a batch
        form of the U criterion of Echard et al. (2011), doi 10.1016/j.strusafe.2011.01.002.
    """
    at = u * scale
    nearest = cKDTree(existing * scale).query(at)[0] ** 2 if len(existing) else np.full(len(u), float(len(scale)))
    selected: list[int] = []
    while len(selected) < min(n, len(u)):
        with np.errstate(divide="ignore"):
            value = log_score + np.log(nearest)
        best = int(np.argmax(value))
        if np.isneginf(value[best]):
            break
        selected.append(best)
        nearest = np.minimum(nearest, ((at - at[best]) ** 2).sum(axis=1))
    return np.array(selected, dtype=np.int64)


def select_representative(u: Points, weight: Vector, existing: Points, n: int, scale: Vector) -> np.ndarray:
    """Return the indices (<= n) of points selected one by one so that little weight stays far from a run.

    Each selection reduces the weighted sum of squared distances to the nearest run the most: the greedy
    solution of a weighted k-medoids problem in which the existing runs are centres already. What a point reduces only
    shrinks as others are selected, so that few have to be looked at again each time; the selection is the same.

    Args:
        u: (m, d) points that are to be represented, and to select from.
        weight: (m,) >= 0.
        existing: (k, d) runs, k >= 1.
        n: how many to select.
        scale: (d,) what a unit of each input counts in the distance.

    Returns:
        (<= n,) distinct indices; fewer where no point reduces the sum any more.

    Source:
        Nemhauser, Wolsey and Fisher (1978), doi 10.1007/BF01588971: the greedy selection reaches at least
        1 - 1/e of the largest possible reduction. Lazy evaluation: Minoux (1978), doi 10.1007/BFb0006528.
    """
    if n == 0 or len(u) == 0:
        return np.empty(0, dtype=np.int64)
    at = u * scale
    between = cdist(at, at, "sqeuclidean")
    nearest = cKDTree(existing * scale).query(at)[0] ** 2

    def gain_of(rows: NDArray[np.intp]) -> Vector:
        return np.asarray((np.maximum(nearest - between[rows], 0.0) * weight).sum(axis=1))

    most = np.concatenate([gain_of(part) for part in np.array_split(np.arange(len(u)), len(u) // _AT_ONCE + 1)])
    known, selected = np.zeros(len(u), dtype=np.int64), list[int]()  # so many were selected when `most` was computed
    while len(selected) < n:
        best = int(np.argmax(most))
        if most[best] <= 0.0:
            break
        if known[best] == len(selected):
            selected.append(best)
            nearest = np.minimum(nearest, between[best])
            continue
        stale = np.argpartition(-most, _LOOKED_AT)[:_LOOKED_AT] if len(most) > _LOOKED_AT else np.arange(len(most))
        stale = stale[known[stale] < len(selected)]
        stale = np.union1d(stale, best)
        most[stale], known[stale] = gain_of(stale), len(selected)
    return np.array(selected, dtype=np.int64)
