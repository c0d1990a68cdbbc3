"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path

__all__ = ["move_atomically", "write_atomically"]

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
    """
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
