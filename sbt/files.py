"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sbt.errors import UnwritableError

__all__ = ["as_cell", "move_atomically", "write_atomically"]

_MODE = 0o644


def write_atomically(path: Path, content: str | bytes | Callable[[Path], object]) -> Path:
    """Write a file beside its place and move it there, so that every reader sees the old one or the new one.

    Two processes that write the same file do not disturb each other: the last one wins. Folders that are
    missing are made.

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
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
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


def move_atomically(path: Path, target: Path) -> None:
    """Move a file within a file system, after all of it is on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
    path.replace(target)


def as_cell(value: Any) -> Any:
    """Return what a cell of a table for people holds: a text that a spreadsheet would take for a formula begins with a quote.

    >>> as_cell("=1+1"), as_cell("-3.5"), as_cell("car"), as_cell(-3.5)
    ("'=1+1", '-3.5', 'car', -3.5)
    """
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r", "\n")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
