"""Who writes a store: the process that holds its lock says so in the lock's file, and sees to it that the store stays."""

from __future__ import annotations

import fcntl
import json
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from sbt.errors import StoreError
from sbt.processes import ProcessId, machine
from sbt.store.layout import DATABASE

__all__ = ["LOCK", "Lock", "Writer", "locked", "released", "writer_of", "written"]

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


@dataclass
class Lock:
    """The lock of a store, held until it is released.

    Args:
        file: of the lock.
        database: the store's file, wherever this process goes.
        known: which file that is (device and number); None: there was none yet.
    """

    file: IO[str]
    database: Path
    known: tuple[int, int] | None = None

    def must_stay(self) -> None:
        """Refuse to write into a file that is no longer in its place: what is written there is lost, or nobody finds it.

        Raises:
            StoreError: it is gone, or there is another one.
        """
        if self.known is not None and _file_at(self.database) != self.known:
            rule = "a store must stay where it is while its campaign runs"
            gone = f"{self.database.parent} was removed, moved or replaced"
            raise StoreError(f"{rule}, but {gone}; what was run until then is where it is now, if anywhere")


def _file_at(path: Path) -> tuple[int, int] | None:
    """Return which file is at a path; None: none."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_dev, found.st_ino


def locked(folder: Path) -> Lock | None:
    """Return a store's lock, which the caller holds until it is released; None: another process holds it."""
    lock = (folder / LOCK).open("a+", encoding="utf-8")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return Lock(lock, folder.absolute() / DATABASE)


def written(lock: Lock, finished: int) -> None:
    """Say in a lock's file that this process writes the store, with so many runs finished; from now on the store must stay."""
    lock.known = _file_at(lock.database)
    this = ProcessId.current()
    _replace(lock.file, json.dumps(asdict(Writer(machine(), this.pid, this.start, time.monotonic(), finished))))


def released(lock: Lock) -> None:
    """Say that nobody writes the store, and release the lock."""
    with suppress(OSError):
        _replace(lock.file, "")
    lock.file.close()


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
