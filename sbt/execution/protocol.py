"""What an executor is: jobs in, outcomes out, in any order."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Protocol, Self

from sbt import interruption
from sbt.execution.spec import ScenarioSpec
from sbt.execution.streams import open_missing
from sbt.execution.worker import run_jobs
from sbt.problem.outcome import Job, Outcome
from sbt.problem.scenario import Batched

__all__ = ["CHUNK", "Executor", "SerialExecutor", "chunk_of"]

CHUNK = 64
"""So many runs are begun, at most, before the outcome of the first is there."""


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


class SerialExecutor:
    """Runs in this process, several at once where the isolation says so: the reference, and for debugging."""

    def __init__(self, spec: ScenarioSpec, timeout: float | None = None):
        self._scenario = spec.resolve().limited(timeout)

    def __enter__(self) -> Self:
        """Return the executor."""
        open_missing()
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job, in order.

        Raises:
            KeyboardInterrupt: Ctrl-C, after the run that was at work at the latest.
        """
        simulate = self._scenario.simulate
        size = CHUNK if isinstance(simulate, Batched) and simulate.batched else 1
        for first in range(0, len(jobs), size):
            with interruption.handled():  # which tells Ctrl-C from a KeyboardInterrupt that the scenario's code raises
                outcomes = run_jobs(self._scenario, jobs[first : first + size], lambda _: None)
            yield from outcomes


def chunk_of(queue: deque[Job], size: float, workers: int) -> list[Job]:
    """Take about `size` jobs from a queue, fewer towards its end, so that every worker stays busy."""
    n = max(1, min(int(size), CHUNK, len(queue) // (2 * max(workers, 1))))
    return [queue.popleft() for _ in range(min(n, len(queue)))]
