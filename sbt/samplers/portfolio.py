"""Where to look for the next failure: several trust regions, global picks of P(critical), deflation.

Everything is a function of the runs so far: what a trust region has become is read from them each
time, nothing is remembered between batches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sbt.arrays import Mask, Points, Vector
from sbt.metamodels.base import Metamodel, Predictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.requirement import CriticalInterval

__all__ = ["DEFLATION", "Belief", "Picks", "Region", "Search", "believe", "deflated", "propose", "regions"]

DEFLATION = 0.22
"""Half the side of the box about a critical run that the search leaves alone (unit cube)."""
_APART = 0.25  # of the best runs of two trust regions, Chebyshev distance
_MOST_REGIONS = 3
_LONGEST, _SHORTEST = 0.8, 2.0**-6  # side of a trust region
_PATIENCE = 3  # batches without an improvement before a trust region is halved
_HOPELESS = 1e-4  # largest inflated P(critical) in a region that is given up
_INFLATION = 2.0  # on sigma, where P(critical) decides what to look at: a belief from few runs is too sure
_THOMPSON = 0.53  # share of the guided picks: 45 of 85 %
_GLOBAL, _LOCAL = 1500, 350  # candidates
_FEWEST_FREE = 0.05  # of the cube that deflation must leave
_CLEAR = 0.05  # picks of one batch repel each other within this part of the cube's diagonal


@dataclass(frozen=True)
class Search:
    """What is searched, and with what belief.

    Args:
        critical: M_c, in the unit of y.
        metamodel: learns the warped y.
        columns: (n, d) unit-cube points to the metamodel's inputs (derived features).
        feasible: (n, d) unit-cube points to (n,) booleans.
        deflation: see `DEFLATION`.
    """

    critical: CriticalInterval
    metamodel: Metamodel
    columns: Callable[[Points], Points] = lambda u: u
    feasible: Callable[[Points], Mask] = lambda u: np.ones(len(u), dtype=bool)
    deflation: float = DEFLATION


@dataclass(frozen=True)
class Picks:
    """Points that were chosen.

    Args:
        u: (n, d) in the unit cube, the one of largest P(critical) first.
        why: (n,) `thompson` or `global`.
    """

    u: Points
    why: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Belief:
    """A metamodel of the warped metric."""

    predictor: Predictor
    columns: Callable[[Points], Points]
    warp: Warp
    critical: CriticalInterval  # warped

    def __call__(self, u: Points) -> Prediction:
        """Return the belief about the warped metric at u (n, d)."""
        return self.predictor(self.columns(u))

    def log_probability(self, u: Points, inflation: float = 1.0) -> Vector:
        """Return (n,) log P(critical) at u, sigma multiplied by `inflation`."""
        p = self(u)
        wide = Prediction(p.mean, inflation * p.std, p.weight, p.noise)
        return wide.log_probability(self.critical)[0]

    def probability(self, u: Points) -> Vector:
        """Return (n,) P(critical) at u."""
        return np.exp(self.log_probability(u))

    def draws(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the warped metric as a function, at u (m, d).

        A process draws functions; of a mixture one component stands for a function; a single Gaussian a
        point is drawn point by point.
        """
        joint: Any = getattr(self.predictor, "draws", None)
        if joint is not None:
            return joint(self.columns(u), n, rng)
        p = self(u)
        component = rng.choice(len(p.weight), n, p=p.weight)
        if len(p.weight) >= 5:
            return p.mean[component]
        return p.mean[component] + p.std[component] * rng.standard_normal((n, len(u)))


def believe(search: Search, u: Points, y: Vector, rng: np.random.Generator) -> Belief:
    """Return the belief learned from u (n, d) and finite y (n,), n >= 2."""
    warp = Warp.about(y, search.critical)
    predictor = search.metamodel.fit(search.columns(u), warp.values(y), rng)
    return Belief(predictor, search.columns, warp, warp.interval(search.critical))


@dataclass(frozen=True, eq=False)
class Free:
    """The part of the cube that is not deflated.

    Args:
        hits: (k, d) critical runs.
        radius: half the side of the box that each takes away.
    """

    hits: Points
    radius: float

    def __call__(self, u: Points) -> Mask:
        """Return (n,) booleans: u is in no box."""
        if len(self.hits) == 0:
            return np.ones(len(u), dtype=bool)
        return np.asarray(cdist(u, self.hits, "chebyshev").min(axis=1) > self.radius)


def deflated(search: Search, hits: Points, rng: np.random.Generator, dimension: int) -> Free:
    """Return what deflation leaves; the radius is halved until that is at least 5 % of the space."""
    probe = rng.random((512, dimension))
    probe = probe[search.feasible(probe)] if search.feasible(probe).any() else probe
    radius = search.deflation
    while radius > 1e-6 and Free(hits, radius)(probe).mean() < _FEWEST_FREE:
        radius /= 2
    return Free(hits, radius)


@dataclass(frozen=True, eq=False)
class Region:
    """A trust region: a box about the best run of its neighbourhood.

    Args:
        centre: (d,) the run.
        side: of the box.
        failures: batches in it since the last improvement.
    """

    centre: Vector
    side: float
    failures: int = 0

    @cached_property
    def dimension(self) -> int:
        """Number of inputs."""
        return len(self.centre)

    def candidates(self, n: int, rng: np.random.Generator) -> Points:
        """Return (n, d) points of the box, of the cube too; at most about 20 coordinates are moved."""
        d = self.dimension
        moved = rng.random((n, d)) < min(1.0, 20.0 / d)
        moved[np.arange(n), rng.integers(0, d, n)] = True
        reach = 0.5 * self.side * 2.0 ** (-3.0 * rng.random((n, 1)))
        step = reach * rng.uniform(-1.0, 1.0, (n, d))
        return np.clip(self.centre + np.where(moved, step, 0.0), 0.0, 1.0)


def regions(u: Points, margin: Vector, batch: Vector) -> list[Region]:
    """Return the trust regions about the best runs, at least 0.25 apart, the best first.

    The side is replayed from the runs near the centre: halved after three batches without an
    improvement, doubled after two with one; a side below 2^-6 retires the region.

    Args:
        u: (n, d) runs, none of them critical.
        margin: (n,) distance of the metric to the critical interval.
        batch: (n,) number of the batch of each run, increasing.
    """
    found: list[Region] = []
    left = margin < np.median(margin)  # on a plateau no run is better than the others
    while left.any() and len(found) < _MOST_REGIONS:
        best = int(np.flatnonzero(left)[np.argmin(margin[left])])
        near = np.abs(u - u[best]).max(axis=1) <= _APART
        side, failures = _side(u[near], margin[near], batch[near])
        if side >= _SHORTEST:
            found.append(Region(u[best], side, failures))
        left &= ~near
    return found


def _side(u: Points, margin: Vector, batch: Vector) -> tuple[float, int]:
    """Return side and failures of a trust region from the runs of its neighbourhood, in order."""
    side, best, failures, successes = _LONGEST, -1, 0, 0
    for number in np.unique(batch):
        mine = np.flatnonzero(batch == number)
        leader = int(mine[np.argmin(margin[mine])])
        if best < 0:
            best = leader
            continue
        if margin[leader] < margin[best]:
            best, successes, failures = leader, successes + 1, 0
            side = min(2 * side, _LONGEST) if successes >= 2 else side
        elif (np.abs(u[mine] - u[best]).max(axis=1) <= 0.5 * side).any():
            failures, successes = failures + 1, 0
            side = side / 2 if failures % _PATIENCE == 0 else side
    return side, failures


def propose(
    search: Search, u: Points, y: Vector, n: int, rng: np.random.Generator, batch: Vector | None = None
) -> Picks:
    """Return n points where the next failure may be, away from the failures that are known.

    About half are Thompson draws in up to three trust regions, the others are global picks of
    P(critical) that repel each other. The caller adds a share of space-filling runs (about 10 %).

    Args:
        search: what is searched.
        u: (m, d) finished runs in the unit cube, in order.
        y: (m,) their metric; NaN where a run failed.
        n: points wanted >= 1.
        rng: the only source of randomness.
        batch: (m,) number of the batch that each run came with; None: each run by itself.

    Returns:
        The picks; random points (`global`) where there are fewer than two runs to learn from.

    Source:
        Trust regions and Thompson draws: Eriksson et al. (2019), TuRBO, arXiv 1910.01739; the mixture
        and the deflation were measured, see docs/falsification.md.
    """
    d = u.shape[1]
    number = np.arange(len(u)) if batch is None else np.asarray(batch)
    ok = np.isfinite(y)
    hit = ok & search.critical.contains(y)
    free = deflated(search, u[hit], rng, d)
    admissible = lambda points: search.feasible(points) & free(points)  # noqa: E731
    known = ok & ~hit & free(u)
    if known.sum() < 2:
        spread = _fill(admissible, n, d, rng)
        return Picks(spread, ("global",) * len(spread))
    belief = believe(search, u[known], y[known], rng)
    niches = _hopeful(belief, regions(u[known], search.critical.margin(y[known]), number[known]), admissible, rng)
    wanted = int(round(_THOMPSON * n)) if niches else 0
    picks = _thompson(belief, niches, wanted, admissible, rng)
    picks = _globally(belief, picks, n, u, niches, admissible, rng)
    why = ["thompson"] * min(wanted, len(picks)) + ["global"] * max(0, len(picks) - wanted)
    order = np.argsort(-belief.log_probability(picks), kind="stable")
    return Picks(picks[order], tuple(why[k] for k in order))


def _fill(admissible: Callable[[Points], Mask], n: int, d: int, rng: np.random.Generator) -> Points:
    """Return (n, d) uniform admissible points; fewer only where 10,000 tries find none."""
    kept = np.empty((0, d))
    for _ in range(100):
        u = rng.random((max(100, n), d))
        kept = np.vstack([kept, u[admissible(u)]])
        if len(kept) >= n:
            break
    missing = n - len(kept)
    return np.vstack([kept, rng.random((missing, d))]) if missing > 0 else kept[:n]


def _hopeful(
    belief: Belief, found: list[Region], admissible: Callable[[Points], Mask], rng: np.random.Generator
) -> list[tuple[Region, Points]]:
    """Return the regions in which a critical run may be, each with its candidates."""
    kept = []
    for region in found:
        candidates = region.candidates(_LOCAL, rng)
        candidates = candidates[admissible(candidates)]
        tried = region.failures >= _PATIENCE
        if len(candidates) and not (tried and belief.log_probability(candidates, _INFLATION).max() < np.log(_HOPELESS)):
            kept.append((region, candidates))
    return kept


def _thompson(
    belief: Belief, niches: list[tuple[Region, Points]], n: int, admissible: Callable[[Points], Mask], rng: np.random.Generator
) -> Points:
    """Return n points, each the best of a function drawn over the candidates of one region."""
    picks: list[Vector] = []
    if not niches or n < 1:
        return np.empty((0, niches[0][1].shape[1])) if niches else np.empty((0, 0))
    drawn = [belief.critical.margin(belief.draws(points, n, rng)) for _, points in niches]
    for k in range(n):
        if k % 2 == 0:  # the region whose draw is best
            which = int(np.argmin([values[k].min() for values in drawn]))
        else:  # each in turn
            which = (k // 2) % len(niches)
        at = int(np.argmin(drawn[which][k]))
        picks.append(niches[which][1][at])
        for values in drawn[which : which + 1]:
            values[:, at] = np.inf  # no point twice
    return np.array(picks)


def _globally(
    belief: Belief, picks: Points, n: int, u: Points, niches: list[tuple[Region, Points]],
    admissible: Callable[[Points], Mask], rng: np.random.Generator,
) -> Points:  # fmt: skip
    """Return the picks and further ones, n in all: the largest inflated P(critical) in the free space."""
    d = u.shape[1]
    candidates = np.vstack([_fill(admissible, _GLOBAL, d, rng), *(points for _, points in niches)])
    for scale in (0.1, 0.03):
        score = belief.log_probability(candidates, _INFLATION)
        best = candidates[np.argsort(-score, kind="stable")[:30]]
        around = np.repeat(best, 10, axis=0)
        moved = rng.random(around.shape) < max(0.3, 1.0 / d)
        around = np.clip(around + scale * rng.standard_normal(around.shape) * moved, 0.0, 1.0)
        candidates = np.vstack([candidates, around[admissible(around)]])
    scores = [np.maximum(belief.log_probability(candidates, wide), np.log(_HOPELESS)) for wide in (1.0, _INFLATION)]
    away = _repelled(candidates, u, 0.2 * _CLEAR * np.sqrt(d))
    chosen = picks.reshape(-1, d)
    for point in chosen:
        away += _repelled(candidates, point[None], _CLEAR * np.sqrt(d))
    for k in range(n - len(chosen)):
        at = int(np.argmax(scores[k % 2] + away))
        chosen = np.vstack([chosen, candidates[at]])
        away += _repelled(candidates, candidates[at][None], _CLEAR * np.sqrt(d))
    return chosen


def _repelled(u: Points, others: Points, radius: float) -> Vector:
    """Return (n,) log factors: 0 far from the others, -inf on one of them."""
    square = cdist(u, others, "sqeuclidean").min(axis=1)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(-np.expm1(-0.5 * square / radius**2)))
