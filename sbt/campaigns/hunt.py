"""The hunt of a boundary campaign: regions of critical runs that are easily missed, because they are small.

A metamodel that knows one small region doubts its border and nothing else. A part of each batch searches
elsewhere, as a falsification does, until the searches have been in vain for long enough.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from sbt.campaigns.settings import Settings
from sbt.loop.learner import Belief
from sbt.loop.stages import Log
from sbt.metamodels.base import simplest
from sbt.problem.arrays import Points
from sbt.samplers.portfolio import propose
from sbt.samplers.search import DEFLATION, Search
from sbt.seeds import stream
from sbt.store.history import VALIDATION

__all__ = ["HUNTED", "SHARE", "hunt", "in_vain", "is_on"]

HUNTED = "hunted"
"""How many runs of an iteration hunted, in its record; they are the first ones of the batch."""
SHARE = 0.5
"""Of a batch, while the hunt is on."""
_RARE = 0.01  # critical share of the space below which a region is easily missed
_PATIENCE = 0.2  # of the budget: hunted runs in vain that end the hunt


def is_on(settings: Settings, belief: Belief, log: Log) -> bool:
    """Return whether to hunt: critical runs seem rare, and the hunts were not in vain for too long.

    Rare: less than 1 % of the space is believed critical. Too long: as many runs as 20 % of the budget.
    Never among the rows of a recorded table.
    """
    rare = belief.scores["critical_fraction"] < _RARE and settings.scenario.pool is None
    return rare and in_vain(settings, log) < _PATIENCE * settings.budget


def in_vain(settings: Settings, log: Log) -> int:
    """Return how many runs have hunted since a hunt last met a critical run apart from all before.

    Apart: by more than the half side of a deflated box, 0.22 in the unit cube. Counted from the first
    critical run on: as long as there is none, no hunt was in vain.
    """
    scenario, history = settings.scenario, log.history
    hit = scenario.requirement.critical.contains(history.y(scenario.requirement.metric))
    if not hit.any():
        return 0
    u, iteration, spent = scenario.space.to_unit(history.x), history.iteration, 0
    for k, how in enumerate(log.iterations):
        before = u[hit & (iteration < k)]
        if len(before) == 0:
            continue
        first = np.flatnonzero(iteration == k)[: how.get(HUNTED, 0)]
        met = first[hit[first]]
        new = len(met) > 0 and bool((cdist(u[met], before, "chebyshev").min(axis=1) > DEFLATION).any())
        spent = 0 if new else spent + len(first)
    return spent


def hunt(settings: Settings, log: Log, n: int) -> Points:
    """Return n points (n, d) in the inputs' units that search for a region apart from those that are known.

    Raises:
        ValueError: there is no metamodel.
    """
    scenario, space = settings.scenario, settings.scenario.space
    if settings.learner is None:
        raise ValueError("a hunt needs a metamodel")
    if n == 0:
        return np.empty((0, space.dimension))
    seen = log.history.where(log.history.stage != VALIDATION)
    search = Search(
        scenario.requirement.critical, simplest(settings.learner.metamodel), space.metamodel_inputs,
        lambda u: space.feasible(space.from_unit(u)),
    )  # fmt: skip
    y = np.where(seen.ok, seen.y(scenario.requirement.metric), np.nan)
    u = np.clip(space.to_unit(seen.x), 0.0, 1.0)
    picks = propose(search, u, y, n, stream(settings.seed, "hunt", log.iteration), seen.iteration)
    return space.from_unit(np.clip(picks.u, 1e-12, 1 - 1e-12))
