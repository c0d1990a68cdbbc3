"""What every search for failures is built on: a metamodel of the warped metric, deflation, candidates.

The metamodel learns the warped metric, not the distance to the critical interval, which has a
kink. After a hit its basin is deflated: left out of the runs to learn from and of the candidates, so
that the next failure is a different one, and so that runs piled up in one basin do not decide which
inputs seem to matter elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from sbt.metamodels.base import Metamodel, Predictor, fitted, gives_different, named_errors, predicted, sample_paths
from sbt.metamodels.joint import metamodel_for
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.saturation import on_side
from sbt.metamodels.success import LogSuccess, learned_success
from sbt.metamodels.warp import JointWarp, Warp, warp_around
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.combination import MARGIN, CombinedInterval
from sbt.problem.cube import CONTINUOUS, Cube
from sbt.problem.requirement import CriticalInterval, as_reached
from sbt.samplers.free_region import FreeRegion
from sbt.samplers.noise import hidden_by_noise
from sbt.samplers.room import Room, fill_uniformly

__all__ = [
    "DEFLATION", "Picks", "Search", "SearchData", "WarpedModel", "deflate", "fit_warped", "log_repulsion", "refine_best",
    "search_data",
]  # fmt: skip

DEFLATION = 0.22
"""Half the side of the box around a critical run that the search leaves alone (unit cube); see docs/measured/falsification.md."""
_LEAST_FREE = 0.05  # of where runs are worth it that deflation must leave: below, too few uniform candidates are admissible
_FLANK = 0.15  # beyond a deflated box: runs there are near-critical for what is known already
_PROBES, _FEWEST_PROBES = 512, 100  # points of which those in the room tell the free share, to a few hundredths at least
_CANDIDATES = 1500  # uniform ones: a proposal of ten takes 0.06 s at 50 runs, 0.5 s at 500 (docs/measured/falsification.md)
_STEPS = (0.1, 0.03)  # standard deviations of the steps from the best candidates, in the unit cube, round by round
_BEST, _CHILDREN = 30, 10  # candidates that are refined in a round, steps from each
_MOVED = 0.3  # share of the coordinates that a step changes: others stay, which pays where few inputs matter
_PRIOR_RUNS = 2.0  # what the metamodel's P(critical) weighs beside repetitions of a run
_MOST_SEEDS, _CERTAIN, _DOUBTFUL = 0.5, 0.9, 0.3  # failure rates: deflated from, without repetition from, left alone below
_MOST_REPEATED, _MOST_EXCHANGED = 3, 60  # runs of the same inputs, after which their basin is left as it is; critical runs


@dataclass(frozen=True)
class Search:
    """What is searched, and with which metamodel.

    Args:
        critical: M_c, in the unit of y.
        metamodel: learns the warped y.
        columns: (n, d) unit-cube points to the metamodel's inputs (derived features).
        feasible: (n, d) unit-cube points to (n,) booleans.
        deflation: see `DEFLATION`.
        cube: which coordinates take single values: distances and steps know that choices have no order.
        most_rows: runs that the metamodel learns from at most: those nearest to M_c are a tenth, the others are drawn.
        learn_success: learns where runs give a metric.
    """

    critical: CriticalInterval
    metamodel: Metamodel
    columns: Callable[[Points], Points] = lambda u: u
    feasible: Callable[[Points], Mask] = lambda u: np.ones(len(u), dtype=bool)
    deflation: float = DEFLATION
    cube: Cube = CONTINUOUS
    most_rows: int = 4000
    learn_success: Callable[[Points, Mask, np.random.Generator], LogSuccess | None] = learned_success

    def reached(self, u: Points, y: Vector) -> tuple[Search, Vector]:
        """Return the search without an end of M_c that the metric ends at, and the metric with what stands for none on its side.

        Args:
            u: (n, d) all runs.
            y: (n,) their metric, NaN where one failed; see `as_reached`, `on_side`.
        """
        if self.critical.one_sided or isinstance(self.critical, CombinedInterval):
            return self, y
        known, y = np.isfinite(y), np.array(y, dtype=np.float64)
        y[known] = on_side(self.columns(u[known]), y[known], self.critical)
        return replace(self, critical=as_reached(self.critical, y)), y

    def margins(self, y: Vector) -> Vector:
        """Return (n,) distances of y (n,) to M_c, inf where a run failed."""
        return np.where(self.critical.known(y), self.critical.margin(y), np.inf)

    def for_noise(self, u: Points, y: Vector) -> Search:
        """Return the search whose metamodel expects much noise (its `for_noise`), where runs u (n, d), y (n,) show it."""
        noisy: Metamodel | None = getattr(self.metamodel, "for_noise", None)
        return replace(self, metamodel=noisy) if noisy is not None and hidden_by_noise(u, self.margins(y)) else self


@dataclass(frozen=True)
class Picks:
    """Points that were chosen.

    Args:
        u: (n, d) in the unit cube, the one of largest P(critical) first.
        why: (n,) by which criterion, such as `thompson` or `global`.
        repeat: critical runs to repeat with other seeds, beside these points, as numbers of rows.
        seeds: (n,) where they were chosen with the points; empty: they are drawn.
    """

    u: Points
    why: tuple[str, ...]
    repeat: tuple[int, ...] = ()
    seeds: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class WarpedModel:
    """A metamodel fitted to the warped metric.

    Args:
        predictor: of the warped metric, at the metamodel's inputs.
        columns: (n, d) unit-cube points to the metamodel's inputs.
        warp: from the metric to the warped metric, or from the metrics of a combination to its margin.
        critical: M_c, warped.
        metamodel: what was fitted; errors name it.
        n: rows it learned from.
        success: log P(a run gives a metric) at the metamodel's inputs; None: all runs did.
    """

    predictor: Predictor
    columns: Callable[[Points], Points]
    warp: Warp | JointWarp
    critical: CriticalInterval
    metamodel: Metamodel
    n: int
    success: LogSuccess | None = None

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of the warped metric at u (n, d)."""
        inputs = self.columns(u)
        with named_errors(self.metamodel, self.n):
            return predicted(self.predictor, inputs)

    def log_probability(self, u: Points, inflation: float = 1.0) -> Vector:
        """Return (n,) log P(a run gives a metric and is critical) at u, sigma multiplied by `inflation`."""
        return self(u).widened(inflation).log_probability(self.critical)[0] + self.log_success(u)

    def log_success(self, u: Points) -> Vector:
        """Return (n,) log P(a run gives a metric) at u."""
        return np.zeros(len(u)) if self.success is None else self.success(self.columns(u))

    def expected(self, scores: Points, u: Points) -> Points:
        """Return scores (..., n) at u, larger is better, in expectation: a run that fails counts as the worst of them."""
        if self.success is None:
            return scores
        worst = scores.min(axis=-1, keepdims=True)
        return np.asarray(worst + np.exp(self.log_success(u)) * (scores - worst))

    def probability(self, u: Points) -> Vector:
        """Return (n,) P(a run gives a metric and is critical) at u."""
        return np.exp(self.log_probability(u))

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the warped metric as a function, at u (m, d)."""
        inputs = self.columns(u)
        with named_errors(self.metamodel, self.n):
            return sample_paths(self.predictor, inputs, n, rng)


def fit_warped(search: Search, u: Points, y: Vector, rng: np.random.Generator, success: LogSuccess | None = None) -> WarpedModel:
    """Return the metamodel fitted to u (n, d) and the warped y (n,), finite, n >= 2; `success` is passed on."""
    warp = warp_around(y, search.critical)
    inputs, target = search.columns(u), warp.interval(search.critical)
    predictor = fitted(metamodel_for(search.metamodel, target), inputs, warp.learned(y), rng)
    critical = MARGIN if isinstance(target, CombinedInterval) else target
    return WarpedModel(predictor, search.columns, warp, critical, search.metamodel, len(y), success)


def deflate(
    search: Search, hits: Points, rng: np.random.Generator, dimension: int, room: Callable[[Points], Mask] | None = None
) -> FreeRegion:
    """Return what deflation leaves; the radius is halved until that is at least 5 % of the room, or of all that is feasible."""
    room, probe = room or search.feasible, rng.random((_PROBES, dimension))
    probe = probe[room(probe)]
    probe = probe if len(probe) >= _FEWEST_PROBES else fill_uniformly(room, _PROBES, dimension, rng)
    probe, hits = search.cube.embedded(probe), search.cube.embedded(hits)
    radius = search.deflation
    while radius > 1e-6 and FreeRegion.without(hits, radius)(probe).mean() < _LEAST_FREE:
        radius /= 2
    return FreeRegion.without(hits, radius)


@dataclass(frozen=True, eq=False)
class SearchData:
    """What is left to learn from, and where to look.

    Args:
        u, y, batch: (m, d), (m,), (m,) runs that neither failed nor lie in a deflated basin.
        flank: (m,) the run lies just outside of a deflated basin: near-critical for what is known already.
        admissible: where to look: feasible, not deflated, and a run there may well give a metric; where there is no such point
            the deflated ones, too, and last all that is feasible.
        failed, failed_batch: (k, d), (k,) runs that gave no metric.
        rows: (m,) which of the runs they are.
        noisy: equal inputs gave different metrics.
        last_hit: number of the batch of the last critical run; -inf: there is none.
        undecided: critical runs, as numbers of rows, whose repetition decides whether their basin is deflated; the most likely
            to fail again first.
        success: log P(a run gives a metric), as in `WarpedModel`.
    """

    u: Points
    y: Vector
    batch: Vector
    flank: Mask
    admissible: Room
    failed: Points
    failed_batch: Vector
    rows: NDArray[np.intp]
    noisy: bool = False
    last_hit: float = -np.inf
    undecided: tuple[int, ...] = ()
    success: LogSuccess | None = None

    def filling(self, search: Search, rng: np.random.Generator) -> Room:
        """Return where points fill space: each admissible one with P(a run there gives a metric)."""
        return self.admissible if self.success is None else _succeeding(search, self.success, self.admissible, rng)

    def thinned(self, margin: Vector, most: int, rng: np.random.Generator) -> SearchData:
        """Return the same with at most so many runs to learn from: a tenth of them of least margin (m,), the others drawn."""
        if len(self.u) <= most:
            return self
        order = np.argsort(margin, kind="stable")
        first = most // 10
        kept = np.sort(np.concatenate([order[:first], rng.permutation(order[first:])[: most - first]]))
        mine = {name: getattr(self, name)[kept] for name in ("u", "y", "batch", "flank", "rows")}
        return replace(self, **mine)

    def runs_since(self, margin: Vector) -> int:
        """Return the number of runs since the last critical one, and the last one that was better than all before (m,)."""
        better = self.batch[int(np.argmin(np.where(self.flank, np.inf, margin)))] if len(margin) else -np.inf
        return int((self.batch > max(float(better), self.last_hit)).sum())


def search_data(search: Search, u: Points, y: Vector, batch: Vector | None, rng: np.random.Generator) -> SearchData:
    """Return the runs and the space that deflation leaves.

    Args:
        search: what is searched.
        u: (m, d) finished runs in the unit cube, in order.
        y: (m,) their metric; NaN where a run failed.
        batch: (m,) number of the batch that each run came with; None: each run by itself.
        rng: the only source of randomness.
    """
    number = np.arange(len(u), dtype=np.float64) if batch is None else np.asarray(batch, dtype=np.float64)
    ok = search.critical.known(y)
    hit = ok & search.critical.contains(y)
    noisy = gives_different(u[ok], y[ok])
    last_hit = float(number[hit].max()) if hit.any() else -np.inf
    deflated: Mask = hit
    undecided: tuple[int, ...] = ()
    if noisy and hit.any():
        deflated, undecided = _decided(search, u, y, ok, hit, rng)
    success = search.learn_success(search.columns(u), ok, rng)

    def worth(points: Points) -> Mask:
        left = np.array(search.feasible(points), dtype=bool)
        if success is not None and left.any():  # it costs a prediction
            left[left] = np.isfinite(success(search.columns(points[left])))
        return left

    room = search.feasible if success is None else Room(worth, search.feasible)
    likely = None if success is None else _succeeding(search, success, search.feasible, rng)
    free = deflate(search, _in_other_choices(search, u, y, ok, deflated, rng), rng, u.shape[1], likely)
    at = search.cube.embedded
    left = ok & ~deflated & free(at(u))
    flank = ~free(at(u[left]), _FLANK)

    def admits(points: Points) -> Mask:
        left = np.array(free(at(points)), dtype=bool)
        if left.any():
            left[left] = room(points[left])
        return left

    return SearchData(
        u[left], y[left], number[left], flank, Room(admits, room), u[~ok], number[~ok], np.flatnonzero(left), noisy, last_hit,
        undecided, success,
    )  # fmt: skip


def _succeeding(
    search: Search, success: LogSuccess, room: Callable[[Points], Mask] | Room, rng: np.random.Generator
) -> Room:  # fmt: skip
    """Return where a random point of a room lies with P(a run there gives a metric)."""
    rng = rng.spawn(1)[0]  # how often it is asked changes nothing else

    def drawn(points: Points) -> Mask:
        left = np.array(room(points), dtype=bool)
        if left.any():
            left[left] = rng.random(int(left.sum())) < np.exp(success(search.columns(points[left])))
        return left

    return Room(drawn, room)


def _in_other_choices(search: Search, u: Points, y: Vector, ok: Mask, deflated: Mask, rng: np.random.Generator) -> Points:
    """Return the runs whose basin is deflated, and their points with other choices, where a basin was met with these too.

    A choice that changes nothing would otherwise show the whole of the same failure again with each of its values. Only where it
    is critical as surely as can be known, and beside a critical run: the first one with each choice tells whether it is the same.
    """
    centres, at = u[deflated], search.cube.embedded
    if not search.cube.nominal or len(centres) == 0:
        return centres
    model, met = fit_warped(search.for_noise(u, y), u[ok], y[ok], rng), FreeRegion.without(at(centres), search.deflation)
    others = search.cube.exchanged(centres[-_MOST_EXCHANGED:])
    others = others[~met(at(others))]
    return np.vstack([centres, others[model.probability(others) >= _CERTAIN] if len(others) else others])


def _decided(search: Search, u: Points, y: Vector, ok: Mask, hit: Mask, rng: np.random.Generator) -> tuple[Mask, tuple[int, ...]]:
    """Return (n,) the critical runs whose basin is deflated, and those of which a repetition decides.

    A basin is deflated where most seeds fail. The failure rate at a run's inputs is that of its repetitions, the first critical
    run aside (it was chosen by its result), shrunk to the metamodel's P(critical) with the weight of two runs. One that was not
    repeated needs P(critical) of at least 0.9.
    """
    model = fit_warped(search.for_noise(u, y), u[ok], y[ok], rng)
    prior = np.zeros(len(u))
    prior[hit] = model.probability(u[hit])
    group = np.unique(u, axis=0, return_inverse=True)[1].reshape(-1)
    runs, critical = (np.bincount(group, weights=mask)[group] for mask in (ok, hit))
    rate = (critical - 1.0 + _PRIOR_RUNS * prior) / (runs - 1.0 + _PRIOR_RUNS)
    deflated = hit & (rate >= np.where(runs > 1, _MOST_SEEDS, _CERTAIN))
    open_ = hit & ~deflated & (rate >= _DOUBTFUL) & (runs <= _MOST_REPEATED)
    rows = np.flatnonzero(open_)
    _, first = np.unique(group[rows], return_index=True)
    return deflated, tuple(int(k) for k in rows[first][np.argsort(-rate[rows[first]], kind="stable")])


def refine_best(
    score: Callable[[Points], Vector], start: Points, admissible: Callable[[Points], Mask], rng: np.random.Generator,
    cube: Cube = CONTINUOUS,
) -> tuple[Points, Vector]:  # fmt: skip
    """Return (m, d) candidates and (m,) scores: uniform ones, those of `start` (k, d), and steps from the best of them.

    The best are refined wherever they lie; `greedy.refine_diverse` spreads them.
    """
    d = start.shape[1]
    candidates = np.vstack([fill_uniformly(admissible, _CANDIDATES, d, rng), start])
    values = score(candidates)
    for scale in _STEPS:
        best = candidates[np.argsort(-values, kind="stable")[:_BEST]]
        parents = np.repeat(best, _CHILDREN, axis=0)
        moved = rng.random(parents.shape) < max(_MOVED, 1.0 / d)
        around = np.clip(parents + scale * rng.standard_normal(parents.shape) * moved, 0.0, 1.0)
        around = cube.flipped(around, parents, max(_MOVED, 1.0 / d), rng)
        around = around[admissible(around)]
        if len(around):
            candidates, values = np.vstack([candidates, around]), np.concatenate([values, score(around)])
    return candidates, values


def log_repulsion(u: Points, others: Points, radius: float) -> Vector:
    """Return (n,) log factors: -inf on one of the others, 0 from three radii on, or all that is left would be corners."""
    square = cdist(u, others, "sqeuclidean").min(axis=1) / radius**2
    with np.errstate(divide="ignore"):
        return np.where(square >= 9.0, 0.0, np.log(-np.expm1(-0.5 * square)))
