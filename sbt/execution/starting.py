"""The one thread of a process that starts other processes: it lives as long as the process does, as the kernel asks of it."""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from multiprocessing import resource_tracker
from typing import Any, TypeVar

__all__ = ["TERMINAL_SIGNALS", "start_apart"]

T = TypeVar("T")
TERMINAL_SIGNALS = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
"""What a terminal sends to every process of its group; workers leave them to their driver."""


def start_apart(function: Callable[[], T], abandon: Callable[[T], None] = lambda _: None) -> T:
    """Call a function that starts processes, in the thread that lives as long as this process; return what it returns.

    What it starts, and the threads it starts, have the terminal's signals blocked.

    Args:
        function: to call.
        abandon: is called with its result where the caller is interrupted meanwhile and does not get it.
    """
    starter = _starter(os.getpid())
    if threading.current_thread() is starter.thread:
        return function()
    future = starter.submit(function)
    try:
        return future.result()
    except KeyboardInterrupt:
        if future.exception() is None:
            abandon(future.result())
        raise


class _Starter:
    """The thread that starts processes."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._work, name="sbt-starter", daemon=True)
        self.thread.start()

    def submit(self, function: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        self._tasks.put((function, future))
        return future

    def _work(self) -> None:
        resource_tracker.ensure_running()  # to start it later would let the signals through again
        signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL_SIGNALS)
        while True:
            function, future = self._tasks.get()
            try:
                future.set_result(function())
            except BaseException as error:
                future.set_exception(error)
            del function, future


@cache
def _starter(pid: int) -> _Starter:
    """Return the thread of this process; a forked child has none of its parent's."""
    return _Starter()
