"""Independent tasks in worker processes: one a time here, or several at once in spawned ones."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import TypeVar

from sbt.errors import place_of
from sbt.execution.local import _THREADS, _end_with

__all__ = ["each"]

T = TypeVar("T")


def each(function: Callable[[T], None], items: Sequence[T], workers: int) -> Iterator[tuple[T, str | None]]:
    """Call a function with every item, and yield each as it is done, with the reason where it raised.

    Args:
        function: importable in another process; its results are what it writes.
        items: plain data.
        workers: processes; 1: this one.
    """
    if workers == 1:
        for item in items:
            yield item, _tried(function, item)
        return
    from joblib.externals.loky.backend import get_context
    from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

    context = get_context("loky")
    pool = ProcessPoolExecutor(
        max_workers=workers, context=context, timeout=None, env=_THREADS, initializer=_begin, initargs=(os.getpid(),)
    )
    try:
        futures = {pool.submit(_tried, function, item): item for item in items}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except BrokenProcessPool:
                yield futures[future], "a worker process died; run again to go on"
    finally:
        pool.shutdown(wait=True, kill_workers=True)


def _begin(parent: int) -> None:
    """Leave Ctrl-C to the driver, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)


def _tried(function: Callable[[T], None], item: T) -> str | None:
    try:
        function(item)
    except Exception as error:
        return f"{type(error).__name__}: {error} ({place_of(error)})"
    return None
