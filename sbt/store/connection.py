"""Connections to a store's SQLite file."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sbt.errors import StoreError
from sbt.processes import scratch
from sbt.store.layout import DATABASE

__all__ = ["connected", "copy_database", "is_never_waited_for", "one_moment", "set_journal", "with_room"]

_UNWRITABLE = (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
_LONGEST = 504
"""Bytes of the longest path that SQLite opens on a Unix: 512, less the ending of its journal."""


def with_room(folder: Path) -> Path:
    """Return a folder whose path, without links, is short enough for SQLite to open a file in it.

    Raises:
        StoreError: it is too long, or leads through a link to nothing.
    """
    broken = next((part for part in (folder, *folder.parents) if part.is_symlink() and not part.exists()), None)
    if broken is not None:
        what = f"{broken} is a link to {broken.readlink()}: not there"
        raise StoreError(f"the path of a store must lead somewhere, but in {folder} {what}")
    there = Path(os.path.realpath(folder))
    excess = len(os.fsencode(there / DATABASE)) - _LONGEST
    if os.name == "posix" and excess > 0:
        most = _LONGEST - len(os.fsencode(DATABASE)) - 1
        rule = f"the path of a store must be of at most {most} bytes, as SQLite opens no longer ones"
        raise StoreError(f"{rule}, but {there} has {most + excess}")
    return folder


def connected(path: Path) -> sqlite3.Connection:
    """Open a file for reading only."""
    with_room(path.parent)
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True, isolation_level=None)
    try:
        db.execute("PRAGMA schema_version").fetchone()
    except sqlite3.OperationalError as error:
        db.close()
        if error.sqlite_errorcode & 0xFF not in _UNWRITABLE:  # a lock that was not released, say: it may be written right now
            raise
        # beside the file nothing may be written, which WAL needs
        log = path.with_name(f"{path.name}-wal")
        if log.is_file() and log.stat().st_size > 0:  # of a campaign that was killed: what it committed last is only there
            return _copied(path, log)
        db = sqlite3.connect(f"{address}?immutable=1", uri=True, isolation_level=None)
    return db


def _copied(path: Path, log: Path) -> sqlite3.Connection:
    """Open a copy of a file with its log; the copy lives as long as the connection."""
    with scratch("read") as folder:
        for file in (path, log):
            shutil.copyfile(file, Path(folder, file.name))
        with closing(sqlite3.connect(Path(folder, path.name), isolation_level=None)) as copy:
            copy.execute("PRAGMA journal_mode = DELETE")  # takes the log into the file
        db = sqlite3.connect(Path(folder, path.name).as_uri() + "?mode=ro&immutable=1", uri=True, isolation_level=None)
        db.execute("PRAGMA schema_version").fetchone()  # open from now on, also without its name
    return db


def copy_database(source: Path, target: Path) -> None:
    """Write a copy of a file, as it was at one moment; a process may be writing it.

    Raises:
        OSError: the disk is full.
    """
    with closing(connected(source)) as db, closing(sqlite3.connect(with_room(target.parent) / target.name)) as copy:
        try:
            db.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")  # one file, which may lie where nobody may write
        except sqlite3.OperationalError as error:
            raise OSError(errno.EIO, str(error), str(target)) from error


def set_journal(db: sqlite3.Connection, *, durable: bool) -> str:
    """Use WAL, or the DELETE journal where the file system cannot; return which."""
    mode = db.execute("PRAGMA journal_mode = WAL").fetchone()[0]
    if mode != "wal":
        db.execute("PRAGMA journal_mode = DELETE")
    db.execute(f"PRAGMA synchronous = {'FULL' if durable else 'OFF'}")
    return str(mode)


@contextmanager
def one_moment(db: sqlite3.Connection) -> Iterator[None]:
    """Let all statements read the file as it was at one moment; between two statements of its own a writer may plan a batch."""
    if db.in_transaction:
        yield
        return
    db.execute("BEGIN")
    try:
        yield
    finally:
        if db.in_transaction:  # SQLite ends it itself where the disk refuses
            db.execute("COMMIT")


def is_never_waited_for(db: sqlite3.Connection) -> bool:
    """Return whether a writer goes on however long this connection reads: so it is with a write-ahead log alone."""
    return str(db.execute("PRAGMA journal_mode").fetchone()[0]) == "wal"
