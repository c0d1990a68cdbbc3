"""The errors a user can meet: one base class, one name a cause.

`InputError` is the user's to mend (exit code 2 of the command line); `StoreError` is about the
folder of a campaign; `RunError` ends one run and becomes a row of the store, never an abort.
"""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

__all__ = [
    "RAISED", "FailedRunsError", "InputError", "PluginError", "RunError", "SbtError", "StoreError", "UnwritableError",
    "command_of", "described", "did_you_mean", "must_be", "must_take", "naming", "place_of", "shown",
]  # fmt: skip


RAISED = (Exception, SystemExit)
"""What somebody's own code may raise and is told of: a `sys.exit()` in it would end the program, maybe with exit code 0."""

_LONG = 60
"""Characters of a value that messages show."""


class SbtError(Exception):
    """Base of every error this package raises on purpose."""


class InputError(SbtError, ValueError):
    """A value from outside breaks a rule; the message states the rule, then the value."""


class PluginError(InputError):
    """A named scenario, metamodel, acquisition or metric cannot be loaded."""


class FailedRunsError(SbtError):
    """So many runs failed that the others tell nothing; the message says why the first one did (exit code 4)."""


class StoreError(SbtError):
    """The store cannot be read or written, or belongs to another configuration."""


class UnwritableError(SbtError, OSError):
    """A file cannot be written: its folder is read-only, the disk is full."""

    def __str__(self) -> str:
        """Return the file and why."""
        return f"a result must be written, but {self.filename} cannot be: {self.strerror}"


class RunError(SbtError):
    """One run cannot give a metric; `status` is the `Status` value it ends with."""

    def __init__(self, status: str, reason: str):
        super().__init__(reason)
        self.status = status
        self.reason = reason

    def __reduce__(self) -> tuple[type[RunError], tuple[str, str]]:
        """Pickle by status and reason (`Exception` would call `__init__` with the reason alone)."""
        return type(self), (self.status, self.reason)


def must_be(rule: str, value: object, *kinds: type) -> None:
    """Refuse a value that is none of these types; True and False are no numbers.

    Raises:
        InputError: the rule, then the value.

    >>> must_be("a name must be text", "a", str)
    """
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise InputError(f"{rule}, but got {shown(value)}")


def shown(value: object) -> str:
    """Return a value as Python writes it, the middle of a long one left out.

    >>> shown(1.5), shown(10**400)
    ('1.5', '1000000000000000000000000000000 ... 000000000000000000000000000000 (401 characters)')
    """
    try:
        text = repr(value)
    except Exception:  # of somebody's own class, or of more digits than Python writes
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _LONG else f"{text[: _LONG // 2 + 1]} ... {text[-_LONG // 2 :]} ({len(text):,} characters)"


def command_of(*words: str | Path) -> str:
    """Return a command to type; a path that would be taken for an option is written from the working directory.

    >>> command_of("sumo-sbt", "replay", Path("-my runs"), "7")
    "sumo-sbt replay './-my runs' 7"
    """
    return shlex.join(f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words)


def must_take(rule: str, function: object, n: int) -> None:
    """Refuse a function that does not take n arguments by position; what wraps another one is asked itself.

    One that is built in tells no signature.

    Raises:
        InputError: the rule, then why not.
    """
    try:
        inspect.signature(function, follow_wrapped=False).bind(*[None] * n)  # type: ignore[arg-type]
    except TypeError as error:
        raise InputError(f"{rule}, but: {error}") from None
    except ValueError:
        pass


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the hint at the end of a message about an unknown name: the closest known one, in any case.

    >>> did_you_mean("Budgte", ["batch", "budget"])
    " (did you mean 'budget'?)"
    >>> did_you_mean("xyz", ["batch", "budget"])
    ''
    """
    if not isinstance(name, str):
        return ""
    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, 1)
    return f" (did you mean '{by_lower[close[0]]}'?)" if close else ""


def described(error: BaseException) -> str:
    """Return type, message and place of an error, on one line where its message has one."""
    try:
        message = str(error)
    except BaseException:  # an exception of a user's own
        message = "(its message cannot be read)"
    return f"{type(error).__name__}{': ' if message else ''}{message} ({place_of(error)})"


@contextmanager
def naming(rule: str) -> Iterator[None]:
    """Return a context in which an error of somebody's own code names the rule that it breaks, and its line.

    Raises:
        SbtError: in place of an error that is not one of this package's.
    """
    try:
        yield
    except SbtError:
        raise
    except RAISED as error:
        raise SbtError(f"{rule}, but raised {described(error)}") from error


def place_of(error: BaseException) -> str:
    """Return file:line where the error was raised."""
    frame = error.__traceback__
    if frame is None:
        return "no place"
    while frame.tb_next is not None:
        frame = frame.tb_next
    return f"{frame.tb_frame.f_code.co_filename}:{frame.tb_lineno}"
