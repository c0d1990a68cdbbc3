"""Where to look next where noise hides which inputs fail: ranks instead of values, and regressions drawn at random.

With one run in ten critical at the worst inputs, and one in two hundred on the whole, hits are too few to learn from. All runs
are: where low values of the metric are frequent, so are critical ones.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.metamodels.base import fitted, predicted, sample_paths
from sbt.metamodels.bootstrap import drawn_regression
from sbt.problem.arrays import Mask, Points, Vector
from sbt.samplers.noise import by_chance, scores
from sbt.samplers.room import fill_uniformly, spread_out
from sbt.samplers.search import (
    Picks,
    Search,
    SearchData,
    WarpedModel,
    fit_warped,
    log_repulsion,
    refine_best,
)  # fmt: skip

__all__ = ["propose_in_noise"]

_UNIFORM = 3000  # candidates
_LOG_AMONG = math.log(50.0), math.log(800.0)  # of the number that a draw decides among
_LARGEST = 0.3  # share of the picks where the failure rate is believed to be largest; the others are draws
_KINDS = 4  # of draws
_CHANCE = 0.1  # p-value of "inputs tell nothing", from which on draws decide among one candidate while nothing was critical
_HOPELESS, _INFLATION = 1e-6, 2.0  # P(critical), with sigma inflated, below which no run tells of failures
_FILLING = 0.8  # share of the picks that fills space then
_CLEAR = 0.05  # picks of one batch repel each other within this part of the cube's diagonal
_BEST, _STEPS, _STEP = 20, 10, 0.1  # runs of the lowest scores, steps from each, their standard deviation in the unit cube


def propose_in_noise(
    search: Search, seen: SearchData, margin: Vector, n: int, rng: np.random.Generator, known: Points
) -> Picks:  # fmt: skip
    """Return n points, those of the best mean score first: where the failure rate is believed to be largest, and draws.

    Three of ten (`rate`) are where the metamodel of the metric has the largest P(critical), wherever that is: runs there correct
    it, and those that are critical stand for their mode. The others (`drawn`) are each the best of a regression drawn for it. In
    turn a draw is a line, a line and a few random trees, both fitted to randomly weighted scores (the Bayesian bootstrap), a
    sample path of the metamodel of the scores, and one of that of the metric. Lines learn a trend from few runs, trees
    thresholds, a process hollows. A draw decides among 50 to 800 random candidates: the best of few looks about, that of many
    looks closer. While nothing was critical, and as far as chance alone would explain that inputs seem to order the runs, they
    decide among fewer, down to one, and half of the picks of `rate` are draws too: a line without a trend leads to a corner.
    Runs that failed have the worst score. No failure's neighbourhood is left out: its rate is to be learned, and
    is highest there. Where nothing was critical and noise explains no failure anywhere, four fifths of the picks fill space.

    Args:
        search: what is searched.
        seen: runs to learn from, and where to look.
        margin: (m,) of `seen`.
        n: points wanted >= 1.
        rng: the only source of randomness.
        known: (k, d) all runs, which picks that fill space keep away from.

    Source:
        Draws: Rubin (1981), The Bayesian bootstrap; choosing by the best of a draw: Thompson (1933).
    """
    u = np.vstack([seen.u, seen.failed])
    score = scores(np.concatenate([margin, np.full(len(seen.failed), np.inf)]))
    score = (score - score.mean()) / max(float(score.std()), 1e-12)
    best = u[np.argsort(score, kind="stable")[:_BEST]]
    candidates = _candidates(search, seen, best, rng)
    inputs, at = search.columns(u), search.columns(candidates)
    noisy = search.for_noise(seen.u, seen.y)
    process = fitted(noisy.metamodel, inputs, score, rng)
    model = fit_warped(noisy, seen.u, seen.y, rng, seen.success)
    nowhere = bool(model.log_probability(candidates, _INFLATION).max() < math.log(_HOPELESS))
    filled = round(_FILLING * n) if nowhere else 0
    doubt = min(by_chance(inputs, score, rng) / _CHANCE, 1.0) if seen.last_hit == -np.inf else 0.0
    most = round(_LARGEST * (1.0 - 0.5 * doubt) * (n - filled))
    largest = _largest(search, seen, model, best[seen.admissible(best)], most, rng)
    picks: list[int] = []
    for k in range(n - filled - len(largest)):
        size = round(float(np.exp((1.0 - doubt) * rng.uniform(*_LOG_AMONG))))
        among = rng.choice(len(at), min(size, len(at)), replace=False)
        points, kind = at[among], k % _KINDS
        if kind == 3:
            value = model.critical.margin(model.sample_paths(candidates[among], 1, rng))[0]
        elif kind == 2:
            value = sample_paths(process, points, 1, rng)[0]
        else:
            value = drawn_regression(inputs, score, points, rng, trees=kind == 1)
        picks.append(int(among[np.argmin(value)]))
    chosen = np.vstack([largest, candidates[np.array(picks, dtype=np.intp)]])
    room = seen.filling(search, rng)
    chosen = np.vstack([chosen, spread_out(room, np.vstack([known, chosen]), filled, rng, search.cube)])
    why = ("rate",) * len(largest) + ("drawn",) * len(picks) + ("fill",) * filled
    order = np.argsort(predicted(process, search.columns(chosen)).mu, kind="stable")
    return Picks(chosen[order], tuple(why[k] for k in order))


def _largest(search: Search, seen: SearchData, model: WarpedModel, best: Points, n: int, rng: np.random.Generator) -> Points:
    """Return up to n points (k, d) of the largest P(critical), apart from each other."""
    candidates, value = refine_best(model.log_probability, best, seen.admissible, rng, search.cube)
    at = search.cube.embedded(candidates)
    found: list[int] = []
    for _ in range(min(n, len(candidates))):
        found.append(int(np.argmax(value)))
        value = value + log_repulsion(at, at[found[-1:]], _CLEAR * math.sqrt(best.shape[1]))
    return candidates[found]


def _candidates(search: Search, seen: SearchData, best: Points, rng: np.random.Generator) -> Points:
    """Return admissible points: uniform ones, and steps from the best runs (k, d)."""
    d = best.shape[1]
    parents = np.repeat(best, _STEPS, axis=0)
    near = np.clip(parents + _STEP * rng.standard_normal(parents.shape), 0.0, 1.0)
    near = search.cube.flipped(near, parents, _STEP, rng)
    keep: Mask = seen.admissible(near)
    return np.vstack([fill_uniformly(seen.admissible, _UNIFORM, d, rng), near[keep]])
