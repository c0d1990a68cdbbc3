"""Films, sumo-gui and files of runs in traffic that comes and goes, on five simulations as people bring them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from own_networks import FIVE, program
from typer.testing import CliRunner

from sbt.cli import app
from sbt.config.load import parse
from sbt.errors import InputError
from sbt.metrics.fcd import Recording, read_fcd
from sbt.metrics.moments import metric_so_far
from sbt.metrics.pairwise import in_traffic
from sbt.metrics.planar import DISTANCE_MIN
from sbt.problem.metric import Metric
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import FieldOfView, Trace
from sbt.report.contacts import Contacts, contacts_of
from sbt.report.film import write_film
from sbt.report.scene import EGO, ROAD, view_of
from sbt.report.sight import area_in_view, expected
from sbt.report.style import CRITICAL
from sbt.report.video import check_format, write_video
from sbt.report.worst import worst_moment
from sbt.sumo.gui import run_in_gui
from sbt.sumo.occlusion import Occluders
from sbt.workflows.running import replay_run, run_study
from sbt.workflows.study import Study

in_sumo = pytest.mark.sumo


@dataclass(frozen=True)
class Stored:
    """A campaign of two runs of an own simulation, and run 1 again."""

    folder: Path
    store: Path
    trace: Trace
    scenario: LogicalScenario
    again: Any


@pytest.fixture(scope="module", params=FIVE)
def stored(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Stored:
    folder = tmp_path_factory.mktemp(request.param)
    path = FIVE[request.param](folder)
    before = {p.name for p in folder.iterdir()}
    text = (
        f"campaign: coverage\nscenario: {path}\nbudget: 2\nbatch: 2\nvalidation: {{share: 0}}\n"
        f"executor: {{kind: serial}}\nstore: {folder}/store\n"
    )
    assert run_study(Study(parse(text)), report=False).ok == 2
    again = replay_run(folder / "store", 1)
    assert again.trace is not None
    assert {p.name for p in folder.iterdir()} == before | {"store"}, "SUMO must not write beside the user's files"
    return Stored(folder, folder / "store", again.trace, again.scenario, again)


def pictures_of(file: Path) -> list[np.ndarray]:
    from PIL import Image

    with Image.open(file) as film:
        found = []
        for k in range(film.n_frames):
            film.seek(k)
            found.append(np.asarray(film.convert("RGB")).astype(int))
    return found


def pixels(picture: np.ndarray, color: str) -> int:
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(picture - wanted).max(axis=2) < 14).sum())


def speeds(recording: Recording, name: str) -> np.ndarray:
    k = recording.names.index(name)
    return recording.speed[recording.start[k] : recording.start[k + 1]]


def metric_of(scenario: LogicalScenario) -> Metric:
    return next(m for m in scenario.metrics if m.name == scenario.requirement.metric)


@in_sumo
def test_a_film_follows_the_ego_on_its_lanes_and_files_hold_who_was_there(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("sbt.report.film._FRAMES", 20)
    gif, out = tmp_path / "run.gif", tmp_path / "out"
    done = CliRunner().invoke(app, ["replay", str(stored.store), "1", "--gif", str(gif), "--export", str(out), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["identical"] is True
    assert gif.stat().st_size < 900_000
    pictures = pictures_of(gif)
    assert min(pixels(p, EGO) for p in pictures) > 40, "the ego is in every picture"
    assert min(pixels(p, ROAD) for p in pictures) > 3_000, "on a road, part of which ego does not see"
    assert not stored.trace.present.all(), "people come and go, or this tests nothing"
    recorded = read_fcd(out / "fcd.xml")
    assert sorted(recorded.names) == sorted(stored.trace.actors)
    assert "nan" not in "".join((out / name).read_text() for name in ("fcd.xml", "scene.add.xml", "trace.csv"))
    counts = [len(step) for step in ET.parse(out / "fcd.xml").getroot()]
    assert counts == stored.trace.present.sum(axis=1).tolist()
    scene = subprocess.run([program("sumo"), "-c", "scene.sumocfg", "--no-step-log"], cwd=out, capture_output=True, text=True)
    assert (scene.returncode, scene.stderr) == (0, "")
    if stored.scenario.simulate.recording.ego.driver is not None:
        return  # what the controller does is not in the files
    plain = [program("sumo"), "-c", "run.sumocfg", "--no-warnings", "--end", "400", "--fcd-output", "plain.xml"]
    subprocess.run(plain, cwd=out / "sumo", check=True, capture_output=True)
    alone, with_us = (speeds(read_fcd(file), stored.trace.actors[0]) for file in (out / "sumo" / "plain.xml", out / "fcd.xml"))
    np.testing.assert_allclose(alone[: len(with_us)], with_us, atol=0.011, err_msg="the files alone show the same run")


@in_sumo
def test_the_view_shows_ego_always_and_the_opponent_at_the_worst_moment(stored: Stored):
    trace, metric = stored.trace, metric_of(stored.scenario)
    moment, opponent = worst_moment(trace, metric)
    assert opponent is not None
    assert metric_so_far(trace, metric, [moment])[0] == metric(trace)
    assert np.isfinite(trace.x[moment, opponent])
    for ratio in (1.0, 2.6):
        view = view_of(trace, opponent, moment, ratio)
        half = np.array([view.half_x, view.half_y])
        ego = np.stack([trace.x[:, 0], trace.y[:, 0]], axis=1)
        assert (np.abs(ego - view.middle) < half).all()
        other = np.array([trace.x[moment, opponent], trace.y[moment, opponent]])
        assert (np.abs(other - view.middle[moment]) < half).all()
        assert np.hypot(*np.diff(view.middle, axis=0).T).max() < 6.0, "no jump"


@in_sumo
def test_another_sumo_program_shows_the_same_run(stored: Stored):
    again, ego = stored.again, stored.trace.actors[0]
    other = run_in_gui(again.scenario.simulate, again.record.inputs, again.record.seed, program("sumo"), ego=ego)
    assert other.identical(stored.trace)


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """A screen: the one that is there, or a virtual one."""
    if os.environ.get("DISPLAY"):
        yield os.environ["DISPLAY"]
        return
    server = shutil.which("Xvfb")
    if server is None:
        pytest.skip("sumo-gui needs a display, and Xvfb is not installed (Debian: apt install xvfb)")
    read, write = os.pipe()
    process = subprocess.Popen(
        [server, "-displayfd", str(write), "-screen", "0", "1280x900x24", "-nolisten", "tcp"], pass_fds=[write],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(write)
    try:
        with os.fdopen(read) as number:
            yield f":{number.readline().strip()}"
    finally:
        process.terminate()
        process.wait()


@in_sumo
@pytest.mark.parametrize("stored", ["grid", "crossing", "merge"], indirect=True)
def test_sumo_gui_shows_the_same_run(stored: Stored, display: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DISPLAY", display)
    again = stored.again
    shown = run_in_gui(
        again.scenario.simulate, again.record.inputs, again.record.seed, program("sumo-gui"),
        ego=stored.trace.actors[0], linger=0.0, pace=float("inf"),
    )  # fmt: skip
    assert shown.identical(stored.trace)


def crowd(n: int, seconds: float = 6.0) -> Trace:
    """Traffic on a road of ten lanes: everybody but the ego comes and goes, somebody stays away; number 1 hits the ego."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, seconds, 0.1)
    y = np.tile(4.0 * rng.integers(-5, 5, n) + 2.0, (len(time), 1))
    speed = np.tile(rng.uniform(5.0, 20.0, n), (len(time), 1))
    x = rng.uniform(-150.0, 150.0, n) + speed * time[:, None]
    x[:, 0], y[:, 0] = speed[:, 0] * time, 0.0
    x[:, 1], y[:, 1] = x[:, 0] + 3.9 + 2.0 * np.abs(time - 3.0), 0.0
    here = (time[:, None] >= rng.uniform(0.0, 2.0, n)) & (time[:, None] <= rng.uniform(3.5, 6.0, n))
    here[:, 0], here[:, -1], here[:, 1] = True, False, time > 1.0
    states = (np.where(here, v, np.nan) for v in (x, y, 0.0 * x, speed, 0.0 * x))
    names = ("ego", *(f"c{k}" for k in range(1, n)))
    return Trace(time, names, *states, np.full(n, 4.8), np.full(n, 1.8))


def test_a_film_of_two_hundred_road_users_marks_the_contact(tmp_path: Path):
    trace, metric = crowd(200), in_traffic(DISTANCE_MIN, "ego")
    (contact,) = contacts_of(trace)
    assert (contact.other, trace.time[contact.instant]) == ("c1", pytest.approx(2.6))
    assert (contact.x, contact.y) == (pytest.approx(trace.x[contact.instant, 0] + 2.4, abs=0.2), pytest.approx(0.0))
    assert worst_moment(trace, metric) == (contact.instant, 1)
    for text, word in (("with 'c1' at 2.600 s: SUMO ...", "unconfirmed "), ("with 'c11' at 2.600 s: SUMO ...", "")):
        doubtful = replace(trace, unconfirmed=(f"contact {text}",))
        assert Contacts(Figure().add_subplot(), doubtful).show(59) == f"{word}contact with c1 at 2.6 s"
    write_film(tmp_path / "a.gif", trace, metric, Requirement("distance_min", high=0.5))
    pictures = pictures_of(tmp_path / "a.gif")
    assert len(pictures) <= 90
    before, after = pictures[5], pictures[round(2.8 / 0.1)]
    assert pixels(after, CRITICAL) > pixels(before, CRITICAL) + 100, "a ring, and words"


def test_who_is_alone_or_nowhere_is_no_obstacle(tmp_path: Path):
    """An ego alone, road users that are never there, a single instant: each has a film."""
    trace, metric = crowd(4), in_traffic(DISTANCE_MIN, "ego")
    states = ("x", "y", "heading", "speed", "acceleration")
    gone = {name: np.where(np.arange(4) > 0, np.nan, getattr(trace, name)) for name in states}
    nobody = [replace(trace, **gone), replace(trace, **{name: getattr(trace, name)[:1] for name in ("time", *states)})]
    for k, each in enumerate(nobody):
        assert worst_moment(each, metric) == (0, None)
        write_film(tmp_path / f"{k}.gif", each, metric, Requirement("distance_min", high=0.5))
        assert min(pixels(p, EGO) for p in pictures_of(tmp_path / f"{k}.gif")) > 40


def test_a_metric_so_far_is_that_of_the_run_up_to_then():
    """Also where it is only computed at some instants."""
    trace, metric = crowd(12), in_traffic(DISTANCE_MIN, "ego")
    instants = range(len(trace.time))
    found = metric_so_far(trace, metric, instants)
    names = ("time", "x", "y", "heading", "speed", "acceleration")
    for k in instants[::7]:
        assert found[k] == metric(replace(trace, **{name: getattr(trace, name)[: k + 1] for name in names}))


@in_sumo
def test_a_run_that_cannot_be_shown_says_why(tmp_path: Path):
    path = FIVE["merge"](tmp_path)
    path.write_text(path.read_text().replace("may_leave: true, ", "").replace("duration: 9", "duration: 200"))
    text = f"campaign: coverage\nscenario: {path}\nbudget: 1\nexecutor: {{kind: serial}}\nstore: {tmp_path}/store\n"
    assert run_study(Study(parse(text)), report=False).failed == 1
    done = CliRunner().invoke(app, ["replay", str(tmp_path / "store"), "0", "--gif", str(tmp_path / "a.gif")])
    assert (done.exit_code, (tmp_path / "a.gif").exists()) == (2, False)
    assert "only a run with a trace can be shown, but run 0 has none: the ego 'ego' must stay for the duration" in done.output


def test_a_film_has_the_format_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from PIL import Image

    shown, times = [Image.new("RGB", (21, 11), (50 * k, 0, 0)).quantize(8) for k in range(4)], [80, 80, 80, 1200]
    write_video(tmp_path / "a.webp", shown, times)
    with Image.open(tmp_path / "a.webp") as film:
        assert film.n_frames == 4
    with pytest.raises(InputError, match=r"must end in one of \.gif, .*\.webm, but got 'a\.avi'"):
        check_format(Path("a.avi"))
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\nwc -c > "$last"\n')
    program.chmod(0o755)
    monkeypatch.setattr("sbt.report.video._ffmpeg", lambda: str(program))
    write_video(tmp_path / "a.mp4", shown, times)
    assert int((tmp_path / "a.mp4").read_text()) == (4 + 14) * 21 * 11 * 3, "every picture, and the last one for 1.2 s"
    monkeypatch.setattr("sbt.report.video._ffmpeg", lambda: "")
    with pytest.raises(InputError, match=r"\.mp4 needs ffmpeg, which is not there: pip install"):
        check_format(Path("a.mp4"))


VIEWS = FieldOfView(30.0, 2.0), FieldOfView(ahead=1.0, half_angle=0.6), FieldOfView(25.0, half_width=1.5)


@pytest.mark.parametrize("view", VIEWS)
def test_the_area_in_view_is_what_is_not_occluded(view: FieldOfView) -> None:
    """A point lies in it where the sensor reaches it, ahead of it, and no rectangle is in between."""
    from matplotlib.path import Path as Outline

    rng = np.random.default_rng(4)
    boxes = np.column_stack([rng.uniform(-35, 35, (6, 2)), rng.uniform(-3, 3, 6), rng.uniform(0.5, 9, 6), rng.uniform(0.5, 3, 6)])
    ego, points = (3.0, -2.0, 0.7), rng.uniform(-40, 40, (4000, 2))
    ahead = np.array([np.cos(ego[2]), np.sin(ego[2])])
    eye = np.array(ego[:2]) + view.ahead * ahead
    along, beside = (points - eye) @ ahead, (points - eye) @ np.array([-ahead[1], ahead[0]])
    corridor = np.isfinite(view.half_width)
    away = along if corridor else np.hypot(along, beside)
    starts = eye + beside[:, None] * np.array([-ahead[1], ahead[0]]) if corridor else np.broadcast_to(eye, points.shape)
    free = [not Occluders(boxes).occlude(start, point[None])[0] for start, point in zip(starts, points, strict=True)]
    seen = np.array(free) & (along > 0.0) & (np.abs(beside) < view.half_width) & (away < min(view.reach, 60.0))
    seen &= np.abs(np.arctan2(beside, along)) < view.half_angle
    outline = Outline(area_in_view(view, ego, boxes, 60.0))
    inside, around = (outline.contains_points(points, radius=r) for r in (-0.3, 0.3))
    clear = inside == around  # not on the edge, where both are right
    assert clear.mean() > 0.8
    assert seen[clear].sum() > 20
    np.testing.assert_array_equal(inside[clear], seen[clear])


def test_who_keeps_on_is_expected_ahead() -> None:
    """After 1, 2 and 3 s at its speed along its heading; who stands is expected nowhere else."""
    both = np.ones((2, 2))
    run = Trace(np.array([0.0, 0.1]), ("ego", "co"), 0 * both, 0 * both, np.pi / 2 * both, np.array([[5.0, 0.0]] * 2), 0 * both,
                np.ones(2), np.ones(2))  # fmt: skip
    np.testing.assert_allclose(expected(run, 0, 0), [[0, 5], [0, 10], [0, 15]], atol=1e-12)
    assert len(expected(run, 0, 1)) == 0


REACH = {"jaywalking": 80.0, "parking": np.inf, "lane_keeping": 20.0, "cut_in": 200.0}


@in_sumo
@pytest.mark.parametrize(("name", "reach"), REACH.items())
def test_films_know_what_ego_sees(name: str, reach: float) -> None:
    """Every controller with a sensor says where it sees, and by whom it is hidden."""
    from sbt.plugins import load

    scenario = load("scenarios", name)
    values = {p.name: p.value(p.centre) for p in scenario.space.parameters}
    found = scenario.simulate(values, 1).view
    assert found is not None
    assert found.reach <= reach
    assert set(found.hidden_by or ()) <= {"machine", "bar_1", "bar_2", "bar_3", "bar_4"}
