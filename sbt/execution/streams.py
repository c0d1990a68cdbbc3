"""Standard streams that nobody can close on a campaign."""

from __future__ import annotations

import codecs
import errno
import io
import os
import sys
from typing import Any, TextIO

__all__ = ["SteadyStream", "UnwrittenError", "open_missing"]

_GONE = (errno.EPIPE, errno.EBADF, errno.EIO, errno.ENXIO)
"""Errors of a stream whose reader has left: a closed pipe, descriptor or terminal."""
_STEADY = {"strict": "backslashreplace", "surrogateescape": "sbt-escape"}
"""By what a stream does with characters that its encoding lacks: what it does here; of ASCII or Latin-1, \\u2264 for ≤."""


def _escaped(error: UnicodeError) -> tuple[str | bytes, int]:
    """Return the bytes that stand in a name of a file, as surrogateescape does, else what stands for the characters."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


codecs.register_error("sbt-escape", _escaped)


class UnwrittenError(OSError):
    """A stream has a reader, but cannot be written to: the disk is full."""


class SteadyStream:
    """A text stream that goes on without its reader: what can no longer be written is dropped.

    Args:
        stream: what is written to.
        any_error: drop the text also where the disk is full, which the result of a command must not do.
    """

    def __init__(self, stream: TextIO, *, any_error: bool = False):
        self._stream, self._any = stream, any_error
        if isinstance(stream, io.TextIOWrapper) and stream.errors in _STEADY:
            stream.reconfigure(errors=_STEADY[stream.errors])
        self.gone = False

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        try:
            return self._stream.write(text)
        except (OSError, ValueError) as error:
            self._drop(error)
            return len(text)

    def flush(self) -> None:
        """Write what is buffered, or drop it."""
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self._drop(error)

    def close(self) -> None:
        """Stay open: the stream belongs to the process."""
        self.flush()

    def __getattr__(self, name: str) -> Any:
        """Return what the stream has of this name."""
        return getattr(self._stream, name)

    def _drop(self, error: OSError | ValueError) -> None:
        """From now on write to nowhere, also what is not Python's (SUMO, child processes)."""
        closed = self._stream.closed
        if isinstance(error, OSError) and not (self._any or error.errno in _GONE):
            raise UnwrittenError(error.errno, error.strerror) from error
        if isinstance(error, ValueError) and not closed:
            raise error
        self.gone = True
        if closed:
            self._stream = open(os.devnull, "w")  # noqa: PTH123, SIM115  (lives as long as the process)
            return
        own = self._stream.fileno()
        numbers = {own}
        if isinstance(error, OSError) and error.errno in _GONE:
            numbers |= {number for number in (1, 2) if os.path.sameopenfile(number, own)}  # `2>&1`: one pipe, two descriptors
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for number in numbers:
            os.dup2(nowhere, number)
        os.close(nowhere)


def open_missing() -> None:
    """Open those of descriptors 0, 1 and 2 that are closed (`2>&-`), so that no file takes their numbers."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            os.set_inheritable(number, True)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
