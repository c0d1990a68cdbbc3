"""THE loop: history in, next batch out, until the stages are done.

A campaign is a fold over its log. Nothing is remembered that is not in the store, so that a campaign
that was killed and run again ends with the same rows as one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from sbt.errors import InputError
from sbt.execution.protocol import Executor
from sbt.problem.outcome import Status
from sbt.problem.requirement import Requirement
from sbt.seeds import run_seed
from sbt.store.database import PlannedRun, Store
from sbt.store.history import PLANNED, History, Record

__all__ = ["Batch", "Campaign", "Fit", "Log", "Progress", "Shard", "Stage", "check_shard", "run_shard", "run_stages"]


@dataclass(frozen=True)
class Fit:
    """Scores of a metamodel, to be kept with the number of rows that were there."""

    scores: Mapping[str, Any]
    seconds: float


@dataclass(frozen=True)
class Batch:
    """What a stage asks for: runs, and how they were chosen (JSON)."""

    runs: tuple[PlannedRun, ...]
    how: Mapping[str, Any] = field(default_factory=dict)
    fit: Fit | None = None


@dataclass(frozen=True)
class Log:
    """All that a stage may look at.

    Attributes:
        history: finished runs.
        iterations: how earlier batches were chosen.
        fits: scores of earlier metamodels.
    """

    history: History
    iterations: tuple[Mapping[str, Any], ...]
    fits: tuple[Mapping[str, Any], ...]

    @property
    def iteration(self) -> int:
        """Number of the next batch."""
        return len(self.iterations)


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
        conclude: gives the conclusion, and the scores of a metamodel that was fitted for it.
        depends: how batches, or when they end, depend on results; None: not at all, so that all runs
            can be planned ahead and shared out.
    """

    stages: tuple[Stage, ...]
    conclude: Callable[[Log], tuple[dict[str, Any], Fit | None]]
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
            y = metrics[self.requirement.metric]
            self.critical += self.requirement.critical.low <= y <= self.requirement.critical.high

    def tell(self, activity: str) -> None:
        self.listener(Progress(self.done, self.budget, self.failed, self.critical, self.iteration, activity))


def run_stages(
    campaign: Campaign, store: Store, executor: Executor, *, seed: int, budget: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None],
) -> tuple[str, dict[str, Any], dict[str, float]]:  # fmt: skip
    """Run all stages to their end, resuming what the store holds.

    Returns:
        Why the last stage stopped, the conclusion, and the seconds of `simulate`, `fit`, `propose`.
    """
    seconds = {"simulate": 0.0, "fit": 0.0, "propose": 0.0}
    counter = _Counter(listener, requirement, budget)
    for record in store.history().records:
        counter.count(record.status, record.metrics)
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
            batch = _proposed(stage, log)
            _keep_fit(store, batch.fit, log, seconds)
            seconds["propose"] += time.perf_counter() - start - (batch.fit.seconds if batch.fit else 0.0)
            _plan(store, stage, batch, log, seed)
    log = _log(store)
    counter.tell("concluding")
    start = time.perf_counter()
    conclusion, fit = campaign.conclude(log)
    _keep_fit(store, fit, log, seconds)
    seconds["propose"] += time.perf_counter() - start - (fit.seconds if fit else 0.0)
    return reason, conclusion, seconds


def run_shard(
    campaign: Campaign, shard: Shard, store: Store, executor: Executor, *, seed: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None],
) -> tuple[str, dict[str, Any], dict[str, float]]:  # fmt: skip
    """Run one shard's runs of a campaign whose batches depend on no result, resuming what the store holds.

    Rows have the index, stage, iteration, inputs and seed that they have in the whole campaign.

    Returns:
        As `run_stages`; the conclusion is which shard it was, and of how many runs.

    Raises:
        InputError: there are fewer runs than shards.
    """
    seconds = {"simulate": 0.0, "fit": 0.0, "propose": 0.0}
    start = time.perf_counter()
    batches = _ahead(campaign, tuple(store.configuration["names"]))
    total = sum(len(batch.runs) for _, batch in batches)
    if shard.of > total:
        raise InputError(f"there must be at most as many shards as runs, but got shard {shard} of {total} runs")
    first, there = 0, len(store.iterations())
    for iteration, (stage, batch) in enumerate(batches):
        mine = [index for index in range(first, first + len(batch.runs)) if index in shard]
        if iteration >= there:
            runs, seeds = [batch.runs[index - first] for index in mine], [run_seed(seed, index) for index in mine]
            store.plan(iteration, stage, runs, seeds, batch.how, indices=mine)
        first += len(batch.runs)
    seconds["propose"] = time.perf_counter() - start
    counter = _Counter(listener, requirement, store.planned, iteration=len(batches))
    for record in store.history().records:
        counter.count(record.status, record.metrics)
    _finish(store, executor, counter, versions, seconds)
    return "shard", {"shard": str(shard), "runs_of_the_campaign": total}, seconds


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


def _ahead(campaign: Campaign, names: tuple[str, ...]) -> list[tuple[str, Batch]]:
    """Return all batches, with the name of their stage; the stages see every run without a result."""
    records: list[Record] = []
    iterations: list[dict[str, Any]] = []
    batches: list[tuple[str, Batch]] = []
    for stage in campaign.stages:
        while stage.stop(log := Log(History(names, tuple(records)), tuple(iterations), ())) is None:
            batch = _proposed(stage, log)
            start = len(records)
            records += [
                Record(start + k, run.stage, log.iteration, run.inputs, 0, PLANNED, {}, "", run.log_q, 0.0, "", "")
                for k, run in enumerate(batch.runs)
            ]
            iterations.append({"iteration": log.iteration, "stage": stage.name, **batch.how})
            batches.append((stage.name, batch))
    return batches


def _proposed(stage: Stage, log: Log) -> Batch:
    batch = stage.propose(log)
    if not batch.runs:
        raise InputError(f"stage {stage.name} must propose runs or stop, but it did neither")
    return batch


def _log(store: Store) -> Log:
    return Log(store.history(), tuple(store.iterations()), tuple(store.fits()))


def _keep_fit(store: Store, fit: Fit | None, log: Log, seconds: dict[str, float]) -> None:
    if fit is not None:
        seconds["fit"] += fit.seconds
        store.add_fit(len(log.history), log.iteration, dict(fit.scores))


def _plan(store: Store, stage: Stage, batch: Batch, log: Log, seed: int) -> None:
    start = store.planned
    seeds = [run_seed(seed, start + k) for k in range(len(batch.runs))]
    store.plan(log.iteration, stage.name, batch.runs, seeds, batch.how)


def _finish(store: Store, executor: Executor, counter: _Counter, versions: str, seconds: dict[str, float]) -> None:
    """Run everything that was planned and has no outcome yet."""
    jobs = store.unfinished()
    if not jobs:
        return
    counter.tell("simulating")
    start = time.perf_counter()
    for outcome in executor.run(jobs):
        store.append(outcome, versions)
        counter.count(outcome.status, outcome.metrics)
        counter.tell("simulating")
    seconds["simulate"] += time.perf_counter() - start
