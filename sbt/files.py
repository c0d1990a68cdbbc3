"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sbt.errors import UnwritableError
from sbt.processes import own_name, remove_abandoned, scratch

__all__ = ["as_cell", "move_atomically", "scratch_in", "write_atomically"]

_MODE = 0o644


def write_atomically(path: Path, content: str | bytes | Callable[[Path], object]) -> Path:
    """Write a file beside its place and move it there, so that every reader sees the old one or the new one.

    Two processes that write the same file do not disturb each other: the last one wins. Folders that are
    missing are made, and what processes left that were killed while they wrote is removed.

    Args:
        path: the file, replaced where it exists.
        content: text (UTF-8), bytes, or what writes the file that it is given; its name ends in `.part`.

    Returns:
        The path.

    Raises:
        UnwritableError: the system does not let it be written.
    """
    try:
        return _written(path, content)
    except OSError as error:
        raise UnwritableError(error.errno, error.strerror or str(error), str(path)) from error


def _written(path: Path, content: str | bytes | Callable[[Path], object]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(path.parent)
    part = path.with_name(f"{own_name(f'.{path.name}')}.part")
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, _MODE))  # the process's umask applies
    try:
        if callable(content):
            content(part)
        else:
            part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return path


def scratch_in(folder: Path | None, kind: str) -> tempfile.TemporaryDirectory[str]:
    """Make a hidden temporary folder in a folder, after what processes left there that were killed is removed.

    None: in that of the system for temporary files.
    """
    return scratch(kind, folder)


def move_atomically(path: Path, target: Path) -> None:
    """Move a file within a file system, after all of it is on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    path.replace(target)


def as_cell(value: Any) -> Any:
    """Return what a cell of a table for people holds: a text that a spreadsheet would take for a formula begins with a quote.

    Carriage returns become ends of lines: writers of CSV leave them unquoted, and a reader begins a row at each.

    >>> as_cell("=1+1"), as_cell("-3.5"), as_cell("car"), as_cell(-3.5)
    ("'=1+1", '-3.5', 'car', -3.5)
    """
    if not isinstance(value, str):
        return value
    value = value.replace("\r\n", "\n").replace("\r", "\n")
    if not value.startswith(("=", "+", "-", "@", "\t", "\n")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
