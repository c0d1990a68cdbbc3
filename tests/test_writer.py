"""Who writes a store, and what `status` makes of it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sbt
from sbt.errors import StoreError
from sbt.problem.outcome import Outcome, Status
from sbt.store.database import PlannedRun, Store
from sbt.store.writer import LOCK, Writer, writer_of
from sbt.workflows import status
from sbt.workflows.live import LiveCampaign
from sbt.workflows.status import read_status

CONFIGURATION = {"names": ["a"], "budget": 4}
OPEN_AND_DIE = """
import os, sys
from pathlib import Path
from sbt.store.database import Store
store = Store.open(Path(sys.argv[1]))
os._exit(0)
"""


def test_a_store_names_its_writer_until_it_is_closed(tmp_path: Path) -> None:
    """Running while open, interrupted after its end, dead after a kill, finished with a conclusion; the rate is told."""
    with Store.open(tmp_path, CONFIGURATION) as store:
        store.plan(0, "learning", [PlannedRun("learning", {"a": 0.5})] * 2, [1, 2], {})
        store.append(Outcome(0, Status.OK, {"y": 1.0}))
        found = read_status(tmp_path)
        assert (found["state"], found["done"], found["budget"]) == ("running", 1, 4)
        assert found["remaining"] == pytest.approx(3 / found["rate"])
        with pytest.raises(StoreError, match="takes one writer"):
            Store.open(tmp_path)
        assert read_status(tmp_path)["state"] == "running"  # the one that was refused took nothing away
    assert writer_of(tmp_path) is None
    assert read_status(tmp_path)["state"] == "interrupted"
    subprocess.run([sys.executable, "-c", OPEN_AND_DIE, str(tmp_path)], check=True)
    found = read_status(tmp_path)
    assert (found["state"], found["rate"], found["remaining"]) == ("dead", None, None)
    with Store.open(tmp_path) as store:
        store.conclude({"runs": 1})
    assert read_status(tmp_path)["state"] == "finished"


def test_a_writer_of_another_machine_is_not_judged(tmp_path: Path) -> None:
    """Neither running nor dead is said of a process that cannot be seen; text that is no writer names nobody."""
    Store.open(tmp_path, CONFIGURATION).close()
    (tmp_path / LOCK).write_text('{"machine": "other", "pid": 1, "start": 1, "since": 0.0, "finished": 0}')
    assert read_status(tmp_path)["state"] == "elsewhere"
    (tmp_path / LOCK).write_text("[]")
    assert read_status(tmp_path)["state"] == "interrupted"


@pytest.mark.parametrize("concluded", [True, False])
def test_a_process_that_ends_in_order_while_it_is_looked_at_was_not_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, concluded: bool
) -> None:
    """Its name is read, then it concludes, takes its name away and is gone."""
    Store.open(tmp_path, CONFIGURATION).close()
    subprocess.run([sys.executable, "-c", OPEN_AND_DIE, str(tmp_path)], check=True)
    found = writer_of(tmp_path)
    assert read_status(tmp_path)["state"] == "dead"

    def ending(folder: Path) -> Writer | None:
        with Store.open(folder) as store:
            if concluded:
                store.conclude({"runs": 1})
        monkeypatch.setattr(status, "writer_of", writer_of)
        return found

    monkeypatch.setattr(status, "writer_of", ending)
    assert read_status(tmp_path)["state"] == ("finished" if concluded else "interrupted")


def test_a_campaign_begun_anew_in_a_folder_that_was_emptied_is_the_one_that_is_shown(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    settings = {"campaign": "coverage", "scenario": "testbed:four_branch_7", "executor": "serial", "report": False}
    sbt.run(**settings, budget=10, initial=10, store=folder)
    shown = LiveCampaign(folder)
    before = shown.explorer(), shown.critical()
    shutil.rmtree(folder)
    with pytest.raises(StoreError, match="there is none in"):
        shown.critical()
    sbt.run(**settings, budget=20, initial=20, seed=5, store=folder)
    assert (shown.explorer(), shown.critical()) != before
    assert shown.explorer() == LiveCampaign(folder).explorer()
