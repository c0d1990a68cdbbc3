"""Where to look for the next failure: trust regions, niches, global picks of P(critical), filling, deflation.

Everything is a function of the runs so far: what a trust region has become is read from them each
time, nothing is remembered between batches.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import Cube
from sbt.samplers.drawn import propose_in_noise
from sbt.samplers.noise import hidden_by_noise, more_repeats
from sbt.samplers.plateaus import beneath_plateaus, plateau
from sbt.samplers.regions import PATIENCE, Region, clusters, niches, regions
from sbt.samplers.room import Room, fill_uniformly, spread_out
from sbt.samplers.search import (
    Picks,
    Search,
    SearchData,
    WarpedModel,
    fit_warped,
    log_repulsion,
    refine_best,
    search_data,
)  # fmt: skip

__all__ = ["Region", "propose", "regions"]

_BENEATH = 0.55  # share of the picks that look beneath a plateau, where there is one
_PATIENT, _HALVED = 30, 30  # guided runs on it without a new failure, from which on the share falls, by half after so many more
_HOPELESS = 1e-4  # largest inflated P(critical) in a region that is given up, and below which all candidates are alike
_INFLATION = 2.0  # on sigma, where P(critical) decides what to look at: a fit to few runs is too sure; measured
_THOMPSON = 0.6  # share of the picks; 75 % and 30 % were measured, see docs/measured/falsification.md
_STAGNANT = 60  # runs without a better one or a new failure, after which the Thompson draws give way to filling:
_THOMPSON_LATE, _FILLING_LATE = 0.2, 0.4  # shares of the picks from then on
_REPEATED = 0.1  # of the picks, rounded up: repetitions of critical runs of a noisy simulator
_LOCAL = 350  # candidates of a trust region: the cost of sample paths is cubic in them
_IN_NICHE, _IN_NICHE_DRAWN = 3, 200  # picks in a niche, the first of them the best of a sample path; its candidates
_FEWEST_FOR_NICHES = 20  # runs: with fewer the metamodel expects nothing
_CLEAR = 0.05  # picks of one batch repel each other within this part of the cube's diagonal
_CLEAR_OF_RUNS = 0.2 * _CLEAR  # the metamodel knows what a finished run says of its neighbourhood


def propose(
    search: Search, u: Points, y: Vector, n: int, rng: np.random.Generator, batch: Vector | None = None,
    filling: Mask | None = None, *, repeats: bool = False, pending: Points | None = None, around_floors: bool = False,
) -> Picks:  # fmt: skip
    """Return n points where the next failure may be, away from the failures that are known.

    About 60 % are Thompson draws in up to three trust regions, the others are global picks of
    P(critical) that repel each other; where nothing promises anything, they fill the space. Runs that lie far below what
    the metamodel expects without them get a few picks about them (niches). Where many runs share the best uncritical value,
    half of the picks look beneath that plateau, instead of Thompson draws. After 60 runs without a better one two fifths of
    the picks fill space instead of two thirds of the Thompson draws. The caller adds a share of space-filling runs (about 10 %).

    Args:
        search: what is searched.
        u: (m, d) finished runs in the unit cube, in order.
        y: (m,) their metric; NaN where a run failed.
        n: points wanted >= 1.
        rng: the only source of randomness.
        batch: (m,) number of the batch that each run came with; None: each run by itself.
        filling: (m,) the run fills space, whatever the results; None: all do.
        pending: (k, d) runs in flight: further picks keep away from them as from those of their own batch; Thompson draws are
            independent of them.
        around_floors: beside a plateau some picks look at its slopes, half of the global picks fill space instead, and no run on
            it founds a niche: for campaigns that look for all regions, and whose other picks do not fill space.
        repeats: where the simulator is noisy, up to a tenth of the n are repetitions that decide whether a basin is deflated.

    Returns:
        The picks; random ones (`global`) where there are fewer than two runs to learn from.

    Source:
        Trust regions and Thompson draws: Eriksson et al. (2019), TuRBO, arXiv 1910.01739; the mixture, the niches
        and the deflation were measured, see docs/measured/falsification.md.
    """
    d = u.shape[1]
    search, y = search.reached(u, y)
    seen = search_data(search, u, y, batch, rng)
    again = _repeats(search, seen, u, y, n) if repeats else ()
    n -= len(again)
    if len(seen.u) < 2:
        return Picks(fill_uniformly(seen.filling(search, rng), n, d, rng), ("global",) * n, again)
    if repeats and seen.noisy and hidden_by_noise(u, search.margins(y)):
        return replace(propose_in_noise(search, seen, search.critical.margin(seen.y), n, rng, u), repeat=again)
    seen = seen.thinned(search.critical.margin(seen.y), search.most_rows, rng)
    model = fit_warped(search, seen.u, seen.y, rng, seen.success)
    margin = search.critical.margin(seen.y) if not seen.noisy else model.critical.margin(model(seen.u).mu)
    fresh, fills = ~seen.flank, np.ones(len(u), dtype=bool) if filling is None else filling
    found = regions(
        np.vstack([seen.u[fresh], seen.failed]), np.concatenate([margin[fresh], np.full(len(seen.failed), np.inf)]),
        np.concatenate([seen.batch[fresh], seen.failed_batch]), search.cube,
        np.concatenate([fills[seen.rows][fresh], np.zeros(len(seen.failed), dtype=bool)]), minima=not seen.noisy,
    )  # fmt: skip
    hopeful = _hopeful(model, found, seen, rng, search.cube)
    stagnant = not seen.noisy and seen.runs_since(margin) >= _STAGNANT  # noise hides what is better
    pending = np.empty((0, d)) if pending is None else pending
    floor = plateau(search.margins(y), u)
    beneath = _share_beneath(search.margins(y), floor if filling is None else floor & ~filling)
    under = beneath_plateaus(search, seen, u, y, round(beneath * n), rng, pending, beside=around_floors)
    flat = floor[seen.rows] & around_floors
    small = _in_niches(model, seen, flat, margin, [region for region, _ in hopeful], n - max(2, len(under)), rng, search.cube)
    filled = round(_FILLING_LATE * (n - len(small))) if stagnant else 0
    if around_floors and len(under):  # P(critical) is alike all over a plateau
        filled = max(filled, (n - len(small) - len(under)) // 2)
    if floor.any():  # what the share has lost fills space
        filled = max(filled, round(_BENEATH * n) - round(beneath * n))
    filled = min(filled, n - len(small) - len(under))
    thompson = min(round((_THOMPSON_LATE if stagnant else _THOMPSON) * n), n - len(small) - filled)
    thompson = thompson if len(small) == 0 else min(thompson, (n - len(small)) // 2)
    room, drawn = seen.filling(search, rng), _thompson(model, hopeful, max(thompson - len(under), 0), d, rng)
    picks = np.vstack([drawn, small, under])
    picks = np.vstack([picks, spread_out(room, np.vstack([u, pending, picks]), filled, rng, search.cube)])
    why = ("thompson",) * len(drawn) + ("niche",) * len(small) + ("beneath",) * len(under) + ("fill",) * filled
    why += ("global",) * (n - len(picks))
    picks = _globally(model, picks, n, u, pending, hopeful, seen.admissible, room, rng, search.cube)
    order = np.argsort(-model.log_probability(picks), kind="stable")
    return Picks(picks[order], tuple(why[k] for k in order), again)


def _share_beneath(margin: Vector, on_floor: Mask) -> float:
    """Return the share of the picks that look beneath a plateau, by how many runs on it (n,) came since the newest failure."""
    hits = np.flatnonzero(margin <= 0)
    fruitless = int(on_floor[hits[-1] if len(hits) else 0 :].sum())
    return float(_BENEATH * 0.5 ** (max(fruitless - _PATIENT, 0) / _HALVED))


def _repeats(search: Search, seen: SearchData, u: Points, y: Vector, n: int) -> tuple[int, ...]:
    """Return up to a tenth of n runs to repeat, and those that tell how large the noise is; of a deterministic simulator none."""
    if not seen.noisy or n < 2:
        return ()
    first = more_repeats(u, search.margins(y))
    return tuple(dict.fromkeys([*first, *seen.undecided[: math.ceil(_REPEATED * n)]]))[: n - 1]


def _in_niches(
    model: WarpedModel, seen: SearchData, flat: Mask, margin: Vector, others: list[Region], most: int, rng: np.random.Generator,
    cube: Cube,
) -> Points:  # fmt: skip
    """Return up to `most` points in the niches: in each the best of a sample path, and random ones; a `flat` run has none."""
    d, left_out, learned = seen.u.shape[1], getattr(model.predictor, "left_out", None), getattr(model.predictor, "u", ())
    picks = np.empty((0, d))
    kept = np.sort(np.unique(model.columns(seen.u), axis=0, return_index=True)[1])  # equal runs are learned from once
    if left_out is None or seen.noisy or len(kept) < _FEWEST_FOR_NICHES or len(learned) != len(kept):
        return picks
    u, margin, flank, warped = seen.u[kept], margin[kept], (seen.flank | flat)[kept], model.warp.values(seen.y[kept])
    lone = clusters(u, margin, cube)
    surprise = np.zeros(len(u))
    for (k, rows), (residual, std) in zip(lone, left_out([rows for _, rows in lone]), strict=True):
        at = rows.index(k)
        gain = model.critical.margin(warped[[k]] - residual[[at]]) - model.critical.margin(warped[[k]])
        surprise[k] = 0.0 if flank[k] else float(gain[0]) / std[at]
    for region in niches(surprise, u, margin, seen.batch[kept], others, cube):
        points = region.candidates(_IN_NICHE_DRAWN, rng, cube)
        points = points[seen.admissible(points)]
        if len(points) < _IN_NICHE or len(picks) + _IN_NICHE > most:
            continue
        path = model.critical.margin(model.sample_paths(points, 1, rng))[0]
        rest = rng.choice(len(points), _IN_NICHE - 1, replace=False)
        picks = np.vstack([picks, points[[int(np.argmin(path))]], points[rest]])
    return picks


def _hopeful(
    model: WarpedModel, found: list[Region], seen: SearchData, rng: np.random.Generator, cube: Cube
) -> list[tuple[Region, Points]]:
    """Return the regions in which a critical run may be, each with its candidates.

    A deterministic metric is followed a while whatever P(critical) is, since the slope may get steeper than few runs tell; of a
    noisy one the noise is known.
    """
    hopeful = []
    for region in found:
        points = region.candidates(_LOCAL, rng, cube)
        points = points[seen.admissible(points)]
        if len(points) == 0:
            continue
        tried = seen.noisy or region.failures >= PATIENCE
        if not tried or model.log_probability(points, _INFLATION).max() >= np.log(_HOPELESS):
            hopeful.append((region, points))
    return hopeful


def _thompson(model: WarpedModel, niches: list[tuple[Region, Points]], n: int, d: int, rng: np.random.Generator) -> Points:
    """Return n points, each the best of a sample path over the candidates of a region; none without regions.

    Every second one is from the region whose path is best, the others from each region in turn.
    """
    if not niches:
        return np.empty((0, d))
    drawn = [-model.expected(-model.critical.margin(model.sample_paths(points, n, rng)), points) for _, points in niches]
    picks = np.empty((n, d))
    for k in range(n):
        which = (k // 2) % len(niches) if k % 2 else int(np.argmin([values[k].min() for values in drawn]))
        at = int(np.argmin(drawn[which][k]))
        picks[k] = niches[which][1][at]
        drawn[which][:, at] = np.inf  # no point twice
    return picks


def _globally(
    model: WarpedModel, picks: Points, n: int, u: Points, pending: Points, niches: list[tuple[Region, Points]],
    admissible: Room, filling: Room, rng: np.random.Generator, cube: Cube,
) -> Points:  # fmt: skip
    """Return the picks and further ones, n in all: the largest P(critical), every second time inflated.

    Where the best is below `_HOPELESS` all candidates are alike, and the pick fills space.
    """
    d = u.shape[1]
    start = np.vstack([np.empty((0, d)), *(points for _, points in niches)])
    candidates, wide = refine_best(lambda v: model.log_probability(v, _INFLATION), start, admissible, rng, cube)
    scores = [np.maximum(values, np.log(_HOPELESS)) for values in (model.log_probability(candidates), wide)]
    at_candidates = cube.embedded(candidates)
    away = log_repulsion(at_candidates, cube.embedded(u), _CLEAR_OF_RUNS * np.sqrt(d))
    for point in cube.embedded(np.vstack([pending, picks])):
        away += log_repulsion(at_candidates, point[None], _CLEAR * np.sqrt(d))
    for k in range(n - len(picks)):
        at = int(np.argmax(scores[k % 2] + away))
        if scores[k % 2][at] <= np.log(_HOPELESS):
            picks = np.vstack([picks, spread_out(filling, np.vstack([u, pending, picks]), 1, rng, cube)])
            continue
        picks = np.vstack([picks, candidates[at]])
        away += log_repulsion(at_candidates, at_candidates[at][None], _CLEAR * np.sqrt(d))
    return picks
