"""Connections to a store's SQLite file."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

__all__ = ["connected", "copy_database", "set_journal"]


def connected(path: Path) -> sqlite3.Connection:
    """Open a file for reading only."""
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True, isolation_level=None)
    try:
        db.execute("PRAGMA schema_version").fetchone()
    except sqlite3.OperationalError:  # a WAL file that may not be written beside: read what is committed
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True, isolation_level=None)
    return db


def copy_database(source: Path, target: Path) -> None:
    """Write a copy of a file, as it was at one moment; a process may be writing it."""
    with closing(connected(source)) as db, closing(sqlite3.connect(target)) as copy:
        db.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")  # one file, which may lie where nobody may write


def set_journal(db: sqlite3.Connection, *, durable: bool) -> str:
    """Use WAL, or the DELETE journal where the file system cannot; return which."""
    mode = db.execute("PRAGMA journal_mode = WAL").fetchone()[0]
    if mode != "wal":
        db.execute("PRAGMA journal_mode = DELETE")
    db.execute(f"PRAGMA synchronous = {'FULL' if durable else 'OFF'}")
    return str(mode)
