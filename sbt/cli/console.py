"""How the command line speaks: exit codes, errors in one line, a clean stdout, progress on stderr."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any, ParamSpec

import typer

from sbt import interruption
from sbt.cli.progress import ProgressDisplay
from sbt.errors import FailedRunsError, InputError, SbtError, command_of
from sbt.execution.streams import SteadyStream, UnwrittenError, open_missing

__all__ = [
    "Exit", "ProgressDisplay", "clean_stdout", "fail", "fail_where_most_failed", "infinite", "next_command", "print_json",
    "process", "resumable", "verb",
]  # fmt: skip

P = ParamSpec("P")
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_begun = threading.Event()
"""Set when a verb begins: before, there is nothing that an interruption would have to put away."""
_ONCE = 0.5
"""Signals within so many seconds are one: a terminal that closes, or `timeout`, sends it twice."""


class Exit(IntEnum):
    """Exit codes, a contract with scripts."""

    DONE = 0
    INTERNAL = 1
    INPUT = 2
    CRITICAL = 3
    FAILED_RUNS = 4
    INTERRUPTED = 130


def fail(message: str, code: Exit) -> typer.Exit:
    """Print a message on stderr and return the exception that ends the process with this code."""
    print(message, file=sys.stderr, flush=True)
    return typer.Exit(int(code))


def fail_where_most_failed(failed: int, runs: int, more: str) -> None:
    """Raise the exit of runs of which most failed; `more` ends the sentence."""
    if 2 * failed > runs:
        raise fail(f"at most half of the runs may fail, but {failed} of {runs} did{more}", Exit.FAILED_RUNS)


def verb(function: Callable[P, None]) -> Callable[P, None]:
    """Return the verb with errors turned into exit codes; SIGTERM, SIGHUP and SIGQUIT are interruptions like Ctrl-C."""

    @functools.wraps(function)
    def reported(*args: P.args, **kwargs: P.kwargs) -> None:
        _begun.set()
        with _handled():
            try:
                function(*args, **kwargs)
            except typer.Exit:
                raise
            except BaseException as error:
                if os.environ.get("SBT_DEBUG") and not interruption.requested():
                    traceback.print_exc()
                raise fail(*_verdict(error)) from None

    return reported


def _verdict(error: BaseException) -> tuple[str, Exit]:
    """Return what to say of an error, and its exit code."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", Exit.INTERRUPTED
    if isinstance(error, InputError):
        return str(error), Exit.INPUT
    if isinstance(error, FailedRunsError):
        return str(error), Exit.FAILED_RUNS
    if isinstance(error, SbtError):
        return str(error), Exit.INTERNAL
    if isinstance(error, UnwrittenError):
        return f"the output must be written, but it cannot be: {error.strerror}", Exit.INTERNAL
    if isinstance(error, OSError) and error.filename is not None:  # the disk, not the code
        return f"a file must be readable and writable, but {error.filename} is not: {error.strerror}", Exit.INTERNAL
    what = f"{type(error).__name__}: {error}".removesuffix(": ")
    return f"internal error: {what} (SBT_DEBUG=1 shows where)", Exit.INTERNAL


@contextlib.contextmanager
def _handled() -> Iterator[None]:
    """Let a signal interrupt, and say so at once where work can be resumed; the second one ends the process and its workers."""
    first, stderr = math.inf, -1
    with contextlib.suppress(OSError):
        stderr = os.dup(2)  # during a run SUMO's output has taken the place of descriptor 2

    def notify(number: int) -> bool:
        nonlocal first
        now = time.monotonic()
        if first == math.inf:
            first = now
            if not _begun.is_set():  # an exception would end in what is being imported or parsed, which may keep it
                _write(stderr, "interrupted, nothing was run yet")
                os._exit(int(Exit.INTERRUPTED))
            if _resumable:
                name = signal.Signals(number).name
                _write(stderr, f"stopping ({name}): {_resumable[-1].consequence()}; a second signal stops at once")
            return True
        if now - first > _ONCE:
            _write(stderr, "stopped at once")
            os._exit(int(Exit.INTERRUPTED))
        return False

    try:
        with interruption.handled(*_SIGNALS, notify=notify):
            yield
    finally:
        with contextlib.suppress(OSError):
            os.close(stderr)


def _write(descriptor: int, line: str) -> None:
    """Write a line without the streams, which a signal may have found in the middle of another."""
    with contextlib.suppress(OSError):  # nobody is there to read it
        start = "\n" if os.isatty(descriptor) else ""
        os.write(descriptor, f"{start}{line}\n".encode())


class _Resumable:
    """Work that can be resumed as soon as there is something in its folder."""

    def __init__(self, pattern: str, again: str):
        self._folder: Path | None = None
        self._pattern, self._again = pattern, again

    @property
    def folder(self) -> Path | None:
        """The folder; None as long as it is not known."""
        return self._folder

    @folder.setter
    def folder(self, folder: Path) -> None:
        self._folder = folder.absolute()  # a run may be in another working directory when the signal comes

    def consequence(self) -> str:
        """Return what an interruption means now."""
        if self._folder is not None and any(self._folder.glob(self._pattern)):
            return self._again
        return "nothing was run yet"


_resumable: list[_Resumable] = []


@contextlib.contextmanager
def resumable(pattern: str = "campaign.sqlite", again: str = "run again to resume") -> Iterator[_Resumable]:
    """End interrupted work with exit code 130, and say what resumes it; before there are results, that there are none.

    Args:
        pattern: of a file that is in the folder of the results as soon as there are some.
        again: what to do to resume.

    Yields:
        An object whose `folder` has to be set once it is known.
    """
    work = _Resumable(pattern, again)
    _resumable.append(work)
    try:
        yield work
    except KeyboardInterrupt:
        raise fail(f"interrupted, {work.consequence()}", Exit.INTERRUPTED) from None
    finally:
        _resumable.pop()


@contextlib.contextmanager
def process() -> Iterator[None]:
    """Be the process of a command: nobody's closed terminal or pipe ends it, and one that a signal ends, ends with 130."""
    open_missing()
    sys.stdout, sys.stderr = SteadyStream(sys.stdout), SteadyStream(sys.stderr, any_error=True)
    interrupted = False
    try:
        with _handled():
            try:
                yield
            finally:
                interrupted = interruption.requested()
    except SystemExit as end:
        if interrupted:  # Python kills itself with SIGINT, whatever the exit code, where that has ended an `exec` of text
            exec("")  # (of a dataclass, say), unless another one ends well
        if not interrupted or not end.code:
            raise
        raise SystemExit(int(Exit.INTERRUPTED)) from end


@contextlib.contextmanager
def clean_stdout() -> Iterator[None]:
    """Send to stderr what anything below prints to stdout: Python, C++ (SUMO) and worker processes."""
    sys.stdout.flush()
    try:
        same = sys.stdout.fileno() == 1
    except (OSError, ValueError):  # a stream in memory
        same = False
    saved = os.dup(1) if same else None
    try:
        if same:
            os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        if saved is not None:
            os.dup2(saved, 1)
            os.close(saved)


def print_json(value: Any) -> None:
    """Print one JSON object on one line of stdout; NaN and infinity become null."""
    print(json.dumps(_plain(value), allow_nan=False), flush=True)


def infinite(metrics: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """Return what `--json` adds to metrics of which `print_json` makes null: which end of the scale each is at, by name."""
    found = {name: f"{value}" for name, value in metrics.items() if math.isinf(value)}
    return {"infinite": found} if found else {}


def _plain(value: Any) -> Any:
    """Return plain JSON data; scalars of NumPy become Python's."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def next_command(*words: str | Path) -> None:
    """Print the command to try next, on a terminal only: what reads the output is not asked to run anything."""
    if sys.stdout.isatty():
        print(f"next: {command_of(*words)}", flush=True)
