"""Who is near is decided by bodies, however long, and whatever a loop subscribes to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_evidence import deaf, net, simulation, vehicle
from test_off_lanes import moving

from sbt.errors import RunError
from sbt.metrics.geometry import rectangle_distance
from sbt.problem.trace import Trace
from sbt.sumo.user_simulation import Loop

pytestmark = pytest.mark.sumo
ROAD = net({"road": [(0.0, 0.0), (600.0, 0.0)]}, lanes=2)
RADII = (2.0, 10.0, 30.0, 100.0)


def around(folder: Path, vehicles: str, loop: Loop, within: float, duration: float = 12.0, step: str = "0.1") -> Trace:
    made = simulation(folder, ROAD, vehicles, loop, duration, step_length=step)
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


@pytest.mark.parametrize(("length", "start"), [(5.0, 20.0), (5.0, 27.0), (5.0, 34.0), (5.0, 41.0), (25.0, 30.0)])
def test_who_drives_farther_than_the_radius_in_a_step_is_met(tmp_path: Path, length: float, start: float):
    """Outside the radius before the step, or after it, one had no step in which it could touch."""
    vehicles = bodies(length) + vehicle("ego", "road", "own", departPos=200, departSpeed=5)
    vehicles += vehicle("o", "road", "other", departPos=start, departSpeed=40)
    found = [around(tmp_path, vehicles, deaf("ego", "o"), within, step="1") for within in RADII]
    assert {(trace.ended, float(trace.time[-1])) for trace in found} == {("collision", float(found[-1].time[-1]))}


def test_a_long_vehicle_that_departs_later_than_the_ego_is_met(tmp_path: Path):
    """Nothing was known of its type, which a loop makes, when the ego's surroundings were subscribed to."""
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


PASSING = vehicle("ego", "road", departPos=20, departSpeed=20) + vehicle("lead", "road", departPos=90, departSpeed=22)
PASSING += vehicle("far", "road", departPos=120, departSpeed=2, departLane=1)
VEHICLES, PERSONS, LANES, VAR_SPEED, VAR_LANE = 0xA4, 0xAE, 0xA3, 0x40, 0x51


def passing(*, before=lambda sumo: None, each=lambda sumo, k: None) -> Loop:
    """A loop in which the ego passes `far`, which is on the lane beside, and which subscribes."""

    def loop(sumo, values, rng):
        sumo.simulationStep()
        for name, speed in (("ego", 20.0), ("lead", 22.0), ("far", 2.0)):
            sumo.vehicle.setSpeedMode(name, 32)
            sumo.vehicle.setLaneChangeMode(name, 0)
            sumo.vehicle.setSpeed(name, speed)
        before(sumo)
        for k in range(100):
            each(sumo, k)
            sumo.simulationStep()

    return loop


def own(sumo, dist=100.0, variables=(VAR_SPEED,), domain=VEHICLES):
    sumo.vehicle.subscribeContext("ego", domain, dist, list(variables))


def filtered(sumo, *, dist=100.0):
    own(sumo, dist)
    sumo.vehicle.addSubscriptionFilterLanes([0])


SUBSCRIBING = {
    "own": own,
    "far": lambda sumo: own(sumo, 5000.0),
    "other variables": lambda sumo: own(sumo, 100.0, (VAR_LANE,)),
    "lanes": lambda sumo: own(sumo, 100.0, (0x44,), LANES),
    "filtered": filtered,
    "filtered, another radius": lambda sumo: filtered(sumo, dist=10.0),
    "downstream": lambda sumo: (own(sumo), sumo.vehicle.addSubscriptionFilterDownstreamDistance(5.0)),
    "lead and follow": lambda sumo: (own(sumo), sumo.vehicle.addSubscriptionFilterLeadFollow([0])),
    "manoeuvre": lambda sumo: (own(sumo), sumo.vehicle.addSubscriptionFilterLCManeuver()),
    "class": lambda sumo: (own(sumo), sumo.vehicle.addSubscriptionFilterVClass(["bus"])),
    "of another one": lambda sumo: (
        sumo.vehicle.subscribeContext("lead", VEHICLES, 100.0, [VAR_SPEED]), sumo.vehicle.addSubscriptionFilterLanes([0])
    ),
    "ended": lambda sumo: (own(sumo), sumo.vehicle.unsubscribeContext("ego", VEHICLES, 100.0)),
    "ended by its name": lambda sumo: (own(sumo), sumo.vehicle.unsubscribeContext(objectID="ego", domain=VEHICLES, dist=1.0)),
    "ended by a list without variables": lambda sumo: (own(sumo), own(sumo, 50.0, ())),
    "ended, then filtered": lambda sumo: (
        own(sumo), sumo.vehicle.unsubscribeContext("ego", VEHICLES, 100.0), filtered(sumo)
    ),
    "another one ended, then filtered": lambda sumo: (
        sumo.vehicle.subscribeContext("lead", VEHICLES, 90.0, [VAR_SPEED]), own(sumo),
        sumo.vehicle.unsubscribeContext("lead", VEHICLES, 90.0), sumo.vehicle.addSubscriptionFilterLanes([0]),
    ),
    "lanes, then filtered": lambda sumo: (
        own(sumo), own(sumo, 100.0, (0x44,), LANES), sumo.vehicle.addSubscriptionFilterLanes([0])
    ),
    "variables alone": lambda sumo: (sumo.vehicle.subscribe("ego", [VAR_SPEED]), sumo.vehicle.unsubscribe("ego")),
}  # fmt: skip


@pytest.mark.parametrize("how", SUBSCRIBING)
@pytest.mark.parametrize("later", [False, True], ids=["at first", "later and again"])
def test_what_a_loop_subscribes_to_changes_nothing(tmp_path: Path, how: str, later: bool):
    """SUMO merged it with what the recorder subscribes to, filters too: whom it filtered out was gone from the record."""
    call = SUBSCRIBING[how]
    some = passing(each=lambda sumo, k: call(sumo) if k in (5, 20) else None) if later else passing(before=call)
    plain, found = (around(tmp_path, PASSING, loop, 100.0) for loop in (passing(), some))
    assert "far" in plain.actors
    assert rectangle_distance(plain.actor("ego"), plain.actor("far")).min() < 2.0
    assert found.identical(plain)


def test_a_loop_may_ask_for_less_of_persons_who_are_far(tmp_path: Path):
    """They were taken for vehicles, of which SUMO knows none by that name."""
    away = '<person id="p" depart="0" departPos="400"><walk edges="road" arrivalPos="500"/></person>'
    ask = passing(before=lambda sumo: own(sumo, 600.0, (0x39, 0x43, 0x40), 0xAE))
    assert "p" not in around(tmp_path, PASSING + away, ask, 100.0).actors


def test_a_filter_of_no_own_subscription_is_refused(tmp_path: Path):
    loop = passing(before=lambda sumo: sumo.vehicle.addSubscriptionFilterLanes([0]))
    with pytest.raises(RunError, match=r"must subscribe to the vehicles.*before .*FilterLanes, but it did not"):
        around(tmp_path, PASSING, loop, 100.0)


def test_a_loop_still_sees_what_it_subscribes_to(tmp_path: Path):
    seen = []

    def before(sumo):
        sumo.vehicle.subscribeContext("lead", VEHICLES, 100.0, [VAR_LANE])
        sumo.vehicle.addSubscriptionFilterLanes([0])

    def each(sumo, k):
        seen.append(sorted(sumo.vehicle.getContextSubscriptionResults("lead")) if k == 1 else None)

    around(tmp_path, PASSING, passing(before=before, each=each), 100.0)
    assert seen[1] == ["ego", "lead"], "and not who is on the other lane"
