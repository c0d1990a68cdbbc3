"""Scenes of actors know the levels of the roads and the bodies of long vehicles, as the user's own simulations do."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_evidence import SOUTH_NORTH, WEST_EAST, net

from sbt.config.scenario_file import from_file
from sbt.metrics.fcd import catalogue
from sbt.metrics.geometry import contact_index
from sbt.metrics.traffic import TTC_PATH_MIN
from sbt.sumo.actors import KEEP, Action, Actor, Scene, State, VehicleType
from sbt.sumo.simulation import SumoSimulation

BUS = VehicleType(14.0, 2.5, (("maxSpeed", "8"),))
ARC = [(22.0 * math.sin(a), -22.0 * math.cos(a)) for a in np.linspace(0.0, math.pi, 60)]
BEND = [(x, -22.0) for x in np.linspace(-60.0, -1.0, 20)] + ARC + [(x, 22.0) for x in np.linspace(-1.0, -60.0, 20)]
"""To the left, so that the second lane is inside."""
pytestmark = pytest.mark.sumo

CAR = VehicleType(attributes=(("maxSpeed", "10"),))


class Looking:
    """Keeps its speed, and notes whom it sees."""

    def __init__(self, seen: set[str]):
        self.seen = seen

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        self.seen.update(f"{own.name}>{other.name}" for other in others)
        return KEEP


def crossing(folder: Path, z: float | None) -> Path:
    """Two roads that cross without a junction, one of them so high above the other (m); None: without heights."""
    heights = (0.0, z)
    roads = {
        name: [p if z is None else (*p, heights[k]) for p in shape]
        for k, (name, shape) in enumerate((("we", WEST_EAST), ("sn", SOUTH_NORTH)))
    }
    path = folder / f"{z}.net.xml"
    path.write_text(net(roads, z=z is not None))
    return path


def meeting(path: Path, seen: set[str] | None, **settings: Any) -> SumoSimulation:
    """The ego and others on both roads; `seen` of controllers, else SUMO drives."""

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        driver = None if seen is None else Looking(seen)
        return Scene((
            Actor("ego", ("we",), 0, 50.0, 10.0, driver, CAR), Actor("lead", ("we",), 0, 75.0, 10.0, driver, CAR),
            Actor("co", ("sn",), 0, 50.0 + values["p"], 10.0, driver, CAR),
        ))  # fmt: skip

    return SumoSimulation(str(path), scene, 9.0, 0.1, isolations=("fresh", "reuse", "replicas"), **settings)


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("z", [None, 6.0, 0.5])
def test_only_who_is_on_the_egos_level_is_hit_seen_or_measured(tmp_path: Path, z: float | None, driven: bool) -> None:
    seen: set[str] = set()
    one = meeting(crossing(tmp_path, z), seen if driven else None, isolation="fresh")
    trace = one({"p": 0.0}, 1)
    apart = z != 0.5
    assert (trace.ended == "collision") is not apart
    assert trace.present[:, trace.actors.index("co")].any() is not np.bool_(apart)
    assert trace.present[:, :2].all()
    if driven:
        assert ("ego>co" in seen, "co>ego" in seen, "lead>ego" in seen) == (not apart, not apart, True)
    values = {metric.name: metric(trace) for metric in catalogue()}
    assert values["collision"] == float(not apart)
    assert not any(math.isnan(value) for value in values.values())
    guessed = [text for text in trace.unconfirmed if text.startswith("on another level: 'co' at")]
    assert bool(guessed) is (z is None), "a contact that rests on a guess is told"
    assert any("cross without a junction" in text for text in one.warnings()) is (z != 6.0)


@pytest.mark.parametrize("z", [None, 6.0])
def test_levels_are_the_same_in_every_isolation(tmp_path: Path, z: float | None) -> None:
    path = crossing(tmp_path, z)
    work = [({"p": float(p)}, 1) for p in (0, 5, 10)]
    fresh = [meeting(path, set(), isolation="fresh")(*one) for one in work]
    for isolation in ("reuse", "replicas"):
        for a, b in zip(fresh, meeting(path, set(), isolation=isolation).simulate_many(work), strict=True):
            assert a.identical(b)


def test_who_begins_by_a_pose_is_on_the_level_of_its_lane(tmp_path: Path) -> None:
    class Standing:
        def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
            return Action(speed=0.0, pose=(own.x, own.y, own.heading))

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        beside = (4.5, -1.6, 0.5 * math.pi)
        return Scene((
            Actor("ego", ("we",), 0, 50.0, 10.0, Looking(set())),
            Actor("co", ("sn",), 0, 90.0, 0.0, Standing(), pose=beside),
        ))  # fmt: skip

    for z, ended in ((6.0, "duration"), (0.5, "collision")):
        assert SumoSimulation(str(crossing(tmp_path, z)), scene, 9.0, 0.1)({}, 1).ended == ended


@pytest.mark.parametrize("x", [0.0, 800.0, -800.0])
def test_who_is_far_outside_a_network_with_bridges_is_on_the_level_of_its_lane(tmp_path: Path, x: float) -> None:
    """SUMO leaves the height out there."""

    class Driving:
        def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
            return Action(pose=(own.x, own.y + 1.0, own.heading))

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        beside = Actor("co", ("sn",), 0, 90.0, 0.0, Driving(), pose=(x + 4.5, 60.0, 0.5 * math.pi))
        return Scene((Actor("ego", ("we",), 0, 50.0, 10.0, Looking(set())), beside))

    trace = SumoSimulation(str(crossing(tmp_path, 6.0)), scene, 3.0, 0.1)({}, 1)
    assert (trace.ended, len(trace.time)) == ("duration", 31)


def bus_in_a_bend(path: Path, *, driven: bool, **settings: Any) -> SumoSimulation:
    """A bus on the outer lane passes a car that stands on the inner one, at the bend."""

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        driver = Looking(set()) if driven else None
        standing = VehicleType(attributes=(("maxSpeed", "0.001"), ("speedFactor", "0.001")))
        return Scene((
            Actor("ego", ("bend",), 1, 75.0 + values["p"], 0.0, driver, standing),
            Actor("co", ("bend",), 0, 30.0, 8.0, driver, BUS),
        ))  # fmt: skip

    path.write_text(net({"bend": BEND}, lanes=2))
    return SumoSimulation(str(path), scene, 12.0, 0.1, isolations=("fresh", "reuse", "replicas"), **settings)


@pytest.mark.parametrize("driven", [True, False])
def test_a_long_vehicle_bends_around_who_stands_inside(tmp_path: Path, driven: bool) -> None:
    """As one rectangle it cut the bend, and hit a car on the next lane that it never met."""
    trace = bus_in_a_bend(tmp_path / "a.net.xml", driven=driven, isolation="fresh")({"p": 0.0}, 1)
    assert trace.ended == "duration"
    bus = trace.actor("co")
    assert contact_index(trace.actor("ego"), bus) is None
    assert contact_index(trace.actor("ego"), replace(bus, parts=())) is not None
    assert sum(part.length for part in bus.parts) == pytest.approx(14.0)
    for one, following in pairwise(bus.parts):
        joints = [(p.x + s * 0.5 * p.length * np.cos(p.heading), p.y + s * 0.5 * p.length * np.sin(p.heading))
                  for p, s in ((one, -1.0), (following, 1.0))]  # fmt: skip
        assert np.hypot(*(np.array(joints[0]) - np.array(joints[1]))).max() < 0.1, "the parts follow each other"


def test_long_bodies_are_the_same_in_every_isolation(tmp_path: Path) -> None:
    path = tmp_path / "a.net.xml"
    work = [({"p": p}, 1) for p in (0.0, 3.0, 6.0)]
    fresh = [bus_in_a_bend(path, driven=True, isolation="fresh")(*one) for one in work]
    for isolation in ("reuse", "replicas"):
        for a, b in zip(fresh, bus_in_a_bend(path, driven=True, isolation=isolation).simulate_many(work), strict=True):
            assert a.parts
            assert a.identical(b)


def test_a_run_ends_where_metrics_see_a_bent_body_touch(tmp_path: Path) -> None:
    path = tmp_path / "a.net.xml"
    path.write_text(net({"bend": BEND}, lanes=1))

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        return Scene((
            Actor("ego", ("bend",), 0, 60.0, 9.0, Looking(set())),
            Actor("co", ("bend",), 0, 90.0, 0.0, Looking(set()), VehicleType(18.0, 2.5)),
        ))  # fmt: skip

    trace = SumoSimulation(str(path), scene, 12.0, 0.1)({}, 1)
    found = contact_index(trace.actor("ego"), trace.actor("co"))
    assert trace.ended == "collision"
    assert found == len(trace.time) - 1


def two_in_a_bend(path: Path, duration: float, **settings: Any) -> SumoSimulation:
    """Ego and a bus beside it in a bend, in lanes of their own."""

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        return Scene((
            Actor("ego", ("bend",), 1, 58.0, 8.0, None, CAR), Actor("co", ("bend",), 0, 62.0, 8.0, Looking(set()), BUS),
            Actor("far", ("bend",), 0, 130.0 + values["p"], 8.0, None, CAR),
        ))  # fmt: skip

    path.write_text(net({"bend": BEND}, lanes=2))
    return SumoSimulation(str(path), scene, duration, 0.1, isolations=("fresh", "reuse", "replicas"), **settings)


def test_at_the_end_of_a_run_actors_go_on_along_their_lanes(tmp_path: Path) -> None:
    """Straight on ego hits the bus, which it never meets. Who drives straight on anyhow needs no way."""
    path = tmp_path / "a.net.xml"
    short, long = (two_in_a_bend(path, duration, isolation="fresh")({"p": 0.0}, 1) for duration in (2.0, 5.5))
    n = len(short.time)
    assert set(short.ways) == {"ego", "co"}
    assert (TTC_PATH_MIN(short), TTC_PATH_MIN(replace(short, ways={}))) == (5.0, pytest.approx(0.91, abs=0.01))
    for name in short.ways:
        one, other = short.actor(name), long.actor(name)
        for now, later in zip((one, *one.parts), (other, *other.parts), strict=True):
            assert now.way is not None
            x, y, heading = now.way.T
            apart = np.hypot(later.x[n:, None] - x, later.y[n:, None] - y)
            near = apart.argmin(axis=1)
            assert apart.min(axis=1).max() < 0.6, "its points are 1 m apart"
            across = (later.y[n:] - y[near]) * np.cos(heading[near]) - (later.x[n:] - x[near]) * np.sin(heading[near])
            assert np.abs(across).max() < 0.15


def test_the_ways_of_a_scene_are_those_of_the_same_files(tmp_path: Path) -> None:
    scene = two_in_a_bend(tmp_path / "a.net.xml", 2.0, isolation="fresh")({"p": 0.0}, 1)
    kind = 'minGap="0" speedFactor="1" speedDev="0" sigma="0" accel="10" decel="10" emergencyDecel="10"'
    cars = "".join(
        f'<vehicle id="{name}" type="{kind}" depart="0" departLane="{lane}" departPos="{at}" departSpeed="8" '
        f'insertionChecks="none"><route edges="bend"/></vehicle>'
        for name, kind, lane, at in (("ego", "car", 1, 58), ("co", "bus", 0, 62), ("far", "car", 0, 130))
    )
    (tmp_path / "a.rou.xml").write_text(
        f'<routes><vType id="car" length="5" width="1.8" maxSpeed="10" {kind}/>'
        f'<vType id="bus" length="14" width="2.5" maxSpeed="${{v}}" {kind}/>{cars}</routes>'
    )
    (tmp_path / "a.yaml").write_text(
        "sumo: {net: a.net.xml, routes: [a.rou.xml], options: {step-method.ballistic: true}}\n"
        "inputs: {v: {min: 8, max: 9}}\nego: ego\nduration: 2\nstep_length: 0.1\nothers: {within: 300}\n"
        "metrics: [ttc_path_min]\nrequirement: {metric: ttc_path_min, critical: [-.inf, 1.0]}\n"
    )
    simulate = from_file(str(tmp_path / "a.yaml"), tmp_path).simulate
    assert simulate is not None
    files = simulate({"v": 8.0}, 1)
    assert set(scene.ways) == {"ego", "co"}
    assert files.actor("co").x == pytest.approx(scene.actor("co").x, abs=1e-3)
    for name in scene.ways:
        a, b = scene.actor(name), files.actor(name)
        for one, other in zip((a, *a.parts), (b, *b.parts), strict=True):
            assert one.way is not None
            assert other.way is not None
            assert len(one.way) > 30
            assert one.way == pytest.approx(other.way[: len(one.way)], abs=1e-3)


def test_ways_are_the_same_in_every_isolation(tmp_path: Path) -> None:
    path = tmp_path / "a.net.xml"
    work = [({"p": p}, 1) for p in (0.0, 3.0, 6.0)]
    fresh = [two_in_a_bend(path, 2.0, isolation="fresh")(*one) for one in work]
    for isolation in ("reuse", "replicas"):
        for a, b in zip(fresh, two_in_a_bend(path, 2.0, isolation=isolation).simulate_many(work), strict=True):
            assert a.ways
            assert a.identical(b)
