"""A piece of work in a child of this process, which shares what is loaded and ends whatever happens to it.

The child has the network of this process without copying it. It crashes, hangs or leaks alone: this process reads its
answer from a pipe, ends it after its time, and goes on.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import pickle
import select
import signal
import time
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

from sbt import interruption
from sbt.errors import InputError, RunError, described
from sbt.problem.outcome import Status
from sbt.processes import exit_words

__all__ = ["in_fork"]

T = TypeVar("T")
_PR_SET_PDEATHSIG = 1
_TICK = 0.25
"""Interval at which signals to this process are looked for while its child works (s)."""
_IGNORED = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT) if hasattr(signal, "SIGHUP") else (signal.SIGINT,)
"""What a terminal sends to every process of its group: this process answers, and ends its child."""


def in_fork(function: Callable[[], T], limit: float | None, what: str) -> T:
    """Call a function in a child of this process and return what it returns.

    Args:
        function: what it returns can be pickled.
        limit: wall-clock seconds after which the child is ended; None: none.
        what: it is, for messages, such as "a run".

    Raises:
        RunError: the child took too long, died, or raised this error; of what else it raises the text is the reason.
        InputError: the child raised it.
    """
    read, write = os.pipe()
    gc.freeze()  # a collection in the child would copy every page that holds an object
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of other threads, which the child does not need
            pid = os.fork()
        if pid == 0:
            os.close(read)
            _work(function, write)
    finally:
        gc.unfreeze()
    os.close(write)
    return _answer(pid, read, limit, what)


def _work(function: Callable[[], Any], write: int) -> None:
    """Do the work of a child, answer, and end the child; nothing of this process is cleaned up twice."""
    code = 1
    try:
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        for number in _IGNORED:
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        try:
            answer: tuple[str, Any] = ("result", function())
        except RunError as error:
            answer = ("run", (str(error.status), str(error.reason)))
        except InputError as error:
            answer = ("input", str(error))
        except BaseException as error:  # a user's controller may raise anything
            answer = ("run", (str(Status.FAILED), described(error)))
        with os.fdopen(write, "wb") as pipe:
            pickle.dump(answer, pipe, protocol=pickle.HIGHEST_PROTOCOL)
        code = 0
    finally:
        os._exit(code)


def _answer(pid: int, read: int, limit: float | None, what: str) -> Any:
    """Return what a child answers, or raise its error; it has ended then."""
    deadline = None if limit is None else time.monotonic() + limit
    parts: list[bytes] = []
    late = ended = False
    try:
        while not ended and not late:
            if select.select([read], [], [], _TICK)[0]:
                part = os.read(read, 1 << 20)
                parts.append(part)
                ended = not part
            interruption.check()
            late = not ended and deadline is not None and time.monotonic() > deadline
    finally:
        os.close(read)
        if not ended:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if late:
        raise RunError(Status.TIMEOUT, f"{what} must take at most {limit:g} s: its process was stopped")
    if status != 0:
        raise RunError(Status.CRASHED, f"{what} must end by itself, but its process died ({exit_words(status)})")
    kind, answer = pickle.loads(b"".join(parts))
    if kind == "run":
        raise RunError(Status(answer[0]), answer[1])
    if kind == "input":
        raise InputError(answer)
    return answer
