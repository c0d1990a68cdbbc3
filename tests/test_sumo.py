"""Simulations in SUMO: determinism, the initial state is the specified one, and every error is a reason of a failed run."""

from __future__ import annotations

import math
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenario_points import sobol

from sbt import plugins
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.seeds import run_seed, stream
from sbt.sumo.actors import KEEP, Action, Actor, Obstacle, Scene, State, VehicleType
from sbt.sumo.ego import Ego
from sbt.sumo.session import libsumo
from sbt.sumo.simulation import CLOCK_STEPS, SumoSimulation

pytestmark = pytest.mark.sumo

CUT_IN: LogicalScenario = plugins.load("scenarios", "cut_in")
BRAKING: LogicalScenario = plugins.load("scenarios", "emergency_braking")


def simulated(scenario: LogicalScenario, values: Mapping[str, float], seed: int = 1) -> Trace:
    assert scenario.simulate is not None
    return scenario.simulate(values, seed)


class Constant:
    """Gives the same action at every step."""

    def __init__(self, action: Action):
        self.action = action

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        return self.action


class Calling:
    """Acts as a function says."""

    def __init__(self, function: Callable[[float, State], Action]):
        self.function = function

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        return self.function(t, own)


def driving(*actors: Actor, **settings: Any) -> SumoSimulation:
    """A simulation of these actors on the straight road, 1 s long."""
    chosen: dict[str, Any] = {"net": "straight", "duration": 1.0, "step_length": 0.05} | settings
    return SumoSimulation(scene=lambda values, ego, rng: Scene(actors), **chosen)


def car(name: str = "ego", position: float = 100.0, speed: float = 20.0, lane: int = 1, act: Any = None) -> Actor:
    driver = Calling(act) if callable(act) else Constant(Action(speed=speed) if act is None else act)
    return Actor(name, ("road",), lane, position, speed, driver, VehicleType(5.0, 1.8))


def outcome(simulation: SumoSimulation, **inputs: float) -> Outcome:
    requirement = Requirement("collision", low=1.0)
    metrics = tuple(m for m in CUT_IN.metrics if m.name == "collision")
    scenario = LogicalScenario("test", ParameterSpace(CUT_IN.space.parameters), requirement, simulation, metrics)
    return run_job(scenario, Job(0, inputs, 1))


def healthy() -> Trace:
    return simulated(CUT_IN, {"d_v": 70.0, "d_t": 1.0}, 7)


def test_a_kept_simulation_is_a_fresh_one_whatever_ran_before():
    work = [(s, v, run_seed(1, k)) for s in (CUT_IN, BRAKING) for k, v in enumerate(sobol(s, 10, 0, close=True))]
    work = [work[k] for k in stream(2).permutation(len(work))]
    kept = [simulated(s, v, seed) for s, v, seed in work]
    for (scenario, values, seed), trace in zip(work, kept, strict=True):
        assert isinstance(scenario.simulate, SumoSimulation)
        assert scenario.simulate.isolations == ("fresh", "reuse", "replicas")
        assert replace(scenario.simulate, isolation="fresh")(values, seed).identical(trace)
    assert len({(t.ended, len(t.time)) for t in kept}) > 8


@pytest.mark.parametrize(("isolation", "kept"), [("auto", True), ("reuse", True), ("fresh", False)])
def test_a_reference_that_is_asked_for_keeps_nothing_between_loads(isolation: str, kept: bool, monkeypatch: pytest.MonkeyPatch):
    calls: list[bool] = []
    monkeypatch.setattr("sbt.sumo.session._keep_xml", lambda: calls.append(True))
    scenario = CUT_IN.configured(isolation=isolation)
    assert scenario.simulate is not None
    scenario.simulate({"d_v": 20.0, "d_t": 1.0}, 0)
    assert bool(calls) is kept


def test_positions_are_centres_and_start_as_specified():
    trace = driving(car(position=100.0, speed=20.0, lane=0), car("co", 180.0, 10.0, 2))({}, 0)
    assert trace.actors == ("ego", "co")
    np.testing.assert_allclose(trace.x[0], [97.5, 177.5], atol=1e-9)  # front bumpers less half a length
    np.testing.assert_allclose(trace.y[0], [-8.75, -1.75], atol=1e-9)
    np.testing.assert_array_equal(trace.heading, 0.0)
    np.testing.assert_array_equal(trace.speed, np.tile([20.0, 10.0], (21, 1)))
    np.testing.assert_allclose(trace.x[-1] - trace.x[0], [20.0, 10.0], atol=1e-9)
    np.testing.assert_allclose(trace.time, np.arange(21) * 0.05)
    assert trace.ended == "duration"


def test_a_controller_that_changes_nothing_keeps_its_speed():
    trace = driving(car(act=KEEP), car("co", 180.0, 10.0, 2, act=Action(lane=0)))({}, 0)
    np.testing.assert_array_equal(trace.speed, np.tile([20.0, 10.0], (21, 1)))


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64])
def test_numpy_scalars_from_a_scene_or_a_controller_are_numbers(kind: Any):
    """Everything a user's code hands to SUMO, once as plain numbers and once as NumPy's."""

    def run(number: Callable[[float], Any], integer: Callable[[int], Any]) -> Trace:
        box, pose = VehicleType(number(5), number(2)), (number(150), number(-5), number(0))
        posed = Constant(Action(speed=number(3), pose=pose))
        wall = Obstacle("wall", (number(300), number(-20), number(1)), number(4), number(2))
        actors = (
            Actor("ego", ("road",), integer(1), number(100), number(20), Constant(Action(number(-2), number(10))), box),
            Actor("co", ("road",), integer(0), number(180), number(12), Constant(Action(lane=integer(1))), box),
            Actor("posed", ("road",), integer(2), number(10), number(0), posed, box, pose),
        )
        settings = {"duration": number(1), "step_length": number(1) / 4, "lane_change_duration": number(1)}
        return SumoSimulation("straight", lambda values, ego, rng: Scene(actors, obstacles=(wall,)), **settings)({}, 1)

    assert run(kind, np.int64).identical(run(float, int))


def test_acceleration_is_integrated_by_the_trapezoidal_rule():
    trace = driving(car(speed=20.0, act=Action(acceleration=-4.0)), duration=8.0)({}, 0)
    t = np.minimum(trace.time, 5.0)
    np.testing.assert_allclose(trace.speed[:, 0], 20 - 4 * t, atol=1e-9)
    np.testing.assert_allclose(trace.x[:, 0] - trace.x[0, 0], 20 * t - 2 * t**2, atol=1e-6)
    assert (trace.speed >= 0).all()
    assert trace.acceleration[:100].min() == pytest.approx(-4.0)


def test_two_at_the_same_place_are_an_impossible_start_and_no_collision():
    found = outcome(driving(car(), car("co")))
    assert (found.status, dict(found.metrics)) == (Status.INVALID, {})
    assert "co" in found.reason


@pytest.mark.parametrize(
    ("actor", "reason"),
    [
        (car("co", position=5000.0), "co"),
        (car("co", lane=7), "co"),
        (car("co", speed=150.0), "co"),
    ],
    ids=["beyond the lane", "no such lane", "faster than the vehicle can"],
)
def test_an_initial_state_that_sumo_does_not_realise_is_invalid_or_failed(actor: Actor, reason: str):
    found = outcome(driving(car(), actor))
    assert found.status in (Status.INVALID, Status.FAILED)
    assert reason in found.reason
    assert found.metrics == {}
    assert healthy().identical(healthy())


def test_a_different_initial_state_is_reported_with_both_values(monkeypatch: pytest.MonkeyPatch):
    real = libsumo().vehicle.getSpeed
    monkeypatch.setattr(libsumo().vehicle, "getSpeed", lambda name: real(name) - 0.5)
    found = outcome(driving(car(speed=20.0)))
    assert (found.status, found.reason) == (Status.INVALID, "ego must start with speed 20 m/s, but SUMO gave 19.5 m/s")


def test_a_vehicle_that_leaves_the_road_fails_the_run():
    found = outcome(driving(car(position=3990.0, speed=40.0)))
    reason = r"ego must stay on the road, but it was gone at t = 0\.\d+ s \(its route ended, or SUMO took it away\)"
    assert (found.status, found.metrics) == (Status.FAILED, {})
    assert re.fullmatch(reason, found.reason)
    assert healthy().identical(healthy())


@pytest.mark.parametrize("name", ["highway_merge", "crossing_pedestrian"])
def test_states_that_nobody_looks_at_during_a_run_are_read_as_those_that_are(name: str):
    """Where SUMO drives everyone states are computed at the end; a signal makes a run look at them at every step."""
    scenario = plugins.load("scenarios", name)
    simulation, space = scenario.simulate, scenario.space
    values = space.named(space.from_unit(np.full((1, space.dimension), 0.4))[0])
    watched = replace(simulation, scene=lambda *given: replace(simulation.scene(*given), signals={"one": lambda: 1.0}))
    one, other = simulation(values, 3), watched(values, 3)
    assert len(other.signals["one"]) == len(one.time)
    assert one.identical(replace(other, signals={}))


@pytest.mark.parametrize("lane", [99, -1, 3, 0.5])
def test_a_lane_that_the_edge_does_not_have_fails_the_run(lane: Any):
    found = outcome(driving(car(act=Action(speed=20.0, lane=lane))))
    reason = f"the controller of ego must give a lane of the edge, 0 to 2 on road, but gave {lane}"
    assert (found.status, found.reason) == (Status.FAILED, reason)


@pytest.mark.parametrize(
    "action",
    [Action(acceleration=math.nan), Action(speed=math.nan), Action(speed=math.inf), Action(pose=(math.nan, 0.0, 0.0))],
    ids=lambda a: repr(tuple(a)),
)
def test_numbers_that_are_not_finite_fail_the_run(action: Action):
    before = healthy()
    found = outcome(driving(car(act=action)))
    assert (found.status, found.metrics) == (Status.FAILED, {})
    assert "the controller of ego must give finite numbers, but gave" in found.reason
    assert healthy().identical(before)


def test_a_controller_that_raises_fails_the_run_at_its_line():
    def act(t: float, own: State) -> Action:
        if t > 0.3:
            raise LookupError("no map here")
        return KEEP

    before = healthy()
    found = outcome(driving(car(act=act)))
    line = act.__code__.co_firstlineno + 2
    assert (found.status, found.reason) == (Status.FAILED, f"LookupError: no map here ({__file__}:{line})")
    assert healthy().identical(before)


def test_messages_on_sumos_error_stream_are_part_of_the_reason(capfd: pytest.CaptureFixture[str]):
    before = healthy()
    for simulation in (
        driving(car(), options=("--route-files", "/nowhere/at_all.rou.xml")),
        driving(car(), options=("--no-such-option", "1")),
        driving(car(), replace(car("co"), route=("no_such_edge",))),
    ):
        found = outcome(simulation)
        assert found.status == Status.FAILED
        assert found.reason.startswith("SUMO: ")
        assert any(word in found.reason for word in ("at_all.rou.xml", "no-such-option", "no_such_edge")), found.reason
        assert "TraCIException" not in found.reason
        assert healthy().identical(before)
        assert pickle.loads(pickle.dumps(found)) == found
    assert capfd.readouterr() == ("", "")


def test_every_error_of_a_run_can_cross_a_process_border():
    with pytest.raises(RunError) as caught:
        driving(car(), replace(car("co"), route=("no_such_edge",)))({}, 0)
    again = pickle.loads(pickle.dumps(caught.value))
    assert (again.status, again.reason) == (caught.value.status, caught.value.reason)


def test_a_slow_run_is_a_timeout():
    def act(t: float, own: State) -> Action:
        import time

        time.sleep(0.001)
        return Action(speed=1.0)

    slow = driving(car(act=act, speed=0.0), duration=0.05 * (CLOCK_STEPS + 50))
    assert outcome(slow.limited(30.0)).status == Status.OK
    found = outcome(slow.limited(0.1))
    assert found.status == Status.TIMEOUT
    assert found.reason.startswith("a run must take at most 0.1 s, but it was at t = ")
    assert outcome(slow.limited(None)).status == Status.OK


def test_a_missing_network_is_reported_before_the_first_run(tmp_path: Path):
    for net in ("strait", str(tmp_path / "my.net.xml")):
        with pytest.raises(InputError, match=r"a network must be one of .*straight.*, or an existing .net.xml file, but got '"):
            driving(car(), net=net).prepare()
    for content, reason in (("", "well-formed"), ("<routes/>", "root <net")):
        (tmp_path / "broken.net.xml").write_text(content)
        found = outcome(driving(car(), net=str(tmp_path / "broken.net.xml")))
        assert (found.status, reason in found.reason) == (Status.FAILED, True)
        assert healthy().identical(healthy())


def test_an_ego_of_sumo_runs_fresh_only_and_is_reproducible():
    scenario = ScenarioSpec("cut_in", ego={"kind": "sumo", "model": "IDM", "tau": 1.2}).resolve()
    assert scenario.isolations == ("fresh",)
    values = {"d_v": 40.0, "d_t": 2.0}
    one = simulated(scenario, values, 3)
    assert one.identical(simulated(scenario, values, 3))
    assert not one.identical(simulated(CUT_IN, values, 3))
    assert one.speed[:, 0].min() < one.speed[0, 0] - 1  # it brakes
    with pytest.raises(InputError, match=r"one of SUMO's Krauss, .*, but got 'NoSuchModel'"):
        ScenarioSpec("cut_in", ego={"kind": "sumo", "model": "NoSuchModel"}).resolve()


def test_an_own_controller_comes_from_a_file(tmp_path: Path):
    (tmp_path / "own.py").write_text(
        "from sbt.sumo.actors import Action\n\n\nclass Coward:\n"
        "    def __init__(self, rng, set_speed, *, braking=1.0):\n        self.braking = braking\n\n"
        "    def act(self, t, own, others):\n        return Action(acceleration=-self.braking)\n\n\nNOTHING = dict\n"
    )
    spec = ScenarioSpec("cut_in", ego={"kind": f"{tmp_path}/own.py:Coward", "braking": 2.5})
    trace = simulated(spec.resolve(), {"d_v": 50.0, "d_t": 2.0})
    assert trace.acceleration[1:, 0] == pytest.approx(-2.5)
    for wrong in ({"kind": f"{tmp_path}/own.py:NOTHING"}, {"kind": f"{tmp_path}/own.py:Coward", "breaking": 1}):
        with pytest.raises(InputError):
            replace(spec, ego=wrong).resolve()


def test_ego_brakes_within_its_limits_and_never_drives_backwards():
    hardest = 0.0
    for scenario in (CUT_IN, BRAKING):
        for k, values in enumerate(sobol(scenario, 16, 3, close=True)):
            trace = simulated(scenario, values, k)
            ego = trace.actors.index("ego")
            assert trace.speed.min() >= 0.0
            assert np.diff(trace.x[:, ego]).min() >= 0.0
            hardest = min(hardest, float(trace.acceleration[:, ego].min()))
            assert trace.acceleration[:, ego].max() <= 2.0 + 1e-6
    assert -9.0 - 1e-6 <= hardest < -6.0  # aeb_braking is reached, and not exceeded


def _median_ttc(scenario: LogicalScenario, values: Mapping[str, float], seeds: int = 40) -> float:
    traces = scenario.simulate.simulate_many([(values, seed) for seed in range(seeds)])
    return float(np.median([scenario.measure(trace)["ttc_min"] for trace in traces]))


def test_more_room_or_less_speed_makes_no_cut_in_worse():
    for d_v in (30.0, 60.0, 90.0):
        y = [_median_ttc(CUT_IN, {"d_v": d_v, "d_t": d_t}) for d_t in (1.0, 1.5, 2.0, 3.0, 5.0)]
        assert (np.diff(y) >= -0.1).all(), (d_v, y)
        assert y[-1] > y[0]


def test_harsher_braking_ahead_makes_nothing_safer():
    for d_t, v_co, v_ego in ((0.6, 120.0, 120.0), (1.0, 100.0, 130.0), (2.0, 90.0, 140.0)):
        values = {"v_co_min_frac": 0.1, "d_t": d_t, "v_co": v_co, "v_ego": v_ego}
        y = [_median_ttc(BRAKING, {**values, "a_co": a}) for a in (-1.0, -3.0, -5.0, -7.0, -10.0)]
        assert (np.diff(y) <= 0.05).all(), (values, y)
        assert y[-1] < y[0]


def test_the_clock_of_the_radar_does_not_show_where_it_has_no_noise():
    quiet = BRAKING.configured(ego={"kind": "acc_aeb", "gap_noise": 0.0, "speed_noise": 0.0})
    values = {"a_co": -6.0, "v_co_min_frac": 0.3, "v_co": 110.0, "v_ego": 110.0}
    work = [({**values, "d_t": float(d_t)}, 1) for d_t in np.linspace(0.8, 1.4, 121)]
    y = np.array([quiet.measure(trace)["ttc_min"] for trace in quiet.simulate.simulate_many(work)])
    assert np.ptp(y) > 0.5
    assert np.diff(y).min() > -0.04, "a little more room must not bring ego nearer to a collision"


def test_the_collision_verdict_is_sumos_where_sumo_has_one():
    """SUMO looks at states only, we also between them; lateral contacts in a lane change are where they may differ."""
    disagree, hits, n = [], 0, 0
    for scenario in (CUT_IN, BRAKING):
        for k, values in enumerate(sobol(scenario, 60, 5, close=True)):
            trace = simulated(scenario, values, k)
            collided = scenario.measure(trace)["collision"] == 1.0
            assert collided == (trace.ended == "collision")
            hits, n = hits + collided, n + 1
            if collided != bool(trace.reported):
                disagree.append((scenario.name, values, trace.reported))
    assert hits > 10
    assert len(disagree) <= 0.05 * n, disagree


def test_ending_early_changes_no_metric():
    simulation = CUT_IN.simulate
    assert isinstance(simulation, SumoSimulation)

    def endless(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
        return replace(simulation.scene(values, ego, rng), until=None)

    whole = replace(simulation, scene=endless)
    ended = []
    for k, values in enumerate(sobol(CUT_IN, 60, 9, close=True)):
        trace = simulation(values, k)
        ended.append(trace.ended)
        if trace.ended in ("passed", "resolved"):
            longer = whole(values, k)
            assert len(longer.time) >= len(trace.time)
            assert CUT_IN.measure(longer)["ttc_min"] == CUT_IN.measure(trace)["ttc_min"], values
    assert ended.count("passed") + ended.count("resolved") > 10


def test_an_error_between_a_move_and_the_next_step_leaves_the_next_run_whole():
    # SUMO keeps a pointer to what moveToXY moved until its next step, and a new load deletes that vehicle
    before = healthy()
    for _ in range(3):
        first = Action(pose=(120.0, -5.25, 0.0), speed=10.0)
        moved = Actor("mover", ("road",), 1, 100.0, 20.0, Constant(first), VehicleType(5.0, 1.8), pose=(97.5, -5.25, 0.0))
        broken = car("ego", 200.0, act=lambda t, own: Action(speed=float("nan")))
        with pytest.raises(RunError, match="finite"):
            driving(moved, broken)({}, 0)
        assert healthy().identical(before)
