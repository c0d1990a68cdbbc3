"""The store of a campaign: one folder, one SQLite file, one writer, one commit a run.

A process that is killed loses no run that was committed. Nor does a power cut lose a plan, a fit or a conclusion, but it may
take a tenth of a second's worth of runs with it, since runs wait for the disk together. They are planned, and run again.

What is in the file is all that a campaign knows: `run` again reads it back and goes on to the
identical result. Any number of processes may read while the driver writes.
"""

from __future__ import annotations

import fcntl
import json
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sbt.errors import StoreError
from sbt.problem.outcome import Job, Outcome
from sbt.store.history import PLANNED, History, Record

__all__ = ["DATABASE", "PlannedRun", "Store"]

DATABASE = "campaign.sqlite"
_VERSION = 1
_TOGETHER = 0.1
"""Seconds within which runs wait for the disk once."""
_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE runs (
    idx INTEGER PRIMARY KEY, stage TEXT NOT NULL, iteration INTEGER NOT NULL, inputs TEXT NOT NULL,
    seed INTEGER NOT NULL, log_q REAL, status TEXT NOT NULL, metrics TEXT NOT NULL DEFAULT '{}',
    reason TEXT NOT NULL DEFAULT '', seconds REAL NOT NULL DEFAULT 0, collisions TEXT NOT NULL DEFAULT '',
    versions TEXT NOT NULL DEFAULT '');
CREATE INDEX unfinished ON runs (status) WHERE status = 'planned';
CREATE TABLE iterations (iteration INTEGER PRIMARY KEY, stage TEXT NOT NULL, proposal TEXT NOT NULL);
CREATE TABLE fits (runs INTEGER PRIMARY KEY, iteration INTEGER NOT NULL, scores TEXT NOT NULL);
"""


@dataclass(frozen=True)
class PlannedRun:
    """A run that a stage asks for, before it has an index."""

    stage: str
    inputs: Mapping[str, float]
    log_q: float | None = None


class Store:
    """A campaign's folder, open for reading or (by one process at a time) for writing.

    Use `Store.create`, `Store.resume` and `Store.read`; each is a context manager.

    Raises:
        StoreError: the folder cannot be read or written, holds no campaign, is being written by
            another process, or was made by a newer version.
    """

    def __init__(self, folder: Path, connection: sqlite3.Connection, lock: Any = None):
        self.folder = folder
        self._db = connection
        self._lock = lock
        self._may_hurry, self._waits = False, True  # commits need not wait for the disk, and do
        self._waited = -_TOGETHER  # when a run last did, on the monotonic clock

    @classmethod
    def open(cls, folder: Path, configuration: Mapping[str, Any], *, durable: bool = True) -> Store:
        """Open for writing: a new store with this configuration, or the one that is there.

        Args:
            folder: made where there is none.
            configuration: what must not change between a campaign and its resumption.
            durable: commits reach the disk; False where the whole file can be written again.
        """
        folder = Path(folder)
        with _reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / "campaign.lock").open("w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(f"a store takes one writer, but another process is writing {folder}") from None
            db = sqlite3.connect(folder / DATABASE, isolation_level=None)
            mode = _set_journal(db, durable=durable)
            store = cls(folder, db, lock)
            store._may_hurry = durable and mode == "wal"
            if db.execute("PRAGMA user_version").fetchone()[0] == 0:
                with store._transaction():
                    for statement in _SCHEMA.strip().split(";\n"):
                        db.execute(statement)
                    store._set_meta("configuration", dict(configuration))
                    db.execute(f"PRAGMA user_version = {_VERSION}")
            store._check_version()
            return store

    @classmethod
    def read(cls, folder: Path) -> Store:
        """Open for reading only; works while a campaign writes."""
        if not cls.begun(folder):
            raise StoreError(f"a store is a folder with a campaign in its {DATABASE}, but there is none in {folder}")
        with _reported(Path(folder)):
            store = cls(Path(folder), _connected(Path(folder) / DATABASE))
            store._check_version()
            return store

    @classmethod
    def begun(cls, folder: Path) -> bool:
        """Return whether a campaign is in the folder; False also where its driver died before the file had its tables."""
        path = Path(folder) / DATABASE
        if not path.is_file():
            return False
        with _reported(Path(folder)), closing(_connected(path)) as db:
            return bool(db.execute("PRAGMA user_version").fetchone()[0])

    def __enter__(self) -> Store:
        """Return the store itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file and release the lock."""
        self.close()

    def close(self) -> None:
        """Close the file and release the lock; closing twice is harmless."""
        self._db.close()
        if self._lock is not None:
            self._lock.close()

    def _check_version(self) -> None:
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version != _VERSION:
            raise StoreError(f"{self.folder}: this version reads stores of version {_VERSION}, but got version {version}")

    @contextmanager
    def _transaction(self, *, waits: bool = True) -> Iterator[None]:
        """Return a transaction that waits for the disk at its end, and there takes along those before that did not."""
        with _reported(self.folder):
            if self._may_hurry and waits != self._waits:
                self._db.execute(f"PRAGMA synchronous = {'FULL' if waits else 'NORMAL'}")
                self._waits = waits
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def _set_meta(self, key: str, value: Any) -> None:
        self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, _dump(value)))

    def _get_meta(self, key: str) -> Any:
        row = self._db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return None if row is None else json.loads(row[0])

    @property
    def configuration(self) -> dict[str, Any]:
        """What the campaign was started with."""
        return dict(self._get_meta("configuration") or {})

    def update_configuration(self, configuration: Mapping[str, Any]) -> None:
        """Replace the configuration (a larger budget, another executor)."""
        with self._transaction():
            self._set_meta("configuration", dict(configuration))

    @property
    def conclusion(self) -> dict[str, Any] | None:
        """The result of the campaign as `run --json` prints it; None while it is not finished."""
        found = self._get_meta("conclusion")
        return None if found is None else dict(found)

    def conclude(self, conclusion: Mapping[str, Any]) -> None:
        """Keep the result of the campaign."""
        with self._transaction():
            self._set_meta("conclusion", dict(conclusion))

    def plan(
        self, iteration: int, stage: str, runs: Sequence[PlannedRun], seeds: Sequence[int], proposal: Mapping[str, Any],
        *, indices: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Write a batch before it runs, all of it or nothing.

        Args:
            iteration: number of the batch, from 0.
            stage: what asked for it.
            runs: the batch.
            seeds: one a run.
            proposal: how the batch was chosen (JSON), such as the position in the Sobol sequence.
            indices: of the runs; None: they continue those of the store.
        """
        start = self.planned
        places = range(start, start + len(runs)) if indices is None else indices
        rows = [
            (index, run.stage, iteration, _dump(dict(run.inputs)), seeds[k], run.log_q, PLANNED)
            for k, (index, run) in enumerate(zip(places, runs, strict=True))
        ]
        with self._transaction():
            self._db.executemany(
                "INSERT INTO runs (idx, stage, iteration, inputs, seed, log_q, status) VALUES (?, ?, ?, ?, ?, ?, ?)", rows
            )
            self._db.execute("INSERT INTO iterations VALUES (?, ?, ?)", (iteration, stage, _dump(dict(proposal))))

    def append(self, outcome: Outcome, versions: str = "") -> None:
        """Write one run's outcome."""
        now = time.monotonic()
        waits = now - self._waited >= _TOGETHER
        self._waited = now if waits else self._waited
        with self._transaction(waits=waits):
            self._db.execute(
                "UPDATE runs SET status = ?, metrics = ?, reason = ?, seconds = ?, collisions = ?, versions = ? WHERE idx = ?",
                (str(outcome.status), _dump(dict(outcome.metrics)), outcome.reason, outcome.seconds,
                 outcome.collisions, versions, outcome.index),
            )  # fmt: skip

    def add_fit(self, runs: int, iteration: int, scores: Mapping[str, Any]) -> None:
        """Keep the scores of the metamodel that learned from the first `runs` rows."""
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO fits VALUES (?, ?, ?)", (runs, iteration, _dump(dict(scores))))

    @property
    def planned(self) -> int:
        """Number of runs that were ever planned, finished or not."""
        return int(self._db.execute("SELECT COUNT(*) FROM runs").fetchone()[0])

    @property
    def counts(self) -> dict[str, int]:
        """Number of runs by status, `planned` for those without an outcome."""
        return dict(self._db.execute("SELECT status, COUNT(*) FROM runs GROUP BY status").fetchall())

    def unfinished(self) -> list[Job]:
        """Return the planned runs that have no outcome yet."""
        rows = self._db.execute("SELECT idx, inputs, seed FROM runs WHERE status = ? ORDER BY idx", (PLANNED,))
        return [Job(index, json.loads(inputs), seed) for index, inputs, seed in rows]

    def iterations(self) -> list[dict[str, Any]]:
        """Return how each batch was chosen: iteration, stage and the proposal's own keys."""
        rows = self._db.execute("SELECT iteration, stage, proposal FROM iterations ORDER BY iteration")
        return [{"iteration": i, "stage": stage, **json.loads(proposal)} for i, stage, proposal in rows]

    def fits(self) -> list[dict[str, Any]]:
        """Return the metamodel's scores: runs, iteration and what was measured, in the order of the runs."""
        rows = self._db.execute("SELECT runs, iteration, scores FROM fits ORDER BY runs")
        return [{"runs": n, "iteration": i, **json.loads(scores)} for n, i, scores in rows]

    def history(self) -> History:
        """Return all finished runs as columns."""
        with _reported(self.folder):
            rows = self._db.execute(
                "SELECT idx, stage, iteration, inputs, seed, status, metrics, reason, log_q, seconds, collisions, versions"
                " FROM runs WHERE status != ? ORDER BY idx", (PLANNED,),
            ).fetchall()  # fmt: skip
        records = tuple(
            Record(index, stage, iteration, json.loads(inputs), seed, status, json.loads(metrics), *rest)
            for index, stage, iteration, inputs, seed, status, metrics, *rest in rows
        )
        return History(tuple(self.configuration["names"]), records)


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _connected(path: Path) -> sqlite3.Connection:
    """Open a file for reading only."""
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True, isolation_level=None)
    try:
        db.execute("PRAGMA schema_version").fetchone()
    except sqlite3.OperationalError:  # a WAL file that may not be written beside: read what is committed
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True, isolation_level=None)
    return db


def _set_journal(db: sqlite3.Connection, *, durable: bool) -> str:
    """Use WAL, or the DELETE journal where the file system cannot; return which."""
    mode = db.execute("PRAGMA journal_mode = WAL").fetchone()[0]
    if mode != "wal":
        db.execute("PRAGMA journal_mode = DELETE")
    db.execute(f"PRAGMA synchronous = {'FULL' if durable else 'OFF'}")
    return str(mode)


@contextmanager
def _reported(folder: Path) -> Iterator[None]:
    """Turn what the disk or SQLite refuses into one clear error; committed runs stay."""
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise StoreError(f"the store must be readable and writable, but {folder} is not: {reason}") from error
