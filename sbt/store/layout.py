"""What a store's file looks like, and how its parts are told from damaged ones."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sbt.errors import StoreError

__all__ = [
    "DATABASE", "OUTCOME", "PLAN", "SCHEMA", "VERSION", "checksum_of", "checksums_of", "damaged", "refuse_damage", "reported",
]  # fmt: skip

DATABASE = "campaign.sqlite"
VERSION = 2
BROKEN = f"the structure of its {DATABASE} is broken"
SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE runs (
    idx INTEGER PRIMARY KEY, stage TEXT NOT NULL, iteration INTEGER NOT NULL, inputs TEXT NOT NULL,
    seed INTEGER NOT NULL, seed_chosen INTEGER NOT NULL, level INTEGER NOT NULL, warm_up INTEGER, log_q REAL,
    plan_checksum INTEGER NOT NULL, status TEXT NOT NULL, metrics TEXT NOT NULL DEFAULT '{}',
    reason TEXT NOT NULL DEFAULT '', seconds REAL NOT NULL DEFAULT 0, collisions TEXT NOT NULL DEFAULT '',
    unconfirmed TEXT NOT NULL DEFAULT '', versions TEXT NOT NULL DEFAULT '', checksum INTEGER NOT NULL DEFAULT 0);
CREATE INDEX unfinished ON runs (status) WHERE status = 'planned';
CREATE TABLE iterations (iteration INTEGER PRIMARY KEY, stage TEXT NOT NULL, proposal TEXT NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE fits (runs INTEGER PRIMARY KEY, iteration INTEGER NOT NULL, scores TEXT NOT NULL, checksum INTEGER NOT NULL);
"""
PLAN = ("idx", "stage", "iteration", "inputs", "seed", "seed_chosen", "level", "warm_up", "log_q")
OUTCOME = ("status", "metrics", "reason", "seconds", "collisions", "unconfirmed", "versions")


def checksum_of(*parts: Any) -> int:
    """Return the CRC-32 of the parts of a row."""
    return zlib.crc32(repr(parts).encode("utf-8", "surrogatepass"))


def checksums_of(rows: Iterable[tuple[Any, ...]]) -> list[int]:
    """Return `checksum_of` of many rows; in one loop, since a million runs have five million of them."""
    crc32 = zlib.crc32
    return [crc32(repr(row).encode("utf-8", "surrogatepass")) for row in rows]


@contextmanager
def reported(folder: Path) -> Iterator[None]:
    """Turn what the disk or SQLite refuses into one clear error; committed runs stay."""
    try:
        yield
    except UnicodeDecodeError as error:  # messages of SQLite's that quote what is broken
        raise damaged(folder, BROKEN) from error
    except (sqlite3.Error, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        if _is_damage(error):
            raise damaged(folder, f"its {DATABASE} is not a database" if "not a database" in reason else BROKEN) from error
        raise StoreError(f"the store must be readable and writable, but {folder} is not: {reason}") from error


def _is_damage(error: Exception) -> bool:
    """Return whether the content of the file is meant, not the disk, a lock or the rights."""
    if type(error) is sqlite3.DatabaseError:
        return True
    return isinstance(error, sqlite3.OperationalError) and any(t in str(error) for t in ("decode", "malformed", "no such"))


def damaged(folder: Path, what: str) -> StoreError:
    """Return the error of a damaged store; `doctor` tells what SQLite says of its file."""
    return StoreError(f"{folder} is damaged: {what}; sumo-sbt doctor {folder} says what can be saved, and saves it")


def refuse_damage(folder: Path, db: sqlite3.Connection) -> None:
    """Refuse a file whose structure is broken, in which rows may be lost without a trace.

    Raises:
        StoreError: it is broken.
    """
    with reported(folder):
        found = [str(row[0]) for row in db.execute("PRAGMA quick_check(3)")]
    if found != ["ok"]:
        raise damaged(folder, BROKEN)
