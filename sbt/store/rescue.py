"""What of a damaged store is whole, and a new store of that, which a resumed campaign completes to the identical result.

A campaign is a function of its log: what is decided later follows from what stands before. So a store is cut at the
first batch whose plan or proposal is damaged, and runs before it whose outcome is damaged are planned again.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sbt.errors import StoreError
from sbt.problem.plain import JsonMapping
from sbt.processes import own_name, remove_abandoned
from sbt.store.connection import connected, with_room
from sbt.store.history import PLANNED
from sbt.store.layout import DATABASE, OUTCOME, PLAN, SCHEMA, VERSION, checksum_of, reported
from sbt.store.planning import dump

__all__ = ["Diagnosis", "examine", "save"]

_ROW = (*PLAN, *OUTCOME, "plan_checksum", "checksum")


@dataclass(frozen=True)
class Diagnosis:
    """What is whole in a store.

    Attributes:
        structure: what SQLite finds wrong; empty where nothing is.
        configuration: it can be read.
        runs: rows that can be read.
        planned: of these, without an outcome yet.
        damaged_plans, damaged_outcomes: indices of rows of which that is damaged.
        lost_runs, lost_iterations: numbers that are missing between others.
        damaged_iterations, damaged_fits: numbers of batches, and numbers of runs that were learned from.
        damaged_texts: of configuration, conclusion and judgements those that are damaged.
    """

    structure: tuple[str, ...] = ()
    configuration: bool = True
    runs: int = 0
    planned: int = 0
    damaged_plans: tuple[int, ...] = ()
    damaged_outcomes: tuple[int, ...] = ()
    lost_runs: tuple[int, ...] = ()
    damaged_iterations: tuple[int, ...] = ()
    lost_iterations: tuple[int, ...] = ()
    damaged_fits: tuple[int, ...] = ()
    damaged_texts: tuple[str, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether nothing is damaged."""
        return not (
            self.structure or self.damaged_plans or self.damaged_outcomes or self.lost_runs or self.damaged_iterations
            or self.lost_iterations or self.damaged_fits or self.damaged_texts
        )  # fmt: skip


@dataclass
class _Content:
    """The rows of a file that are what was written."""

    meta: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    runs: dict[int, tuple[Any, ...]] = field(default_factory=dict)  # without what follows the plan where that is damaged
    iterations: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    fits: dict[int, tuple[Any, ...]] = field(default_factory=dict)


def examine(folder: Path) -> Diagnosis:
    """Return what of a store is whole; reads every row.

    Raises:
        StoreError: the folder holds no store.
    """
    return _read(Path(folder))[0]


def save(folder: Path, target: Path, configuration: JsonMapping | None = None) -> tuple[int, int]:
    """Write a new store of what is whole, from which `run` goes on.

    Args:
        folder: of the damaged store, which stays as it is.
        target: a folder without a store; made where there is none.
        configuration: as it stands beside the store, in place of a damaged one.

    Returns:
        How many runs it has, and how many of them are planned again.

    Raises:
        StoreError: the configuration is damaged and none is given, or no run can be read, so that nothing can go on, or there
            is a store in the target.
    """
    folder, target = Path(folder), with_room(Path(target))
    found, content = _read(folder)
    if "configuration" not in content.meta and configuration is not None:
        text = dump(dict(configuration))
        content.meta["configuration"] = ("configuration", text, checksum_of("configuration", text))
    if "configuration" not in content.meta:
        raise StoreError(f"a store is saved with its configuration, but that of {folder} is damaged: begin a new campaign")
    if not found.whole and not content.runs:
        raise StoreError(f"a store is saved with its runs, but of {folder} none can be read: begin a new campaign")
    if (target / DATABASE).exists():
        raise StoreError(f"what is saved needs a folder without a store, but there is one in {target}")
    end = _first_unknown(found, content)
    runs = [row for row in content.runs.values() if row[2] < end]
    with reported(target):
        target.mkdir(parents=True, exist_ok=True)
        remove_abandoned(target)
        part = target / f"{own_name(f'.{DATABASE}')}.part"
        with closing(sqlite3.connect(part, isolation_level=None)) as db:
            db.executescript(f"BEGIN; {SCHEMA}")
            kept = [row for key, row in content.meta.items() if found.whole or key == "configuration"]
            db.executemany("INSERT INTO meta VALUES (?, ?, ?)", kept)
            for row in runs:
                names = ("status", *PLAN, "plan_checksum") if len(row) == len(PLAN) + 1 else _ROW
                values = (PLANNED, *row) if len(row) == len(PLAN) + 1 else row
                db.execute(f"INSERT INTO runs ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})", values)
            db.executemany("INSERT INTO iterations VALUES (?, ?, ?, ?)", [r for n, r in content.iterations.items() if n < end])
            fits = [row for row in content.fits.values() if row[1] < end and row[0] <= len(runs)]
            db.executemany("INSERT INTO fits VALUES (?, ?, ?, ?)", fits)
            db.execute(f"PRAGMA user_version = {VERSION}")
            db.execute("COMMIT")
        part.replace(target / DATABASE)
    return len(runs), sum(len(row) == len(PLAN) + 1 or row[len(PLAN)] == PLANNED for row in runs)


def _first_unknown(found: Diagnosis, content: _Content) -> int:
    """Return the number of the first batch that is not known whole; all before it are."""
    end = next((k for k in range(len(content.iterations)) if k not in content.iterations), len(content.iterations))
    if found.whole or not (found.structure or found.damaged_plans or found.lost_runs):
        return end
    known = 0
    while known in content.runs:
        known += 1
    if known == len(content.runs) and not found.structure and not found.damaged_plans:
        return end
    return min(end, content.runs[known - 1][2]) if known else 0  # the batch of the last known run may have lost some


def _read(folder: Path) -> tuple[Diagnosis, _Content]:
    """Return what is whole, and its rows."""
    content, texts, plans, outcomes, steps, fits = _Content(), list[str](), list[int](), list[int](), list[int](), list[int]()
    db = _opened(folder)
    if isinstance(db, str):
        return Diagnosis((db,), configuration=False, damaged_texts=("configuration",)), content
    with reported(folder), closing(db):
        db.text_factory = lambda data: data.decode("utf-8", "replace")
        structure = _structure(db)
        for row in _rows(db, "meta", ("key", "value", "checksum"), "rowid"):
            if row[2] == checksum_of(*row[:2]):
                content.meta[row[0]] = row
            else:
                texts.append(str(row[0]))
        if "configuration" not in content.meta and "configuration" not in texts:
            texts.append("configuration")
        n = len(PLAN)
        for row in _rows(db, "runs", _ROW, "idx"):
            if row[-2] != checksum_of(*row[:n]):
                plans.append(row[0])
            elif row[n] == PLANNED or row[-1] == checksum_of(row[0], *row[n:-2]):
                content.runs[row[0]] = row
            else:
                outcomes.append(row[0])
                content.runs[row[0]] = (*row[:n], row[-2])
        for row in _rows(db, "iterations", ("iteration", "stage", "proposal", "checksum"), "iteration"):
            if row[-1] == checksum_of(*row[:-1]):
                content.iterations[row[0]] = row
            else:
                steps.append(row[0])
        for row in _rows(db, "fits", ("runs", "iteration", "scores", "checksum"), "runs"):
            if row[-1] == checksum_of(*row[:-1]):
                content.fits[row[0]] = row
            else:
                fits.append(row[0])
    sharded = "configuration" in content.meta and "shard" in json.loads(content.meta["configuration"][1])
    return Diagnosis(
        structure, "configuration" in content.meta, len(content.runs) + len(plans),
        sum(row[n] == PLANNED for row in content.runs.values() if len(row) == len(_ROW)), tuple(plans), tuple(outcomes),
        () if sharded else _missing([*content.runs, *plans]), tuple(steps), _missing([*content.iterations, *steps]), tuple(fits),
        tuple(texts),
    ), content  # fmt: skip


def _opened(folder: Path) -> sqlite3.Connection | str:
    """Return a connection to a store's file, or what SQLite says where nothing of it can be read."""
    if not (folder / DATABASE).is_file():
        raise StoreError(f"a store is a folder with a campaign in its {DATABASE}, but there is none in {folder}")
    with reported(folder):
        try:
            return connected(folder / DATABASE)
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError as error:  # its first page is broken, or its end is missing
            return str(error)


def _structure(db: sqlite3.Connection) -> tuple[str, ...]:
    """Return what SQLite finds wrong."""
    try:
        found = [str(row[0]) for row in db.execute("PRAGMA quick_check(10)")]
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:  # its own messages quote what is broken
        return (str(error),)
    return () if found == ["ok"] else tuple(found)


def _rows(db: sqlite3.Connection, table: str, columns: Sequence[str], key: str) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table that can be read: from the front, and behind a broken page from the back."""
    names, seen = ", ".join(columns), set[tuple[Any, ...]]()
    for order in ("ASC", "DESC"):
        try:
            for row in db.execute(f"SELECT {names} FROM {table} ORDER BY {key} {order}"):
                if row not in seen:
                    seen.add(row)
                    yield row
        except sqlite3.DatabaseError:
            continue
        return


def _missing(numbers: Sequence[int]) -> tuple[int, ...]:
    """Return what is missing between 0 and the largest number."""
    there = {number for number in numbers if isinstance(number, int)}
    return tuple(sorted(set(range(min(max(there, default=-1) + 1, 10 * len(there) + 10))) - there))
