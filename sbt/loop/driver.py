"""What has been run, written and told: the state of a campaign's driver, none of which decides what comes next."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sbt.execution.protocol import Executor, groups_of
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Batch, Log, Progress, Stage
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.requirement import Requirement
from sbt.seeds import run_seeds
from sbt.store.database import PlannedPoints, Store
from sbt.store.history import History

__all__ = ["Counter", "Driver"]


@dataclass
class Counter:
    """Counts what has been run, and tells the listener."""

    listener: Callable[[Progress], None]
    requirement: Requirement
    budget: int
    iteration: int = 0
    done: int = 0
    failed: int = 0
    critical: int = 0

    def count(self, status: str, metrics: Mapping[str, float]) -> None:
        """Count a run."""
        self.done += 1
        if status != Status.OK:
            self.failed += 1
        else:
            self.critical += self.requirement.is_critical(metrics)

    def count_all(self, history: History) -> None:
        """Count the runs of a history."""
        self.done += len(history)
        self.failed += int((~history.ok).sum())
        self.critical += int(np.count_nonzero(self.requirement.critical_runs(history)))

    def tell(self, activity: str) -> None:
        """Tell the listener where the campaign stands."""
        self.listener(Progress(self.done, self.budget, self.failed, self.critical, self.iteration, activity))



@dataclass
class Driver:
    """Writes batches and outcomes into the store, and measures where the time goes.

    Args:
        store: of the campaign.
        counter: tells the listener.
        seed: of the campaign.
        versions: of the software that runs it.
    """

    store: Store
    counter: Counter
    seed: int
    versions: str
    seconds: dict[str, float] = field(default_factory=lambda: {"simulate": 0.0, "fit": 0.0, "propose": 0.0})
    _busy: float = 0.0
    _first: float | None = None
    _last: float = 0.0

    def plan(self, stage: Stage, batch: Batch, log: Log) -> Iterator[Job]:
        """Write a batch, and what its metamodel is worth; return its runs, in the order of their indices."""
        spent, end = self.keep(batch.fitted, log), self.store.end
        seeds = run_seeds(self.seed, range(end, end + len(batch.runs)))
        self.store.plan(log.iteration, stage.name, batch.runs, seeds, batch.proposal)
        self.seconds["propose"] -= spent
        if isinstance(batch.runs, PlannedPoints):  # a million of them need not be read from where they have just been written
            return batch.runs.jobs(end, seeds)
        return iter(self.store.unfinished(since=end))

    def keep(self, fitted: FittedMetamodel | None, log: Log) -> float:
        """Write what the log keeps of a metamodel; return the seconds of its fit."""
        if fitted is None:
            return 0.0
        self.seconds["fit"] += fitted.seconds
        if log.pending is None or all(known.runs != len(log.history) for known in log.fits):  # the same runs, the same fit
            self.store.add_fit(replace(fitted.record, runs=len(log.history), iteration=log.iteration))
        return fitted.seconds

    def begin(self) -> None:
        """Note that runs are at work from now on."""
        self._first = time.perf_counter() if self._first is None else self._first
        self.counter.tell("simulating")

    def done(self, outcomes: Sequence[Outcome]) -> None:
        """Write outcomes that came together."""
        if not outcomes:
            return
        self.store.append_all(outcomes, self.versions)
        self._last = time.perf_counter()
        self._busy += sum(outcome.seconds for outcome in outcomes)
        for outcome in outcomes:
            if outcome.level == 0:
                self.counter.count(outcome.status, outcome.metrics)
            self.counter.tell("simulating")

    def simulate(self, executor: Executor, queue: deque[Job]) -> None:
        """Run what is queued, to its end."""
        self.begin()
        start = time.perf_counter()
        for outcomes in groups_of(executor, queue):
            self.done(outcomes)
        self.seconds["simulate"] += time.perf_counter() - start

    def use_of(self, workers: int | None) -> dict[str, float]:
        """Return the seconds of `work` and `idle`, summed over the workers, from the first run to the last; none: not known."""
        if workers is None or self._first is None or self._last <= self._first:
            return {}
        return {"work": self._busy, "idle": max(workers * (self._last - self._first) - self._busy, 0.0)}
