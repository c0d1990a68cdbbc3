"""What an executor is: jobs in, outcomes out, in any order."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from sbt import interruption
from sbt.execution.spec import ScenarioSpec
from sbt.execution.streams import open_missing
from sbt.execution.worker import prepare, run_at_levels, run_job
from sbt.plugins import LoadedAnew
from sbt.problem.outcome import Job, Outcome
from sbt.problem.scenario import Batched

__all__ = ["CHUNK", "Executor", "Grouping", "SerialExecutor", "chunk_of", "groups_of", "is_apart"]

CHUNK = 64
"""Largest number of runs that are started before the outcome of the first is known."""
_QUICK = 0.02
"""Runs in this process are reported together if they take less time than this (s)."""


class Executor(Protocol):
    """Runs concrete scenarios; results do not depend on which executor or how many workers."""

    def __enter__(self) -> Self:
        """Start what is needed, so that the first run costs no more than the others."""
        ...

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        """Stop it."""
        ...

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job as they finish; a run that fails is an outcome, never an exception."""
        ...


@runtime_checkable
class Grouping(Protocol):
    """An executor that says which runs ended together, and takes more runs while it is at work."""

    @property
    def apart(self) -> bool:
        """Whether runs leave this process idle."""
        ...

    def groups(self, queue: deque[Job]) -> Iterator[list[Outcome]]:
        """Yield the outcomes as they come, those that came together in one list; an empty one where nothing came for a while.

        The queue is emptied; what is appended to it meanwhile is run as well.
        """
        ...


def is_apart(executor: Executor) -> bool:
    """Return whether runs leave this process idle."""
    return isinstance(executor, Grouping) and executor.apart


def groups_of(executor: Executor, queue: deque[Job]) -> Iterator[list[Outcome]]:
    """Yield the outcomes of queued runs in the groups that the executor makes; alone where it makes none."""
    for outcomes in _grouped(executor, queue):
        yield outcomes
        interruption.check()  # code of a plug-in may have caught it


def _grouped(executor: Executor, queue: deque[Job]) -> Iterator[list[Outcome]]:
    if isinstance(executor, Grouping):
        yield from executor.groups(queue)
    while queue:
        jobs = list(queue)
        queue.clear()
        for outcome in executor.run(jobs):
            yield [outcome]


class SerialExecutor:
    """Runs in this process, several at once where the isolation says so: the reference, and for debugging."""

    apart = False

    def __init__(self, spec: ScenarioSpec, timeout: float | None = None):
        self._files = LoadedAnew()
        with self._files.collected():
            self._scenarios = tuple(level.resolve().limited(timeout) for level in spec.levels)

    def __enter__(self) -> Self:
        """Let the scenario load what is slow to load."""
        open_missing()
        with self._files.collected():
            for scenario in self._scenarios:
                prepare(scenario)
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job, in order; see `groups`."""
        for outcomes in self.groups(deque(jobs)):
            yield from outcomes

    def groups(self, queue: deque[Job]) -> Iterator[list[Outcome]]:
        """Yield the outcomes in order, those of runs that take no time together.

        Raises:
            InputError: a file that runs load anew has changed.
            KeyboardInterrupt: Ctrl-C, after the run that was at work at the latest.
        """
        place, depth = Path.cwd(), sys.getrecursionlimit()
        while queue:
            simulate = self._scenarios[queue[0].level].simulate
            together = isinstance(simulate, Batched) and simulate.batched
            with interruption.handled():  # which tells Ctrl-C from a KeyboardInterrupt that the scenario's code raises
                outcomes = self._together(queue) if together else self._alone(queue)
            _restore(place, depth)
            self._files.check()
            yield outcomes

    def _together(self, queue: deque[Job]) -> list[Outcome]:
        """Run the next jobs at once."""
        jobs = [queue.popleft() for _ in range(min(CHUNK, len(queue)))]
        return run_at_levels(self._scenarios.__getitem__, jobs, lambda _: None)

    def _alone(self, queue: deque[Job]) -> list[Outcome]:
        """Run the next job, and more where that takes no time."""
        start = time.perf_counter()
        outcomes: list[Outcome] = []
        while queue and (not outcomes or time.perf_counter() - start < _QUICK):
            job = queue.popleft()
            outcomes.append(run_job(self._scenarios[job.level], job))
        return outcomes


def _restore(place: Path, depth: int) -> None:
    """Undo what a run may do to its process: the next one and the campaign find folder, streams and recursion limit."""
    sys.setrecursionlimit(depth)
    open_missing()
    try:
        moved = Path.cwd() != place
    except FileNotFoundError:  # a folder that the run has removed since
        moved = True
    if moved:
        os.chdir(place)


def chunk_of(queue: deque[Job], size: float, workers: int) -> list[Job]:
    """Take about `size` jobs from a queue, fewer towards its end, so that every worker stays busy."""
    n = max(1, min(int(size), CHUNK, len(queue) // (2 * max(workers, 1))))
    return [queue.popleft() for _ in range(min(n, len(queue)))]
