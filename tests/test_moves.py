"""Road users that SUMO moves within a step: over a lane, at an edge's end, out of sight; and those that are there for one instant."""

# ruff: noqa: E501  (XML)

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program

from sbt.execution.spec import ScenarioSpec
from sbt.metrics.geometry import contact_index
from sbt.metrics.paths import ttc_on_paths
from sbt.metrics.traffic import any_collision, nearest_distance, ttc_path_min
from sbt.problem.trace import Trace

LANE = 3.2


def cars(time: np.ndarray, *tracks: np.ndarray, length: float = 5.0) -> Trace:
    """Cars 1.8 m wide, each with (t, 4) x, y, heading and speed."""
    x, y, heading, speed = (np.stack([np.broadcast_to(track, (len(time), 4))[:, k] for track in tracks], axis=1) for k in range(4))
    names, size = ("ego", *(f"co_{k}" for k in range(1, len(tracks)))), (np.full(len(tracks), length), np.full(len(tracks), 1.8))
    return Trace(time, names, x, y, heading, speed, np.zeros_like(x), *size)


def around(radius: float, along: np.ndarray | float) -> np.ndarray:
    """Return x, y and heading on a bend to the left, so far along it."""
    angle = np.asarray(along) / radius
    return np.stack([radius * np.sin(angle), radius - radius * np.cos(angle), angle], axis=-1)


@pytest.mark.parametrize(
    ("radius", "step", "speed"),
    [(40.0, 0.05, 4.0), (40.0, 0.1, 12.0), (40.0, 0.5, 13.0), (40.0, 1.0, 7.0), (120.0, 0.2, 32.0), (120.0, 1.0, 30.0), (1e6, 0.1, 36.0), (1e6, 1.0, 30.0)],
)
def test_who_swerves_within_a_step_would_have_hit_what_was_ahead_whatever_the_step(radius: float, step: float, speed: float):
    """Ego swerves to the inner lane, at the same angle of the bend, .6 s before it would hit who stands there."""
    time = np.arange(0.0, 7.0, step)
    swerves = int(np.argmax(time > 4.9))
    own = around(radius, speed * time)
    normal = np.stack([-np.sin(own[:, 2]), np.cos(own[:, 2])], axis=1)
    own[swerves:, :2] += LANE * normal[swerves:]
    ahead = around(radius, speed * time[swerves - 1] + 0.6 * speed + 5.0)
    trace = cars(time, np.column_stack([own, np.full_like(time, speed)]), np.array([*ahead, 0.0]))
    found = ttc_on_paths(trace, "ego", "co_1")
    assert found[swerves - 1] == pytest.approx(0.6, abs=0.08)
    assert (found[swerves:] == 5.0).all()


def entering(time: np.ndarray, speed: float, swerves: int) -> np.ndarray:
    """Return the states of a car whose front is on another lane from one step on, and whose rear is when it gets there, as in SUMO."""
    front = np.stack([speed * time, np.where(np.arange(len(time)) >= swerves, LANE, 0.0)], axis=1)
    rear_x = front[:, 0] - 5.0
    heading = np.arctan2(front[:, 1] - np.where(rear_x >= front[swerves, 0], LANE, 0.0), 5.0)
    middle = front - 2.5 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.column_stack([middle, heading, np.full_like(time, speed)])


@pytest.mark.parametrize(("step", "speed"), [(0.05, 10.0), (0.1, 9.0), (0.2, 13.0)])
def test_who_enters_an_edge_on_another_lane_would_have_hit_what_was_ahead_in_its_own(step: float, speed: float):
    """SUMO turns it by 33 degrees, until its rear is there, too: what it drives meanwhile beside its heading is no change of lanes."""
    time = np.arange(0.0, 8.0, step)
    swerves = int(np.argmax(time > 4.9))
    own = entering(time, speed, swerves)
    before, ahead = np.array([own[swerves - 1, 0] + 0.8 * speed + 5.0, 0.0, 0.0, 0.0]), np.array([200.0, 0.0, 0.0, 0.0])
    found = ttc_on_paths(cars(time, own, before), "ego", "co_1")
    assert found[swerves - 1] == pytest.approx(0.8, abs=0.2)
    assert ttc_on_paths(cars(time, own, ahead), "ego", "co_1").min() == 5.0
    beside = np.array([own[swerves - 1, 0] + 0.8 * speed + 5.0, LANE, 0.0, 0.0])
    assert ttc_on_paths(cars(time, own, beside), "ego", "co_1")[swerves - 1] == 5.0, "that lane is none of its path yet"


def test_a_change_of_lanes_after_the_other_has_gone_is_none_of_the_path():
    """Who stands in the other lane is recorded until before ego changes: ego's way as it was would not have led there."""
    time = np.arange(0.0, 6.0, 0.1)
    own = np.column_stack([10.0 * time, np.where(time > 3.95, LANE, 0.0), 0.0 * time, 10.0 + 0.0 * time])
    stands = np.where((time < 3.05)[:, None], np.array([60.0, LANE, 0.0, 0.0]), np.nan)
    trace = cars(time, own, stands)
    assert ttc_path_min()(trace) == 5.0
    assert ttc_path_min()(trace.select(slice(0, 31))) == 5.0
    assert ttc_path_min()(trace.select(slice(0, 2))) == 5.0


@pytest.mark.parametrize("at", [0, 10, 20])
def test_who_is_there_for_an_instant_counts_in_every_metric(at: int):
    time = np.linspace(0.0, 2.0, 21)
    own = np.column_stack([10.0 * time, 0.0 * time, 0.0 * time, 10.0 + 0.0 * time])
    for ahead, touches in ((4.0, 1.0), (8.0, 0.0)):
        other = np.full((21, 4), np.nan)
        other[at] = 10.0 * time[at] + ahead, 0.0, 0.0, 0.0
        trace = cars(time, own, other)
        assert any_collision()(trace) == touches
        assert nearest_distance()(trace) == pytest.approx(max(ahead - 5.0, 0.0))
        assert ttc_path_min()(trace) == pytest.approx(max(ahead - 5.0, 0.0) / 10.0)
        assert ttc_on_paths(trace, "ego", None).min() == pytest.approx(ttc_path_min()(trace))


def test_what_a_tail_sweeps_within_a_step_is_touched():
    """A bus turns by .76 rad in a second; its rectangle on the chord, with the heading at its end, passes what stands there."""
    radius, speed, time = 11.037, 8.407, np.arange(3.0)
    bus = np.column_stack([around(radius, speed * time), np.full_like(time, speed)])
    for away, hit in ((0.0, True), (2.0, False)):
        x, y, heading, speeds = (np.stack([bus[:, k], np.full(3, value)], axis=1) for k, value in enumerate((13.547 + away, 8.196, -2.2, 0.0)))
        trace = Trace(time, ("ego", "co"), x, y, heading, speeds, 0.0 * x, np.array([12.0, 2.0]), np.array([2.5, 0.6]))
        assert (contact_index(trace.actor("ego"), trace.actor("co")) is not None) == hit


def test_who_comes_where_a_turn_has_just_been_is_not_touched():
    """Ego turns away from the place at which somebody is seen for the first time an instant later: both were never there at once."""
    time = np.arange(4.0)
    own = np.column_stack([around(8.0, 6.0 * time), np.full_like(time, 6.0)])
    comes = np.full((4, 4), np.nan)
    comes[2:] = [*around(8.0, 4.5), 0.0]
    assert contact_index(*(cars(time, own, comes).actor(name) for name in ("ego", "co_1"))) is None
    comes[1] = comes[2]
    assert contact_index(*(cars(time, own, comes).actor(name) for name in ("ego", "co_1"))) == 1


NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/><node id="c" x="400" y="0"/><node id="d" x="800" y="0"/></nodes>'
EDGES = "<edges>{}</edges>".format("".join(f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="3"/>' for a, b in ("ab", "bc", "cd")))
ROUTES = """<routes><vType id="truck" length="16.5" width="{width}"/><route id="r" edges="ab bc cd"/>
<vehicle id="ego" route="r" depart="0" departPos="162" departSpeed="${{speed}}" departLane="0"/>
<vehicle id="g" type="truck" route="r" depart="0" departPos="180" departSpeed="10" departLane="1"/></routes>
"""
LOOP = """
def simulate(sumo, values, rng):
    sumo.simulationStep()
    for name in ("ego", "g"):
        sumo.vehicle.setSpeedMode(name, 0)
        sumo.vehicle.setLaneChangeMode(name, 0)
        sumo.vehicle.setSpeed(name, sumo.vehicle.getSpeed(name))
    while True:
        lane = sumo.vehicle.getLaneID("g")
        if "{what}" == "change" and lane.startswith("ab") and sumo.lane.getLength(lane) - sumo.vehicle.getLanePosition("g") < 1.0:
            sumo.vehicle.changeLane("g", 2, 100)
        if "{what}" == "move" and abs(sumo.simulation.getTime() - 1.0) < 0.01:
            sumo.vehicle.moveTo("g", "cd_1", 300)
        sumo.simulationStep()
"""
YAML = """sumo: my.sumocfg
simulate: mine.py:simulate
inputs: {speed: {min: 10, max: 14}}
ego: ego
duration: 4
metrics: [ttc_path_min, distance_min]
requirement: {metric: ttc_path_min, critical: [-.inf, 0.5]}
"""


def simulated(folder: Path, what: str, *, step: float = 0.1, width: float = 2.5) -> Trace:
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "e.edg.xml").write_text(EDGES)
    run_program(folder, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    files = f'<net-file value="net.net.xml"/><route-files value="my.rou.xml"/><step-length value="{step}"/>'
    (folder / "my.sumocfg").write_text(f"<configuration>{files}</configuration>")
    (folder / "my.rou.xml").write_text(ROUTES.format(width=width))
    (folder / "mine.py").write_text(LOOP.format(what=what))
    (folder / "scenario.yaml").write_text(YAML)
    trace: Trace = ScenarioSpec(str(folder / "scenario.yaml")).resolve().simulate({"speed": 12.0}, 1)
    return trace


@pytest.mark.sumo
def test_a_truck_that_changes_lanes_as_it_enters_an_edge_takes_its_tail_along(tmp_path: Path):
    trace = simulated(tmp_path, "change")
    truck = trace.actor("g")
    moved = np.flatnonzero(np.abs(np.diff(truck.parts[0].y)) > 2.0)
    assert len(moved) == 1, "it was moved over a lane within one step"
    assert [np.diff(part.y)[moved[0]] for part in truck.parts] == pytest.approx([LANE] * len(truck.parts), abs=0.05)
    assert ttc_path_min()(trace) == 5.0, "ego drives in a lane that the truck never was in"


@pytest.mark.sumo
def test_who_is_moved_out_of_sight_has_no_way_there(tmp_path: Path):
    trace = simulated(tmp_path, "move")
    assert not trace.present[-1, 1]
    assert trace.actor("g").way is None
    assert "teleported: 'g' at " in trace.unconfirmed[0]


@pytest.mark.sumo
def test_who_drives_on_while_a_contact_is_judged_is_not_teleported(tmp_path: Path):
    """SUMO lists no contact with a load that is as wide as two lanes, and is given a second for it: everybody drives on."""
    trace = simulated(tmp_path, "drive", step=0.05, width=5.0)
    assert trace.ended == "collision"
    assert not [said for said in trace.unconfirmed if said.startswith("teleported")]
    assert trace.actor("g").way is not None


@pytest.mark.sumo
def test_a_long_vehicle_that_sumo_turns_at_once_has_not_moved(tmp_path: Path):
    """In a U-turn a bus of 12 m is turned round within a step: its front moves by less than it drives, its middle by 12 m."""
    (tmp_path / "n.nod.xml").write_text('<nodes><node id="a" x="0" y="0"/><node id="b" x="60" y="0"/></nodes>')
    (tmp_path / "e.edg.xml").write_text('<edges><edge id="ab" from="a" to="b"/><edge id="ba" from="b" to="a"/></edges>')
    run_program(tmp_path, "netconvert", "-n", "n.nod.xml", "-e", "e.edg.xml", "-o", "net.net.xml")
    (tmp_path / "my.rou.xml").write_text(
        """<routes><vType id="bus" length="12" width="2.5"/><route id="r" edges="ab ba"/>
<vehicle id="ego" depart="0" departPos="25" departSpeed="0"><route edges="ba"/><stop lane="ba_0" endPos="28" duration="100"/></vehicle>
<vehicle id="g" type="bus" route="r" depart="0" departPos="30" departSpeed="${speed}"/></routes>"""
    )
    files = '<net-file value="net.net.xml"/><route-files value="my.rou.xml"/><step-length value="0.05"/>'
    (tmp_path / "my.sumocfg").write_text(f"<configuration>{files}</configuration>")
    (tmp_path / "scenario.yaml").write_text(YAML.replace("simulate: mine.py:simulate\n", "").replace("min: 10", "min: 3").replace("duration: 4", "duration: 20"))
    trace = ScenarioSpec(str(tmp_path / "scenario.yaml")).resolve().simulate({"speed": 4.0}, 1)
    heading = np.unwrap(trace.actor("g").heading)
    assert np.nanmax(heading) - np.nanmin(heading) > 3.0, "it turns round"
    assert not [said for said in trace.unconfirmed if said.startswith("teleported")]
    assert trace.present[:, 1].sum() == len(trace.time)
