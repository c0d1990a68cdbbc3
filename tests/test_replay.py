"""Replay: a stored run again as a film, as files, in another SUMO program; the same run each time."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_doors import files_of
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError, StoreError
from sbt.metrics.fcd import read_fcd
from sbt.metrics.moments import metric_so_far
from sbt.plugins import forget_files, load, names
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.sumo import gui
from sbt.sumo.nets import lanes
from sbt.sumo.session import libsumo, session
from sbt.workflows.running import replay_run, run_study
from sbt.workflows.study import Study

pytestmark = pytest.mark.sumo

Run = tuple[Path, Trace, LogicalScenario]


def study(text: str) -> Study:
    return Study(parse(text))


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    """A campaign of a few runs of two scenarios: the store, the trace of run 1, the scenario."""
    found = {}
    for name in ("cut_in", "jaywalking"):
        folder = tmp_path_factory.mktemp(name) / "store"
        text = (
            f"campaign: coverage\nscenario: {name}\nbudget: 4\nbatch: 4\nvalidation: {{share: 0}}\n"
            f"executor: {{kind: serial}}\nstore: {folder}\n"
        )
        run_study(study(text), report=False)
        again = replay_run(folder, 1)
        assert again.trace is not None
        found[name] = (folder, again.trace, again.scenario)
    return found


@pytest.mark.parametrize("name", ["cut_in", "jaywalking"])
def test_the_film_is_small_and_plays_in_real_time(name: str, stored: dict[str, Run], tmp_path: Path):
    from PIL import Image

    folder, trace, _ = stored[name]
    done = CliRunner().invoke(app, ["replay", str(folder), "1", "--gif", str(tmp_path / "run.gif"), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["identical"] is True
    assert 5_000 < (tmp_path / "run.gif").stat().st_size < 600_000
    with Image.open(tmp_path / "run.gif") as film:
        pictures, seconds = [], 0.0
        for k in range(film.n_frames):
            film.seek(k)
            seconds += film.info["duration"] / 1000
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    assert seconds == pytest.approx(trace.time[-1] + 1.2, abs=0.35)
    assert np.abs(pictures[-1] - pictures[0]).max() > 50
    blue = (np.abs(pictures[0] - np.array([0x1F, 0x6F, 0xB4])).max(axis=2) < 12).sum()
    assert blue > 100  # ego is there, in its colour


@pytest.mark.parametrize("name", [n for n in names("scenarios") if load("scenarios", n).simulate is not None])
def test_a_metric_so_far_ends_with_the_metric_and_never_recovers(name: str):
    """Otherwise a film would show a run violate a requirement that it met."""
    scenario = load("scenarios", name)
    u = np.random.default_rng(7).random((1, scenario.space.dimension))
    trace = scenario.simulate(dict(zip(scenario.space.names, map(float, scenario.space.from_unit(u)[0]), strict=True)), 5)
    instants = np.unique(np.linspace(0, len(trace.time) - 1, 12).astype(int))
    for metric in scenario.metrics:
        values = metric_so_far(trace, metric, instants)
        assert values[-1] == metric(trace), metric.name
        worse = np.diff(values[np.isfinite(values)]) * (-1.0 if metric.direction == "low" else 1.0)
        assert (worse >= -1e-9).all(), metric.name


def test_what_is_exported_is_the_run(stored: dict[str, Run], tmp_path: Path):
    folder, trace, _ = stored["jaywalking"]
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["replay", str(folder), "1", "--export", str(out), "--trace", str(tmp_path / "t.csv")])
    assert done.exit_code == 0, done.output
    names = {path.name for path in out.iterdir()}
    assert names == {"trace.csv", "fcd.xml", "street.net.xml", "scene.add.xml", "scene.sumocfg"}
    assert (out / "trace.csv").read_bytes() == (tmp_path / "t.csv").read_bytes()
    nowhere = CliRunner().invoke(app, ["replay", str(folder), "1", "--gif", str(tmp_path / "nowhere" / "a.gif")])
    assert nowhere.exit_code == 2
    assert "must be in a folder that is there" in nowhere.output
    recording = read_fcd(out / "fcd.xml")
    assert sorted(recording.names) == sorted(trace.actors)
    assert sorted(recording.length.tolist()) == sorted(trace.length.tolist())
    libsumo()
    with session().run(_setup(), 0, "fresh"):
        libsumo().load(["-c", str(out / "scene.sumocfg"), "--no-step-log", "true", "--no-warnings", "true"])
        shapes = libsumo().polygon.getIDList()
        assert {"ego_start", "ego_end", "ego_path", "child_path", "machine_start"} <= set(shapes)
        first = np.array(libsumo().polygon.getShape("ego_start"))
    assert np.ptp(first[:, 0]) == pytest.approx(5.0, abs=1e-3)


def _setup():
    from sbt.plugins import load
    from sbt.sumo.actors import Scene

    return load("scenarios", "jaywalking").simulate.setup(Scene(()))


def test_exported_positions_follow_sumos_conventions(stored: dict[str, Run], tmp_path: Path):
    import xml.etree.ElementTree as ET

    from sbt.report.outside import write_fcd

    _, trace, _ = stored["jaywalking"]
    write_fcd(tmp_path / "fcd.xml", trace)
    steps = ET.parse(tmp_path / "fcd.xml").getroot().findall("timestep")
    assert len(steps) == len(trace.time)
    ego, child = steps[3].find("vehicle[@id='ego']"), steps[3].find("person[@id='child']")
    assert ego is not None
    assert child is not None
    assert float(ego.attrib["x"]) == pytest.approx(trace.x[3, 0] + 2.5)
    assert float(ego.attrib["angle"]) == pytest.approx(90.0)
    assert float(child.attrib["y"]) == trace.y[3, 1]
    assert float(child.attrib["angle"]) == pytest.approx(0.0, abs=1e-9)


def test_a_replay_that_cannot_be_shown_says_so(stored: dict[str, Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shutil, "which", lambda *_: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    with pytest.raises(InputError, match="needs sumo-gui on the path, but it is not there"):
        gui.gui_program()
    monkeypatch.setattr(shutil, "which", lambda *_: "/bin/sumo-gui")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="needs a display, but neither DISPLAY"):
        gui.gui_program()
    text = f"campaign: coverage\nscenario: testbed:four_branch_7\nbudget: 4\nexecutor: {{kind: serial}}\nstore: {tmp_path}/s\n"
    run_study(study(text), report=False)
    done = CliRunner().invoke(app, ["replay", str(tmp_path / "s"), "1", "--gif", str(tmp_path / "x.gif")])
    assert done.exit_code == 2
    assert "only a run with a trace can be shown" in done.output


@pytest.mark.skipif(shutil.which("sumo") is None, reason="needs the program sumo (extra `tools`)")
@pytest.mark.parametrize("name", ["cut_in", "jaywalking"])
def test_another_sumo_program_shows_the_same_run(name: str, stored: dict[str, Run]):
    folder, trace, scenario = stored[name]
    record = replay_run(folder, 1).record
    program = shutil.which("sumo")
    assert program is not None
    assert gui.run_in_gui(scenario.simulate, record.inputs, record.seed, program).identical(trace)
    assert scenario.simulate(record.inputs, record.seed).identical(trace)  # and libsumo goes on as before


@pytest.mark.parametrize(("shape", "height"), [("0,0,6 100,0", 3.0), ("0,0 100,0,6", 3.0), ("0,0 100,0", 0.0)])
def test_netconvert_leaves_out_heights_of_0(tmp_path, shape, height):
    """A ramp down to 0 ended every report with an internal error."""
    net = tmp_path / "a.net.xml"
    net.write_text(f'<net version="1.20"><edge id="a"><lane id="a_0" index="0" shape="{shape}"/></edge></net>')
    assert [lane.height for lane in lanes(str(net))] == [height]


def test_lanes_are_where_the_network_has_them():
    shapes = lanes("straight")
    assert [lane.shape[0][1] for lane in shapes] == [-8.75, -5.25, -1.75]
    assert {lane.width for lane in shapes} == {3.5}
    assert math.isclose(shapes[0].shape[-1][0], 4000.0)


CAPPED = """
from sbt import Parameter, Requirement, Scenario

SCENARIO = Scenario(
    "capped", inputs=[Parameter("gap", 0, 10, "m")], evaluate=lambda values, seed: {"room": min(4.0, FACTOR * values["gap"])},
    requirement=Requirement("room", high=0.0),
)
"""


def replayed(folder: Path, run: int, *more: str) -> tuple[int, str]:
    forget_files()  # as another process, which has read nothing
    done = CliRunner().invoke(app, ["replay", str(folder), str(run), "--trust", *more])
    return done.exit_code, done.output


def test_a_replay_from_files_that_were_changed_is_not_said_to_be_the_stored_run(tmp_path: Path):
    """A metric at its cap is the same whatever traffic there is: it was said to be identical."""
    file, folder = tmp_path / "capped.py", tmp_path / "store"
    file.write_text(CAPPED.replace("FACTOR", "1.0"))
    sbt.run(
        campaign="coverage", scenario=f"{file}:SCENARIO", budget=8, batch=8, seed=2, store=folder, executor="serial", report=False
    )  # fmt: skip
    room = sbt.open(folder).frame["y.room"]
    at_cap, below = int(room.idxmax()), int(room.idxmin())
    assert room[at_cap] == 4.0 > room[below]
    os.utime(file, (2e9, 2e9))  # a checkout has times of its own: what is in the file counts
    code, said = replayed(folder, at_cap)
    assert code == 0
    assert "\nidentical to the stored run\n" in said
    assert json.loads(replayed(folder, at_cap, "--json")[1])["identical"] is True
    file.write_text(CAPPED.replace("FACTOR", "1.5"))
    os.utime(file, (1e9, 1e9))
    code, said = replayed(folder, at_cap)
    assert code == 0
    assert "identical" not in said
    assert f"files were changed since: {file}" in said
    told = json.loads(replayed(folder, at_cap, "--json")[1])
    assert (told["identical"], told["changed"]) == (None, [str(file)])
    again = sbt.open(folder, trust=True).replay(at_cap)
    assert (again.as_stored, again.identical, again.changed) == (True, False, (file,))
    code, said = replayed(folder, below)
    assert code != 0
    assert "NOT identical" in said
    assert f"changed since: {file}" in said
    assert json.loads(replayed(folder, below, "--json")[1].splitlines()[0])["identical"] is False
    with pytest.raises(StoreError, match=r"changed since: .*capped\.py"):
        sbt.open(folder, trust=True).replay(below)
    file.write_text(CAPPED.replace("FACTOR", "1.0"))
    assert "\nidentical to the stored run\n" in replayed(folder, at_cap)[1], "it is as it was"


def test_files_of_a_store_that_was_moved_with_them_are_known(tmp_path: Path):
    here = tmp_path / "here"
    here.mkdir()
    files_of("own_files", here)
    text = "campaign: coverage\nscenario: scenario.yaml\nbudget: 2\nexecutor: {kind: serial}\n"
    (here / "study.yaml").write_text(text)
    sbt.run(here / "study.yaml", store=here / "store", report=False)
    here.rename(tmp_path / "there")
    for file in (tmp_path / "there").iterdir():
        os.utime(file, (2e9, 2e9))
    store = tmp_path / "there" / "store"
    assert "\nidentical to the stored run\n" in replayed(store, 1)[1]
    cars = tmp_path / "there" / "cars.rou.xml"
    cars.write_text(cars.read_text().replace("<routes>", "<routes><!-- the same -->"))
    code, said = replayed(store, 1)
    assert code == 0
    assert f"all that is stored of the run is the same, but what is not may differ, as files were changed since: {cars}" in said


def test_files_that_a_replay_writes_itself_are_none_of_the_users(tmp_path: Path):
    """The type of an ego of another model is in a file of its own: it was said to have changed since."""
    files_of("own_files", tmp_path)
    ego = "ego: {kind: sumo, model: IDM, tau: 0.8}"
    text = f"campaign: coverage\nscenario: scenario.yaml\nbudget: 2\n{ego}\nexecutor: {{kind: serial}}\n"
    (tmp_path / "study.yaml").write_text(text)
    sbt.run(tmp_path / "study.yaml", store=tmp_path / "store", report=False)
    again = sbt.open(tmp_path / "store", trust=True).replay(1)
    assert (again.identical, again.changed) == (True, ())
    assert "\nidentical to the stored run\n" in replayed(tmp_path / "store", 1)[1]
    cars = tmp_path / "cars.rou.xml"
    cars.write_text(cars.read_text().replace("<routes>", "<routes><!-- the same -->"))
    assert sbt.open(tmp_path / "store", trust=True).replay(1).changed == (cars,)


def test_files_of_another_campaign_are_not_those_of_a_replay(tmp_path: Path):
    """In a Python session both were read; a file that runs alone read is one of the store's."""
    for name in ("own", "other"):
        (tmp_path / name).mkdir()
        files_of("traci_loop", tmp_path / name)
        text = "campaign: coverage\nscenario: scenario.yaml\nbudget: 2\nexecutor: {kind: local, workers: 1}\n"
        (tmp_path / name / "study.yaml").write_text(text)
        sbt.run(tmp_path / name / "study.yaml", store=tmp_path / name / "store", report=False)
    for file in (tmp_path / "other").glob("*.*"):
        file.write_text(file.read_text() + "\n")
        os.utime(file, (2e9, 2e9))
    own, other = (tmp_path / name / "store" for name in ("own", "other"))
    sbt.simulate(tmp_path / "other" / "scenario.yaml")
    assert {path.name for path in sbt.open(other, trust=True).replay(1).changed} >= {"loop.py", "road.net.xml", "scenario.yaml"}
    assert sbt.open(own, trust=True).replay(1).identical
    net = tmp_path / "own" / "road.net.xml"
    net.write_text(net.read_text() + "\n")
    assert sbt.open(own, trust=True).replay(1).changed == (net,)


def test_contacts_of_a_replay_are_compared(stored: dict[str, Run]):
    """Metrics alone were."""
    folder = stored["jaywalking"][0]
    again = replay_run(folder, 1)
    assert again.identical
    assert again.differing == ""
    for field in ("collisions", "unconfirmed"):
        other = dataclasses.replace(again, outcome=dataclasses.replace(again.outcome, **{field: "ego>child@1.2"}))
        assert not other.identical
        assert other.differing.startswith("contacts and doubts ")
        assert "ego>child@1.2" in other.differing
