"""Who writes a store: the process that holds its lock says so in the lock's file."""

from __future__ import annotations

import fcntl
import json
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from sbt.processes import ProcessId, machine

__all__ = ["LOCK", "Writer", "locked", "released", "writer_of", "written"]

LOCK = "campaign.lock"


@dataclass(frozen=True)
class Writer:
    """A process that opened a store for writing, and did not close it yet.

    Args:
        machine: that it runs on, by a name that is its own.
        pid, start: the process (see `ProcessId`).
        since: when it opened the store (s, on the machine's monotonic clock, which counts from its start).
        finished: runs that the store had then.
    """

    machine: str
    pid: int
    start: int
    since: float
    finished: int

    @property
    def here(self) -> bool:
        """Whether it is a process of this machine."""
        return self.machine == machine()

    @property
    def alive(self) -> bool | None:
        """Whether it still runs; None: it is another machine's, which cannot be known from here."""
        return ProcessId(self.pid, self.start).alive if self.here else None


def locked(folder: Path) -> IO[str] | None:
    """Return the file of a store's lock, which the caller holds until it is closed; None: another process holds it."""
    lock = (folder / LOCK).open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


def written(lock: IO[str], finished: int) -> None:
    """Say in a lock's file that this process writes the store, with so many runs finished."""
    this = ProcessId.current()
    _replace(lock, json.dumps(asdict(Writer(machine(), this.pid, this.start, time.monotonic(), finished))))


def released(lock: IO[str]) -> None:
    """Say that nobody writes the store, and release the lock."""
    with suppress(OSError):
        _replace(lock, "")
    lock.close()


def writer_of(folder: Path) -> Writer | None:
    """Return who opened a store for writing and did not close it: it writes, or was killed; None: nobody.

    The lock itself is not touched, so that no campaign that starts meanwhile finds it taken.
    """
    try:
        found: Any = json.loads((folder / LOCK).read_text(encoding="utf-8"))
        return Writer(**found)
    except (OSError, ValueError, TypeError):
        return None


def _replace(lock: IO[str], text: str) -> None:
    lock.seek(0)
    lock.truncate()
    lock.write(text)
    lock.flush()
