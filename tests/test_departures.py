"""Who begins inside another is no collision, and what SUMO holds back or drops is told with a remedy that works."""

# ruff: noqa: E501  (one case per line)

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from departing import ANYWHERE, NET, car, flow, run, stopped

from sbt.errors import RunError
from sbt.metrics.geometry import overlap_depth, rectangle_distance
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace
from sbt.sumo.actors import Action, Actor, Obstacle, Scene, State, VehicleType
from sbt.sumo.appearances import AppearanceMonitor
from sbt.sumo.overlaps import instant
from sbt.sumo.simulation import SumoSimulation

Case = Callable[..., tuple[str, str]]


@pytest.fixture
def case(tmp_path: Path) -> Case:
    return partial(run, tmp_path)


EGO = car("ego", "${p}", speed="5")
INSIDE: list[Any] = [
    ("another car", EGO + car("other", "102", speed="5"), 100),
    ("another car, bumper on bumper", EGO + car("other", "105"), 100),
    ("another car by 1 cm, from behind", EGO + car("other", "95.01", speed="5"), 100),
    ("a long truck behind, by its front", EGO + car("other", "96", kind="truck", speed="5"), 100),
    ("the tail of a truck that stands beyond the junction", car("other", "1", kind="truck", route="end", inner=stopped("next_0", 1)) + EGO, 299),
    ("a stopped bus", car("other", "120", kind="bus", inner=stopped("road_0", 120)) + car("ego", "${p}", depart="2", speed="5"), 110),
    ("a person who walks on the edge", '<person id="other" depart="0" departPos="100"><walk edges="road" arrivalPos="290"/></person>' + car("ego", "${p}", depart="1", speed="5", more=ANYWHERE + ' departPosLat="right"'), 103),
    ("one that starts where it will park", car("other", "stop", inner=stopped("road_0", 100, 'parking="true"')) + EGO, 100),
    ("one that crosses the junction where its tail is", car("other", "299", speed="5", more=ANYWHERE + ' speedFactor="0.1"') + car("ego", "1", depart="2", route="end", speed="1"), 0),
    ("one on the same departPos=base", car("other", "stop", inner=stopped("road_0", 7)) + car("ego", "base", depart="1"), 0),
]  # fmt: skip
CLEAR: list[Any] = [
    ("a car in the next lane", EGO + car("other", "100", lane="1", speed="5"), 100),
    ("a car 1 cm ahead", EGO + car("other", "105.01", speed="5"), 100),
    ("a car behind, 1 cm away", EGO + car("other", "94.99", speed="5"), 100),
    ("behind the tail of a truck beyond the junction", car("other", "1", kind="truck", route="end", inner=stopped("next_0", 1)) + EGO, 280),
    ("a car that parks beside the road since a while", car("other", "stop", inner=stopped("road_0", 100, 'parking="true"')) + car("ego", "${p}", depart="2", speed="5"), 100),
    ("behind a stopped bus", car("other", "120", kind="bus", inner=stopped("road_0", 120)) + car("ego", "${p}", depart="2", speed="5"), 80),
    ("departPos=last behind another", car("other", "50", speed="5") + car("ego", "last", speed="5", more=""), 0),
    ("a passenger of its own", car("ego", "${p}", depart="triggered", speed="0", inner=stopped("road_0", 100).replace('duration="100"', 'duration="1"')) + '<person id="other" depart="0"><ride from="road" to="next" lines="ego"/></person>', 100),
]  # fmt: skip


@pytest.mark.sumo
@pytest.mark.parametrize(("vehicles", "p"), [one[1:] for one in INSIDE], ids=[one[0] for one in INSIDE])
def test_an_ego_that_starts_inside_somebody_is_invalid_and_says_inside_whom(case, vehicles, p):
    status, reason = case(vehicles, p)
    assert (status, bool(re.search(r"'ego' must start clear of all others, but its place is taken by 'other' \(they overlap by", reason))) == ("invalid", True), reason


@pytest.mark.sumo
@pytest.mark.parametrize(("vehicles", "p"), [one[1:] for one in CLEAR], ids=[one[0] for one in CLEAR])
def test_an_ego_that_starts_next_to_somebody_is_fine(case, vehicles, p):
    status, reason = case(vehicles, p)
    assert (status, reason) in (("ok", "duration"), ("ok", "collision")), reason


APPEARING: list[Any] = [
    ("inserted into the ego", car("ego", "${p}") + car("other", "101", depart="2"), "'other' must appear clear of the ego, but overlaps it by .* at t = 2.1 s, which is no collision"),
    ("teleported, not by us: right before a fast ego", car("ego", "${p}", speed="20") + car("other", "151", depart="2"), "'other' must appear where drivers can react, but at t = 2.1 s .* m/s\\^2 of braking"),
    ("right behind a slow ego, much faster", car("ego", "${p}", inner=stopped("road_0", 104)) + car("other", "95", depart="3", speed="30"), "'other' must appear where drivers can react"),
    ("a person on the ego", car("ego", "${p}", inner=stopped("road_0", 104)) + '<person id="other" depart="3" departPos="101"><walk edges="road" departPosLat="0" arrivalPos="290"/></person>', "'other' must appear clear of the ego"),
    ("out of a parking place through the ego", car("other", "stop", inner=stopped("road_0", 104, 'parking="true"').replace('"100"', '"4"')) + car("ego", "${p}", depart="1", inner=stopped("road_0", 104)), "'other' must leave its parking place where nobody is"),
]  # fmt: skip


@pytest.mark.sumo
@pytest.mark.parametrize(("vehicles", "message"), [one[1:] for one in APPEARING], ids=[one[0] for one in APPEARING])
def test_who_appears_inside_or_right_before_the_ego_is_an_artefact(case, vehicles, message):
    status, reason = case(vehicles)
    assert (status, bool(re.search(message, reason))) == ("invalid", True), reason


FOLLOWERS: list[Any] = [
    ("can stop", "", "7", ""),
    ("decides rarely", 'actionStepLength="1"', "7", r"inf m/s\^2 of braking of 'other', which may act 0\.9 s late, would keep them apart \(tyres"),
    ("decides rarely, but slow enough", 'actionStepLength="1"', "2", ""),
    ("brakes weakly", 'decel="3" emergencyDecel="4"', "7", r"only 6\.\d+ m/s\^2 of braking would keep them apart \('other' can do 4\)"),
]  # fmt: skip


@pytest.mark.sumo
@pytest.mark.parametrize(("attributes", "speed", "message"), [one[1:] for one in FOLLOWERS], ids=[one[0] for one in FOLLOWERS])
def test_who_appears_behind_the_ego_can_brake_as_its_type_lets_it(case, attributes, speed, message):
    """Within what tyres allow, but not within what SUMO lets the follower do: the ego was hit in every run."""
    kind = f'<vType id="own" length="5" width="1.8" sigma="0" {attributes}/>'
    vehicles = car("ego", "${p}", inner=stopped("road_0", 104)) + car("other", "95", depart="3", speed=speed, kind="own")
    status, reason = case(kind + vehicles)
    assert (status, bool(re.search(message, reason))) == ("invalid" if message else "ok", True), reason


@pytest.mark.parametrize(("action", "limits", "message"), [
    (0.1, (4.5, 9.0), ""), (0.5, (4.5, 9.0), r"so close to 'c' that only 54 m/s\^2 of braking of 'c', which may act 0\.4 s late"),
    (0.1, (4.5, 5.5), r"that only 6\.02 m/s\^2 .*\('c' can do 5\.5\)"), (0.1, (8.0, 4.5), ""),
])  # fmt: skip
def test_an_ego_inserted_before_a_follower_starts_where_that_one_can_brake(action, limits, message):
    ego, behind = State("ego", 5.0, 1.8), State("c", 5.0, 1.8)
    ego.x, ego.speed, behind.x, behind.speed = 7.44, 5.64, 0.0, 11.06
    states = {"ego": ego, "c": behind}
    near = SimpleNamespace(states=states, newcomers=lambda: ["c"], body=lambda name: instant(states[name]), jumped=frozenset())
    vehicle = SimpleNamespace(
        getIDList=lambda: ("ego", "c"), getActionStepLength=lambda _: action, getDecel=lambda _: limits[0],
        getEmergencyDecel=lambda _: limits[1],
    )  # fmt: skip
    simulation = SimpleNamespace(getTime=lambda: 120.0, getDeltaT=lambda: 0.1)
    monitor = AppearanceMonitor(SimpleNamespace(simulation=simulation, vehicle=vehicle), "ego", SimpleNamespace())
    if not message:
        monitor._refuse_close(near, ["c"], "s.yaml:3:5: insert.ego: ", "move it")
        return
    with pytest.raises(RunError, match=message):
        monitor._refuse_close(near, ["c"], "s.yaml:3:5: insert.ego: ", "move it")


@pytest.mark.sumo
def test_a_vehicle_that_the_user_puts_right_before_the_ego_is_a_scenario(case):
    """Its departure has a placeholder: the distance is an input, and the collision the result."""
    vehicles = car("ego", "100", speed="20") + car("other", "${p}", depart="2")
    assert case(vehicles, 151) == ("ok", "collision")
    assert case(vehicles, 145)[0] == "invalid", "inside is no scenario, whoever asks"


def advised(reason: str, vehicles: str, more: str, options: dict[str, str]) -> tuple[str, str, dict[str, str]]:
    """Return the changed vehicles, keys of the ego and options, as the message advises."""
    ego = next(line for line in vehicles.splitlines() if 'id="ego"' in line)
    option = re.search(r"(?:set|raise) the option ([\w-]+)(?:: (\w+)| from (\d+))", reason)
    if option:
        return vehicles, more, {**options, option[1].replace("-", "_"): option[2] or str(int(option[3]) + 1)}
    if 'set insertionChecks="none" on the vehicle' in reason:
        return vehicles.replace(ego, ego.replace(" route=", ' insertionChecks="none" route=', 1)), more, options
    if "move its departPos" in reason:
        return vehicles.replace(ego, re.sub(r'departPos="[^"]*"', 'departPos="30"', ego)), more, options
    raise AssertionError(f"no advice in: {reason}")


HELD: list[Any] = [
    ("an unsafe gap", car("other", "120") + car("ego", "${p}", speed="20", more=""), {}, 1),
    ("a flow that waits on its edge", car("block", "62") + flow("50") + car("ego", "${p}", depart="3", speed="5"), {}, 1),
    ("a flow, and an unsafe gap", car("block", "62") + flow("50") + car("other", "120", depart="1") + car("ego", "${p}", depart="3", speed="20", more=""), {}, 2),
    ("a taken place", car("other", "102") + car("ego", "${p}", speed="5", more=""), {}, 1),
    ("the tail of a truck", car("other", "1", kind="truck", route="end") + car("ego", "299", depart="0", more=""), {}, 1),
    ("too many vehicles", car("other", "200") + car("ego", "${p}", depart="1"), {"max_num_vehicles": "1"}, 1),
    ("too many vehicles, and an unsafe gap", car("other", "120") + car("ego", "${p}", speed="20", depart="1", more=""), {"max_num_vehicles": "1"}, 2),
]  # fmt: skip


@pytest.mark.sumo
@pytest.mark.parametrize(("vehicles", "options", "rounds"), [one[1:] for one in HELD], ids=[one[0] for one in HELD])
def test_the_advice_lets_a_held_back_ego_in(case, vehicles, options, rounds):
    more = ""
    for _ in range(rounds):
        status, reason = case(vehicles, more=more, **options)
        assert (status, bool(re.search(r"cars.rou.xml:\d+:1: 'ego' must depart at t = .* but SUMO holds it back, as ", reason))) == ("invalid", True), reason
        vehicles, more, options = advised(reason, vehicles, more, options)
    assert case(vehicles, more=more, **options)[0] == "ok"


@pytest.mark.sumo
def test_an_ego_of_a_flow_waits_for_its_turn_and_no_advice_is_in_vain(case):
    """Its own flow is in its way, which no option changes; with time, or a vehicle of its own, it gets in."""
    busy = flow("${20 + 0 * p}", period="0.2")
    status, reason = case(busy, ego="f.4", more=", delay: 1")
    assert (status, "the vehicles of its flow 'f' wait for a safe gap one after the other: give it a <vehicle> of its own" in reason) == ("invalid", True), reason
    assert "or let it wait longer: ego: {delay: SECONDS}" in reason
    assert case(busy, ego="f.4", more=", delay: 60")[0] == "ok"
    assert case(busy + car("ego", "60", depart="0.5"), eager_insert="true")[0] == "ok"


@pytest.mark.sumo
def test_traffic_that_the_options_leave_out_is_not_missed(case):
    """Vehicles with placeholders that depart before the beginning, or that `scale` drops."""
    early = car("early", "${p + 50}", depart="1") + car("ego", "10", depart="5")
    assert case(early, begin="4")[0] == "ok"
    thinned = "".join(car(f"o{k}", f"${{p + {20 * k}}}") for k in range(6)) + '<vType id="own" scale="2"/>' + car("ego", "10", kind="own")
    assert case(thinned, scale="0.5")[0] == "ok"


@pytest.mark.sumo
def test_an_ego_that_may_wait_does_as_long_as_it_may(case):
    vehicles = car("other", "120", speed="5") + car("ego", "${p}", speed="15", more="")
    assert case(vehicles, more=", delay: 30")[0] == "ok"
    status, reason = case(vehicles, more=", delay: 0.5")
    assert (status, "must depart within 0.5 s of t = 0 s, 17.9 m behind 'other', but SUMO holds it back" in reason) == ("invalid", True), reason


@pytest.mark.sumo
@pytest.mark.parametrize(("depart", "step"), [("0.05", "0.1"), ("0.1", "0.1"), ("0.25", "0.1"), ("1.01", "0.5"), ("0.3", "0.05"), *((f"1.{k:05d}", "0.1") for k in (40, 50, 90, 96, 100, 9949, 9951))])
def test_rounding_to_a_step_is_no_delay(case, depart, step):
    assert case(car("ego", "${p}", depart=depart, speed="5", more=""), step_length=step)[0] == "ok"


@pytest.mark.sumo
@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_delay_of_a_single_step_is_one(case, step):
    """The only other vehicle that may be on the road leaves it: until then the ego is held back, and from then on it is not."""
    leaving = car("other", "250", route="end", speed="20").replace(' type=', ' arrivalPos="285" type=')

    def status(k: int, delay: float = 0.0) -> str:
        ego = car("ego", "${p}", depart=f"{k * step:.2f}", more="")
        return case(leaving + ego, more=f", delay: {delay}", max_num_vehicles="1", step_length=str(step))[0]

    first = next(k for k in range(1, 40) if status(k) == "ok")
    assert first > 1
    assert (status(first - 1), status(first - 2, step), status(first - 1, step)) == ("invalid", "invalid", "ok")


@pytest.mark.sumo
def test_an_invalid_run_ends_at_once_and_waiting_is_counted_from_the_departure(case, monkeypatch):
    """Not one step more than needed, and an hour of traffic before the ego is nobody's waiting."""
    from sbt.sumo.user_simulation import TraciProxy

    steps = []
    step = TraciProxy.simulationStep
    monkeypatch.setattr(TraciProxy, "simulationStep", lambda self, until=0.0: (steps.append(1), step(self, until)))
    blocked = car("other", "102") + car("ego", "${p}", depart="2", more="")
    assert (case(blocked)[0], len(steps)) == ("invalid", 21)
    assert case(car("ego", "${p}", depart="3700"), step_length="10")[0] == "ok"


LOOP = """
def simulate(sumo, values, rng):
    sumo.start(["sumo", "-n", "net.net.xml", "--insertion-checks", "{checks}"])
    sumo.route.add("all", ["road", "next"])
    for _ in range({empty}):
        sumo.simulationStep()
    sumo.vehicle.add("ego", "all", departPos=str(values["p"]), departSpeed="{speed}", departLane="0")
    sumo.vehicle.add("other", "all", depart="{depart}", departPos="{other}", departSpeed="5", departLane="0")
    while True:
        sumo.simulationStep()
"""


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("changed", "status", "message"),
    [
        ({"other": 102}, "invalid", r"'ego' must start clear of all others, but its place is taken by 'other' .* \(.*loop.py:10\)"),
        ({"other": 108, "speed": 15}, "ok", "duration|collision"),
        ({"other": 122, "speed": 15, "depart": 1}, "ok", "collision"),
        ({"other": 122, "speed": 15, "depart": 1.4}, "invalid", "'other' must appear clear of the ego"),
        ({"other": 108, "speed": 15, "checks": "all"}, "invalid", "SUMO holds it back, as its insertion checks find that unsafe: start SUMO with the option insertion-checks: none"),
        ({"other": 300, "empty": 30, "depart": 60}, "ok", "duration"),
    ],
    ids=["inside", "right behind", "put right before it", "put onto it", "held back", "added to an empty road"],
)
def test_the_same_holds_for_loops(case, changed, status, message):
    loop = LOOP.format(**{"checks": "none", "empty": 0, "speed": 5, "depart": "now", **changed})
    found = case("", loop=loop)
    assert (found[0], bool(re.search(message, found[1]))) == (status, True), found


class Standing:
    """A controller that stands."""

    def act(self, t: float, own: Any, others: Any) -> Action:
        return Action(speed=0.0, pose=None if own.steered is None else (own.x, own.y, own.heading))


@pytest.mark.sumo
@pytest.mark.parametrize(
    ("other", "valid"),
    [
        (Actor("other", ("road",), 0, 55.0, 0.0, Standing()), False),
        (Actor("other", ("road",), 0, 57.0, 0.0, Standing()), True),
        (Actor("other", ("road",), 1, 50.0, 0.0, Standing()), True),
        (Actor("other", ("road",), 0, 60.0, 0.0, Standing(), VehicleType(16.5, 2.5)), False),
        (Actor("other", ("road",), 0, 50.0, 0.0, Standing(), VehicleType(0.5, 0.5), (49.5, -4.7, 0.0), person=True), False),
        (Actor("other", ("road",), 0, 50.0, 0.0, Standing(), VehicleType(0.5, 0.5), (51.0, -7.0, 0.0), person=True), True),
        (Obstacle("other", (52.0, -5.0, 0.3), 4.0, 2.0), False),
        (Obstacle("other", (52.0, -8.0, 0.3), 4.0, 2.0), True),
    ],
    ids=["touching", "2 m ahead", "next lane", "by a truck's tail", "by a person", "a person beside", "in a standing object", "beside it"],
)  # fmt: skip
@pytest.mark.parametrize("isolation", ["fresh", "reuse", "replicas"])
def test_the_same_holds_for_built_in_actors(tmp_path, other, valid, isolation):
    (tmp_path / "net.net.xml").write_text(NET)
    ego = Actor("ego", ("road",), 0, 50.0, 0.0, Standing())
    scene = Scene((ego,), obstacles=(other,)) if isinstance(other, Obstacle) else Scene((ego, other))
    levels = ("fresh", "reuse", "replicas")
    simulation = SumoSimulation(str(tmp_path / "net.net.xml"), lambda *_: scene, 1.0, isolations=levels, isolation=isolation)
    for found in simulation.simulate_many([({}, 0), ({}, 1)]):
        if valid:
            assert not isinstance(found, BaseException)
            assert found.ended == "duration"
        else:
            assert isinstance(found, RunError)
            assert (found.status, "its place is taken by 'other'" in found.reason) == (Status.INVALID, True)


def test_the_depth_of_an_overlap_is_the_shortest_move_that_parts():
    """Positive exactly where the distance is 0, never deeper than a move along any direction, and symmetric."""
    rng = np.random.default_rng(3)
    n = 2000

    def some(length: float, width: float) -> ActorTrace:
        x, y, heading = rng.uniform(-4, 4, n), rng.uniform(-4, 4, n), rng.uniform(-3.2, 3.2, n)
        return ActorTrace(x, y, heading, np.zeros(n), np.zeros(n), length, width)

    a, b = some(5.0, 1.8), some(12.0, 2.5)
    depth = overlap_depth(a, b)
    apart = rectangle_distance(a, b)
    assert ((depth < 0) == (apart > 0)).all()
    assert (-depth[apart > 0] <= apart[apart > 0] + 1e-9).all()
    assert depth == pytest.approx(overlap_depth(b, a))
    for angle in np.linspace(0, 2 * np.pi, 37):
        step = np.maximum(depth, 0) * 0.999
        moved = ActorTrace(b.x + step * np.cos(angle), b.y + step * np.sin(angle), b.heading, b.speed, b.acceleration, b.length, b.width)
        assert (overlap_depth(a, moved)[depth > 1e-6] > 0).all()


@pytest.mark.parametrize(("place", "refused"), [("s.yaml:5:8: insert.ego: ", True), ("town.rou.xml:5:8: ", False)])
def test_an_ego_that_the_scenario_inserts_right_before_traffic_is_no_run(place: str, refused: bool):
    """The other is .33 m behind and 7 m/s faster: nobody could brake. Who places vehicles in own files means it."""
    ego, behind = State("ego", 5.0, 1.8), State("c", 5.0, 1.8)
    ego.x, ego.speed, behind.x, behind.speed = 5.33, 5.0, 0.0, 12.0
    states = {"ego": ego, "c": behind}

    class Near:
        jumped = frozenset()

        def __init__(self):
            self.states = states

        def __len__(self):
            return 1

        def newcomers(self):
            return ["c"]

        def body(self, name):
            return instant(states[name])

    departures = SimpleNamespace(asked={"ego"}, place_of=lambda name: place)
    nobody = {f"getParking{when}VehiclesNumber": lambda: 0 for when in ("Starting", "Ending")}
    sumo = SimpleNamespace(simulation=SimpleNamespace(**nobody, getTime=lambda: 100.1))
    monitor = AppearanceMonitor(sumo, "ego", departures)
    if refused:
        with pytest.raises(RunError, match=r"so close to 'c' that only 74\.2 m/s\^2 .*: change its position or at"):
            monitor.after_step(Near(), frozenset())
    else:
        monitor.after_step(Near(), frozenset())


@pytest.mark.parametrize("when", ["Starting", "Ending"])
def test_an_ego_that_parks_is_moved_there_and_hits_nobody_on_its_way(when: str):
    """SUMO moves it 6 m sideways within a step, through who walks on the pavement: 13 of 60 runs had a collision."""
    class Near:
        jumped: tuple[str, ...] = ()

        def __len__(self):
            return 2

        def newcomers(self):
            return []

    there = {f"getParking{each}VehiclesNumber": lambda each=each: int(each == when) for each in ("Starting", "Ending")}
    ids = {f"getParking{each}VehiclesIDList": lambda: ("ego",) for each in ("Starting", "Ending")}
    sumo = SimpleNamespace(simulation=SimpleNamespace(**there, **ids, getTime=lambda: 6.5))
    monitor = AppearanceMonitor(sumo, "ego", SimpleNamespace(asked={"ego"}, place_of=lambda name: ""))
    monitor.refuse_contact("walker")
    monitor.after_step(Near(), frozenset())
    with pytest.raises(RunError, match="the ego 'ego' must park, and leave its parking place, where nobody is"):
        monitor.refuse_contact("walker")
