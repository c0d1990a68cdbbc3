"""THE loop: history in, next batch out, until the stages are done.

A campaign is a fold over its log. Nothing is remembered that is not in the store, so that a campaign
that was killed and run again ends with the same rows as one that was not.

A stage that looks ahead chooses batch k from the runs of the batches up to k - 1 - ahead, from how all earlier batches were
chosen, and from where the runs in between lie, whose outcomes it does not see even where they are known. So its rows, too,
are the same with any number of workers. The first batch is always waited for, and so are those of a later stage, which sent
the campaign back.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

from sbt.errors import InputError
from sbt.execution.protocol import Executor, groups_of, is_apart
from sbt.loop.driver import Counter, Driver
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import BACK, Batch, Campaign, Conclusion, Facts, Log, LooksAhead, Progress, Shard, Stage, proposed
from sbt.problem.outcome import Job
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement
from sbt.seeds import run_seeds
from sbt.store.database import Store
from sbt.store.history import PLANNED, Rows, as_numbers
from sbt.store.records import Iteration, to_json

__all__ = ["Finished", "ShardConclusion", "ahead_of", "check_shard", "run_shard", "run_stages"]

_AT_ONCE = 4_000
"""Planned runs that are read from the store at once."""


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
        seconds: of `simulate`, `fit`, `propose`, and of the workers' `work` and `idle`.
        fitted: the metamodel that was fitted for the conclusion.
    """

    stopped: str
    conclusion: Conclusion
    seconds: Mapping[str, float]
    fitted: FittedMetamodel | None = None


def run_stages(
    campaign: Campaign, store: Store, executor: Executor, *, seed: int, budget: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None], workers: int | None = None,
) -> Finished:  # fmt: skip
    """Run all stages to their end, resuming what the store holds; `workers` are what the use of their time is counted of."""
    driver, reason, k = Driver(store, Counter(listener, requirement, budget), seed, versions), "", 0
    driver.counter.count_all(store.history())
    while k < len(campaign.stages):
        later = {stage.name for stage in campaign.stages[k + 1 :]} - {stage.name for stage in campaign.stages[: k + 1]}
        loop = _StageLoop(campaign.stages[k], driver, executor, frozenset(later), campaign)
        reason = loop.run(sent_back=reason == BACK)
        k = 0 if reason == BACK else k + 1
    log = _log(store, 0)
    driver.counter.tell("concluding")
    start = time.perf_counter()
    conclusion, fitted = campaign.conclude(log)
    spent = driver.keep(fitted, log)
    driver.seconds["propose"] += time.perf_counter() - start - spent
    return Finished(reason, conclusion, driver.seconds | driver.use_of(workers), fitted)


def ahead_of(stage: Stage) -> int:
    """Return how many batches in flight the stage's proposals do not wait for."""
    return stage.ahead if isinstance(stage, LooksAhead) else 0


def _log(store: Store, ahead: int, later: frozenset[str] = frozenset()) -> Log:
    """Return the log as a stage sees it that chooses the next batch; all of it where it does not look ahead."""
    iterations, fits = tuple(store.iterations()), tuple(store.fits())
    if ahead == 0 or not iterations:
        coarse = store.history(level=1)
        return Log(store.history(), iterations, fits, coarse=coarse if len(coarse) else None)
    history = store.history(until=_last_visible(iterations, ahead, later))
    pending = store.pending(since=len(history))
    return Log(history, iterations, fits, pending if len(pending) else None)


def _last_visible(iterations: Sequence[Iteration], ahead: int, later: frozenset[str]) -> int:
    """Return the number of the last batch whose outcomes the choice of the next one depends on; -1: of none."""
    waited_for = (batch.number for batch in iterations if batch.stage in later)
    return max(len(iterations) - 1 - ahead, 0, *waited_for) if iterations else -1


@dataclass
class _StageLoop:
    """One stage, its batches chosen and run.

    Args:
        stage: proposes the batches.
        driver: writes them.
        executor: runs them; where that leaves this process idle, a stage that looks ahead chooses meanwhile.
        later: stages after it, whose batches it waits for.
        campaign: of the stage.
    """

    stage: Stage
    driver: Driver
    executor: Executor
    later: frozenset[str]
    campaign: Campaign
    _queue: deque[Job] = field(default_factory=deque)
    _planned: deque[Iterator[Job]] = field(default_factory=deque)
    _thought: _Thought | None = None
    _reason: str | None = None

    def run(self, *, sent_back: bool = False) -> str:
        """Run the stage to its end; return why it was over. `sent_back`: a later one has seen that it was not, from all runs."""
        ahead = ahead_of(self.stage)
        if sent_back:
            self._advance(0)
        while True:
            if not self._queue:
                self._queue.extend(self._coming())
            self._advance(ahead)
            if self._queue:
                self._simulate(ahead)
            elif self._thought is not None:
                self._thought.wait()
            elif self._reason is not None:
                return self._reason

    def _coming(self) -> list[Job]:
        """Return the next runs that were planned and not queued yet, or those that an interrupted campaign left."""
        while self._planned:
            if jobs := list(islice(self._planned[0], _AT_ONCE)):
                return jobs
            self._planned.popleft()
        return self.driver.store.unfinished(_AT_ONCE)

    def _simulate(self, ahead: int) -> None:
        """Run what is queued, and what joins the queue meanwhile."""
        self.driver.begin()
        start, chosen = time.perf_counter(), self.driver.seconds["propose"] + self.driver.seconds["fit"]
        for outcomes in groups_of(self.executor, self._queue):
            self.driver.done(outcomes)
            if ahead:
                self._advance(ahead)
        here = 0.0 if is_apart(self.executor) else self.driver.seconds["propose"] + self.driver.seconds["fit"] - chosen
        self.driver.seconds["simulate"] += time.perf_counter() - start - here

    def _advance(self, ahead: int) -> None:
        """Plan the batch that was chosen, and choose the next one as soon as what it depends on is known."""
        store, counter = self.driver.store, self.driver.counter
        while self._reason is None:
            if self._thought is None:
                iterations, unfinished = store.iterations(), store.first_unfinished
                if unfinished is not None and unfinished <= _last_visible(iterations, ahead, self.later):
                    return
                counter.iteration = len(iterations)
                if unfinished is None:
                    counter.tell(f"{self.stage.name}: choosing")
                apart = ahead > 0 and is_apart(self.executor)
                self._thought = _Thought(self.stage, _log(store, ahead, self.later), self.campaign, apart=apart)
            if not self._thought.ended:
                return
            thought, self._thought = self._thought, None
            self._plan(thought)

    def _plan(self, thought: _Thought) -> None:
        """Write the batch that was chosen, and queue its runs; or note why the stage is over."""
        chosen, driver = thought.result(), self.driver
        if isinstance(chosen, str):
            self._reason = chosen
            return
        driver.seconds["propose"] += thought.seconds
        self._planned.append(driver.plan(self.stage, chosen, thought.log))
        self._queue.extend(islice(self._planned[-1], _AT_ONCE))


class _Thought:
    """Whether a stage is over, or its next batch; here and now, or beside what else this process does."""

    def __init__(self, stage: Stage, log: Log, campaign: Campaign, *, apart: bool):
        self.log, self.seconds = log, 0.0
        self._stage, self._campaign = stage, campaign
        self._found: str | Batch | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._think, name="sbt-thinker", daemon=True) if apart else None
        if self._thread is None:
            self._think()
        else:
            self._thread.start()

    def _think(self) -> None:
        start = time.perf_counter()
        try:
            stopped = self._stage.stop(self.log)
            self._found = stopped if stopped is not None else proposed(self._stage, self.log, self._campaign)
        except BaseException as error:  # raised again where it is waited for
            self._error = error
        self.seconds = time.perf_counter() - start

    @property
    def ended(self) -> bool:
        """Whether there is a result."""
        return self._thread is None or not self._thread.is_alive()

    def wait(self) -> None:
        """Wait until there is a result."""
        if self._thread is not None:
            self._thread.join()

    def result(self) -> str | Batch:
        """Return why the stage is over, or its next batch."""
        if self._error is not None:
            raise self._error
        if self._found is None:
            raise RuntimeError("a thought has a result once it has ended, but was asked before")
        return self._found


def run_shard(
    campaign: Campaign, shard: Shard, store: Store, executor: Executor, *, seed: int, requirement: Requirement,
    versions: str, listener: Callable[[Progress], None],
) -> Finished:  # fmt: skip
    """Run one shard's runs of a campaign whose batches depend on no result, resuming what the store holds.

    Rows have the index, stage, iteration, inputs and seed that they have in the whole campaign.

    Raises:
        InputError: there are fewer runs than shards.
    """
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
    driver = Driver(store, Counter(listener, requirement, store.planned, iteration=len(batches)), seed, versions)
    driver.seconds["propose"] = time.perf_counter() - start
    driver.counter.count_all(store.history())
    while jobs := store.unfinished(_AT_ONCE):
        driver.simulate(executor, deque(jobs))
    return Finished("shard", ShardConclusion(str(shard), total), driver.seconds)


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
            batch = proposed(stage, log, campaign)
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
