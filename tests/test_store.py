"""The store: what was acknowledged is there, whatever happened afterwards."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.errors import StoreError
from sbt.problem.outcome import Outcome, Status
from sbt.problem.requirement import Requirement
from sbt.store.database import DATABASE, PlannedPoints, PlannedRun, Store
from sbt.store.history import VALIDATION, History
from sbt.store.records import FitRecord, Iteration, Validation

CONFIGURATION = {"names": ["a", "b"], "seed": 3}
BATCH = [PlannedRun("initial", {"a": 0.1 * k, "b": 1 / 3}, -0.5 if k % 2 else None) for k in range(5)]


FIT = FitRecord(3, 0.25, 0.01, 0.1, "ff", Validation(rmse=0.1, n=2), runs=3, iteration=1)


def planned(folder: Path) -> Store:
    store = Store.open(folder, CONFIGURATION)
    store.plan(0, "initial", BATCH, [10, 11, 12, 13, 14], {"method": "rejection"})
    return store


def outcome(k: int, y: float = 0.1) -> Outcome:
    return Outcome(k, Status.OK, {"y": y + k, "z": -1 / 3}, "", 0.01, "ego>co@1.2")


def test_rows_come_back_to_the_last_bit(tmp_path: Path):
    with planned(tmp_path / "s") as store:
        assert [(j.index, j.inputs, j.seed) for j in store.unfinished()] == [
            (k, {"a": 0.1 * k, "b": 1 / 3}, 10 + k) for k in range(5)
        ]
        for k in (3, 0):
            store.append(outcome(k), "sbt 1")
        store.append(Outcome(1, Status.TIMEOUT, {}, "too long: 60 s ünd 'quotes'"))
        store.add_fit(FIT)
        assert [j.index for j in store.unfinished()] == [2, 4]
        assert store.counts == {"ok": 2, "timeout": 1, "planned": 2}
    with Store.read(tmp_path / "s") as store:
        history = store.history()
        assert (store.planned, len(history)) == (5, 3)
        assert store.configuration == CONFIGURATION
        assert store.iterations() == [Iteration(0, "initial", {"method": "rejection"})]
        assert store.fits() == [FIT]
    np.testing.assert_array_equal(history.index, [0, 1, 3])
    np.testing.assert_array_equal(history.x, [[0.0, 1 / 3], [0.1, 1 / 3], [0.1 * 3, 1 / 3]])
    np.testing.assert_array_equal(history.y("y"), [0.1, np.nan, 3.1])
    np.testing.assert_array_equal(history.ok, [True, False, True])
    assert history.records[1].reason == "too long: 60 s ünd 'quotes'"
    assert [r.log_q for r in history.records] == [None, -0.5, -0.5]
    assert history.records[0].collisions == "ego>co@1.2"


def test_a_design_gives_the_jobs_and_rows_that_a_store_gives_of_its_runs(tmp_path: Path):
    x = np.column_stack([np.random.default_rng(0).normal(size=6), [2.0, 0.0, 1.0, 1.0, -0.0, 2.0]])
    points = PlannedPoints("initial", x, ("a", "b"), {"b": ("left", "middle", "right")})
    kept = {**CONFIGURATION, "described": {"inputs": [{"name": "b", "choices": ["left", "middle", "right"]}]}}
    found = []
    for k, runs in enumerate((points, list(points), [points[k] for k in range(-6, 0)], [*points[:2], *points[2:]])):
        with Store.open(tmp_path / str(k), kept) as store:
            store.plan(0, "initial", runs, range(6), {})
            found.append((store.unfinished(), store._select("SELECT * FROM runs")))
    assert all(each == found[0] for each in found)
    assert list(points.jobs(0, range(6))) == found[0][0]


def test_a_frame_has_one_column_an_input_and_a_metric(tmp_path: Path):
    with planned(tmp_path) as store:
        store.append(outcome(0))
        store.append(Outcome(1, Status.FAILED, {}, "why"))
        frame = store.history().to_frame(Requirement("y", high=0.5))
    assert list(frame.columns) == [
        "index", "stage", "iteration", "x.a", "x.b", "y.y", "y.z", "critical", "margin", "log_q", "status", "reason", "seed",
        "collisions", "seconds", "versions", "seed_chosen", "level", "warm_up", "unconfirmed",
    ]  # fmt: skip
    assert frame["critical"].isna().tolist() == [False, True]
    assert bool(frame["critical"][0]) is True
    assert frame["margin"][0] == pytest.approx(-0.4)
    assert np.isnan(frame["margin"][1])
    assert frame["status"].tolist() == ["ok", "failed"]
    assert np.isnan(frame["y.y"][1])
    assert np.isnan(frame["log_q"][0])
    assert frame["log_q"][1] == -0.5
    empty = History.of(("a",)).to_frame()
    assert (len(empty), "x.a" in empty.columns) == (0, True)


def test_a_history_keeps_held_out_runs_apart(tmp_path: Path):
    with Store.open(tmp_path, CONFIGURATION) as store:
        store.plan(0, "s", [*BATCH[:3], PlannedRun(VALIDATION, BATCH[3].inputs, 0.0)], [1, 2, 3, 4], {})
        for k in (0, 2, 3):
            store.append(outcome(k))
        store.append(Outcome(1, Status.FAILED, {}, "no"))
        history = store.history()
    assert [r.index for r in history.training.records] == [0, 2]
    assert [r.index for r in history.held_out.records] == [3]
    assert History.of(("a", "b")).x.shape == (0, 2)
    assert History.of(("a", "b")).metrics == ()


def test_a_plan_is_all_or_nothing(tmp_path: Path):
    with Store.open(tmp_path, CONFIGURATION) as store:
        with pytest.raises(ValueError, match="Out of range"):
            store.plan(0, "s", [*BATCH[:2], PlannedRun("s", {"a": float("nan"), "b": 0.0})], [1, 2, 3], {})
        with pytest.raises(ValueError, match="shorter"):
            store.plan(0, "s", BATCH, [1, 2], {})
        with pytest.raises(ValueError, match="Out of range"):
            store.plan(0, "s", BATCH, [1, 2, 3, 4, 5], {"acceptance": float("inf")})
        assert (store.planned, store.iterations()) == (0, [])
        store.plan(0, "s", BATCH, [1, 2, 3, 4, 5], {})
        with pytest.raises(StoreError):
            store.plan(0, "s", BATCH, [1, 2, 3, 4, 5], {})  # the iteration is there already
        assert store.planned == 5
        assert len(store.history()) == 0


WRITER = """
import sys
from pathlib import Path
from sbt.problem.outcome import Outcome, Status
from sbt.problem.requirement import Requirement
from sbt.store.database import PlannedRun, Store

store = Store.open(Path(sys.argv[1]), {"names": ["a"]})
store.plan(0, "s", [PlannedRun("s", {"a": k / 7}) for k in range(100000)], range(100000), {})
for k in range(100000):
    store.append(Outcome(k, Status.OK, {"y": k / 3}))
    print(k, flush=True)
"""


def test_what_was_acknowledged_survives_a_kill(tmp_path: Path):
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path / "s")], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    acknowledged = [int(writer.stdout.readline()) for _ in range(60)]
    with Store.read(tmp_path / "s") as reader:  # while it is being written
        first = len(reader.history())
        assert first >= 60
        assert reader.configuration == {"names": ["a"]}
    writer.kill()
    acknowledged += [int(line) for line in writer.stdout.read().splitlines()]
    writer.wait()
    writer.stdout.close()
    with Store.open(tmp_path / "s", {}) as store:  # the lock went with the process
        history = store.history()
        assert store.planned == 100_000
        assert len(history) - len(acknowledged) in (0, 1)  # the last one may be written and not told
        assert [r.metrics["y"] for r in history.records] == [k / 3 for k in range(len(history))]


def test_runs_wait_for_the_disk_together_and_plans_always(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In WAL mode a commit at level FULL (2) waits for the disk and takes along the earlier ones at NORMAL (1)."""
    clock = SimpleNamespace(monotonic=lambda: clock.now, now=0.0)
    monkeypatch.setattr("sbt.store.database.time", clock)

    def level() -> int:
        return int(store._db.execute("PRAGMA synchronous").fetchone()[0])

    with planned(tmp_path / "s") as store:
        assert level() == 2
        levels = []
        for k in (0, 1, 2):
            store.append(outcome(k))
            levels.append(level())
            with Store.read(tmp_path / "s") as reader:
                assert len(reader.history()) == k + 1  # committed, for every other process
        assert levels == [2, 1, 1]
        clock.now = 0.1
        store.append(outcome(3))
        assert level() == 2
        store.append(outcome(4))
        assert level() == 1
        store.add_fit(dataclasses.replace(FIT, runs=5))
        assert level() == 2


def test_one_writer_any_number_of_readers(tmp_path: Path):
    with planned(tmp_path) as store:
        with pytest.raises(StoreError, match="takes one writer, but another process is writing"):
            Store.open(tmp_path, CONFIGURATION)
        with Store.read(tmp_path, live=True) as one, Store.read(tmp_path, live=True) as two:
            store.append(outcome(0))
            assert len(one.history()) == len(two.history()) == 1
            with pytest.raises(StoreError, match="must be readable and writable"):
                one.append(outcome(1))
        store.append(outcome(1))
    with Store.open(tmp_path, CONFIGURATION) as store:
        store.close()
        store.close()


def test_a_batch_planned_while_a_reader_reads_is_not_half_seen(tmp_path: Path):
    """Between any two statements of a reader the writer may plan runs and finish some; no row is then damaged, or passed over."""
    with planned(tmp_path) as writer, Store.read(tmp_path, live=True) as reader:
        for k in range(5):
            writer.append(outcome(k))
        statements: list[str] = []

        def plans(statement: str) -> None:
            statements.append(statement)
            if "FROM runs WHERE idx >=" in statement and writer.end == 5:  # the reader has asked which run is unfinished: none
                writer.plan(1, "initial", BATCH, [20, 21, 22, 23, 24], {})
                writer.append(outcome(7))

        reader._db.set_trace_callback(plans)
        assert list(reader.history().index) == [0, 1, 2, 3, 4]
        assert writer.end == 10, statements  # it did plan between two statements
        reader._db.set_trace_callback(None)
        assert list(reader.history().index) == [0, 1, 2, 3, 4, 7]
        for k in (5, 6, 8, 9):
            writer.append(outcome(k))
        assert list(reader.history().index) == list(range(10))


@pytest.mark.parametrize("text", ["no file 'r\udcfcck.xml'", "x" * 10**7, "\x00\x1b[31m"])
def test_any_message_of_a_run_can_be_kept(tmp_path: Path, text: str):
    """A file's name that is no Unicode, or a dump of 10 MB: the campaign goes on, and the store stays small."""
    with planned(tmp_path) as store:
        store.append(Outcome(0, Status.FAILED, {}, text, 1.0, collisions=text[:20]))
        (kept,) = store.history().reason
    assert kept.startswith(text[:8])
    assert len(kept) < 11_000
    assert list(Store.read(tmp_path).history().reason) == [kept]


def test_a_store_is_read_as_it_was_at_one_moment(tmp_path: Path):
    """What a campaign writes while its store is read, its end too, is seen by those who open it later, whole."""
    with planned(tmp_path) as writer:
        writer.append(outcome(0))
        with Store.read(tmp_path) as before, Store.read(tmp_path, live=True) as live:
            writer.plan(1, "boundary", BATCH, [20, 21, 22, 23, 24], {})
            for k in range(1, 10):
                writer.append(outcome(k))
            writer.conclude({"conclusion": {}})
            assert (len(before.history()), len(before.iterations()), before.conclusion) == (1, 1, None)
            assert before.counts == {"ok": 1, "planned": 4}
            with live.one_moment():
                assert len(live.history()) == 10
                writer.plan(2, "boundary", BATCH, [30, 31, 32, 33, 34], {})
                assert len(live.iterations()) == 2
            assert len(live.iterations()) == 3
        with Store.read(tmp_path) as after:
            assert (len(after.history()), len(after.iterations()), after.conclusion) == (10, 3, {"conclusion": {}})


def test_a_store_that_is_locked_is_not_read_past_its_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Only where nothing may be written beside the file is it read as one that does not change."""
    planned(tmp_path).close()
    opened, connect = list[str](), sqlite3.connect

    class Refusing:
        def __init__(self, code: int):
            self.error = sqlite3.OperationalError("said by a test")
            self.error.sqlite_errorcode = code

        def execute(self, _: str) -> None:
            raise self.error

        def close(self) -> None:
            pass

    def refused(code: int) -> None:
        def connecting(address: object, *args: object, **options: object) -> object:
            opened.append(str(address))
            return connect(address, *args, **options) if "immutable" in str(address) else Refusing(code)

        monkeypatch.setattr(sqlite3, "connect", connecting)
        Store.read(tmp_path).close()

    for code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_BUSY_RECOVERY, sqlite3.SQLITE_PROTOCOL):
        with pytest.raises(StoreError, match="must be readable and writable"):
            refused(code)
    assert not any("immutable" in address for address in opened)
    for code in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY_DIRECTORY):
        refused(code)
    assert any("immutable" in address for address in opened)


def test_a_store_of_another_version_is_refused_and_untouched(tmp_path: Path):
    planned(tmp_path).close()
    with (tmp_path / DATABASE).open("r+b") as file:
        file.seek(60)  # "user version" in the header of SQLite's files
        file.write((99).to_bytes(4, "big"))
    before = (tmp_path / DATABASE).read_bytes()
    for way in (Store.read, lambda folder: Store.open(folder, CONFIGURATION)):
        for _ in range(2):  # and not, the second time: another process is writing
            with pytest.raises(StoreError, match=r"reads stores of version \d+, but got version 99"):
                way(tmp_path)
    assert (tmp_path / DATABASE).read_bytes() == before


def read_everything(folder: Path) -> None:
    with Store.read(folder) as store:
        _ = store.configuration, store.iterations(), store.fits(), store.history()


@pytest.mark.parametrize(
    ("written", "damaged", "what"),
    [
        (b'{"y":3.1', b'{"y":3.2', "is damaged: the outcome of run 3 "),
        (b"[0.4,0.3", b"[0.5,0.3", "is damaged: run 4 "),
        (b'"rejection"', b'"rejectiom"', "is damaged: iteration 0 "),
        (b'"seed":3', b'"seed":4', "is damaged: the configuration "),
    ],
)
def test_damage_is_told_and_never_read_as_a_result(tmp_path: Path, written: bytes, damaged: bytes, what: str):
    with planned(tmp_path) as store:
        for k in range(5):
            store.append(outcome(k))
    content = (tmp_path / DATABASE).read_bytes()
    assert content.count(written) == 1
    (tmp_path / DATABASE).write_bytes(content.replace(written, damaged))
    with pytest.raises(StoreError, match=what):
        read_everything(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "there is none in"),
        (b"SQLite format 3\x00" + b"\x00" * 50, "is not a database"),
        (b"not a database at all" * 400, "is not a database"),
    ],
)
def test_a_file_that_is_no_store_is_told(tmp_path: Path, content: bytes, message: str):
    (tmp_path / DATABASE).write_bytes(content)
    with pytest.raises(StoreError, match=message):
        Store.read(tmp_path)


def test_a_folder_that_cannot_be_is_told(tmp_path: Path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StoreError, match="must be readable and writable"):
            Store.open(folder, CONFIGURATION)
    with pytest.raises(StoreError, match="there is none in"):
        Store.read(tmp_path / "nothing")
    (tmp_path / "folder" / DATABASE).mkdir(parents=True)
    with pytest.raises(StoreError):
        Store.open(tmp_path / "folder", CONFIGURATION)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_can_be_read_and_not_written(tmp_path: Path):
    with planned(tmp_path / "s") as store:
        store.append(outcome(0))
    (tmp_path / "s").chmod(0o500)
    try:
        with Store.read(tmp_path / "s") as store:
            assert len(store.history()) == 1
        with pytest.raises(StoreError, match="must be readable and writable"):
            Store.open(tmp_path / "s", CONFIGURATION)
    finally:
        (tmp_path / "s").chmod(0o700)


def full(folder: Path, monkeypatch: pytest.MonkeyPatch, pages: int) -> None:
    """Let the disk be full after so many pages of 4 KiB."""
    connect = sqlite3.connect

    def limited(*args: Any, **settings: Any) -> sqlite3.Connection:
        db = connect(*args, **settings)
        db.execute(f"PRAGMA max_page_count = {pages}")
        return db

    monkeypatch.setattr("sbt.store.database.sqlite3.connect", limited)


def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    planned(tmp_path).close()
    size = (tmp_path / DATABASE).stat().st_size // 4096
    with monkeypatch.context() as patch:
        full(tmp_path, patch, size + 1)
        with Store.open(tmp_path, CONFIGURATION) as store:
            store.append(outcome(0))
            with pytest.raises(StoreError, match="database or disk is full"):
                store.append(Outcome(1, Status.OK, {"y": 1.0}, "x" * 20_000))
            assert [r.index for r in store.history().records] == [0]
            store.append(outcome(2))  # the failed transaction is not left open
    with Store.open(tmp_path, CONFIGURATION) as store:
        store.append(outcome(1))
        assert [r.index for r in store.history().records] == [0, 1, 2]


@pytest.mark.slow
def test_a_campaign_on_a_full_disk_goes_on_when_there_is_room(
    campaign: Callable[..., dict[str, Any]], rows: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    whole = campaign("whole", budget=300, initial=40, batch=40)
    with monkeypatch.context() as patch:
        full(Path(), patch, 20)
        with pytest.raises(StoreError, match="database or disk is full"):
            campaign("part", budget=300, initial=40, batch=40)
    with Store.read(Path(whole["store"]).parent / "part") as store:
        assert 0 < len(store.history()) < 300
    assert campaign("part", budget=300, initial=40, batch=40)["runs"] == 300
    assert rows(Path(whole["store"]).parent / "part") == rows(whole["store"])


LIMITED = """
import resource, sys
most = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from sbt.cli import main
main()
"""


def on_a_full_disk(most: int, *command: str) -> subprocess.CompletedProcess[str]:
    """Call the program where no file may have more than `most` bytes."""
    return subprocess.run([sys.executable, "-c", LIMITED, str(most), *command], capture_output=True, text=True, timeout=120)


def test_a_disk_that_refuses_a_bundle_ends_it_with_one_line(campaign: Callable[..., dict[str, Any]], tmp_path: Path):
    store = campaign("whole", budget=200)["store"]
    (tmp_path / "there").mkdir()
    done = on_a_full_disk(40_000, "bundle", store, "--to", str(tmp_path / "there" / "mail.zip"))
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"a bundle must be written into a folder that may be written, but .*mail\.zip: .*\n", done.stderr)
    assert list((tmp_path / "there").iterdir()) == []


def test_a_disk_that_refuses_ends_the_campaign_with_one_line(configured: Callable[..., Path], rows: Callable[..., Any]):
    config = configured("c", budget=600, initial=100, batch=100)
    done = on_a_full_disk(120_000, "run", str(config), "--json")
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"the store must be readable and writable, but .*/c is not: .*\n", done.stderr)
    assert 0 < len(rows(config.parent / "c")["runs"]) < 600


def damaged_somewhere(content: bytes, rng: random.Random, bits: int) -> bytes:
    """Return the bytes of a file with some bits flipped."""
    found = bytearray(content)
    for _ in range(bits):
        found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small campaign that has concluded."""
    folder = tmp_path_factory.mktemp("finished")
    sbt.run(**CAMPAIGN, store=folder, report=False)
    return folder


CAMPAIGN = {"campaign": "coverage", "scenario": "testbed:four_branch_7", "budget": 120, "batch": 10, "executor": "serial"}


def content_of(folder: Path) -> tuple[Any, ...]:
    with Store.read(folder) as store:
        return store.history().records, store.iterations(), store.fits(), store.conclusion, store.configuration, store.counts


@pytest.mark.parametrize("bits", [1, 8])
def test_flipped_bits_are_refused_or_change_nothing(finished: Path, tmp_path: Path, bits: int):
    """A few of those that `benchmarks/faults.py --corruptions` makes."""
    right, content, rng = content_of(finished), (finished / DATABASE).read_bytes(), random.Random(bits)
    refused = 0
    for _ in range(40):
        (tmp_path / DATABASE).write_bytes(damaged_somewhere(content, rng, bits))
        try:
            assert content_of(tmp_path) == right
        except StoreError:
            refused += 1
    assert refused > (5 if bits == 1 else 30)


def test_what_is_whole_is_saved_and_goes_on_to_the_same_rows(finished: Path, tmp_path: Path, rows: Any):
    content = (finished / DATABASE).read_bytes()
    with Store.read(finished) as store:
        history = store.history()
        record = history.record(70)
    whole = sum(each.iteration < record.iteration for each in history.records)
    assert 30 < whole <= 70, "in the batches before its own"
    inputs = json.dumps(list(record.inputs.values()), separators=(",", ":"))
    metric = json.dumps(record.metrics["y"])
    for name, wrong, again, kept in (
        ("outcome", (metric, metric[:-1] + ("1" if metric[-1] != "1" else "2")), 1, 120),
        ("plan", (inputs, inputs.replace("0.", "1.", 1)), 0, whole),
    ):
        folder = tmp_path / name
        folder.mkdir()
        assert content.count(wrong[0].encode()) == 1
        (folder / DATABASE).write_bytes(content.replace(wrong[0].encode(), wrong[1].encode()))
        with pytest.raises(StoreError, match="sumo-sbt doctor"):
            content_of(folder)
        done = CliRunner().invoke(app, ["doctor", str(folder), "--save", str(folder / "new"), "--json"])
        told = json.loads(done.stdout)
        assert (done.exit_code, told["whole"]) == (1, False)
        assert told["saved"] == {"store": str(folder / "new"), "runs": kept, "planned_again": again}
        sbt.run(**CAMPAIGN, store=folder / "new", report=False)
        assert rows(folder / "new")["runs"] == rows(finished)["runs"]
    done = CliRunner().invoke(app, ["doctor", str(finished)])
    assert (done.exit_code, done.stdout) == (0, f"{finished} is whole: 120 runs\n")


def test_a_damaged_configuration_is_taken_from_the_file_beside_it(finished: Path, tmp_path: Path, rows: Any):
    shutil.copytree(finished, tmp_path / "s")
    content = (finished / DATABASE).read_bytes()
    assert content.count(b'"described":') == 1
    (tmp_path / "s" / DATABASE).write_bytes(content.replace(b'"described":', b'"descrixed":'))
    done = CliRunner().invoke(app, ["doctor", str(tmp_path / "s")])
    assert "damaged: configuration" in done.stdout
    assert f"with the configuration of {tmp_path / 's' / 'config.resolved.yaml'}" in done.stdout
    saved = CliRunner().invoke(app, ["doctor", str(tmp_path / "s"), "--save", str(tmp_path / "new"), "--json"])
    assert json.loads(saved.stdout)["saved"] == {"store": str(tmp_path / "new"), "runs": 120, "planned_again": 0}
    sbt.run(**CAMPAIGN, store=tmp_path / "new", report=False)
    assert rows(tmp_path / "new") == rows(finished)
    (tmp_path / "s" / "config.resolved.yaml").unlink()
    lost = CliRunner().invoke(app, ["doctor", str(tmp_path / "s"), "--save", str(tmp_path / "other")])
    assert (lost.exit_code, "begin a new campaign" in lost.output) == (1, True)


@pytest.mark.parametrize("size", [0, 50, 3000, 9000])
def test_of_a_truncated_store_doctor_says_what_can_be_done(finished: Path, tmp_path: Path, size: int):
    (tmp_path / DATABASE).write_bytes((finished / DATABASE).read_bytes()[:size])
    shutil.copy(finished / "config.resolved.yaml", tmp_path)
    done = CliRunner().invoke(app, ["doctor", str(tmp_path)])
    assert done.exit_code == 1
    anew = f"  nothing can be saved; the same campaign anew: sumo-sbt run {tmp_path / 'config.resolved.yaml'} --store NEW"
    assert done.stdout.splitlines()[-1] == anew
    again = CliRunner().invoke(app, ["doctor", str(tmp_path), "--save", str(tmp_path / "new")])
    assert again.exit_code == 1
    assert again.stderr == f"a store is saved with its runs, but of {tmp_path} none can be read: begin a new campaign\n"
    told = CliRunner().invoke(app, ["status", str(tmp_path)])
    assert "malformed" not in told.output


@pytest.mark.parametrize("verb", [["doctor", "--json"], ["doctor", "--save", "x"], ["status"], ["report"], ["bundle"]])
def test_a_folder_that_is_no_store_is_wrong_input_for_every_verb(tmp_path: Path, verb: list[str]):
    for folder in (tmp_path, tmp_path / "none"):
        done = CliRunner().invoke(app, [verb[0], str(folder), *verb[1:]])
        said = f"DIR must be the folder of a campaign (with campaign.sqlite), but got '{folder}'\n"
        assert (done.exit_code, done.stdout, done.stderr) == (2, "", said)


@pytest.mark.skipif(os.name != "posix", reason="other systems have another longest path")
def test_a_path_that_sqlite_takes_no_longer_is_told_before_anything_is_made(tmp_path: Path):
    """It was told as a folder that is not writable, which was there then."""

    def of_length(name: str, n: int) -> Path:
        """Return a folder whose path has n bytes."""
        folder = tmp_path.resolve() / name
        while (missing := n - len(os.fsencode(folder))) > 120:
            folder /= "ü" * 50
        return folder / ("x" * (missing - 1))

    longest = 504 - len(f"/{DATABASE}")
    fits, beyond = of_length("a", longest), of_length("b", longest + 1)
    assert len(os.fsencode(fits.resolve())) == longest
    with planned(fits) as store:
        store.append(outcome(0))
    with Store.read(fits) as store:
        assert len(store.history()) == 1
    said = f"the path of a store must be of at most {longest} bytes, .* has {longest + 1}"
    with pytest.raises(StoreError, match=said):
        Store.open(beyond, CONFIGURATION)
    assert not (tmp_path / "b").exists()
    shutil.copytree(fits, beyond)
    with pytest.raises(StoreError, match=said):
        Store.read(beyond)
    (tmp_path / "link").symlink_to(beyond)
    with pytest.raises(StoreError, match=said):
        Store.open(tmp_path / "link")


@pytest.mark.parametrize("what", ["removed", "moved", "replaced"])
def test_a_folder_that_does_not_stay_ends_its_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str):
    """A campaign ended well, with a conclusion and a report of rows that were gone."""
    monkeypatch.chdir(tmp_path)
    folder, other, calls = Path("s"), Path("other"), []
    with Store.open(other, {"names": ["a"]}):
        pass

    def evaluate(values: dict[str, Any], seed: int) -> dict[str, float]:
        calls.append(seed)
        if len(calls) == 5:
            folder.rename("away") if what != "removed" else shutil.rmtree(folder)
            if what == "replaced":
                shutil.copytree(other, folder)
            os.chdir("/")
        return {"y": values["a"]}

    scenario = sbt.Scenario("leaving", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.1), evaluate=evaluate)
    rule = r"a store must stay where it is while its campaign runs, but .*s was removed, moved or replaced"
    with pytest.raises(StoreError, match=rule):
        sbt.run(campaign="coverage", scenario=scenario, budget=20, executor="serial", store=folder)
    assert len(calls) < 20
    assert (tmp_path / "s").exists() is (what == "replaced")
    if what != "removed":
        with Store.read(tmp_path / "away") as store:
            assert store.planned > 0
            assert store.conclusion is None


def test_a_frame_has_the_columns_of_the_requirement_before_any_run_is_ok(tmp_path: Path):
    """A script that reads `frame["y.g"]` died of it while no run had gone well yet."""
    none = sbt.Scenario("none", [sbt.Parameter("a", 0, 1)], sbt.Requirement("g", high=0.1), evaluate=lambda values, seed: {})
    done = sbt.run(campaign="coverage", scenario=none, budget=4, executor="serial", store=tmp_path / "s", report=False)
    frame = done.frame[["x.a", "y.g", "critical", "margin"]]
    assert len(frame) == 4
    assert frame["y.g"].isna().all()
    assert frame["y.g"].dtype == np.float64
    either = sbt.any_of(sbt.Requirement("g", high=0.1), sbt.Requirement("h", low=3.0))
    assert done.history.to_frame(either)[["y.g", "y.h"]].isna().all(axis=None)
    assert list(done.history.where(np.zeros(4, dtype=bool)).to_frame(either)[["y.g", "y.h"]].dtypes) == [np.float64] * 2


def test_a_store_below_a_link_to_nothing_is_refused_in_words(tmp_path):
    """"File exists" was the reason."""
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(StoreError, match="link is a link to nowhere: not there"):
        Store.open(tmp_path / "link" / "s", {})
