"""Pairs of inputs and seed that a boundary campaign runs: those of which it is in doubt whether they are critical."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sbt.campaigns.combinations import few
from sbt.campaigns.exploration import search_of
from sbt.campaigns.settings import Settings
from sbt.loop.drawn_traffic import PairRisk
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Log
from sbt.problem.arrays import Points
from sbt.problem.covariates import Covariates
from sbt.samplers.pairs import propose_pairs
from sbt.samplers.room import fill_uniformly
from sbt.seeds import SEED_END, stream
from sbt.store.history import VALIDATION
from sbt.store.planning import PlannedRun

__all__ = ["pairs_in_doubt"]

_SHARE = 0.5
"""Of a batch: the rest is chosen by its inputs, with drawn seeds, which alone tell rates, noise and shares."""
_ENOUGH = 10
"""Critical runs before which pairs are searched for them, as a falsification does."""
_CANDIDATES = 20
"""Pairs that one is drawn from."""


def pairs_in_doubt(settings: Settings, fitted: FittedMetamodel | None, log: Log, n: int, stage: str) -> list[PlannedRun]:
    """Return runs of chosen pairs for a batch of n, about half of it; none where seeds are not looked at, or tell nothing.

    A pair is drawn from fresh ones in proportion to the standard deviation of "critical or not" as learned from inputs and
    covariates. The critical runs that this needs are searched for first, where traffic promises to tell of them.

    Args:
        settings: of the campaign.
        fitted: its metamodel, which knows where runs fail.
        log: of the campaign.
        n: runs of the batch that are chosen.
        stage: of the runs.
    """
    traffic = None if settings.learner is None else settings.learner.traffic
    wanted = int(_SHARE * n)
    if traffic is None or traffic.covariates is None or wanted == 0 or few(settings.scenario, log.planned, settings.budget):
        return []
    learned = traffic.learned(log.history)
    few_critical = settings.scenario.requirement.critical_runs(log.history).sum() < _ENOUGH
    if learned is None or not (learned.promises if few_critical else learned.tells):
        return []
    if few_critical:
        u, seeds = _searched(settings, traffic.covariates, log, wanted)
    else:
        u, seeds = _drawn(settings, traffic.covariates, learned, fitted, log, wanted)
    space = settings.scenario.space
    return [PlannedRun(stage, space.named(x), seed=int(k)) for x, k in zip(space.from_unit(u), seeds, strict=True)]


def _drawn(
    settings: Settings, covariates: Covariates, learned: PairRisk, fitted: FittedMetamodel | None, log: Log, n: int
) -> tuple[Points, NDArray[np.int64]]:
    """Return n of 20 n fresh pairs, drawn in proportion to sqrt(P (1 - P)) and P(a run gives a metric)."""
    space, rng = settings.scenario.space, stream(settings.seed, "pairs in doubt", log.iteration)
    u = fill_uniformly(lambda v: space.feasible(space.from_unit(v)), _CANDIDATES * n, space.dimension, rng)
    seeds = rng.integers(0, SEED_END, len(u))
    with threadpool_limits(1):
        log_p, log_not = learned.risk(covariates.beside_inputs(space.from_unit(u), seeds.tolist(), keep=False))
    score = 0.5 * (log_p + log_not)
    score = score if fitted is None or fitted.log_success is None else score + fitted.log_success(u)
    gumbel = score + rng.gumbel(size=len(u))  # the largest are a draw without replacement
    best = np.argsort(-gumbel, kind="stable")
    _, first = np.unique(seeds[best], return_index=True)
    chosen = best[np.sort(first)[:n]]
    return u[chosen], seeds[chosen]


def _searched(settings: Settings, covariates: Covariates, log: Log, n: int) -> tuple[Points, NDArray[np.int64]]:
    """Return n pairs that promise to be critical."""
    space = settings.scenario.space
    runs = log.history.where(log.history.stage != VALIDATION)
    u, y = np.clip(space.to_unit(runs.x), 0.0, 1.0), settings.scenario.requirement.values(runs)
    rng = stream(settings.seed, "pairs", log.iteration)
    found = propose_pairs(search_of(settings), covariates.of_points, u, runs.seed, y, n, rng)
    return found.u, np.array(found.seeds, dtype=np.int64)
