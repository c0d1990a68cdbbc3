"""Where to look next where noise hides which inputs fail: ranks instead of values, and regressions drawn at random.

With one run in ten critical at the worst inputs, and one in two hundred on the whole, hits are too few to learn from. All runs
are: where low values of the metric are frequent, so are critical ones.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.metamodels.base import check_prediction, named_errors, sample_paths
from sbt.metamodels.bootstrap import drawn_regression
from sbt.problem.arrays import Mask, Points, Vector
from sbt.samplers.noise import scores
from sbt.samplers.search import Search, SearchData, fill_uniformly

__all__ = ["propose_in_noise"]

_UNIFORM = 3000  # candidates
_LOG_AMONG = math.log(50.0), math.log(800.0)  # of the number that a draw decides among
_BEST, _STEPS, _STEP = 20, 10, 0.1  # runs of the lowest scores, steps from each, their standard deviation in the unit cube


def propose_in_noise(search: Search, seen: SearchData, margin: Vector, n: int, rng: np.random.Generator) -> Points:
    """Return n points (n, d), the one of the best mean score first: each is the best of a regression drawn for it.

    In turn a draw is a line, a line and a few random trees, both fitted to randomly weighted scores (the Bayesian bootstrap), and
    a sample path of the metamodel. Lines learn a trend from few runs, trees thresholds, a process
    hollows. A draw decides among 50 to 800 random candidates: the best of few looks about, that of many looks closer. Runs that
    failed have the worst score. No failure's neighbourhood is left out: its rate is to be learned, and is highest there.

    Args:
        search: what is searched.
        seen: runs to learn from, and where to look.
        margin: (m,) of `seen`.
        n: points wanted >= 1.
        rng: the only source of randomness.

    Source:
        Draws: Rubin (1981), The Bayesian bootstrap; choosing by the best of a draw: Thompson (1933).
    """
    u = np.vstack([seen.u, seen.failed])
    score = scores(np.concatenate([margin, np.full(len(seen.failed), np.inf)]))
    score = (score - score.mean()) / max(float(score.std()), 1e-12)
    candidates = _candidates(search, seen, u[np.argsort(score, kind="stable")[:_BEST]], rng)
    inputs, at = search.columns(u), search.columns(candidates)
    metamodel = search.for_noise(seen.u, seen.y).metamodel
    with named_errors(metamodel, len(u)):
        process = metamodel.fit(inputs, score, rng)
    mean, picks = check_prediction(process(at), len(at)).mu, []
    for k in range(n):
        among = rng.choice(len(at), min(int(np.exp(rng.uniform(*_LOG_AMONG))), len(at)), replace=False)
        points, kind = at[among], k % 3
        if kind == 2:
            value = sample_paths(process, points, 1, rng)[0]
        else:
            value = drawn_regression(inputs, score, points, rng, trees=kind == 1)
        picks.append(int(among[np.argmin(value)]))
    chosen = np.array(picks, dtype=np.intp)
    return candidates[chosen[np.argsort(mean[chosen], kind="stable")]]


def _candidates(search: Search, seen: SearchData, best: Points, rng: np.random.Generator) -> Points:
    """Return admissible points: uniform ones, and steps from the best runs (k, d)."""
    d = best.shape[1]
    parents = np.repeat(best, _STEPS, axis=0)
    near = np.clip(parents + _STEP * rng.standard_normal(parents.shape), 0.0, 1.0)
    near = search.cube.flipped(near, parents, _STEP, rng)
    keep: Mask = seen.admissible(near)
    return np.vstack([fill_uniformly(seen.admissible, _UNIFORM, d, rng), near[keep]])
