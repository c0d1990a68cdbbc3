"""Stages that need no metamodel: draws from the inputs' distribution, and subset simulation in repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.campaigns.clustering import spread_of_share
from sbt.campaigns.counting import NOMINAL, RANDOM, crude_rows
from sbt.campaigns.records import COUNT, EstimationProposal
from sbt.campaigns.settings import Settings
from sbt.estimators.monte_carlo import Proportion
from sbt.estimators.subset import SubsetRun, next_levels
from sbt.loop.stages import Batch, Log
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.database import PlannedRun
from sbt.store.records import Iteration

__all__ = [
    "FIRST_LEVEL", "NOMINAL_STAGES", "MonteCarloStage", "SubsetStage", "nominal_proportion", "nominal_rows", "points_a_level",
    "repeats_of", "took_monte_carlo",
]  # fmt: skip

FIRST_LEVEL = "subset level 0"
"""Stage of the draws that subset simulation begins with."""
NOMINAL_STAGES = (NOMINAL, FIRST_LEVEL)
"""Stages of runs that are drawn from the inputs' distribution, whatever the results."""
_REPEATS = 5  # independent runs of subset simulation: their spread is the error
_FEWEST_HITS = 10  # before the coefficient of variation is believed: its own error is a sixth then
_FEWEST_BATCHES = 4  # likewise


@dataclass(frozen=True)
class MonteCarloStage:
    """Independent draws from the distribution of the inputs."""

    settings: Settings
    name: str = NOMINAL

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for: draws depend on no result."""
        return self.settings.ahead

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough."""
        if log.iterations and len(log.planned) >= self.settings.budget:
            return "budget"
        target = self.settings.stop.get("cov")
        if target is not None and log.iteration >= _FEWEST_BATCHES:
            share, history = nominal_proportion(log, self.settings), log.history
            critical = self.settings.scenario.requirement.critical_runs(history)
            between = spread_of_share(history, nominal_rows(log), critical)
            differing = between is not None and between.exceeds(target, share.value)
            if share.hits >= _FEWEST_HITS and share.cov is not None and share.cov <= target and not differing:
                return "cov"
        return None

    def propose(self, log: Log) -> Batch:
        """Return the next draws."""
        s, space = self.settings, self.settings.scenario.space
        size = min(s.batch if log.iterations else s.initial, s.budget - len(log.planned))
        x = space.sample(size, stream(s.seed, "monte_carlo", log.iteration))
        return Batch(_runs(space, x, NOMINAL, space.log_density(x)), EstimationProposal(COUNT, "monte_carlo"))


@dataclass(frozen=True)
class SubsetStage:
    """Subset simulation on the simulator: a batch is one step of every chain of every repeat."""

    settings: Settings
    name: str = "subset"

    def stop(self, log: Log) -> str | None:
        """Return `converged` where every repeat has finished, `budget` where the next step does not fit in it."""
        if not any(_is_step(batch) for batch in log.iterations):
            return "budget" if len(log.history) >= self.settings.budget else None
        repeats = repeats_of(log, self.settings)
        if all(r.finished for r in repeats):
            return "converged"
        size = sum(r.width for r in repeats if r.asks)
        return "budget" if len(log.history) + size > self.settings.budget else None

    def propose(self, log: Log) -> Batch:
        """Return one step of every chain that does not wait for the level of others."""
        s, space = self.settings, self.settings.scenario.space
        runs: list[PlannedRun] = []
        repeats = repeats_of(log, s)
        for k, repeat in enumerate(repeats):
            if repeat.asks:
                z = repeat.ask(stream(s.seed, "subset", k, log.iteration))
                stage = FIRST_LEVEL if repeat.levels == 0 else "subset"
                x = space.from_normal(z)
                log_q = space.log_density(x) if repeat.levels == 0 and not space.constraints else None
                runs += _runs(space, x, stage, log_q)
        level = None if repeats[0].alone else repeats[0].n
        return Batch(tuple(runs), EstimationProposal("subset", "subset", level=level))


def took_monte_carlo(log: Log) -> bool:
    """Return whether draws from the inputs' distribution count: crude Monte Carlo from some batch on, until now."""
    last = log.last(EstimationProposal)
    return last is not None and last.phase == COUNT and last.method == "monte_carlo"


def repeats_of(log: Log, settings: Settings) -> list[SubsetRun]:
    """Return where the repeats stand, replayed from the log: their draws belong to the seed, the metrics are there."""
    requirement, space = settings.scenario.requirement, settings.scenario.space
    steps = [batch for batch in log.iterations if _is_step(batch)]
    before = log.history.iteration < (steps[0].number if steps else log.iteration)
    level = steps[0].read(EstimationProposal).level if steps else None
    alone = bool(steps) and level is None  # of a store of once
    level = level or points_a_level(max(settings.budget - int(before.sum()), 1))  # other runs may have come first
    repeats = [SubsetRun(level, space.dimension, alone=alone) for _ in range(_REPEATS)]
    margin = requirement.margins(log.history)
    for batch in steps:
        rows, start = np.flatnonzero(log.history.iteration == batch.number), 0
        for k, repeat in enumerate(repeats):
            if repeat.asks:
                z = repeat.ask(stream(settings.seed, "subset", k, batch.number))
                outcomes = _outcomes(margin[rows[start : start + len(z)]], z, space)
                repeats[k], start = repeat.tell(z, outcomes), start + len(z)
        repeats = repeats if alone else next_levels(repeats)
    return repeats


def points_a_level(budget: int) -> int:
    """Return the points a level of every repeat of subset simulation, so that four levels fit in the budget."""
    level = max(budget // (4 * _REPEATS) // 10, 2) * 10
    return level if budget >= _REPEATS * level else max(budget // _REPEATS, 1)


def _is_step(batch: Iteration) -> bool:
    return batch.read(EstimationProposal).method == "subset"


def _outcomes(margin: Vector, z: Points, space: ParameterSpace) -> Vector:
    return np.where(space.feasible(space.from_normal(z)), margin, np.inf) if space.constraints else margin


def _runs(space: ParameterSpace, x: Points, stage: str, log_q: Vector | None) -> tuple[PlannedRun, ...]:
    return tuple(PlannedRun(stage, space.named(row), None if log_q is None else float(log_q[k])) for k, row in enumerate(x))


def nominal_rows(log: Log, stage: str = NOMINAL) -> Mask:
    """Return which runs were drawn from the inputs' distribution: of this stage, and those of many inputs that count with it.

    Beside the first level of subset simulation all do; in crude Monte Carlo those halves of the first draws that do not count
    because of their own results.
    """
    rows = crude_rows(log.history) if stage == NOMINAL else log.history.stage == stage
    first = np.flatnonzero(log.history.stage == RANDOM)
    if stage == FIRST_LEVEL:
        rows[first] = True
    elif stage == NOMINAL and len(first):
        counts = log.iterations[1].read(EstimationProposal).trial if log.iteration > 1 else (True, True)
        for half, counted in zip(np.array_split(first, 2), counts or (False, False), strict=True):
            rows[half] = counted
    return rows


def nominal_proportion(
    log: Log, settings: Settings, stage: str = NOMINAL, requirement: Requirement | None = None
) -> Proportion:  # fmt: skip
    """Return the hits among these runs; `requirement` None: of the campaign's own."""
    runs = log.history.where(nominal_rows(log, stage))
    hits = int((requirement or settings.scenario.requirement).critical_runs(runs).sum())
    return Proportion(len(runs), hits, int((~runs.ok).sum()))
