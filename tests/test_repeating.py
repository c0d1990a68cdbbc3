"""A run is the same whoever looks at it, and in whatever process; where SUMO cannot promise it, that is said."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from warm_networks import town

import sbt
from sbt.errors import InputError, StoreError
from sbt.execution.spec import ScenarioSpec
from sbt.plugins import read_files
from sbt.sumo.warming import _read
from sbt.workflows import rechecking, running

IGNORING = r'<vType id="\1" jmIgnoreFoeProb="0.5" jmIgnoreFoeSpeed="20"'


def changed(folder: Path, *changes: tuple[str, str], **more: str) -> Path:
    """Write the town with changes of its files by regular expressions, and return the scenario."""
    path = town(folder, **more)
    for file in (path, *folder.glob("*.rou.xml")):
        text = file.read_text()
        for pattern, by in changes:
            text = re.sub(pattern, by, text)
        file.write_text(text)
    return path


@pytest.mark.sumo
def test_looking_at_traffic_does_not_change_it(tmp_path: Path):
    """Where somebody leaves the radius was looked up by what draws a random number for who ignores others."""
    ego = []
    for within in (10, 60):
        path = changed(
            tmp_path / str(within),
            (r'<vType id="(car|fast|slow)"', IGNORING), ("<person .*?</person>", ""), ("duration: 3", "duration: 30"),
            ("ego: {id: ego", f"others: {{within: {within}}}\nego: {{id: ego, may_leave: true"), warm_up="",
        )  # fmt: skip
        ego.append(ScenarioSpec(str(path)).resolve().simulate({"accel": 2.0, "tau": 1.0}, 3).actor("ego"))
    assert np.array_equal(ego[0].x, ego[1].x)
    assert np.array_equal(ego[0].speed, ego[1].speed)


def test_of_a_sublane_state_no_advice_is_read(tmp_path: Path):
    """SUMO reads with it what it has never set; the state of the lane change itself stays, as all does without sublanes."""
    generators = '<rngState default="1"><rngLane state="2"/></rngState>'
    vehicle = '<vehicle id="a" lcStateBase="688132.0{}" posLat="0.06"/>'
    path = tmp_path / "0.state.xml.gz"
    path.write_bytes(gzip.compress(f"<snapshot>{generators}{vehicle.format(' 1.126 8388608.0')}</snapshot>".encode()))
    assert _read(path, sublane=True).after == f"{vehicle.format('')}</snapshot>"
    assert _read(path, sublane=False).after == f"{vehicle.format(' 1.126 8388608.0')}</snapshot>"


@pytest.mark.sumo
@pytest.mark.parametrize(("changes", "told"), [([(r'<vType id="(car)"', IGNORING)], True), ([], False)])
def test_that_sumo_does_not_repeat_every_run_is_said(tmp_path: Path, changes: list[tuple[str, str]], told: bool):
    path = changed(tmp_path / "a", *changes)
    scenario = ScenarioSpec(str(path)).resolve()
    scenario.simulate({"accel": 2.0, "tau": 1.0}, 1)
    assert any("jmIgnoreFoeProb and persons walk" in text for text in scenario.simulate.warnings()) is told
    assert bool(rechecking.not_repeated(scenario)) is told


@pytest.mark.sumo
def test_a_run_that_sumo_does_not_repeat_ends_no_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its resumption was refused for ever; where no reason is known it still is, and a replay tells the reason."""
    path = changed(tmp_path / "a", (r'<vType id="(car)"', IGNORING))
    given = {"campaign": "coverage", "scenario": str(path), "seed": 3, "initial": 4, "batch": 4, "executor": {"kind": "serial"}}
    sbt.run(**given, budget=4, store=tmp_path / "s")
    again = rechecking._again

    def last_differs(*arguments):
        *some, (record, outcome) = again(*arguments)
        yield from some
        yield record, outcome.__class__(outcome.index, outcome.status, {**outcome.metrics, "distance_min": -1.0}, "", 0.0)

    monkeypatch.setattr(rechecking, "_again", last_differs)
    assert len(sbt.run(**given, budget=6, store=tmp_path / "s").frame) == 6
    monkeypatch.setattr(rechecking, "not_repeated", lambda scenario: "")
    with pytest.raises(InputError, match="must give the runs"):
        sbt.run(**given, budget=8, store=tmp_path / "s")
    monkeypatch.undo()
    result = sbt.open(tmp_path / "s")
    monkeypatch.setattr(running.Replay, "as_stored", property(lambda replay: False))
    with pytest.raises(StoreError, match="jmIgnoreFoeProb"):
        result.replay(0)


@pytest.mark.sumo
def test_a_file_that_this_package_writes_is_none_of_the_users(tmp_path: Path):
    """Its name is new in every process: it was named as what had changed since, and every resumption tried twenty runs."""
    insert = "insert: {ego: {at: 44, edge: A2B2, lane: 2, position: 5, speed: 0, to: C3D3}}"
    path = changed(tmp_path / "a", ("<trip id=.ego.*?/>", ""), (r"\nego: ", f"\n{insert}\nego: "))
    ScenarioSpec(str(path)).resolve().simulate({"accel": 2.0, "tau": 1.0}, 1)
    assert {file.parent for file in read_files()} >= {tmp_path / "a"}
    assert not [file for file in read_files() if file.name.startswith("insert-")]
