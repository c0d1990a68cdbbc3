"""Where to look next where the seed's traffic is known before the run: pairs of inputs and seed.

Which runs fail is decided by the traffic as much as by the inputs. A forest learns from both; candidates are fresh pairs at
promising inputs, and the best of them with other inputs beside the same traffic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbt.metamodels.extra_trees import ExtraTrees, ForestPredictor
from sbt.problem.arrays import Points, Vector
from sbt.samplers.noise import scores
from sbt.samplers.search import Search, fill_uniformly
from sbt.seeds import SEED_END

__all__ = ["PairPicks", "propose_pairs"]

Draw = Callable[[Points, NDArray[np.int64]], Points]
"""(n, d) unit-cube points and their n seeds to (n, c) covariates."""

_FOREST = ExtraTrees(trees=60)
_SCREENED = 2000  # uniform points, of which inputs alone choose
_PROMISING, _ANY = 200, 100  # points that are given traffic: the best of them, and any
_BEST, _STEPS, _STEP = 20, 5, 0.1  # runs and pairs of the lowest scores, steps from each, their std in the unit cube
_DARING = 5  # of so many picks one is the best by a few trees alone
_FEW_TREES = 8


@dataclass(frozen=True)
class PairPicks:
    """Pairs that were chosen.

    Attributes:
        u: (n, d) inputs in the unit cube, the most promising pair first.
        seeds: of each, all different.
    """

    u: Points
    seeds: tuple[int, ...]


def propose_pairs(
    search: Search, draw: Draw, u: Points, seeds: NDArray[np.int64], y: Vector, n: int, rng: np.random.Generator
) -> PairPicks:
    """Return n pairs of the lowest expected score, each with traffic that no other run has.

    Args:
        search: what is searched.
        draw: gives the covariates.
        u: (m, d) finished runs in the unit cube.
        seeds: (m,) of them.
        y: (m,) their metric, NaN where a run failed, which counts as the worst.
        n: pairs wanted >= 1.
        rng: the only source of randomness.
    """
    score = scores(search.margins(y))
    inputs = search.columns(u)
    pairs = _FOREST.fit(np.column_stack([inputs, draw(u, seeds)]), score, rng)
    alone = _FOREST.fit(inputs, score, rng)

    def expected(points: Points, theirs: NDArray[np.int64]) -> Points:
        return _by_tree(pairs, np.column_stack([search.columns(points), draw(points, theirs)]))

    points = _inputs(search, alone, u[np.argsort(score, kind="stable")[:_BEST]], rng)
    drawn = _fresh(len(points), rng, set(seeds.tolist()))
    found = expected(points, drawn)
    best = np.argsort(found.mean(axis=0), kind="stable")[:_BEST]
    moved = _steps(search, points[best], rng)
    origin = np.repeat(best, _STEPS)
    keep = search.feasible(moved)
    moved, same = moved[keep], drawn[origin[keep]]
    if len(moved):
        points, drawn = np.vstack([points, moved]), np.concatenate([drawn, same])
        found = np.hstack([found, expected(moved, same)])
    return _picked(points, drawn, found, n, rng)


def _picked(points: Points, seeds: NDArray[np.int64], found: Points, n: int, rng: np.random.Generator) -> PairPicks:
    """Return the n pairs of the lowest mean (by a few of the trees, for some of them), no seed twice.

    Args:
        points: (m, d) candidates.
        seeds: (m,) of them.
        found: (trees, m) expected scores.
        n: pairs wanted.
        rng: of the trees.
    """
    mean, left, chosen = found.mean(axis=0), np.ones(len(seeds), dtype=bool), []
    for k in range(min(n, len(np.unique(seeds)))):
        few = k % _DARING == _DARING - 1
        value = found[rng.choice(len(found), _FEW_TREES, replace=False)].mean(axis=0) if few else mean
        at = int(np.argmin(np.where(left, value, np.inf)))
        chosen.append(at)
        left &= seeds != seeds[at]
    order = np.array(chosen)[np.argsort(mean[chosen], kind="stable")]
    return PairPicks(points[order], tuple(int(s) for s in seeds[order]))


def _inputs(search: Search, alone: ForestPredictor, best: Points, rng: np.random.Generator) -> Points:
    """Return inputs that are given traffic: the most promising of many by themselves, steps from the best runs, and any."""
    d = best.shape[1]
    many = fill_uniformly(search.feasible, _SCREENED, d, rng)
    promising = many[np.argsort(alone.mu(search.columns(many)), kind="stable")[:_PROMISING]]
    near = _steps(search, best, rng)
    return np.vstack([promising, near[search.feasible(near)], fill_uniformly(search.feasible, _ANY, d, rng)])


def _steps(search: Search, parents: Points, rng: np.random.Generator) -> Points:
    """Return steps from each of these points."""
    parents = np.repeat(parents, _STEPS, axis=0)
    near = np.clip(parents + _STEP * rng.standard_normal(parents.shape), 0.0, 1.0)
    return search.cube.flipped(near, parents, _STEP, rng)


def _fresh(n: int, rng: np.random.Generator, taken: set[int]) -> NDArray[np.int64]:
    """Return n different seeds that no run has."""
    found: dict[int, None] = {}
    while len(found) < n:
        found |= dict.fromkeys(int(s) for s in rng.integers(0, SEED_END, n) if int(s) not in taken)
    return np.array(list(found)[:n], dtype=np.int64)


def _by_tree(forest: ForestPredictor, inputs: Points) -> Points:
    """Return (trees, n) predictions of each tree."""
    return forest(inputs).mean
