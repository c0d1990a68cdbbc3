"""Where to look for the next failure: several trust regions, global picks of P(critical), deflation.

Everything is a function of the runs so far: what a trust region has become is read from them each
time, nothing is remembered between batches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube
from sbt.samplers.search import Picks, Search, WarpedModel, fill_uniformly, fit_warped, log_repulsion, refine_best, search_data

__all__ = ["Region", "propose", "regions"]

_APART = 0.25  # of the best runs of two trust regions, Chebyshev distance: a little more than DEFLATION
_MOST_REGIONS = 3  # a batch of ten has two Thompson draws for each
_LONGEST, _SHORTEST = 0.8, 2.0**-6  # side of a trust region: TuRBO's first one; it is retired after six halvings
_PATIENCE = 3  # batches without an improvement before a trust region is halved; two were measured to be worse
_HOPELESS = 1e-4  # largest inflated P(critical) in a region that is given up, and below which all candidates are alike
_INFLATION = 2.0  # on sigma, where P(critical) decides what to look at: a fit to few runs is too sure; measured
_THOMPSON = 0.6  # share of the picks; 75 % and 30 % were measured, see docs/falsification.md
_LOCAL = 350  # candidates of a trust region: the cost of sample paths is cubic in them
_CLEAR = 0.05  # picks of one batch repel each other within this part of the cube's diagonal
_CLEAR_OF_RUNS = 0.2 * _CLEAR  # the metamodel knows what a finished run says of its neighbourhood


def propose(search: Search, u: Points, y: Vector, n: int, rng: np.random.Generator, batch: Vector | None = None) -> Picks:
    """Return n points where the next failure may be, away from the failures that are known.

    About 60 % are Thompson draws in up to three trust regions, the others are global picks of
    P(critical) that repel each other; where nothing promises anything, they fill the space. The caller
    adds a share of space-filling runs (about 10 %).

    Args:
        search: what is searched.
        u: (m, d) finished runs in the unit cube, in order.
        y: (m,) their metric; NaN where a run failed.
        n: points wanted >= 1.
        rng: the only source of randomness.
        batch: (m,) number of the batch that each run came with; None: each run by itself.

    Returns:
        The picks; random ones (`global`) where there are fewer than two runs to learn from.

    Source:
        Trust regions and Thompson draws: Eriksson et al. (2019), TuRBO, arXiv 1910.01739; the mixture
        and the deflation were measured, see docs/falsification.md.
    """
    seen, d = search_data(search, u, y, batch, rng), u.shape[1]
    if len(seen.u) < 2:
        return Picks(fill_uniformly(seen.admissible, n, d, rng), ("global",) * n)
    model = fit_warped(search, seen.u, seen.y, rng, seen.success)
    fresh = ~seen.flank
    found = regions(
        np.vstack([seen.u[fresh], seen.failed]),
        np.concatenate([search.critical.margin(seen.y[fresh]), np.full(len(seen.failed), np.inf)]),
        np.concatenate([seen.batch[fresh], seen.failed_batch]), search.cube,
    )  # fmt: skip
    niches = _hopeful(model, found, seen.admissible, rng, search.cube)
    drawn = _thompson(model, niches, round(_THOMPSON * n), d, rng)
    picks = _globally(model, drawn, n, u, niches, seen.admissible, rng, search.cube)
    why = ("thompson",) * len(drawn) + ("global",) * (n - len(drawn))
    order = np.argsort(-model.log_probability(picks), kind="stable")
    return Picks(picks[order], tuple(why[k] for k in order))


@dataclass(frozen=True, eq=False)
class Region:
    """A trust region: a box around the best run of its neighbourhood.

    Args:
        centre: (d,) the run.
        side: of the box.
        failures: batches in it since the last improvement.
    """

    centre: Vector
    side: float
    failures: int = 0

    def candidates(self, n: int, rng: np.random.Generator, cube: Cube = CONTINUOUS) -> Points:
        """Return (n, d) points of the box, of the cube too; at most about 20 coordinates are moved.

        Another choice is as likely as the candidate's step is long, so that a small box keeps to the choices of its centre.
        """
        d = len(self.centre)
        moved = rng.random((n, d)) < min(1.0, 20.0 / d)
        moved[np.arange(n), rng.integers(0, d, n)] = True
        reach = 0.5 * self.side * 2.0 ** (-3.0 * rng.random((n, 1)))
        step = reach * rng.uniform(-1.0, 1.0, (n, d))
        start = np.tile(self.centre, (n, 1))
        return cube.flipped(np.clip(start + np.where(moved, step, 0.0), 0.0, 1.0), start, reach[:, 0], rng)


def regions(u: Points, margin: Vector, batch: Vector, cube: Cube = CONTINUOUS) -> list[Region]:
    """Return the trust regions around the best runs, at least 0.25 apart or of different choices, the best first.

    The side is replayed from the runs near the centre: halved after three batches without an
    improvement, doubled after two with one; a side below 2^-6 retires the region.

    Args:
        u: (n, d) runs, none of them critical.
        margin: (n,) distance of the metric to the critical interval; inf where a run failed: it found no region, but tried.
        batch: (n,) number of the batch of each run, increasing.
        cube: which coordinates take single values.
    """
    found: list[Region] = []
    at = cube.embedded(u)
    finite = np.isfinite(margin)
    left = margin < (np.median(margin[finite]) if finite.any() else -np.inf)  # on a plateau no run is better than the others
    while left.any() and len(found) < _MOST_REGIONS:
        best = int(np.flatnonzero(left)[np.argmin(margin[left])])
        near = np.abs(at - at[best]).max(axis=1) <= _APART
        side, failures = _side(at[near], margin[near], batch[near])
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


def _hopeful(
    model: WarpedModel, found: list[Region], admissible: Callable[[Points], Mask], rng: np.random.Generator, cube: Cube
) -> list[tuple[Region, Points]]:
    """Return the regions in which a critical run may be, each with its candidates."""
    hopeful = []
    for region in found:
        points = region.candidates(_LOCAL, rng, cube)
        points = points[admissible(points)]
        if len(points) == 0:
            continue
        tried = region.failures >= _PATIENCE
        if not tried or model.log_probability(points, _INFLATION).max() >= np.log(_HOPELESS):
            hopeful.append((region, points))
    return hopeful


def _thompson(model: WarpedModel, niches: list[tuple[Region, Points]], n: int, d: int, rng: np.random.Generator) -> Points:
    """Return n points, each the best of a sample path over the candidates of a region; none without regions.

    Every second one is from the region whose path is best, the others from each region in turn.
    """
    if not niches:
        return np.empty((0, d))
    drawn = [
        -model.expected(-model.critical.margin(model.sample_paths(points, n, rng)), points) for _, points in niches
    ]
    picks = np.empty((n, d))
    for k in range(n):
        which = (k // 2) % len(niches) if k % 2 else int(np.argmin([values[k].min() for values in drawn]))
        at = int(np.argmin(drawn[which][k]))
        picks[k] = niches[which][1][at]
        drawn[which][:, at] = np.inf  # no point twice
    return picks


def _globally(
    model: WarpedModel, picks: Points, n: int, u: Points, niches: list[tuple[Region, Points]],
    admissible: Callable[[Points], Mask], rng: np.random.Generator, cube: Cube,
) -> Points:  # fmt: skip
    """Return the picks and further ones, n in all: the largest P(critical), every second time inflated.

    Below `_HOPELESS` all candidates are alike, and what repels them alone decides.
    """
    d = u.shape[1]
    start = np.vstack([np.empty((0, d)), *(points for _, points in niches)])
    candidates, wide = refine_best(lambda v: model.log_probability(v, _INFLATION), start, admissible, rng, cube)
    scores = [np.maximum(values, np.log(_HOPELESS)) for values in (model.log_probability(candidates), wide)]
    at_candidates = cube.embedded(candidates)
    away = log_repulsion(at_candidates, cube.embedded(u), _CLEAR_OF_RUNS * np.sqrt(d))
    for point in cube.embedded(picks):
        away += log_repulsion(at_candidates, point[None], _CLEAR * np.sqrt(d))
    for k in range(n - len(picks)):
        at = int(np.argmax(scores[k % 2] + away))
        picks = np.vstack([picks, candidates[at]])
        away += log_repulsion(at_candidates, at_candidates[at][None], _CLEAR * np.sqrt(d))
    return picks
