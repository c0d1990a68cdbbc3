"""The store of a campaign: one folder, one SQLite file, one writer, one commit a run.

A process that is killed loses no run that was committed. Nor does a power cut lose a plan, a fit or a conclusion, but it may
take a tenth of a second's worth of runs with it, since runs wait for the disk together. They are planned, and run again.

What is in the file is all that a campaign knows: `run` again reads it back and goes on to the
identical result. Any number of processes may read while the driver writes.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sbt.errors import StoreError
from sbt.problem.description import described_choices
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.plain import Json, JsonMapping
from sbt.store.checks import check_row, check_rows
from sbt.store.connection import connected, is_never_waited_for, one_moment, set_journal, with_room
from sbt.store.history import PLANNED, History, Rows, as_numbers
from sbt.store.layout import DATABASE, OUTCOME, PLAN, SCHEMA, VERSION, checksum_of, checksums_of, damaged, refuse_damage, reported
from sbt.store.planning import PlannedPoints, PlannedRun, dump, dump_metrics, plan_rows, storable, storable_reason
from sbt.store.records import FitRecord, Iteration, Judgement, from_json, to_json
from sbt.store.writer import Lock, locked, released, written

__all__ = ["DATABASE", "PlannedPoints", "PlannedRun", "Store"]

_READ = 2_000
"""Rows that are decoded at once."""
_TOGETHER = 0.1
"""Seconds within which runs wait for the disk once."""
_FIELDS = ("stage", "iteration", "seed", "seed_chosen", "level", "warm_up", "log_q", "status", "reason", "seconds", "collisions",
           "unconfirmed", "versions")  # fmt: skip
"""Columns of a row that a history holds as they are."""
_OUTCOME_OF = f"UPDATE runs SET {', '.join(f'{name} = ?' for name in OUTCOME)}, checksum = ? WHERE idx = ?"


class Store:
    """A campaign's folder, open for reading or (by one process at a time) for writing.

    Use `Store.open` and `Store.read`; both are context managers.

    Raises:
        StoreError: the folder cannot be read or written, holds no campaign, is being written by
            another process, was made by another version, or is damaged.
    """

    def __init__(self, folder: Path, connection: sqlite3.Connection, lock: Lock | None = None):
        self.folder = folder
        self._db = connection
        self._lock = lock
        self._may_hurry, self._waits, self._waited = False, True, -_TOGETHER  # commits may go on at once, wait, last did (clock)
        self._rows: Rows | None = None  # finished rows before the first unfinished one: they never change
        self._read_up_to = 0  # index of the first row not among them
        self._iterations: list[Iteration] = []
        self._fits: list[FitRecord] = []

    @classmethod
    def open(cls, folder: Path, configuration: JsonMapping | None = None, *, durable: bool = True) -> Store:
        """Open for writing: a new store with this configuration, or the one that is there.

        Args:
            folder: made where there is none.
            configuration: what must not change between a campaign and its resumption; None: a new store has no campaign
                until `begin` is called.
            durable: commits reach the disk; False where the whole file can be written again.
        """
        folder = with_room(Path(folder))
        with reported(folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = locked(folder)
            if lock is None:
                raise StoreError(f"a store takes one writer, but another process is writing {folder}")
            db = sqlite3.connect(folder / DATABASE, isolation_level=None)
            store = cls(folder, db, lock)
            store._may_hurry = set_journal(db, durable=durable) == "wal" and durable
            finished = 0
            if db.execute("PRAGMA user_version").fetchone()[0] != 0:
                store._check_version()
                refuse_damage(folder, db)
                finished = store.planned - len(store._select("SELECT idx FROM runs WHERE status = ?", (PLANNED,)))
            elif configuration is not None:
                store.begin(configuration)
            written(lock, finished)
            return store

    def begin(self, configuration: JsonMapping) -> None:
        """Make the tables of a new store, with the configuration of its campaign; a store that has them stays as it is."""
        if self._db.execute("PRAGMA user_version").fetchone()[0] != 0:
            return
        with self._transaction():
            for statement in SCHEMA.strip().split(";\n"):
                self._db.execute(statement)
            self._set_meta("configuration", dict(configuration))
            self._db.execute(f"PRAGMA user_version = {VERSION}")

    @classmethod
    def read(cls, folder: Path, *, live: bool = False) -> Store:
        """Open for reading only, also while a campaign writes: all of it is as it was at one moment.

        Args:
            folder: of the store.
            live: every reading sees what was written meanwhile, but for those within `one_moment`.
        """
        if not cls.begun(folder):
            raise StoreError(f"a store is a folder with a campaign in its {DATABASE}, but there is none in {folder}")
        with reported(Path(folder)):
            store = cls(Path(folder), connected(Path(folder) / DATABASE))
            if not live and is_never_waited_for(store._db):
                store._db.execute("BEGIN")
            store._check_version()
            refuse_damage(store.folder, store._db)
            return store

    @classmethod
    def begun(cls, folder: Path) -> bool:
        """Return whether a campaign is in the folder; False also where its driver died before the file had its tables."""
        path = Path(folder) / DATABASE
        if not path.is_file():
            return False
        with reported(Path(folder)), closing(connected(path)) as db:
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
            released(self._lock)
            self._lock = None

    @contextmanager
    def one_moment(self) -> Iterator[None]:
        """Let all that is read within be as it was at one moment; short, as a writer may have to wait for its end."""
        with reported(self.folder), one_moment(self._db):
            yield

    def _check_version(self) -> None:
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if version != VERSION:
            raise StoreError(f"{self.folder}: this version reads stores of version {VERSION}, but got version {version}")

    @contextmanager
    def _transaction(self, *, waits: bool = True) -> Iterator[None]:
        """Return a transaction that waits for the disk at its end, and there takes along those before that did not."""
        with reported(self.folder):
            if self._lock is not None:
                self._lock.must_stay()
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
        text = dump(value)
        self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?, ?)", (key, text, checksum_of(key, text)))

    def _get_meta(self, key: str) -> Any:
        if self._select("PRAGMA user_version")[0][0] == 0:
            return None
        rows = self._select("SELECT value, checksum FROM meta WHERE key = ?", (key,))
        if not rows:
            return None
        text, checksum = rows[0]
        check_row(self.folder, f"the {key}", checksum, key, text)
        return json.loads(text)

    def _select(self, query: str, values: Sequence[Any] = ()) -> list[Any]:
        """Return all rows of a query."""
        with reported(self.folder):
            return self._db.execute(query, values).fetchall()

    @property
    def configuration(self) -> Json:
        """What the campaign was started with; empty where none was begun."""
        return dict(self._get_meta("configuration") or {})

    def update_configuration(self, configuration: JsonMapping) -> None:
        """Replace the configuration (a larger budget, another executor)."""
        with self._transaction():
            self._set_meta("configuration", dict(configuration))

    @property
    def conclusion(self) -> Json | None:
        """The result of the campaign as `run --json` prints it; None while it is not finished."""
        found = self._get_meta("conclusion")
        return None if found is None else dict(found)

    def conclude(self, conclusion: JsonMapping) -> None:
        """Keep the result of the campaign."""
        with self._transaction():
            self._set_meta("conclusion", dict(conclusion))

    @property
    def judgements(self) -> list[Judgement]:
        """What reference drivers made of some of the runs."""
        return [from_json(Judgement, each) for each in self._get_meta("judgements") or []]

    def judge(self, judgements: Sequence[Judgement]) -> None:
        """Keep what reference drivers made of some of the runs, in place of what was kept."""
        with self._transaction():
            self._set_meta("judgements", to_json(list(judgements)))

    def plan(
        self, iteration: int, stage: str, runs: Sequence[PlannedRun], seeds: Sequence[int], proposal: object,
        *, indices: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        """Write a batch before it runs, all of it or nothing.

        Args:
            iteration: number of the batch, from 0.
            stage: what asked for it.
            runs: the batch.
            seeds: one a run.
            proposal: how the batch was chosen: a record (dataclass) or JSON data.
            indices: of the runs; None: they continue those of the store.
        """
        start = self.end
        places = range(start, start + len(runs)) if indices is None else indices
        rows = plan_rows(iteration, places, runs, seeds, self._known.names, self._warm_ups)
        text = dump(proposal if isinstance(proposal, dict) else to_json(proposal))
        with self._transaction():
            self._db.executemany(
                f"INSERT INTO runs ({', '.join(PLAN)}, plan_checksum, status) VALUES ({', '.join('?' * (len(PLAN) + 2))})", rows
            )
            self._db.execute(
                "INSERT INTO iterations VALUES (?, ?, ?, ?)", (iteration, stage, text, checksum_of(iteration, stage, text))
            )

    def append(self, outcome: Outcome, versions: str = "") -> None:
        """Write one run's outcome."""
        self.append_all([outcome], versions)

    def append_all(self, outcomes: Sequence[Outcome], versions: str = "") -> None:
        """Write the outcomes of runs that ended together, in one commit."""
        now = time.monotonic()
        waits = now - self._waited >= _TOGETHER
        self._waited = now if waits else self._waited
        rows = [
            (o.index, str(o.status), dump_metrics(o.metrics), storable_reason(o.reason), float(o.seconds),
             storable(o.collisions), storable(o.unconfirmed), versions) for o in outcomes
        ]  # fmt: skip
        with self._transaction(waits=waits):
            self._db.executemany(_OUTCOME_OF, ((*r[1:], c, r[0]) for r, c in zip(rows, checksums_of(rows), strict=True)))

    def add_fit(self, fit: FitRecord) -> None:
        """Keep what is known of the metamodel that learned from the first `fit.runs` rows."""
        text = dump(to_json(fit))
        with self._transaction():
            row = (fit.runs, fit.iteration, text, checksum_of(fit.runs, fit.iteration, text))
            self._db.execute("INSERT OR REPLACE INTO fits VALUES (?, ?, ?, ?)", row)
        self._fits = [known for known in self._fits if known.runs < fit.runs]

    @property
    def planned(self) -> int:
        """Number of runs that were ever planned, finished or not."""
        return int(self._select("SELECT COUNT(*) FROM runs")[0][0])

    @property
    def end(self) -> int:
        """Index behind the last run that was ever planned; found at once, where `planned` counts every row."""
        return int(self._select("SELECT IFNULL(MAX(idx), -1) + 1 FROM runs")[0][0])

    @property
    def counts(self) -> dict[str, int]:
        """Number of runs of the scenario itself by status, `planned` for those without an outcome."""
        found = dict(self._select("SELECT status, COUNT(*) FROM runs WHERE level = 0 GROUP BY status"))
        if unknown := set(found) - {PLANNED, *map(str, Status)}:
            raise damaged(self.folder, f"a run has the status {min(map(repr, unknown))}")
        return found

    @property
    def coarse(self) -> int:
        """Number of finished runs of a coarser level of fidelity."""
        return int(self._select("SELECT COUNT(*) FROM runs WHERE level > 0 AND status != ?", (PLANNED,))[0][0])

    @cached_property
    def _warm_ups(self) -> int:
        """Number of warm-ups that the runs of the campaign share; 0: there are none."""
        return int(self.configuration.get("isolation", {}).get("seeds", 0))

    @property
    def _known(self) -> Rows:
        """The finished rows that were read so far, with the names of the inputs."""
        if self._rows is None:
            kept = self.configuration
            self._rows = Rows(tuple(kept["names"]), described_choices(kept.get("described") or {}))
        return self._rows

    def unfinished(self, most: int = -1, since: int = 0) -> list[Job]:
        """Return the planned runs from index `since` on that have no outcome yet; the first `most` of them, -1: all."""
        query = f"SELECT {', '.join(PLAN)}, plan_checksum FROM runs WHERE status = ? AND idx >= ? ORDER BY idx LIMIT ?"
        rows = self._select(query, (PLANNED, since, most))
        check_rows(self.folder, "run", [row[:-1] for row in rows], [row[-1] for row in rows])
        names, values = self._known.names, json.loads(f"[{','.join([row[3] for row in rows])}]")
        return [Job(row[0], dict(zip(names, each, strict=True)), row[4], row[6]) for row, each in zip(rows, values, strict=True)]

    @property
    def first_unfinished(self) -> int | None:
        """Number of the first batch with a run that has no outcome yet; None: there is none."""
        rows = self._select("SELECT iteration FROM runs WHERE status = ? ORDER BY idx LIMIT 1", (PLANNED,))
        return int(rows[0][0]) if rows else None

    def pending(self, since: int) -> History:
        """Return the runs from index `since` on as they were planned, whether they have an outcome or not."""
        rows = self._select(f"SELECT {', '.join(PLAN)}, plan_checksum FROM runs WHERE idx >= ? ORDER BY idx", (since,))
        check_rows(self.folder, "run", [row[:-1] for row in rows], [row[-1] for row in rows])
        found = Rows(self._known.names, self._known.choices)
        columns = dict(zip(PLAN, zip(*rows, strict=True), strict=False)) if rows else {}
        x = as_numbers([json.loads(text) for text in columns.pop("inputs", ())], found.names, found.choices)
        columns["index"], columns["status"] = columns.pop("idx", ()), (PLANNED,) * len(rows)
        found.append(x, columns, [{}] * len(rows))
        return found.history()

    def iterations(self) -> list[Iteration]:
        """Return how each batch was chosen."""
        last = self._iterations[-1].number if self._iterations else -1
        rows = self._select("SELECT * FROM iterations WHERE iteration > ? ORDER BY iteration", (last,))
        for number, stage, text, checksum in rows:
            check_row(self.folder, f"iteration {number}", checksum, number, stage, text)
            self._iterations.append(Iteration(number, stage, json.loads(text)))
        return list(self._iterations)

    def fits(self) -> list[FitRecord]:
        """Return what is known of each fitted metamodel, in the order of the runs."""
        last = self._fits[-1].runs if self._fits else -1
        for runs, iteration, text, checksum in self._select("SELECT * FROM fits WHERE runs > ? ORDER BY runs", (last,)):
            check_row(self.folder, f"the fit after {runs} runs", checksum, runs, iteration, text)
            self._fits.append(from_json(FitRecord, json.loads(text)))
        return list(self._fits)

    def history(self, until: int | None = None, *, level: int | None = 0) -> History:
        """Return all finished runs of a level of fidelity as columns, or those of the batches up to `until`; None: of any level.

        Level 0 is the scenario itself; coarser runs only teach, and are not among its runs. Nothing is decoded twice.
        """
        found = self._finished(until)
        return found if level is None else found.at_level(level)

    def _finished(self, until: int | None) -> History:
        """Return all finished runs, or those of the batches up to `until`."""
        with self.one_moment():
            done = self._known
            pending = self._db.execute("SELECT MIN(idx) FROM runs WHERE status = ?", (PLANNED,)).fetchone()[0]
            end = "" if pending is None else f" AND idx < {int(pending)}"
            self._read_into(done, f"idx >= {self._read_up_to}{end}")
            if done.count:
                self._read_up_to = int(done.history().index[-1]) + 1
            if until is not None:  # of finished batches: none of their rows is pending
                return done.history(int(np.searchsorted(done.history().iteration, until, side="right")))
            if pending is None:
                return done.history()
            some = Rows(done.names, done.choices)  # rows behind one that is still being run may get neighbours later
            self._read_into(some, f"idx > {int(pending)} AND status != '{PLANNED}'")
            return done.history() if some.count == 0 else done.history().extended(some.history())

    def sample(self, most: int) -> History:
        """Return at most so many finished runs, evenly spaced by their index: not all are read."""
        some = Rows(self._known.names, self._known.choices)
        with self.one_moment():
            end = self.end
            places = range(end) if end <= most else [k * end // most for k in range(most)]
            self._read_into(some, f"idx IN ({','.join(map(str, places))}) AND status != '{PLANNED}'")
        return some.history().at_level(0)

    def _read_into(self, rows: Rows, condition: str) -> None:
        """Append the rows that meet a condition, in the order of their index."""
        query = f"SELECT {', '.join((*PLAN, *OUTCOME))}, plan_checksum, checksum FROM runs WHERE {condition} ORDER BY idx"
        cursor = self._db.execute(query)
        n = len(PLAN)
        while found := cursor.fetchmany(_READ):
            check_rows(self.folder, "run", [row[:n] for row in found], [row[-2] for row in found])
            check_rows(self.folder, "the outcome of run", [(row[0], *row[n:-2]) for row in found], [row[-1] for row in found])
            columns = dict(zip((*PLAN, *OUTCOME), zip(*found, strict=True), strict=False))
            x = as_numbers(json.loads(f"[{','.join(columns['inputs'])}]"), rows.names, rows.choices)
            metrics = json.loads(f"[{','.join(columns['metrics'])}]")
            rows.append(x, {"index": columns["idx"], **{name: columns[name] for name in _FIELDS}}, metrics)
