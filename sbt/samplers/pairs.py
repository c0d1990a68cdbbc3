"""Where to look next where the seed's traffic is known before the run: pairs of inputs and seed.

Which runs fail is decided by the traffic as much as by the inputs. A forest and a Gaussian process learn from both, and choose in
turn; candidates are fresh pairs at promising inputs, and the best of them with other inputs beside the same traffic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sbt.metamodels.extra_trees import ExtraTrees, ForestPredictor
from sbt.metamodels.risk import fit_process
from sbt.problem.arrays import Mask, Points, Vector
from sbt.samplers.noise import scores
from sbt.samplers.room import fill_uniformly
from sbt.samplers.search import Search
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
_EMPTY = 2  # of so many picks this one is of the half of the candidates whose inputs are farther from all runs: traps are left


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
    """Return n pairs of the lowest expected score, or the largest P(critical), each with traffic that no other run has.

    Args:
        search: what is searched.
        draw: gives the covariates.
        u: (m, d) finished runs in the unit cube.
        seeds: (m,) of them.
        y: (m,) their metric, NaN where a run failed, which counts as the worst.
        n: pairs wanted >= 1.
        rng: the only source of randomness.
    """
    search, y = search.reached(u, y)
    margin = search.margins(y)
    score = scores(margin)
    inputs = search.columns(u)
    known = np.column_stack([inputs, draw(u, seeds)])
    pairs, alone = _FOREST.fit(known, score, rng), _FOREST.fit(inputs, score, rng)
    process = fit_process(known, margin, rng)

    def ranked(points: Points, theirs: NDArray[np.int64]) -> tuple[Points, Vector | None]:
        both = np.column_stack([search.columns(points), draw(points, theirs)])
        return _by_tree(pairs, both), None if process is None else -process[0](both)

    points = _inputs(search, alone, u[np.argsort(score, kind="stable")[:_BEST]], rng)
    drawn = _fresh(len(points), rng, set(seeds.tolist()))
    trees, odds = ranked(points, drawn)
    by_each = [trees.mean(axis=0)] if odds is None else [trees.mean(axis=0), odds]
    best = np.unique(np.concatenate([np.argsort(value, kind="stable")[: _BEST // len(by_each)] for value in by_each]))
    moved = _steps(search, points[best], rng)
    origin = np.repeat(best, _STEPS)
    keep = search.feasible(moved)
    moved, same = moved[keep], drawn[origin[keep]]
    if len(moved):
        points, drawn = np.vstack([points, moved]), np.concatenate([drawn, same])
        more, more_odds = ranked(moved, same)
        trees = np.hstack([trees, more])
        odds = None if odds is None or more_odds is None else np.concatenate([odds, more_odds])
    distance = cKDTree(u).query(points)[0]
    return _picked(points, drawn, trees, odds, distance >= np.median(distance), n, rng)


def _picked(
    points: Points, seeds: NDArray[np.int64], trees: Points, odds: Vector | None, far: Mask, n: int, rng: np.random.Generator
) -> PairPicks:
    """Return n pairs, in turn of the lowest mean of the trees (of a few of them, for some) and by the process, no seed twice.

    Args:
        points: (m, d) candidates.
        seeds: (m,) of them.
        trees: (trees, m) expected scores.
        odds: (m,) log odds of uncritical by the process; None: there is none.
        far: (m,) which lie in the emptier half.
        n: pairs wanted.
        rng: of the trees.
    """
    mean, left, chosen = trees.mean(axis=0), np.ones(len(seeds), dtype=bool), []
    for k in range(min(n, len(np.unique(seeds)))):
        few = k % _DARING == _DARING - 1
        value = trees[rng.choice(len(trees), _FEW_TREES, replace=False)].mean(axis=0) if few else mean
        value = odds if k % 2 and odds is not None else value
        allowed = left & far if k % _DARING == _EMPTY and (left & far).any() else left
        at = int(np.argmin(np.where(allowed, value, np.inf)))
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
