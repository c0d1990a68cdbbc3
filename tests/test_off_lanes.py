"""Who is moved by poses is there off the lanes too, moves as it is moved, and who parks jumps there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_evidence import net, simulation, vehicle

from sbt.errors import RunError
from sbt.metrics.planar import pet
from sbt.sumo.user_simulation import Loop

pytestmark = pytest.mark.sumo
ROAD = net({"road": [(0.0, 0.0), (400.0, 0.0)]})
BAY = (
    '<additional><parkingArea id="pa" lane="road_0" startPos="100" endPos="112" roadsideCapacity="1" angle="45" length="5"/>'
    "</additional>"
)
EGO, OTHER = vehicle("ego", "road", departPos=50), vehicle("other", "road", departPos=150)


def moving(
    *poses: tuple[str, float, float, float, float, float], domain: str = "vehicle", by_sumo: bool = False, keep: int = 2
) -> Loop:  # fmt: skip
    """A loop that moves road users: name, x and y (m) of the front at 0 s, angle (degrees), speeds along x and y (m/s)."""

    def loop(sumo, values, rng):
        if by_sumo:  # past the proxy
            import libsumo
        client = libsumo if by_sumo else sumo
        sumo.simulationStep()
        while sumo.simulation.getTime() < 30.0:
            t = sumo.simulation.getTime()
            for name, x, y, angle, vx, vy in poses:
                lane = [-1] if domain == "vehicle" else []
                getattr(client, domain).moveToXY(name, "", *lane, x + vx * t, y + vy * t, angle, keep)
            sumo.simulationStep()

    return loop


@pytest.mark.parametrize("by_sumo", [False, True])
def test_who_comes_from_beside_the_road_is_met(tmp_path: Path, by_sumo: bool):
    """SUMO's subscription does not see it 2.7 m beside the lane: the contact was missed without a word."""
    poses = ("ego", 50.0, 0.0, 90.0, 10.0, 0.0), ("other", 100.0, -12.0, 0.0, 0.0, 2.0)
    trace = simulation(tmp_path, ROAD, EGO + OTHER, moving(*poses, by_sumo=by_sumo), 8.0, step_length="0.1")({}, 1)
    assert trace.ended == "collision"
    assert trace.time[-1] == pytest.approx(5.5, abs=0.2), "its front is at y = -0.9 m, beside the ego's"
    k = trace.actors.index("other")
    if not by_sumo:
        assert trace.y[5, k] == pytest.approx(-12.0 + 2.0 * trace.time[5] - 2.5, abs=0.4), "seen before it reaches the road"


def test_an_ego_may_leave_its_lane(tmp_path: Path):
    """The run ended as if it were gone."""
    beside = vehicle("other", "road", departPos=150, departSpeed=0)
    trace = simulation(tmp_path, ROAD, EGO + beside, moving(("ego", 50.0, 0.0, 100.0, 10.0, -2.0)), 5.0, step_length="0.1")({}, 1)
    assert trace.ended == "duration"
    assert np.isfinite(trace.actor("ego").x).all()
    assert trace.actor("ego").y[-1] < -8.0
    assert trace.actors[1] == "other", "whom it meets on the lanes is there"


def test_an_ego_that_the_loop_leaves_beside_the_road_is_gone_and_why_is_said(tmp_path: Path):
    def loop(sumo, values, rng):
        for k in range(40):
            sumo.simulationStep()
            if k < 10:
                sumo.vehicle.moveToXY("ego", "", -1, 52.0 + k, -float(k), 90.0, 2)

    with pytest.raises(RunError, match=r"was gone at t = .*SUMO keeps only whom the loop moves \(moveToXY\) in every step"):
        simulation(tmp_path, ROAD, EGO, loop, 5.0, step_length="0.1")({}, 1)


@pytest.mark.parametrize(("y", "vx"), [(0.0, 3.0), (-12.0, 3.0), (-12.0, -3.0), (0.0, 0.0)])
def test_speed_is_that_of_the_motion(tmp_path: Path, y: float, vx: float):
    """SUMO's is what its own driver would do: 53 m/s after a jump, braking from there on, on and off the lanes."""
    poses = ("ego", 50.0, 0.0, 90.0, 10.0, 0.0), ("other", 120.0, y, 90.0, vx, 0.0)
    trace = simulation(tmp_path, ROAD, EGO + OTHER, moving(*poses), 4.0, step_length="0.1")({}, 1)
    other = trace.actor("other")
    there = np.flatnonzero(np.isfinite(other.speed))[1:]
    assert len(there) > 30
    assert other.speed[there] == pytest.approx(vx)
    assert other.acceleration[there] == pytest.approx(0.0, abs=1e-9)
    assert trace.actor("ego").speed == pytest.approx(10.0)
    assert trace.actor("ego").acceleration == pytest.approx(0.0, abs=1e-9)


def test_a_person_that_is_moved_has_the_speed_of_its_motion(tmp_path: Path):
    person = '<person id="p" depart="0" departPos="120"><walk edges="road" arrivalPos="300"/></person>'
    network = ROAD.replace("<lane ", '<lane allow="passenger pedestrian" ')
    loop = moving(("p", 120.0, 9.0, 180.0, 0.0, -1.5), domain="person")
    trace = simulation(tmp_path, network, vehicle("ego", "road", departPos=20, departSpeed=1) + person, loop, 6.0)({}, 1)
    assert trace.actor("p").speed[3:] == pytest.approx(1.5)


def test_who_is_moved_into_a_parking_place_does_not_drive_there(tmp_path: Path):
    """SUMO moves it by 5 m sideways within a step: a post-encroachment time of .1 s with who passed behind it."""
    (tmp_path / "b.add.xml").write_text(BAY)
    stop = '<stop parkingArea="pa" duration="100"/>'
    parks = vehicle("other", "road", departPos=60, departSpeed=8).replace("</vehicle>", f"{stop}</vehicle>")
    one = simulation(tmp_path, ROAD, vehicle("ego", "road", departPos=20, departSpeed=4) + parks, _keeps_on, 25.0,
                     additional_files="b.add.xml", step_length="0.1")  # fmt: skip
    trace = one({}, 1)
    assert trace.unconfirmed == (), "it is what a parking car does"
    assert pet("ego", "other").function(trace) > 1.0


def _keeps_on(sumo, values, rng):
    while True:
        sumo.simulationStep()


def test_who_is_moved_once_drives_at_sumos_speed_afterwards(tmp_path: Path):
    """Its speed was that of its motion for the rest of the run: 27 m/s within a step where SUMO changes lanes."""
    speeds: dict[float, float] = {}

    def loop(sumo, values, rng):
        sumo.simulationStep()
        sumo.vehicle.moveToXY("ego", "", 1, *sumo.vehicle.getPosition("ego"), 90.0, 1)
        for _ in range(60):
            sumo.simulationStep()
            speeds[round(sumo.simulation.getTime(), 3)] = sumo.vehicle.getSpeed("ego")

    bend = net({"road": [(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (200.0, 60.0)]}, lanes=2)
    ego = vehicle("ego", "road", departPos=30, departSpeed=12)
    trace = simulation(tmp_path, bend, ego, loop, 5.0, step_length="0.1")({}, 1)
    own = trace.actor("ego").speed[3:-1]
    assert own == pytest.approx(np.array([speeds[round(0.1 * (k + 4), 3)] for k in range(len(own))]))


def test_who_leaves_a_parking_place_does_not_drive_out_of_it(tmp_path: Path):
    """SUMO says so a step before."""
    (tmp_path / "b.add.xml").write_text(BAY)
    stop = '<stop parkingArea="pa" duration="4"/>'
    parks = vehicle("other", "road", departPos=80, departSpeed=5).replace("</vehicle>", f"{stop}</vehicle>")
    waits = '<stop lane="road_0" endPos="30" duration="100"/>'
    ego = vehicle("ego", "road", departPos=5, departSpeed=1).replace("</vehicle>", f"{waits}</vehicle>")
    one = simulation(tmp_path, ROAD, ego + parks, _keeps_on, 20.0,
                     additional_files="b.add.xml", step_length="0.1")  # fmt: skip
    other = one({}, 1).actor("other")
    moved = np.hypot(np.diff(other.x), np.diff(other.y))
    assert np.nanmax(moved) < 1.5, "into the place and out of it its track is interrupted"
    assert np.isnan(moved).sum() >= 4


BRIDGE = {"road": [(0.0, 0.0, 8.0), (400.0, 0.0, 8.0)], "low": [(200.0, -100.0, 0.0), (200.0, 100.0, 0.0)]}


@pytest.mark.parametrize("heights", [True, False])
@pytest.mark.parametrize("who", ["other", "ego"])
def test_off_the_lanes_everybody_is_on_the_level_of_the_last_road(tmp_path: Path, who: str, heights: bool):
    """Beside its lane a car under the bridge touched the ego on it; keepRoute 3, since else SUMO puts it onto the bridge."""
    network = net({name: [p if heights else p[:2] for p in shape] for name, shape in BRIDGE.items()}, z=heights)
    y = -4.5 if who == "ego" else 0.0
    x = 204.0 if who == "other" else 200.0
    poses = [("ego", 110.0, y, 90.0, 10.0, 0.0), ("other", x, -88.0, 0.0, 0.0, 10.0)]
    vehicles = vehicle("ego", "road", departPos=110) + vehicle("other", "low", departPos=12)
    trace = simulation(tmp_path, network, vehicles, moving(*poses, keep=3), 15.0, step_length="0.1")({}, 1)
    assert trace.ended == "duration"
    assert "other" not in trace.actors or np.isnan(trace.actor("other").x[60:]).all()


def test_an_error_after_a_move_leaves_nothing_to_the_next_run(tmp_path: Path):
    """SUMO holds a pointer to whom it was to move in the next step: the next run of the process was another one, or its end."""
    first, *others = (vehicle(f"v{k}", "road", departPos=20 + 12 * k) for k in range(20))

    def fails(sumo, values, rng):
        for _ in range(10):
            sumo.simulationStep()
        for k in range(1, 20):
            sumo.vehicle.moveToXY(f"v{k}", "", -1, 100.0 + 6 * k, -12.0, 90.0, 2)
        sumo.vehicle.getSpeed("nobody")

    ego = vehicle("ego", "road", departPos=5)
    healthy = simulation(tmp_path, ROAD, ego + first + "".join(others), _keeps_on, 8.0)
    before = healthy({}, 1)
    for _ in range(3):
        with pytest.raises(RunError, match="nobody"):
            simulation(tmp_path, ROAD, ego + first + "".join(others), fails, 60.0)({}, 1)
        assert healthy({}, 1).identical(before)
