"""Who is near is decided by bodies, however long, and whatever a loop subscribes to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_evidence import deaf, net, simulation, vehicle
from test_off_lanes import moving

from sbt.metrics.geometry import rectangle_distance
from sbt.problem.trace import Trace
from sbt.sumo.user_simulation import Loop

pytestmark = pytest.mark.sumo
ROAD = net({"road": [(0.0, 0.0), (600.0, 0.0)]}, lanes=2)
RADII = (2.0, 10.0, 30.0, 100.0)


def around(folder: Path, vehicles: str, loop: Loop, within: float, duration: float = 12.0) -> Trace:
    made = simulation(folder, ROAD, vehicles, loop, duration, step_length="0.1")
    return replace(made, recording=replace(made.recording, within=within))({}, 1)


def bodies(length: float, own: float = 5.0) -> str:
    """Vehicle types as long as that: of the other one, and of the ego."""
    return f'<vType id="other" length="{length}" width="2.5"/><vType id="own" length="{own}" width="1.8" minGap="0"/>'


@pytest.mark.parametrize("length", [5.0, 12.0, 18.0, 19.9, 25.0, 60.0])
def test_the_body_of_who_stands_ahead_is_met_whatever_the_radius(tmp_path: Path, length: float):
    """With a radius below its length it was recorded half a second after the contact: its front was not within the radius."""
    vehicles = bodies(length) + vehicle("ego", "road", "own", departPos=20, departSpeed=20)
    vehicles += vehicle("o", "road", "other", departPos=120 + length, departSpeed=0)
    found = [around(tmp_path, vehicles, deaf("ego", "o"), within) for within in RADII]
    assert {trace.ended for trace in found} == {"collision"}
    assert {float(trace.time[-1]) for trace in found} == {float(found[-1].time[-1])}
    for trace, within in zip(found, RADII, strict=True):
        gap = rectangle_distance(trace.actor("ego"), trace.actor("o"))
        first = int(np.flatnonzero(np.isfinite(gap))[0])
        assert first == 0 or gap[first] > within - 2.1, "it is seen as soon as its body is within the radius, a step's way later"


def test_who_runs_into_a_long_ego_is_met(tmp_path: Path):
    """The ego's own rear is farther from its front than the radius."""
    vehicles = bodies(5.0, own=18.0) + vehicle("ego", "road", "own", departPos=120, departSpeed=5)
    vehicles += vehicle("o", "road", "other", departPos=20, departSpeed=25)
    found = [around(tmp_path, vehicles, deaf("ego", "o"), within) for within in RADII]
    assert {(trace.ended, float(trace.time[-1])) for trace in found} == {("collision", float(found[-1].time[-1]))}


def test_a_long_vehicle_that_departs_later_than_the_ego_is_met(tmp_path: Path):
    """When the ego's surroundings are subscribed to nothing is known of a type that a loop makes."""
    vehicles = bodies(5.0) + vehicle("ego", "road", "own", departPos=20, departSpeed=10)
    deaf_ego = deaf("ego", "o")

    def loop(sumo, values, rng):
        sumo.simulationStep()
        sumo.vehicletype.copy("other", "late")
        sumo.vehicletype.setLength("late", 19.0)
        sumo.vehicle.add("o", "", "late", departPos="120", departSpeed="0")
        sumo.vehicle.setRoute("o", ["road"])
        sumo.simulationStep()
        deaf_ego(sumo, values, rng)

    found = [around(tmp_path, vehicles, loop, within) for within in (5.0, 100.0)]
    assert {(trace.ended, float(trace.time[-1])) for trace in found} == {("collision", float(found[-1].time[-1]))}


def test_a_long_vehicle_off_the_lanes_is_met(tmp_path: Path):
    """It comes backwards out of a yard beside the road: its front is far when its rear is on the lane."""
    vehicles = bodies(18.0) + vehicle("ego", "road", "own", departPos=50) + vehicle("o", "road", "other", departPos=200)
    poses = ("ego", 50.0, 0.0, 90.0, 10.0, 0.0), ("o", 100.0, -30.0, 180.0, 0.0, 2.0)
    found = [around(tmp_path, vehicles, moving(*poses), within) for within in (6.0, 100.0)]
    assert {(trace.ended, float(trace.time[-1])) for trace in found} == {("collision", float(found[-1].time[-1]))}


def test_who_is_farther_than_the_radius_is_not_recorded(tmp_path: Path):
    vehicles = bodies(18.0) + vehicle("ego", "road", "own", departPos=20, departSpeed=0)
    vehicles += vehicle("o", "road", "other", departPos=100, departSpeed=0, departLane=1)
    trace = around(tmp_path, vehicles, deaf("ego", "o"), 50.0, 2.0)
    assert trace.actors == ("ego",), "62 m between the bodies"
