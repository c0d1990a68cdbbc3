"""Independent tasks in worker processes: one a time here, or several at once in spawned ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import Any, ParamSpec, TypeVar

from sbt import interruption
from sbt.errors import FailedRunsError, InputError, SbtError, described
from sbt.execution.pool import broken, close_pool, how_ended, open_pool
from sbt.processes import scratch

__all__ = ["DiedError", "each", "elsewhere"]

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


class DiedError(SbtError):
    """A worker process died."""


def each(function: Callable[[T], None], items: Sequence[T], workers: int) -> Iterator[tuple[T, SbtError | None]]:
    """Call a function with every item, and yield each as it is done, with the error where it raised one.

    Args:
        function: importable in another process; its results are what it writes.
        items: plain data.
        workers: processes; 1: this one.
    """
    if workers == 1:
        for item in items:
            yield item, _tried(function, item)
        return
    with scratch("tasks") as folder:
        pool = open_pool(workers, folder)
        try:
            futures = {pool.submit(_tried, function, item): item for item in items}
            for future in as_completed(futures):
                try:
                    yield futures[future], future.result()
                except broken():
                    yield futures[future], DiedError("a worker process died; run again to go on")
        finally:
            close_pool(pool)


def elsewhere(seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function in a process of its own and return what it returns, or raise what it raises.

    Args:
        seconds: longest time.
        function: importable in another process.
        *args: plain data.
        **kwargs: plain data.

    Raises:
        DiedError: the process died.
        TimeoutError: it took too long.
    """
    processes: list[Any] = []
    with scratch("tasks") as folder:
        pool = open_pool(1, folder)
        try:
            future = pool.submit(function, *args, **kwargs)
            processes += pool._processes.values()
            result: R = future.result(seconds)
            return result
        except broken():
            pass
        finally:
            close_pool(pool)
    raise DiedError(f"the worker process died{how_ended(next(iter(processes), None))}")


def _tried(function: Callable[[T], None], item: T) -> SbtError | None:
    try:
        function(item)
    except BaseException as error:
        if interruption.is_interruption(error):
            raise KeyboardInterrupt from None
        kind = next((kind for kind in (InputError, FailedRunsError, SbtError) if isinstance(error, kind)), None)
        return SbtError(described(error)) if kind is None else kind(str(error))  # of plain text: it comes from another process
    return None
