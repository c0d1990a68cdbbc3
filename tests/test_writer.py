"""Who writes a store, and what `status` makes of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sbt.errors import StoreError
from sbt.problem.outcome import Outcome, Status
from sbt.store.database import PlannedRun, Store
from sbt.store.writer import LOCK, writer_of
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
