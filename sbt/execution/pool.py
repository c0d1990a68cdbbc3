"""Pools of worker processes that end with their driver, whatever ends it.

A worker waits for work in a queue that never says that the driver is gone, so it has to notice by itself:

- the kernel kills it as soon as the thread that started it ends (Linux, `PR_SET_PDEATHSIG`), also inside a
  step of SUMO, which lets no other code run. Every process is therefore started by one thread of the driver,
  which lives as long as the driver does;
- it compares the driver's identifier and start time when it begins, since the driver may have died by
  then, and every second after that.

Until it begins a worker waits for nothing but its start-up data, which ends with the driver.
The terminal's signals (Ctrl-C, hangup) are the driver's to handle: they are blocked in a worker from its first
instruction on, and ignored once it has begun.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import queue
import re
import signal
import sys
import threading
import time
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from sbt.errors import InputError
from sbt.execution.starting import TERMINAL_SIGNALS, start_apart
from sbt.execution.streams import SteadyStream, open_missing
from sbt.processes import SCRATCH, ProcessId, exit_words

__all__ = ["broken", "close_pool", "how_ended", "open_pool"]

T = TypeVar("T")

_THREADS = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")}
_PR_SET_PDEATHSIG = 1
_ABANDONED = 3600.0
"""Age of a semaphore (s) from which on its process is taken for ended where there is none of that number."""


def open_pool(workers: int, folder: str) -> Any:
    """Return an executor (as of `concurrent.futures`) of worker processes with one thread each; they start with the first task.

    Args:
        workers: number of processes.
        folder: where the workers make their temporary folders; remove it after `close_pool`.
    """
    from joblib.externals.loky.process_executor import ProcessPoolExecutor

    from sbt.execution.loky_context import Context

    if multiprocessing.current_process().daemon:
        rule = "worker processes need a process that may start some, but this is a daemonic one, such as of multiprocessing.Pool"
        raise InputError(f"{rule}: executor serial runs in it, concurrent.futures.ProcessPoolExecutor has others")
    _remove_semaphores(os.getpid())
    return start_apart(
        lambda: ProcessPoolExecutor(
            max_workers=workers, context=Context(), timeout=None, env={**_THREADS, SCRATCH: folder},
            initializer=_begin, initargs=(ProcessId.current(),),
        )
    )  # fmt: skip


@cache
def _remove_semaphores(pid: int) -> None:
    """Remove the semaphores of this user's pools whose processes were killed all at once, with what would have removed them."""
    with suppress(OSError), os.scandir("/dev/shm") as entries:
        for entry in entries:
            match = re.fullmatch(r"sem\.loky-(\d+)-\w+", entry.name)
            with suppress(OSError):
                state = entry.stat(follow_symlinks=False)
                old = datetime.now(UTC).timestamp() - state.st_mtime > _ABANDONED
                if match and old and state.st_uid == os.getuid() and not ProcessId(int(match[1]), 0).alive:
                    Path(entry.path).unlink()


def close_pool(pool: Any) -> None:
    """Kill the workers of a pool and wait until they have ended.

    What waits to be handed to a worker is forgotten first: loky drops these tasks when it kills the workers, but keeps
    their numbers, and its thread ends with a KeyError (and leaves its semaphores) where it meets one of them afterwards.
    """
    waiting: queue.Queue[int] = pool._work_ids
    with suppress(queue.Empty):
        while True:
            waiting.get_nowait()
    pool.shutdown(wait=True, kill_workers=True)


def how_ended(process: Any) -> str:
    """Return in brackets how a worker of a closed pool ended; "" where that is not known."""
    code = None if process is None else process.exitcode
    return "" if code is None else f" ({exit_words(code)})"


def broken() -> type[BaseException]:
    """Return the error of a pool whose worker died."""
    from joblib.externals.loky.process_executor import BrokenProcessPool

    error: type[BaseException] = BrokenProcessPool
    return error


def _begin(driver: ProcessId) -> None:
    """In a worker: end with the driver, leave the terminal's signals to it, and survive its closed terminal."""
    with suppress(OSError, AttributeError):  # another system than Linux
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if not _has_driver(driver):
        os._exit(1)
    with suppress(OSError, AttributeError):  # what a run sends to its process group reaches neither driver nor other workers
        os.setpgid(0, 0)
        for number in (signal.SIGTTOU, signal.SIGTTIN):  # a terminal stops who uses it from another group than its own
            signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_watch, args=(driver,), name="sbt-driver-watch", daemon=True).start()
    for number in TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)
    open_missing()
    sys.stdout, sys.stderr = SteadyStream(sys.stdout, any_error=True), SteadyStream(sys.stderr, any_error=True)


def _has_driver(driver: ProcessId) -> bool:
    return os.getppid() == driver.pid and driver.alive


def _watch(driver: ProcessId) -> None:
    while _has_driver(driver):
        time.sleep(1.0)
    os._exit(1)
