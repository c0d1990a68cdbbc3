"""Recorded road users as traffic: they are where they were, seen by whoever drives, and made of every kind of recording."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program
from test_evidence import SOUTH_NORTH, TYPES, WEST_EAST, net, vehicle

from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.metrics.conflict_types import conflict_type, describe_conflict_type
from sbt.metrics.fcd import read_fcd
from sbt.metrics.tracks import read_meta, read_recording
from sbt.problem.outcome import Doubt, Status, doubts
from sbt.sumo.ego import Ego
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.sumo.files import SumoFiles
from sbt.sumo.recorded import RecordedTraffic, recorded_tracks
from sbt.sumo.recorded_net import extent, motorway
from sbt.sumo.recorder import RecordingSettings
from sbt.sumo.user_simulation import UserSimulation

CAR, TRUCK, RATE = (4.5, 1.8), (12.0, 2.5), 25
FRAMES = np.arange(1, 126)


def motions() -> dict[str, tuple[np.ndarray, ...]]:
    """Centre x, y (m, up), heading (rad), and speed (m/s) of three vehicles and a person over the frames."""
    t, one = FRAMES / RATE, np.ones(len(FRAMES))
    turn = 0.2 * t
    return {
        "1": (60 + 10 * t, 2 * one, 0 * t, 10 * one),
        "2": (150 - 8 * t + 0.5 * t**2, 6 * one, np.pi * one, 8 - t),
        "3": (90 + 20 * np.sin(turn), 20 * (1 - np.cos(turn)) - 30, turn, 4 * one),
        "4": (70 + 0 * t, -6 + 1.4 * t, 0.5 * np.pi * one, 1.4 * one),
    }


def write(path: Path, columns: str, rows: list[tuple]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns.split(), *rows])


def ind(folder: Path, names: str = "1234") -> Path:
    rows = [
        (0, n, f, x[k], y[k], np.degrees(h[k]) % 360, *(reversed(CAR) if n != "4" else (0, 0)),
         v[k] * np.cos(h[k]), v[k] * np.sin(h[k]))
        for n, (x, y, h, v) in motions().items() if n in names for k, f in enumerate(FRAMES)
    ]  # fmt: skip
    write(folder / "07_tracks.csv", "recordingId trackId frame xCenter yCenter heading width length xVelocity yVelocity", rows)
    classes = [("1", "car"), ("2", "truck_bus"), ("3", "bicycle"), ("4", "pedestrian")]
    write(folder / "07_tracksMeta.csv", "trackId class", classes)
    write(folder / "07_recordingMeta.csv", "frameRate speedLimit", [(RATE, 13.9)])
    return folder / "07_tracks.csv"


def highd(folder: Path) -> Path:
    rows = [
        (f, n, x[k] - CAR[0] / 2, -y[k] - CAR[1] / 2, *CAR, v[k] * np.cos(h[k]), 0)
        for n, (x, y, h, v) in motions().items() if n in "12" for k, f in enumerate(FRAMES)
    ]  # fmt: skip
    write(folder / "01_tracks.csv", "frame id x y width height xVelocity yVelocity", rows)
    meta = (RATE, -1, "-8;-4", "-4;0;4")
    write(folder / "01_recordingMeta.csv", "frameRate speedLimit upperLaneMarkings lowerLaneMarkings", [meta])
    return folder / "01_tracks.csv"


def fcd(folder: Path, names: str = "1234") -> Path:
    rows = [
        (f / RATE, n, x[k] + size / 2 * np.cos(h[k]), y[k] + size / 2 * np.sin(h[k]), (90 - np.degrees(h[k])) % 360, v[k],
         size, wide)
        for n, (x, y, h, v) in motions().items() if n in names for k, f in enumerate(FRAMES)
        for size, wide in [CAR if n != "4" else (0.215, 0.478)]
    ]  # fmt: skip
    write(folder / "fcd.csv", "time id x y angle speed length width", rows)
    return folder / "fcd.csv"


@pytest.mark.parametrize(("make", "names"), [(ind, "1234"), (highd, "12")])
def test_every_format_gives_the_same(tmp_path, make, names):
    one, two = read_recording(make(tmp_path)), read_fcd(fcd(tmp_path, names))
    assert one.names == two.names == tuple(names)
    assert one.start.tolist() == two.start.tolist()
    for name in ("time", "x", "y", "speed", "length", "width"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), abs=1e-9), name
    assert np.exp(1j * one.heading) == pytest.approx(np.exp(1j * two.heading))
    if make is ind:
        assert one.kinds == ("car", "truck_bus", "bicycle", "person")


def test_a_motorway_is_made_of_lane_markings(tmp_path):
    path = highd(tmp_path)
    upper, lower = motorway(read_meta(path), extent(recorded_tracks(path)))
    assert [lane[0, 1] for lane in lower.lanes] == [-2.0, 2.0]  # from the right
    assert upper.lanes[0][0, 0] > upper.lanes[0][1, 0]
    assert (upper.widths, lower.widths) == ((4.0,), (4.0, 4.0))
    assert upper.lanes[0][0, 1] == 6.0


@pytest.mark.parametrize(
    ("text", "words"),
    [("frame,id,x,y\n1,1,0,0\n", "width, height, xVelocity, yVelocity is missing"),
     ("frame,id,x,y,width,height,xVelocity,yVelocity\n1,1,a,0,4,2,5,0\n", "row 2, column x has no finite number: 'a'"),
     ("frame,id,x,y,width,height,xVelocity,yVelocity\n", "none in"),
     ("frame,id,x,y,width,height,xVelocity,yVelocity\n1,1,0,0,4,2,5,0\n1,1,0,0,4,2,5,0\n", "once per time step"),
     ("frame,id,x,y,width,height,xVelocity,yVelocity\n1,1,,0,4,2,5,0\n", "finite number")],
)  # fmt: skip
def test_bad_tracks_are_an_input_error(tmp_path, text, words):
    (tmp_path / "01_tracks.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_recording(tmp_path / "01_tracks.csv")


ROUTES = """<routes><vType id="av" length="5" width="1.8" sigma="0" maxSpeed="30"/>
<vehicle id="av" type="av" depart="0.2" departPos="${place}" departSpeed="${speed}" insertionChecks="none">
<route edges="main"/></vehicle>
</routes>"""
SCENARIO = """
recorded: {file: 07_tracks.csv, begin: "BEGIN", without: [WITHOUT], roads: {main: {along: [[0, 2], [300, 2]]}}}
sumo: {routes: av.rou.xml}
inputs: {place: {min: 0, max: 50}, speed: {min: 0, max: 30}, t: {min: 0, max: 2}}
ego: {id: av, may_leave: true}
others: {within: 200}
duration: 2
step_length: 0.08
metrics: [ttc_min, collision]
requirement: {metric: ttc_min, critical: [-.inf, 1.0]}
"""


def traced(folder: Path, begin: str = "${t}", without: str = "", along: str = "[[0, 2], [300, 2]]", **values: float):
    ind(folder)
    (folder / "av.rou.xml").write_text(ROUTES)
    path = folder / f"without {without}.yaml"  # a process resolves each file once
    path.write_text(SCENARIO.replace("BEGIN", begin).replace("WITHOUT", without).replace("[[0, 2], [300, 2]]", along))
    scenario = ScenarioSpec(str(path)).resolve()
    return scenario.simulate(scenario.space.values(values), 0)


@pytest.mark.sumo
@pytest.mark.parametrize("t", [0.0, 0.013, 1.0])
def test_everybody_is_where_it_was_on_and_off_the_lane(tmp_path, t):
    trace = traced(tmp_path, place=10, speed=10, t=t)
    assert set(trace.actors) == {"av", "1", "2", "3", "4"}
    recording = read_recording(tmp_path / "07_tracks.csv")
    for k, name in enumerate(recording.names):
        rows = slice(recording.start[k], recording.start[k + 1])
        now, actor = trace.time + 0.24 + t, trace.actor(name)  # the first step that begins at 0.2 s or later is that of 0.24 s
        at = recording.time[recording.step[rows]]
        for what, tolerance in (("x", 2e-3), ("y", 2e-3), ("heading", 1e-6), ("speed", 1e-9)):  # between frames along a chord
            expected = np.interp(now, at, np.unwrap(getattr(recording, what)[rows]))
            found = getattr(actor, what)
            found = expected + np.angle(np.exp(1j * (found - expected))) if what == "heading" else found
            assert found == pytest.approx(expected, abs=tolerance), (name, what)
        assert (actor.length, actor.width) == (recording.length[k], recording.width[k])


@pytest.mark.sumo
def test_they_do_not_react_and_can_be_left_out(tmp_path):
    far, near = traced(tmp_path, place=10, speed=5, t=0), traced(tmp_path, place=50, speed=5, t=0)
    for name in "1234":
        n = min(len(far.time), len(near.time))
        assert np.array_equal(far.actor(name).x[:n], near.actor(name).x[:n])
    assert "1" not in traced(tmp_path, without="1", place=10, speed=5, t=0).actors


@pytest.mark.sumo
def test_a_driver_of_sumo_sees_who_is_on_its_lane(tmp_path):
    behind, alone = (traced(tmp_path, without=name, place=45, speed=20, t=0) for name in ("4", "1, 4"))
    assert behind.actor("av").speed[-1] < 15 < alone.actor("av").speed[-1]
    assert behind.ended == "duration"


@pytest.mark.sumo
def test_a_contact_with_one_of_them_ends_the_run_and_sumo_lists_it(tmp_path):
    (tmp_path / "beside").mkdir()
    trace = traced(tmp_path / "beside", along="[[0, -3], [300, -3]]", place=50, speed=20, t=0.5)
    assert trace.ended == "collision"
    assert trace.reported[0].startswith("av>4")
    assert trace.unconfirmed == ()


@pytest.mark.sumo
def test_one_who_drives_into_the_ego_from_behind_does_not_react_and_is_told(tmp_path):
    trace = traced(tmp_path, along="[[60, 2], [300, 2]]", place=16, speed=3, t=0)
    assert (trace.ended, trace.unreacting) == ("collision", ("1", "2", "3", "4"))
    assert sorted(doubts(" | ".join(trace.unconfirmed)))[0] == Doubt.STRUCK
    assert "hit from behind by '1' at" in trace.unconfirmed[-1]
    assert describe_conflict_type(conflict_type("av")(trace)) == "behind ego, same direction, recorded and does not react"
    (tmp_path / "ahead").mkdir()
    into = traced(tmp_path / "ahead", along="[[0, 2], [300, 2]]", place=48, speed=30, t=0)
    assert conflict_type("av")(into) < 32, "who is ahead was hit"


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("begin", "words"), [("4.5", "must last as long as the run"), ("500", "ends at 5 s"), ("-9", "must have begun")]
)
def test_a_run_outside_the_recording_is_invalid(tmp_path, begin, words):
    with pytest.raises(RunError, match=words) as error:
        traced(tmp_path, begin=f"${{{begin} + t}}", place=10, speed=5, t=0)
    assert error.value.status == Status.INVALID


@pytest.mark.sumo
def test_mistakes_are_named(tmp_path):
    for change, words in [
        ({"begin": "${tt}"}, "must be one of place, speed, t"), ({"without": "9"}, "a road user of the recording must be one"),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=words):
            traced(tmp_path, **change)
    for k, (old, new, words) in enumerate(
        [
            ("[[0, 2], [300, 2]]", "12", r"must be along a road user of the recording \(1, 2, 3, 4, .*'12'"),
            ("[[0, 2], [300, 2]]", "[[0, 2], [0, 2.1]]", "two points or more that are 0.5 m apart"),
            (", roads:", "} #", "lane markings in its recordingMeta.csv, but there are none"),
        ]
    ):
        path = tmp_path / f"{k}.yaml"
        path.write_text(SCENARIO.replace("BEGIN", "${t}").replace("WITHOUT", "").replace(old, new))
        with pytest.raises(InputError, match=words):
            ScenarioSpec(str(path)).resolve()


@pytest.mark.sumo
@pytest.mark.parametrize("driver", [None, Ego.of("acc_aeb")])
@pytest.mark.parametrize(("z", "told"), [(6.0, False), (0.5, False), (None, True)])
def test_a_recorded_road_user_is_at_its_own_height(tmp_path: Path, z: float | None, told: bool, driver: Ego | None) -> None:
    """On the bridge it was taken to be at the height of the ego below, which braked for it, and was hit."""
    decks = {"we": [(x, y, 0.0) for x, y in WEST_EAST], "sn": [(x, y, 6.0) for x, y in SOUTH_NORTH]}
    (tmp_path / "a.net.xml").write_text(net(decks, z=True))
    (tmp_path / "a.rou.xml").write_text(f"<routes>{TYPES}{vehicle('ego', 'we', departPos=20)}</routes>")
    height = "" if z is None else f' z="{z}"'
    steps = "".join(
        f'<timestep time="{t:.1f}"><vehicle id="co" x="0" y="2.5" angle="0" speed="0"{height}/></timestep>'
        for t in np.arange(0.0, 15.0, 0.1)
    )
    (tmp_path / "a.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    files = SumoFiles.of({"net-file": "a.net.xml", "route-files": "a.rou.xml"}, tmp_path, "test")
    recording = RecordingSettings(EgoVehicle("ego", driver=driver, may_leave=True), 12.0)
    one = UserSimulation(recording, files, participants=(RecordedTraffic(tmp_path / "a.xml"),), step=0.1)
    trace = one({}, 1)
    assert ("co" in trace.actors) is (z != 6.0)
    if driver is None:
        assert (trace.ended == "collision") is (z != 6.0)
    else:
        assert bool(trace.acceleration[:, 0].min() < -1.0) is (z != 6.0)
    assert any("recorded road users are taken to be on the ego's level" in line for line in one.warnings()) is told


CROSSED = ("--grid", "--grid.number", "3", "--grid.length", "100", "--sidewalks.guess", "--crossings.guess", "--no-turnarounds")
SOME = """<routes>
<flow id="c" begin="0" end="40" period="4" departSpeed="max"><route edges="A0A1 A1B1 B1C1"/></flow>
<flow id="d" begin="0" end="40" period="4" departSpeed="max"><route edges="C2B2 B2B1 B1B0"/></flow>
<personFlow id="p" begin="0" end="30" period="3"><walk edges="A1B1 B1B2 B2C2"/></personFlow>
<personFlow id="q" begin="0" end="30" period="3"><walk edges="B0B1 B1C1"/></personFlow>
</routes>"""


@pytest.mark.sumo
def test_recorded_road_users_on_crossings_do_not_crash_sumo(tmp_path: Path):
    """libsumo died of a walking area that it took for the lane of who is moved: 28 of 28 runs of a campaign crashed."""
    run_program(tmp_path, "netgenerate", *CROSSED, "-o", "net.net.xml")
    (tmp_path / "t.rou.xml").write_text(SOME)
    run_program(
        tmp_path, "sumo", "-n", "net.net.xml", "-r", "t.rou.xml", "--step-length", "0.1", "-e", "100", "--fcd-output", "f.xml",
        "--precision", "6", "--no-step-log",
    )  # fmt: skip
    (tmp_path / "av.rou.xml").write_text(
        '<routes><vehicle id="av" depart="1" departSpeed="${v}"><route edges="B2B1 B1B0"/></vehicle></routes>'
    )
    (tmp_path / "scenario.yaml").write_text(
        "recorded: {file: f.xml}\nsumo: {net: net.net.xml, routes: av.rou.xml}\ninputs: {v: {min: 1, max: 3, unit: m/s}}\n"
        "ego: {id: av, kind: acc_aeb, may_leave: true}\nduration: 90\nstep_length: 0.1\nmetrics: [distance_min]\n"
        "requirement: {metric: distance_min, critical: [-.inf, 0]}\n"
    )
    (tmp_path / "alone.py").write_text(
        "import sbt\nrun = sbt.simulate('scenario.yaml', {'v': 2.0}, seed=1)\n"
        "print(run.outcome.status, run.trace.actor.nunique())\n"
    )
    done = subprocess.run([sys.executable, "alone.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]
    status, actors = done.stdout.split()
    assert status in ("ok", "invalid")
    assert int(actors) > 5
