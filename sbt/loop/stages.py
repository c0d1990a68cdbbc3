"""THE loop: history in, next batch out, until the stages are done.

A campaign is a fold over its log. Nothing is remembered that is not in the store, so that a campaign
that was killed and run again ends with the same rows as one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np

from sbt.errors import InputError
from sbt.execution.protocol import Executor, groups_of
from sbt.loop.learner import FittedMetamodel
from sbt.problem.outcome import Status
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import run_seeds
from sbt.store.database import PlannedRun, Store
from sbt.store.history import PLANNED, History, Rows, as_numbers
from sbt.store.records import FitRecord, Iteration, to_json

__all__ = [
    "Batch", "Campaign", "Conclusion", "Facts", "Finished", "Log", "Progress", "Shard", "ShardConclusion", "Stage", "check_shard",
    "run_shard", "run_stages",
]  # fmt: skip

T = TypeVar("T")
_AT_ONCE = 10_000
"""Planned runs that are read from the store at once."""


@dataclass(frozen=True)
class Batch:
    """What a stage asks for.

    Args:
        runs: the concrete scenarios.
        proposal: how they were chosen: a dataclass or a mapping, written to the log as JSON and read back by `Iteration.read`.
        fitted: the metamodel that chose them, whose scores the log keeps.
    """

    runs: Sequence[PlannedRun]
    proposal: object = field(default_factory=dict)
    fitted: FittedMetamodel | None = None


@dataclass(frozen=True)
class Log:
    """All that a stage may look at.

    Attributes:
        history: finished runs.
        iterations: how earlier batches were chosen.
        fits: scores of earlier metamodels.
    """

    history: History
    iterations: tuple[Iteration, ...]
    fits: tuple[FitRecord, ...]

    @property
    def iteration(self) -> int:
        """Number of the next batch."""
        return len(self.iterations)

    def last(self, kind: type[T]) -> T | None:
        """Return how the last batch was chosen; None before the first one."""
        return self.iterations[-1].read(kind) if self.iterations else None


class Conclusion(Protocol):
    """What a campaign found: a frozen dataclass with typed attributes."""

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        ...

    def sentences(self, facts: Facts) -> list[str]:
        """Return what was found in plain words, the most important first."""
        ...


@dataclass(frozen=True)
class Facts:
    """What sentences about a conclusion may refer to.

    Attributes:
        history: finished runs.
        requirement: metric and critical interval.
        unit: of the metric.
        scenario: its name.
        units: of inputs and metrics, by name.
    """

    history: History
    requirement: Requirement
    unit: str = ""
    scenario: str = ""
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, history: History, scenario: LogicalScenario) -> Facts:
        """Return the facts of a campaign with this scenario."""
        return cls(history, scenario.requirement, scenario.unit, scenario.name, scenario.units)


class Stage(Protocol):
    """Proposes batches until it stops; a function of the log alone."""

    @property
    def name(self) -> str:
        """What its iterations are called in the store."""
        ...

    def stop(self, log: Log) -> str | None:
        """Return why the stage is over, None while it goes on."""
        ...

    def propose(self, log: Log) -> Batch:
        """Return the next batch; only called where `stop` gave None."""
        ...


@dataclass(frozen=True)
class Campaign:
    """Stages one after the other, and what to conclude from the log in the end.

    Args:
        stages: propose the batches.
        conclude: gives the conclusion, and the metamodel that was fitted for it.
        depends: how batches, or when they end, depend on results; None: not at all, so that all runs
            can be planned ahead and shared out.
    """

    stages: tuple[Stage, ...]
    conclude: Callable[[Log], tuple[Conclusion, FittedMetamodel | None]]
    depends: str | None = "each batch depends on all results before it"


@dataclass(frozen=True)
class Shard:
    """Every `of`-th run of a campaign, from run `number` - 1 on: number 1, ..., of.

    >>> [index for index in range(10) if index in Shard(2, 4)]
    [1, 5, 9]
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        """Check the rule."""
        if not 1 <= self.number <= self.of:
            raise InputError(f"a shard is I/N with 1 <= I <= N, but got {self}")

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard that is written I/N."""
        number, _, of = text.partition("/")
        if not (number.isdecimal() and of.isdecimal()):
            raise InputError(f"a shard is I/N, such as 3/10, but got '{text}'")
        return cls(int(number), int(of))

    def __str__(self) -> str:
        """Return I/N."""
        return f"{self.number}/{self.of}"

    def __contains__(self, index: int) -> bool:
        """Return whether the run of this index belongs to the shard."""
        return index % self.of == self.number - 1


@dataclass(frozen=True)
class Progress:
    """Where a campaign stands, for a progress bar."""

    done: int
    budget: int
    failed: int
    critical: int
    iteration: int
    activity: str


@dataclass
class _Counter:
    """Counts what has been run, and tells the listener."""

    listener: Callable[[Progress], None]
    requirement: Requirement
    budget: int
    iteration: int = 0
    done: int = 0
    failed: int = 0
    critical: int = 0

    def count(self, status: str, metrics: Mapping[str, float]) -> None:
        self.done += 1
        if status != Status.OK:
            self.failed += 1
        else:
            self.critical += self.requirement.is_critical(metrics)

    def count_all(self, history: History) -> None:
        self.done += len(history)
        self.failed += int((~history.ok).sum())
        self.critical += int(np.count_nonzero(self.requirement.critical_runs(history)))

    def tell(self, activity: str) -> None:
        self.listener(Progress(self.done, self.budget, self.failed, self.critical, self.iteration, activity))


@dataclass(frozen=True)
class ShardConclusion:
    """The conclusion of one shard: which one it was, and of how many runs.

    Attributes:
        shard: I/N.
        runs_of_the_campaign: of all shards together.
    """

    shard: str
    runs_of_the_campaign: int

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        return {"shard": self.shard, "runs_of_the_campaign": self.runs_of_the_campaign}

    def sentences(self, facts: Facts) -> list[str]:
        """Return what was run."""
        return [f"Shard {self.shard}: {len(facts.history):,} of {self.runs_of_the_campaign:,} runs of the campaign."]


@dataclass(frozen=True)
class Finished:
    """How a campaign ended.

    Attributes:
        stopped: why the last stage was over.
        conclusion: what was found.
        seconds: of `simulate`, `fit` and `propose`.
        fitted: the metamodel that was fitted for the conclusion.
    """

    stopped: str
    conclusion: Conclusion
    seconds: Mapping[str, float]
    fitted: FittedMetamodel | None = None


def run_stages(
    campaign: Campaign, store: Store, executor: Executor, *, seed: int, budget: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None],
) -> Finished:  # fmt: skip
    """Run all stages to their end, resuming what the store holds."""
    seconds = {"simulate": 0.0, "fit": 0.0, "propose": 0.0}
    counter = _Counter(listener, requirement, budget)
    counter.count_all(store.history())
    reason = ""
    for stage in campaign.stages:
        while True:
            _finish(store, executor, counter, versions, seconds)
            log = _log(store)
            counter.iteration = log.iteration
            stopped = stage.stop(log)
            if stopped is not None:
                reason = stopped
                break
            counter.tell(f"{stage.name}: choosing")
            start = time.perf_counter()
            spent = _plan_next(stage, store, log, seed, seconds)
            seconds["propose"] += time.perf_counter() - start - spent
    log = _log(store)
    counter.tell("concluding")
    start = time.perf_counter()
    conclusion, fitted = campaign.conclude(log)
    spent = _keep_fit(store, fitted, log, seconds)
    seconds["propose"] += time.perf_counter() - start - spent
    return Finished(reason, conclusion, seconds, fitted)


def run_shard(
    campaign: Campaign, shard: Shard, store: Store, executor: Executor, *, seed: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None],
) -> Finished:  # fmt: skip
    """Run one shard's runs of a campaign whose batches depend on no result, resuming what the store holds.

    Rows have the index, stage, iteration, inputs and seed that they have in the whole campaign.

    Raises:
        InputError: there are fewer runs than shards.
    """
    seconds = {"simulate": 0.0, "fit": 0.0, "propose": 0.0}
    start = time.perf_counter()
    known = store.history()
    batches = _ahead(campaign, Rows(known.names, known.choices))
    total = sum(len(batch.runs) for _, batch in batches)
    if shard.of > total:
        raise InputError(f"there must be at most as many shards as runs, but got shard {shard} of {total} runs")
    first, planned = 0, len(store.iterations())
    for iteration, (stage, batch) in enumerate(batches):
        mine = [index for index in range(first, first + len(batch.runs)) if index in shard]
        if iteration >= planned:
            runs, seeds = [batch.runs[index - first] for index in mine], run_seeds(seed, mine)
            store.plan(iteration, stage, runs, seeds, batch.proposal, indices=mine)
        first += len(batch.runs)
    seconds["propose"] = time.perf_counter() - start
    counter = _Counter(listener, requirement, store.planned, iteration=len(batches))
    counter.count_all(store.history())
    _finish(store, executor, counter, versions, seconds)
    return Finished("shard", ShardConclusion(str(shard), total), seconds)


def check_shard(campaign: Campaign) -> None:
    """Refuse to share out the runs of a campaign that cannot plan them ahead.

    Raises:
        InputError: its batches depend on results.
    """
    if campaign.depends is not None:
        raise InputError(
            f"--shard needs batches that depend on no result, but here {campaign.depends}; "
            "run it as one campaign with more workers: executor.kind local, or dask on a cluster"
        )


def _ahead(campaign: Campaign, rows: Rows) -> list[tuple[str, Batch]]:
    """Return all batches, with the name of their stage; the stages see every run (in `rows`, none yet) without a result."""
    iterations: list[Iteration] = []
    batches: list[tuple[str, Batch]] = []
    for stage in campaign.stages:
        while stage.stop(log := Log(rows.history(), tuple(iterations), ())) is None:
            batch = _proposed(stage, log)
            x = as_numbers([[run.inputs[name] for name in rows.names] for run in batch.runs], rows.names, rows.choices)
            n = len(batch.runs)
            columns = {
                "index": range(rows.count, rows.count + n), "stage": [run.stage for run in batch.runs],
                "iteration": [log.iteration] * n, "status": [PLANNED] * n, "log_q": [run.log_q for run in batch.runs],
            }  # fmt: skip
            rows.append(x, columns, [{}] * n)
            iterations.append(Iteration(log.iteration, stage.name, to_json(batch.proposal)))
            batches.append((stage.name, batch))
    return batches


def _proposed(stage: Stage, log: Log) -> Batch:
    batch = stage.propose(log)
    if not batch.runs:
        raise InputError(f"stage {stage.name} must propose runs or stop, but it did neither")
    return batch


def _log(store: Store) -> Log:
    return Log(store.history(), tuple(store.iterations()), tuple(store.fits()))


def _keep_fit(store: Store, fitted: FittedMetamodel | None, log: Log, seconds: dict[str, float]) -> float:
    """Write what the log keeps of a metamodel; return the seconds of its fit."""
    if fitted is None:
        return 0.0
    seconds["fit"] += fitted.seconds
    store.add_fit(replace(fitted.record, runs=len(log.history), iteration=log.iteration))
    return fitted.seconds


def _plan_next(stage: Stage, store: Store, log: Log, seed: int, seconds: dict[str, float]) -> float:
    """Plan the stage's next batch; return the seconds of its fit."""
    batch = _proposed(stage, log)
    spent, start = _keep_fit(store, batch.fitted, log, seconds), store.end
    seeds = run_seeds(seed, range(start, start + len(batch.runs)))
    store.plan(log.iteration, stage.name, batch.runs, seeds, batch.proposal)
    return spent


def _finish(store: Store, executor: Executor, counter: _Counter, versions: str, seconds: dict[str, float]) -> None:
    """Run everything that was planned and has no outcome yet."""
    while jobs := store.unfinished(_AT_ONCE):
        counter.tell("simulating")
        start = time.perf_counter()
        for outcomes in groups_of(executor, jobs):
            store.append_all(outcomes, versions)
            for outcome in outcomes:
                counter.count(outcome.status, outcome.metrics)
                counter.tell("simulating")
        seconds["simulate"] += time.perf_counter() - start
