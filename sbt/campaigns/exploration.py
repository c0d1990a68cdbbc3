"""Exploration in a boundary campaign: the search for regions of critical runs that are easily missed, because they are small.

A metamodel that knows one small region is uncertain at its border only. A part of each batch searches
elsewhere, as a falsification does, until enough exploratory runs have found no new region.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from sbt.campaigns.records import BatchProposal
from sbt.campaigns.settings import Settings
from sbt.estimators.binomial import interval
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Log
from sbt.metamodels.base import simplest
from sbt.problem.arrays import Mask, Points
from sbt.samplers.free_region import FreeRegion
from sbt.samplers.plateaus import plateau
from sbt.samplers.portfolio import propose
from sbt.samplers.search import DEFLATION, Search
from sbt.seeds import stream
from sbt.store.history import VALIDATION, History

__all__ = [
    "about_regions", "exploration_share", "explore", "fruitless_runs", "largest_batch", "search_of", "should_explore",
    "space_filling",
]  # fmt: skip

_SHARE = 0.5  # of a batch that explores
_RUNS_ABOUT, _REACH = 8, 0.15  # beside plateaus: runs an input about each known region, and their distance to its critical runs
_FEWEST_IN_BATCH, _BATCHES = 10, 30  # beside a plateau: runs of a batch at least, and into how many the budget is split at most
_RARE = 0.01  # critical share of the space below which a region is easily missed
_MOST_ROWS = 1000  # that the search learns from: it looks for regions, not for their edges, and costs the square of them
_PATIENCE, _PATIENCE_HIDDEN = 0.2, 0.4  # of the budget: exploratory runs without a new region that end the exploration


def should_explore(settings: Settings, fitted: FittedMetamodel, log: Log) -> bool:
    """Return whether the next batch explores: critical runs seem rare, and the exploration still finds new regions.

    Rare: at most 1 % of the runs that fill the space were critical, or the mean P(critical) is below 1 % and they do not
    deny it. A metamodel of few runs may take ten times too much of the space to be critical; the runs know. Exploration ends
    when runs worth 20 % of the budget have found no new region. Recorded tables are never explored.
    """
    if settings.scenario.pool is not None:
        return False
    n, hits = _filling_hits(settings, log)
    believed = fitted.record.critical_fraction < _RARE and float(interval(hits, n)[0]) <= _RARE
    return (hits <= _RARE * n or believed) and not _in_vain(settings, log)


def _filling_hits(settings: Settings, log: Log) -> tuple[int, int]:
    """Return how many runs that fill the space gave a metric, and how many of them were critical."""
    runs = log.history.where(space_filling(log))
    return int(runs.ok.sum()), int(settings.scenario.requirement.critical_runs(runs).sum())


def _in_vain(settings: Settings, log: Log) -> bool:
    """Return whether exploratory runs worth 20 % of the budget found no new region; 40 % where plateaus may hide regions."""
    return fruitless_runs(settings, log) >= (_PATIENCE_HIDDEN if _hidden(settings, log) else _PATIENCE) * settings.budget


def exploration_share(settings: Settings, log: Log) -> float:
    """Return the share of the next batch that explores, if it does: a half; where plateaus may hide regions, all or nothing.

    There whole batches explore, because the search beside a plateau has several things to look at, and others look at the edges
    of the regions that are known (see `about_regions`), until each has had eight runs an input.
    """
    if not _hidden(settings, log):
        return _SHARE
    known = len(_about_hits(settings, log.history).low)
    parts = [batch.read(BatchProposal) for batch in log.iterations]
    looked = sum((part.representative or 0) + (part.greedy or 0) for part in parts)
    return float(looked >= _RUNS_ABOUT * settings.scenario.space.dimension * known)


def about_regions(settings: Settings, log: Log) -> Callable[[Points], Mask] | None:
    """Return which points (n, d) of the unit cube are near a critical run, where plateaus may hide others; else None.

    The metamodel is uncertain all over a plateau, of which next to nothing is critical: its edges are where critical runs are.
    """
    free, at = _about_hits(settings, log.history), settings.scenario.space.cube.embedded
    return (lambda u: ~free(at(u))) if len(free.low) and _hidden(settings, log) else None


def _about_hits(settings: Settings, history: History) -> FreeRegion:
    """Return the complement of boxes about the critical runs, one for those whose boxes touch."""
    space, hit = settings.scenario.space, settings.scenario.requirement.critical_runs(history)
    return FreeRegion.without(space.cube.embedded(np.clip(space.to_unit(history.x[hit]), 0.0, 1.0)), _REACH)


def largest_batch(settings: Settings, log: Log) -> int:
    """Return how many runs the next batch has at most.

    While plateaus may hide small regions, and looking beneath them is not in vain, a thirtieth of the budget, at least ten: what
    a few runs find tells where the next ones look.
    """
    n, hits = _filling_hits(settings, log)
    if settings.scenario.pool is not None or hits > _RARE * n or not _hidden(settings, log) or _in_vain(settings, log):
        return settings.batch
    return min(settings.batch, max(settings.budget // _BATCHES, _FEWEST_IN_BATCH))


def _hidden(settings: Settings, log: Log) -> bool:
    """Return whether many runs share the best uncritical value: beneath such a plateau there may be critical regions."""
    margin, u = settings.scenario.requirement.margins(log.history), settings.scenario.space.to_unit(log.history.x)
    return bool(plateau(np.where(log.history.ok, margin, np.inf), u).any())


def space_filling(log: Log) -> Mask:
    """Return (n,) the runs that no metamodel chose: the first batch, held-out runs, and what filled the space in a batch."""
    history = log.history
    mask = (history.stage == VALIDATION) | (history.iteration == 0)
    for k, batch in enumerate(log.iterations):
        proposal = batch.read(BatchProposal)
        first = proposal.explored or 0
        mask[np.flatnonzero(history.iteration == k)[first : first + (proposal.filling or 0)]] = True
    return mask


def fruitless_runs(settings: Settings, log: Log) -> int:
    """Return the number of exploratory runs since one last met a critical run apart from all earlier ones.

    Apart: by more than the half side of a deflated box, 0.22 in the unit cube. Zero as long as there is no critical run.
    """
    scenario, history = settings.scenario, log.history
    hit = scenario.requirement.critical_runs(history)
    if not hit.any():
        return 0
    u, iteration, spent = scenario.space.cube.embedded(scenario.space.to_unit(history.x)), history.iteration, 0
    for k, batch in enumerate(log.iterations):
        before = u[hit & (iteration < k)]
        if len(before) == 0:
            continue
        first = np.flatnonzero(iteration == k)[: batch.read(BatchProposal).explored or 0]
        met = first[hit[first]]
        new = len(met) > 0 and bool((cdist(u[met], before, "chebyshev").min(axis=1) > DEFLATION).any())
        spent = 0 if new else spent + len(first)
    return spent


def search_of(settings: Settings) -> Search:
    """Return what a search for critical regions needs to know.

    Raises:
        ValueError: there is no metamodel.
    """
    scenario, space = settings.scenario, settings.scenario.space
    if settings.learner is None:
        raise ValueError("exploration needs a metamodel")
    return Search(
        scenario.requirement.critical, simplest(settings.learner.metamodel), space.metamodel_inputs,
        lambda u: space.feasible(space.from_unit(u)), cube=space.cube, most_rows=_MOST_ROWS,
    )  # fmt: skip


def explore(settings: Settings, log: Log, n: int) -> Points:
    """Return n points (n, d) in the inputs' units that search for a region apart from those that are known.

    Raises:
        ValueError: there is no metamodel.
    """
    scenario, space = settings.scenario, settings.scenario.space
    if n == 0:
        return np.empty((0, space.dimension))
    seen, search = log.history.where(log.history.stage != VALIDATION), search_of(settings)
    y = scenario.requirement.values(seen)
    u = np.clip(space.to_unit(seen.x), 0.0, 1.0)
    pending = None if log.pending is None else np.clip(space.to_unit(log.pending.x), 0.0, 1.0)
    hidden = _hidden(settings, log)
    filling = space_filling(log)[log.history.stage != VALIDATION] if hidden else None
    picks = propose(
        search, u, y, n, stream(settings.seed, "hunt", log.iteration), seen.iteration, filling, pending=pending,
        around_floors=hidden,
    )  # fmt: skip
    return space.from_unit(picks.u)
