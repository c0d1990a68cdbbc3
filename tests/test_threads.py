"""Threads of one process take turns in SUMO, which has one simulation a process."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

import sbt

pytest.importorskip("libsumo")


def test_campaigns_in_two_threads_have_the_rows_that_each_has_alone(tmp_path: Path):
    frames = {}

    def run(name: str) -> None:
        result = sbt.run(
            campaign="coverage", scenario="cut_in", budget=8, seed=3, store=tmp_path / name, executor="serial", report=False
        )
        frames[name] = result.frame.drop(columns=["seconds"])

    run("alone")
    threads = [threading.Thread(target=run, args=(name,)) for name in ("first", "second")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (frames["alone"]["status"] == "ok").all()
    assert frames["first"].equals(frames["alone"])
    assert frames["second"].equals(frames["alone"])
