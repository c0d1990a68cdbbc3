"""Contacts have evidence: levels, the bodies of long vehicles, and SUMO's own list."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.execution.worker import run_job
from sbt.metrics.geometry import contact_index, corners, rectangle_distance, rectangles
from sbt.metrics.longitudinal import COLLISION, encounter
from sbt.metrics.traffic import any_impact_speed
from sbt.problem.metric import Metric
from sbt.problem.outcome import LISTED_ONLY, UNCONFIRMED, Job
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.sumo.files import SumoFiles
from sbt.sumo.recorder import RecordingSettings
from sbt.sumo.trailing import TrailingBody
from sbt.sumo.user_simulation import Loop, UserSimulation, step_until_over

Point = tuple[float, ...]
TYPES = """<vType id="car" length="5" width="1.8" sigma="0" speedDev="0" minGap="0"/>
<vType id="wide" length="5" width="2.1" sigma="0" speedDev="0" minGap="0"/>
<vType id="bike" vClass="bicycle" maxSpeed="10" length="1.6" width="0.65" sigma="0" speedDev="0" minGap="0"/>
<vType id="rail" vClass="rail" length="250" width="3" sigma="0"/>
<vType id="bus" vClass="bus" length="12" width="2.5" sigma="0" speedDev="0" minGap="0"/>"""


def net(edges: dict[str, list[Point]], lanes: int = 1, width: float = 3.2, z: bool = False) -> str:
    """A network of edges, each between two nodes of its own, whose lanes lie beside each other to the left."""
    parts = ['<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="5.50">'
             '<location netOffset="0,0" convBoundary="0,0,1,1" origBoundary="0,0,1,1" projParameter="!"/>']  # fmt: skip
    nodes = []
    for name, shape in edges.items():
        rows = []
        for k in range(lanes):
            across = np.gradient(np.array(shape)[:, :2], axis=0)
            across = np.stack([-across[:, 1], across[:, 0]], axis=1) / np.hypot(*across.T)[:, None]
            points = np.array(shape, dtype=float)
            points[:, :2] += k * width * across
            length = np.hypot(*np.diff(points[:, :2], axis=0).T).sum()
            text = " ".join(",".join(f"{v:.3f}" for v in p[: 3 if z else 2]) for p in points)
            rows.append(f'<lane id="{name}_{k}" index="{k}" speed="30" length="{length:.3f}" width="{width}" shape="{text}"/>')
        parts.append(f'<edge id="{name}" from="{name}0" to="{name}1" priority="1">{"".join(rows)}</edge>')
        last = " ".join(f"{name}_{k}" for k in range(lanes))
        for node, p, incoming in ((f"{name}0", shape[0], ""), (f"{name}1", shape[-1], last)):
            nodes.append(f'<junction id="{node}" type="dead_end" x="{p[0]}" y="{p[1]}" incLanes="{incoming}" intLanes=""/>')
    return "".join([*parts, *nodes, "</net>"])


Simulated = Callable[..., Trace]


@pytest.fixture
def simulate(tmp_path: Path) -> Simulated:
    """Write a network and vehicles, and return the trace of the ego."""

    def run(network: str, vehicles: str, loop: Loop = step_until_over, duration: float = 20.0, **options: str) -> Trace:
        return simulation(tmp_path, network, vehicles, loop, duration, **options)({}, 1)

    return run


def simulation(folder: Path, network: str, vehicles: str, loop: Loop, duration: float, **options: str) -> UserSimulation:
    (folder / "a.net.xml").write_text(network)
    (folder / "a.rou.xml").write_text(f"<routes>{TYPES}{vehicles}</routes>")
    named = {"net-file": "a.net.xml", "route-files": "a.rou.xml", "insertion-checks": "none"}
    files = SumoFiles.of(named | {k.replace("_", "-"): v for k, v in options.items()}, folder, "test")
    return UserSimulation(RecordingSettings(EgoVehicle("ego", may_leave=True), duration), files, loop)


def vehicle(name: str, edges: str, kind: str = "car", **attributes: float | str) -> str:
    given = {"depart": 0, "departPos": 20, "departSpeed": 10, "departLane": 0} | attributes
    text = " ".join(f'{k}="{v}"' for k, v in given.items())
    return f'<vehicle id="{name}" type="{kind}" {text}><route edges="{edges}"/></vehicle>'


def deaf(*names: str) -> Loop:
    """A loop in which these vehicles look at nobody and keep their speeds."""

    def loop(sumo, values, rng):
        sumo.simulationStep()
        for name in names:
            sumo.vehicle.setSpeedMode(name, 32)
            sumo.vehicle.setLaneChangeMode(name, 0)
            sumo.vehicle.setSpeed(name, sumo.vehicle.getSpeed(name))
        step_until_over(sumo, values, rng)

    return loop


WEST_EAST, SOUTH_NORTH = [(-100.0, 0.0), (100.0, 0.0)], [(0.0, -100.0), (0.0, 100.0)]
MEETING = vehicle("ego", "we", departPos=20) + vehicle("other", "sn", departPos=20)


@pytest.mark.sumo
@pytest.mark.parametrize("step", ["0.1", "0.5", "1"])
@pytest.mark.parametrize("ballistic", [True, False])
def test_the_impact_speed_is_that_of_the_braking_that_sumo_simulates(simulate, step, ballistic):
    """With Euler a step has one speed; ballistic, it falls evenly within the step: v^2 = v0^2 - 2 a s."""
    road = net({"we": [(0.0, 0.0), (300.0, 0.0)]})
    kind = '<vType id="bad" length="5" width="1.8" minGap="0" decel="6" emergencyDecel="6" tau="0.1" sigma="0"/>'
    wall = vehicle("wall", "we", departPos=110, departSpeed=0)

    def loop(sumo, values, rng):
        for k in range(200):
            if k == 1:
                for name in ("ego", "wall"):
                    sumo.vehicle.setSpeedMode(name, 0)
                sumo.vehicle.slowDown("ego", 0.0, 25.0 / 6.0)
                sumo.vehicle.setSpeed("wall", 0.0)
            sumo.simulationStep()

    vehicles = kind + vehicle("ego", "we", "bad", departPos=60, departSpeed=25) + wall
    trace = simulate(road, vehicles, loop, step_length=step, **{"step-method.ballistic": str(ballistic).lower()})
    assert trace.ended == "collision"
    assert trace.ballistic is ballistic
    ego, said = trace.actor("ego"), any_impact_speed()(trace)
    if not ballistic:
        assert said == ego.speed[-1]
        return
    v, way = ego.speed[-2:], float(trace.actor("wall").x[-1] - 5.0 - ego.x[-2])
    assert v[1] < v[0]
    assert said == pytest.approx(math.sqrt(v[0] ** 2 - way * (v[0] ** 2 - v[1] ** 2) / (ego.x[-1] - ego.x[-2])), abs=1e-3)
    assert v[1] < said < v[0]


@pytest.mark.sumo
def test_on_a_bridge_and_below_is_no_contact_and_a_net_without_heights_is_warned_of(simulate, tmp_path):
    """In the plane the two would collide; with the heights known, and with the missing junction alone."""
    flat = {"we": WEST_EAST, "sn": SOUTH_NORTH}
    high = {"we": WEST_EAST, "sn": [(x, y, 6.0) for x, y in SOUTH_NORTH]}
    for network in (net(flat), net({k: [(*p, 0.0)[:3] for p in shape] for k, shape in high.items()}, z=True)):
        trace = simulate(network, MEETING, deaf("ego", "other"))
        assert (trace.ended, trace.unconfirmed) != ("collision", ())
        doubt = [] if network.count("6.0") else ["on another level: 'other' at"]
        assert [text[: len(doubt[0])] for text in trace.unconfirmed] == doubt, "a contact that rests on a guess is told"
        assert trace.actors == ("ego",), "nobody on another level is recorded, so no metric counts them"
    one = simulation(tmp_path, net(flat), MEETING, deaf("ego", "other"), 5.0)
    one({}, 1)
    assert any("'sn' and 'we' at (0, 0)" in line and "taken for bridges" in line for line in one.warnings())


@pytest.mark.sumo
@pytest.mark.parametrize(
    "shape", [[(0.0, 0.0, 0.0), (300.0, 0.0, 18.0)], [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (100.0, 0.0, 6.0), (300.0, 0.0, 6.0)]]
)
@pytest.mark.parametrize(
    "bridge", [{}, {"we": [(-400.0, 9.0, 0.0), (-300.0, 9.0, 0.0)], "sn": [(-350.0, -50.0, 6.0), (-350.0, 50.0, 6.0)]}]
)
def test_who_drives_ahead_on_a_hill_is_on_the_same_level(simulate, shape, bridge):
    """It was not recorded until it was 50 m ahead on 6 %, as it was 3 m higher."""
    vehicles = vehicle("ego", "up", departPos=20, departSpeed=20) + vehicle("lead", "up", departPos=110, departSpeed=10)
    trace = simulate(net({"up": shape, **bridge}, z=True), vehicles, deaf("ego", "lead"), duration=6.0)
    assert trace.actors == ("ego", "lead")
    assert trace.present.all()
    assert encounter(trace, "ego", "lead").gap[0] == pytest.approx(85.0, abs=0.3)


@pytest.mark.sumo
@pytest.mark.parametrize(("named", "within", "length"), [(("other",), 30.0, 5), ((), 300.0, 5), ((), 50.0, 60)])
def test_a_vehicle_that_a_loop_removes_leaves_the_trace(tmp_path, named, within, length):
    """SUMO does not list it as arrived: the run failed as it was not known."""
    kind = f'<vType id="tr" length="{length}" sigma="0"/>'

    def loop(sumo, values, rng):
        sumo.simulationStep()
        while sumo.simulation.getTime() < 4.0:
            sumo.simulationStep()
        sumo.vehicle.remove("other")
        step_until_over(sumo, values, rng)

    other = vehicle("other", "we", "tr", departPos=150, departSpeed=1)
    vehicles = kind + vehicle("ego", "we", departPos=10, departSpeed=2) + other
    one = simulation(tmp_path, net({"we": WEST_EAST}), vehicles, loop, 8.0)
    trace = replace(one, recording=replace(one.recording, within=within, named=named))({}, 1)
    assert trace.ended == "duration"
    assert "other" not in trace.actors or not trace.present[-1, trace.actors.index("other")]


@pytest.mark.sumo
@pytest.mark.parametrize("length", [5, 60])
def test_who_stands_beside_a_hill_is_seen_and_asked_nothing_that_ends_the_process(tmp_path, length):
    """libsumo's getRoadID of a vehicle off the lanes is a segmentation fault."""
    roads = {"up": [(0.0, 0.0, 0.0), (300.0, 0.0, 30.0)], "over": [(-200.0, -50.0, 6.0), (-200.0, 50.0, 6.0)],
             "below": [(-250.0, 0.0, 0.0), (-150.0, 0.0, 0.0)]}  # fmt: skip

    def loop(sumo, values, rng):
        sumo.simulationStep()
        while sumo.simulation.getTime() < 5.0:
            sumo.vehicle.moveToXY("other", "", -1, 160.0, -12.0, 90.0, 2)
            sumo.simulationStep()

    kind = f'<vType id="tr" length="{length}" sigma="0"/>'
    vehicles = kind + vehicle("ego", "up", departSpeed=2) + vehicle("other", "up", "tr", departPos=150, departSpeed=0)
    trace = simulation(tmp_path, net(roads, z=True), vehicles, loop, 4.0)({}, 1)
    assert trace.ended == "duration"


@pytest.mark.sumo
@pytest.mark.parametrize(("train", "car"), [("other", "ego"), ("ego", "other")])
@pytest.mark.parametrize(("across", "ended"), [(6.0, "duration"), (0.5, "collision")])
def test_a_train_is_where_its_body_is_not_on_the_level_of_its_front(simulate, across, ended, train, car):
    """On the bridge with its front down it touched who passed below; on the crossing with its front up it was not there.

    So it is whichever of the two is the ego, and where heights decide nothing is told to be taken for a bridge.
    """
    far = 14.0 if across < 1.0 else 0.5
    rail = [(0.0, -300.0, across), (0.0, 20.0, across), (0.0, 120.0, far), (0.0, 400.0, far)]
    bridge = {"over": [(200.0, -50.0, 6.0), (200.0, 50.0, 6.0)], "below": [(150.0, 0.0, 0.0), (250.0, 0.0, 0.0)]}
    roads = {"we": [(-200.0, 0.0, 0.0), (100.0, 0.0, 0.0)], "sn": rail, **bridge}
    vehicles = vehicle(train, "sn", "rail", departPos=300, departSpeed=12) + vehicle(car, "we", departPos=10, departSpeed=14)
    trace = simulate(net(roads, z=True), vehicles, deaf("ego", "other"), duration=18.0)
    assert trace.ended == ended
    assert not any(text.startswith("on another level") for text in trace.unconfirmed)


@pytest.mark.sumo
def test_the_other_deck_of_a_road_that_falls_is_another_level(simulate):
    """What the slope allows has a sign: the oncoming car 6 m above was near the height of the ego 60 m before it."""
    decks = {"low": [(0.0, 0.0, 20.0), (400.0, 0.0, 0.0)], "high": [(400.0, 0.0, 6.0), (0.0, 0.0, 26.0)]}
    vehicles = vehicle("ego", "low", departPos=20, departSpeed=20) + vehicle("other", "high", departPos=20, departSpeed=20)
    assert simulate(net(decks, z=True), vehicles, deaf("ego", "other"), duration=15.0).actors == ("ego",)


@pytest.mark.sumo
@pytest.mark.parametrize("heights", [True, False])
def test_a_named_one_on_a_bridge_is_on_another_level_at_any_distance(tmp_path, heights):
    """Beyond the radius it was recorded: a time to collision of a second with who crossed 6 m above."""
    crossing = {"we": WEST_EAST, "sn": [(x, y, 6.0) for x, y in SOUTH_NORTH]}
    network = net({k: [(*p, 0.0)[:3] for p in shape] for k, shape in crossing.items()}, z=heights)
    one = simulation(tmp_path, network, MEETING, deaf("ego", "other"), 20.0)
    near = replace(one, recording=replace(one.recording, within=15.0, named=("other",)))
    assert near({}, 1).actors == ("ego",)


@pytest.mark.sumo
@pytest.mark.parametrize(
    "others", [{}, {"over": [(60.0, -100.0, 8.0), (60.0, 100.0, 8.0)]}], ids=["a metre apart", "at one height"]
)
def test_roads_that_cross_on_one_level_without_a_junction_stay_a_contact_that_sumo_does_not_list(simulate, tmp_path, others):
    """Heights that differ by less than a vehicle say that it is no bridge; SUMO never compares such roads."""
    level = {"we": [(*p, 0.0) for p in WEST_EAST], "sn": [(*p, 0.0 if others else 1.0) for p in SOUTH_NORTH]} | others
    trace = simulate(net(level, z=True), MEETING, deaf("ego", "other"))
    one = simulation(tmp_path, net(level, z=True), MEETING, deaf("ego", "other"), 5.0)
    one({}, 1)
    assert any("'sn' and 'we' at (0, 0)" in line and "give bridges their height" in line for line in one.warnings())
    assert trace.ended == "collision"
    (text,) = trace.unconfirmed
    assert text.startswith(f"{UNCONFIRMED}'other' at ")
    assert "'we' and 'sn' overlap in the plane but share no junction" in text


def arc(radius: float, *, straight: float = 60.0, steps: int = 24, back: bool = False) -> list[Point]:
    """A road to the north that turns left by 180 degrees around (0, 0), and back to the south."""
    turn = [(radius * math.cos(a), radius * math.sin(a)) for a in np.linspace(0.0, math.pi, steps)]
    shape = [(radius, -straight), *turn, (-radius, -straight)]
    return shape[::-1] if back else shape


@pytest.mark.sumo
def test_a_bus_in_a_bend_is_as_wide_as_what_it_sweeps(simulate):
    """Its straight rectangle would cut 2.3 m into the bend, over an oncoming car; its parts keep to the lane."""
    network = net({"out": arc(8.0), "in": arc(4.4, back=True)})
    vehicles = vehicle("ego", "in", departPos=40, departSpeed=4) + vehicle("bus", "out", "bus", departPos=40, departSpeed=4)
    trace = simulate(network, vehicles, deaf("ego", "bus"), duration=25.0)
    ego, bus = trace.actor("ego"), trace.actor("bus")
    assert len(bus.parts) == 3
    assert (trace.ended, trace.unconfirmed) == ("left", ())
    straight = Trace(trace.time, trace.actors, trace.x, trace.y, trace.heading, trace.speed, trace.acceleration, trace.length,
                     trace.width)  # fmt: skip
    assert COLLISION(straight) == 1.0, "the rectangle touches"
    assert COLLISION(trace) == 0.0, "the metrics see the body that the recorder sees"
    assert 0.2 < np.nanmin(rectangle_distance(ego, bus)) < 1.5
    middle = np.concatenate([np.hypot(part.x, part.y)[part.y > 2.0] for part in bus.parts])
    assert np.abs(middle - 8.0).max() < 0.3, "every part is on the lane, within the height of its arc"


@pytest.mark.sumo
def test_a_car_that_drives_into_the_rear_of_a_long_bus_in_a_bend_is_confirmed(simulate):
    network = net({"out": arc(20.0)})
    vehicles = vehicle("bus", "out", "bus", departPos=75, departSpeed=3) + vehicle("ego", "out", departPos=40, departSpeed=10)
    trace = simulate(network, vehicles, deaf("ego", "bus"))
    assert (trace.ended, trace.unconfirmed) == ("collision", ())
    assert trace.reported[-1].startswith("ego>bus@")
    e = encounter(trace, "ego", "bus")
    assert e.rear_end
    assert e.gap[0] == pytest.approx(75 - 12 - 40, abs=1.5), "to the rear part, not to the middle"


@pytest.mark.sumo
def test_a_collision_that_sumo_lists_is_confirmed_and_cars_are_one_rectangle(simulate):
    vehicles = vehicle("lead", "we", departPos=60, departSpeed=2) + vehicle("ego", "we", departPos=20, departSpeed=15)
    trace = simulate(net({"we": WEST_EAST}), vehicles, deaf("ego", "lead"))
    assert (trace.ended, trace.unconfirmed, dict(trace.parts)) == ("collision", (), {})
    assert trace.reported
    assert trace.reported[0].startswith("ego>lead@")


@pytest.mark.sumo
def test_a_side_contact_across_lanes_stays_critical_and_says_why_sumo_does_not_list_it(simulate, tmp_path):
    network = net({"we": WEST_EAST}, lanes=2, width=2.2)
    vehicles = vehicle("bus", "we", "bus", departPos=40, departSpeed=5)
    vehicles += vehicle("ego", "we", "wide", departLane=1, departPos=20.3)
    trace = simulate(network, vehicles, deaf("ego", "bus"))
    assert (trace.ended, len(trace.unconfirmed)) == ("collision", 1)
    assert "side by side on lanes 'we_1' and 'we_0'" in trace.unconfirmed[0]
    assert re.search(r"no sublane model.*bodies overlap by 0\.\d+ m$", trace.unconfirmed[0])
    assert COLLISION(trace) == 1.0
    scenario = LogicalScenario(
        "side", (Parameter("a", 0, 1),), metrics=(COLLISION,), requirement=Requirement("collision", low=1.0),
        simulate=lambda values, seed: trace,
    )  # fmt: skip
    outcome = run_job(scenario, Job(0, {"a": 0.5}, 0))
    assert (outcome.metrics["collision"], outcome.unconfirmed) == (1.0, trace.unconfirmed[0])


@pytest.mark.sumo
def test_what_sumo_lists_without_a_contact_is_told(simulate):
    """Two bicycles beside each other on one lane: SUMO compares along the lane only."""
    vehicles = vehicle("lead", "we", "bike", departPos=40, departSpeed=2, departPosLat=1.2)
    vehicles += vehicle("ego", "we", "bike", departPos=20, departSpeed=6, departPosLat=-1.2)
    trace = simulate(net({"we": WEST_EAST}), vehicles, deaf("ego", "lead"), duration=8.0)
    assert (trace.ended, len(trace.unconfirmed)) == ("duration", 1)
    assert trace.unconfirmed[0].startswith(f"{LISTED_ONLY}'lead' at ")
    assert "SUMO compares positions along the lane, not sideways" in trace.unconfirmed[0]
    assert "1.75 m apart" in trace.unconfirmed[0]


@pytest.mark.sumo
def test_the_rear_of_a_train_is_there_although_its_front_is_far(simulate):
    network = net({"we": [(-300.0, 0.0), (300.0, 0.0)], "sn": [(-40.0, -100.0, 0.0), (-40.0, 100.0, 0.5)]}, z=False)
    vehicles = vehicle("train", "we", "rail", departPos=460, departSpeed=0) + vehicle("ego", "sn")
    trace = simulate(network, vehicles, deaf("ego", "train"), duration=3.0)
    assert trace.actors == ("ego",), "a level of its own, without heights"
    parallel = net({"we": [(-300.0, 0.0), (300.0, 0.0)], "sn": [(-200.0, 6.0), (200.0, 6.0)]})
    trace = simulate(parallel, vehicle("train", "we", "rail", departPos=400, departSpeed=0) + vehicle("ego", "sn"),
                     deaf("ego", "train"), duration=3.0)  # fmt: skip
    assert trace.actors == ("ego", "train")
    assert trace.present[:, 1].all(), "the front is farther than the radius, the body is beside the ego"
    least = np.nanmin(rectangle_distance(trace.actor("ego"), trace.actor("train")))
    assert least == pytest.approx(6.0 - 1.5 - 0.9, abs=0.05)


def test_a_trailing_body_follows_the_path_and_changes_lanes_as_a_whole():
    body = TrailingBody(12.0)
    for k in range(1, 41):
        straight = body.move((float(k), 0.0), 1.0, 0.0, "a_0", 1.0)
    x = 40.0
    assert body.poses([straight])[0] == pytest.approx(np.array([[x - 2, 0, 0], [x - 6, 0, 0], [x - 10, 0, 0]]))
    changed = body.move((x + 1.0, 3.2), 1.0, 0.0, "a_1", 1.0)
    assert body.poses([changed])[0, :, 1] == pytest.approx(3.2), "a change of lanes in one step moves all of it"
    for k in range(1, 25):
        a = k / 8.0
        last = body.move((x + 1 + 8 * math.sin(a), 3.2 + 8 - 8 * math.cos(a)), math.cos(a), math.sin(a), "b_0", 1.0)
    poses = body.poses([straight, changed, last])
    assert poses[:2] == pytest.approx(np.array([body.poses([k])[0] for k in (straight, changed)])), "what was stays as it was"
    poses = poses[2]
    radius = [math.hypot(px - x - 1, py - 11.2) for px, py, _ in poses]
    assert radius == pytest.approx([8.0] * 3, abs=0.3)
    turned = np.unwrap([p[2] for p in poses])
    assert np.diff(turned) == pytest.approx(-4.0 / 8.0, abs=0.03)


def test_a_straight_long_vehicle_has_the_metrics_of_its_rectangle():
    from dataclasses import replace

    from sbt.metrics.planar import pet, severity, ttc_2d_min
    from sbt.metrics.traffic import ttc_path_min
    from sbt.problem.trace import ActorTrace

    t = np.arange(0.0, 8.0, 0.1)
    zero = np.zeros_like(t)
    x = np.stack([-60.0 + 12.0 * t, zero + 3.0], axis=1)
    y = np.stack([zero, -50.0 + 7.5 * t], axis=1)
    heading = np.stack([zero, zero + 0.5 * math.pi], axis=1)
    speed = np.stack([zero + 12.0, zero + 7.5], axis=1)
    whole = Trace(t, ("ego", "co"), x, y, heading, speed, np.zeros_like(x), np.array([5.0, 12.0]), np.array([1.8, 2.5]))
    part = tuple(
        ActorTrace(x[:, 1], y[:, 1] + d, heading[:, 1], speed[:, 1], zero, 4.0, 2.5) for d in (4.0, 0.0, -4.0)
    )  # fmt: skip
    split = replace(whole, parts={"co": part})
    for metric in (ttc_2d_min(), pet(), severity(), ttc_path_min()):
        assert metric(split) == pytest.approx(metric(whole), abs=2e-3), metric.name
    a, b = split.actor("ego"), split.actor("co")
    assert contact_index(a, b) == contact_index(whole.actor("ego"), whole.actor("co"))
    assert {corners(p).shape for p in rectangles(b)} == {(80, 4, 2)}
    assert not split.identical(whole)
    assert split.identical(split.select(slice(None)))


SCENARIO = """sumo: a.sumocfg
simulate: loop.py:simulate
inputs:
  v_ego: {min: 6, max: 12, unit: m/s}
ego: {id: ego, may_leave: true}
duration: 4
metrics: [collision]
requirement: {metric: collision, critical: [0.5, .inf]}
"""
LOOP = """
def simulate(sumo, values, rng):
    sumo.simulationStep()
    for name in ("ego", "bus"):
        sumo.vehicle.setSpeedMode(name, 32)
        sumo.vehicle.setLaneChangeMode(name, 0)
        sumo.vehicle.setSpeed(name, sumo.vehicle.getSpeed(name))
    while True:
        sumo.simulationStep()
"""


@pytest.mark.sumo
def test_row_report_and_conclusion_tell_an_unconfirmed_contact_apart_and_show_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vehicles = vehicle("bus", "we", "bus", departPos=40, departSpeed=5)
    vehicles += vehicle("ego", "we", "wide", departLane=1, departPos=20.3, departSpeed="${v_ego}")
    Path("a.net.xml").write_text(net({"we": WEST_EAST}, lanes=2, width=2.2))
    Path("a.rou.xml").write_text(f"<routes>{TYPES}{vehicles}</routes>")
    named = {"net-file": "a.net.xml", "route-files": "a.rou.xml", "insertion-checks": "none"}
    options = "".join(f'<{name} value="{value}"/>' for name, value in named.items())
    Path("a.sumocfg").write_text(f"<configuration>{options}</configuration>")
    Path("scenario.yaml").write_text(SCENARIO)
    Path("loop.py").write_text(LOOP)
    Path("c.yaml").write_text(json.dumps({
        "campaign": "falsification", "scenario": "scenario.yaml", "budget": 8, "initial": 8, "metamodel": {"kind": "et"},
        "store": "runs", "executor": {"kind": "serial"},
    }))  # fmt: skip
    done = CliRunner().invoke(app, ["run", "c.yaml", "--json"])
    assert done.exit_code == 0, done.output
    summary = sbt.open("runs")
    rows = summary.frame
    critical = rows["critical"].astype(bool).to_numpy()
    assert 0 < critical.sum() < len(rows)
    told = rows["unconfirmed"].str.contains("side by side on lanes").to_numpy()
    assert (told == critical).all()
    links = summary.conclusion.links
    assert links is not None  # a critical one is one more run of its mode
    unconfirmed = sum(mode.unconfirmed for mode in summary.conclusion.failure_modes)
    assert unconfirmed == (critical & (rows["stage"] != "confirm")).sum() + links.critical
    assert json.loads(done.stdout)["unconfirmed"] == critical.sum()
    page = Path("runs/report.html").read_text()
    assert f"{critical.sum()} of the {critical.sum()} critical runs have a contact that SUMO" in page
    assert 'id="contacts"' in page
    run = int(rows.index[critical][0])
    assert f"sumo-sbt replay runs {run} --gif {run}.gif" in page
    assert CliRunner().invoke(app, ["replay", "runs", str(run), "--gif", f"{run}.gif"]).exit_code == 0
    assert Path(f"{run}.gif").stat().st_size > 1000


def test_an_ego_that_moves_as_no_vehicle_can_is_told(tmp_path: Path):
    braking = np.array([[0.0], [-60.0], [1.0]])
    trace = Trace(np.arange(3.0), ("ego",), *np.zeros((4, 3, 1)), braking, np.full(1, 4.5), np.full(1, 1.8))
    scenario = LogicalScenario(
        "brick", [sbt.Parameter("a", 0, 1)], sbt.Requirement("m", high=0.0), simulate=lambda values, seed: trace,
        metrics=[Metric("m", lambda trace: 1.0)],
    )  # fmt: skip
    outcome = run_job(scenario, Job(0, {"a": 0.5}, 1))
    assert outcome.status == "ok"
    assert outcome.unconfirmed == "as no vehicle can: -60 m/s^2 of ego at 1.000 s"
    result = sbt.run(campaign="coverage", scenario=scenario, budget=4, store=tmp_path / "s", executor="serial", report=False)
    assert any("In 4 of 4 runs the ego moves as no vehicle can" in said for said in result.sentences())
