"""What tyres, drivers and pedestrians can do, over the built-in scenarios and the kinds of ego they admit."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from own_networks import run_program
from scenario_points import sobol

import sbt
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.metrics.physics import breaches, drove_on, stopped_dead
from sbt.plugins import load, names
from sbt.problem.outcome import Doubt, Job, doubts
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.trace import Trace
from sbt.sumo.actors import Action, State
from sbt.sumo.drivers import Braking
from sbt.sumo.dynamics import next_speed
from sbt.sumo.nets import net_file
from sbt.sumo.road_ahead import RoadAhead, on_road, path_of
from sbt.testing import ContractError, check_physics, check_scenario

ONE_LANE = ("emergency_braking", "cut_in")


@pytest.mark.sumo
@pytest.mark.parametrize("name", ONE_LANE)
def test_an_ego_of_sumo_changes_lanes_only_where_asked_and_then_takes_its_time(name: str) -> None:
    lateral: dict[bool, list[float]] = {}
    for asked in (False, True):
        for model in ("Krauss", "IDM"):
            given = {"lane_change": True} if asked else {}
            scenario = load("scenarios", name).configured(ego={"kind": "sumo", "model": model, **given})
            for k, values in enumerate(sobol(scenario, 4)):
                trace = scenario.simulate(values, k)
                y = trace.actor("ego").y
                lateral.setdefault(asked, []).append(float(np.ptp(y)))
                assert np.abs(np.diff(y)).max() <= 3.5 / 3.0 * float(trace.time[1]) + 0.01, "a lane change lasts 3 s"
    assert max(lateral[False]) == 0.0
    assert max(lateral[True]) > 1.0


def moving(x: np.ndarray, y: np.ndarray, *, speed: np.ndarray | None = None, size: tuple[float, float] = (5.0, 1.8)) -> Trace:
    """Return the trace of one road user with steps of 0.1 s that heads along x."""
    t = 0.1 * np.arange(len(x))
    speed = np.append(np.diff(x), 0.0) / 0.1 if speed is None else speed
    acceleration = np.append(0.0, np.diff(speed)) / 0.1
    columns = [np.asarray(c, dtype=float)[:, None] for c in (x, y, np.zeros(len(x)), speed, acceleration)]
    return Trace(t, ("ego",), *columns, np.array(size[:1]), np.array(size[1:]))


STEADY = 2.0 * np.arange(30.0)  # 20 m/s
STILL = np.zeros(30)


@pytest.mark.parametrize(
    ("law", "trace"),
    [
        ("longitudinal", moving(STEADY, STILL, speed=np.append(np.full(15, 20.0), np.full(15, 18.5)))),
        ("sideways", moving(STEADY, np.append(np.zeros(15), np.full(15, 3.5)))),
        ("lateral", moving(STEADY, 0.5 * 6.0 * (0.1 * np.arange(30)) ** 2)),
        ("jerk", moving(STEADY, STILL, speed=20.0 - np.append(np.zeros(10), np.cumsum([1.02] * 2 + [0.0] * 18)))),
        ("mismatch", moving(STEADY, STILL, speed=np.full(30, 15.0))),
        ("walking", moving(np.append(0.1 * np.arange(15.0), 0.5 + 0.1 * np.arange(15.0)), STILL, size=(0.5, 0.5))),
    ],
)
def test_each_law_is_broken_by_what_it_forbids(law: str, trace: Trace) -> None:
    assert law in [b.law for b in breaches(trace)]
    steady = moving(STEADY, STILL, speed=np.full(30, 20.0))
    assert breaches(steady) == ()


def test_contacts_and_collisions_at_the_start_are_found() -> None:
    one = moving(STEADY, STILL, speed=np.full(30, 20.0))
    ahead = {n: np.concatenate([getattr(one, n)] * 2, axis=1) for n in ("x", "y", "heading", "speed", "acceleration")}
    for distance, expected in ((4.0, ["start"]), (9.0, [])):
        x = ahead["x"] + np.array([0.0, distance])
        pair = Trace(one.time, ("ego", "co"), **ahead | {"x": x}, length=np.full(2, 5.0), width=np.full(2, 1.8))
        assert [b.law for b in breaches(pair)] == expected
    reported = dataclasses.replace(pair, reported=("ego>co@0.050", "ego>co@2.000"))
    assert [str(b) for b in breaches(reported)] == ["start must be <= 0, but ego has 1 at 0.00 s"]


def test_only_drivers_whom_ego_does_not_force_are_judged() -> None:
    t = 0.1 * np.arange(30)
    speed = np.maximum(20.0 - 8.0 * t, 0.0)
    x = np.cumsum(np.append(0.0, 0.05 * (speed[1:] + speed[:-1])))
    for offset, expected in ((30.0, []), (-30.0, ["braking_of_others"])):
        both = [np.stack([a, b], axis=1) for a, b in ((STEADY + offset, x), (STILL, STILL), (STILL, STILL), (STILL + 20.0, speed),
                                                    (STILL, np.append(0.0, np.diff(speed) / 0.1)))]  # fmt: skip
        trace = Trace(t, ("ego", "co"), *both, np.full(2, 5.0), np.full(2, 1.8))
        assert [b.law for b in breaches(trace)] == expected
        assert breaches(trace, scripted=("co",)) == ()


JERKY = {"following": "co", "parking": "co_1", "highway_merge": "ego"}
"""Whose acceleration changes at once: by the profiles of the data set, and by SUMO's model where it brakes in an emergency."""


@pytest.mark.sumo
@pytest.mark.parametrize("name", names("scenarios"))
def test_no_built_in_scenario_breaks_a_law(name: str) -> None:
    scenario = load("scenarios", name)
    scripted = (scenario.roles.other or "",)
    broken = [b for k, v in enumerate(sobol(scenario, 10)) for b in breaches(scenario.simulate(v, k), scripted)]
    assert [str(b) for b in broken if not (b.law == "jerk" and b.actor == JERKY.get(name))] == []


@pytest.mark.sumo
@pytest.mark.parametrize("name", ["roundabout_entry", "unprotected_left_turn", "highway_merge"])
def test_a_controller_slows_down_for_bends_and_the_end_of_its_lane(name: str) -> None:
    scenario = load("scenarios", name).configured(ego={"kind": "acc_aeb"})
    for k, values in enumerate(sobol(scenario, 6)):
        trace = scenario.simulate(values, k)
        assert not [b for b in breaches(trace) if b.actor == "ego" and b.law in ("lateral", "longitudinal", "sideways")]


def test_the_road_ahead_knows_bends_and_where_a_lane_ends() -> None:
    ring = RoadAhead("roundabout", ("in_south", "ring_south_east", "ring_east_north"), 0)
    assert ring.limit(100.0) > 20.0
    entry = min(ring.limit(s) for s in np.arange(570.0, 590.0))
    assert entry == pytest.approx(math.sqrt(4.0 * 6.8), abs=0.4)
    assert ring.limit(560.0) ** 2 - entry**2 < 2 * 3.0 * 30.0
    ramp = RoadAhead("on_ramp", ("ramp", "merge", "after"), 0)
    end = 250.2329 + 3.0 + 244.5
    assert ramp.limit(end) == 0.0
    assert ramp.limit(end - 50.0) == pytest.approx(math.sqrt(2 * 3.0 * 49.0), rel=0.02)
    assert ramp.beside(400.0, 0.0, 0.0)


def test_braking_with_a_limited_jerk_reaches_its_deceleration_and_final_speed() -> None:
    for deceleration, final in ((10.0, 5.0), (10.0, 29.5), (1.0, 30.0)):
        driver, own = Braking(deceleration, final, 30.0), State("co", 5.0, 1.8, 0.01)
        own.speed, speeds = 30.0, [30.0]
        for k in range(600):
            speed = driver.act(0.01 * k, own, ()).speed
            assert speed is not None
            own.speed = speed
            speeds.append(speed)
        a = np.diff(speeds) / 0.01
        assert speeds[-1] == final
        assert np.abs(np.diff(a)).max(initial=0.0) / 0.01 <= 30.0 + 1e-6
        assert -a.min() <= deceleration + 1e-9


def test_a_speed_beside_an_acceleration_ends_it_and_is_never_jumped_to() -> None:
    speeds, targets = (0.0, 5.0, 20.0), (0.0, 4.9, 5.1, 20.0, 30.0)
    for speed, a, target, dt in itertools.product(speeds, (-3.0, -0.5, 0.0, 1.0, 8.0), targets, (0.1, 1.0)):
        free = speed + a * dt
        ends = min(speed, free) <= target <= max(speed, free)
        reached = next_speed(speed, a, target, dt)
        beyond = speed if a > 0.0 and target < speed else max(free, 0.0)
        assert reached == (target if ends else beyond), (speed, a, target, dt)
    for a, step in ((-3.0, -1e-12), (3.0, 1e-12)):
        assert next_speed(20.0 + step, a, 20.0, 0.1) == 20.0, "what SUMO gives back may be rounded"
    assert math.isnan(next_speed(20.0, -3.0, math.nan, 0.1))


def test_who_brakes_ahead_of_the_end_of_a_lane_is_not_slowed_down_for_a_speed_that_braking_never_reaches() -> None:
    route, own, braking = ("ramp", "merge", "after"), State("ego", 5.0, 1.8, 0.1), Action(acceleration=-3.0, speed=90.0)
    start = path_of(str(net_file("on_ramp")), route, 0)[0][0][0]
    own.x, own.y = float(start[0]), float(start[1])
    own.speed = RoadAhead("on_ramp", route, 0).limit(0.0) - 0.5
    limited = on_road(_Always(braking), "on_ramp", route, 0, 0.0)
    assert limited is not None
    assert limited.act(0.0, own, ()) == braking


class _Always:
    def __init__(self, action: Action) -> None:
        self._action = action

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        return self._action


@pytest.mark.parametrize("jerk", [30.0, math.inf])
def test_who_is_slower_than_the_final_speed_of_its_braking_keeps_its_own(jerk: float) -> None:
    driver, own = Braking(6.0, 12.0, jerk), State("co", 5.0, 1.8, 0.1)
    own.speed = 10.0
    for k in range(5):
        action = driver.act(0.1 * k, own, ())
        own.speed = action.speed if action.acceleration is None else next_speed(own.speed, action.acceleration, action.speed, 0.1)
        assert own.speed == 10.0


def test_a_remark_says_what_is_compared_and_whose_it_is() -> None:
    (breach,) = (b for b in breaches(moving(STEADY, STILL, speed=np.full(30, 15.0))) if b.law == "mismatch")
    told = "mismatch (difference between the speed and the distance driven per step, beyond 10 %) 3.5 m/s of ego, "
    assert breach.told(["ego"]) == f"{told}the ego, at {breach.time:.2f} s, above 0.5 m/s"
    assert breach.told(["av"]).startswith(f"{told}not the ego, at ")


def test_check_tells_a_user_which_laws_an_own_scenario_breaks(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom sbt import Parameter, Requirement, Scenario\nfrom sbt.problem.trace import Trace\n\n\n"
        "def simulate(values, seed):\n    x = 2.0 * np.arange(30.0)[:, None]\n"
        "    zero, v = np.zeros((30, 1)), np.full((30, 1), 20.0)\n"
        "    y = np.where(x > 20.0, values['aside'], 0.0)\n"
        "    return Trace(0.1 * np.arange(30), ('ego',), x, y, zero, v, zero, np.array([5.0]), np.array([1.8]))\n\n\n"
        "def y_max(trace):\n    return float(trace.y.max())\n\n\n"
        "INPUTS = [Parameter('aside', 0.0, 3.5, 'm')]\n"
        "SCENARIO = Scenario('own', INPUTS, Requirement('y_max', high=-1.0), simulate, [y_max])\n"
    )
    findings = check_scenario(ScenarioSpec(f"{tmp_path}/own.py:SCENARIO"))
    told = next(f for f in findings if "laws of motion" in f.rule)
    assert told.ok
    assert told.detail.startswith("in 2 of 3 runs: ")
    what = "sideways (speed across the heading beyond 0.2 of the speed along it)"
    assert f"{what} 13.5 m/s of ego, the ego, at 1.10 s, above 1.5 m/s" in told.detail
    scenario = ScenarioSpec(f"{tmp_path}/own.py:SCENARIO").resolve()
    check_physics(scenario.simulate({"aside": 0.0}, 0))
    with pytest.raises(ContractError, match=r"sideways must be <= 1\.5 m/s, but ego has 31 m/s at 1\.10 s"):
        check_physics(scenario.simulate({"aside": 3.5}, 0))


@pytest.mark.parametrize(
    ("speed", "aside", "cause"),
    [
        ("np.full(30, 20.0)", "np.where(x > 20.0, 3.5, 0.0)", "SUMO changes lanes within a step unless"),
        ("np.clip(20.0 - 10.0 * t, 0.0, None)", "np.where(t > 2.05, 3.5, 0.0)", "who stands there parks, or leaves its place"),
        ("np.clip(10.0 * t - 5.0, 0.0, None)", "np.where(t > 0.45, 3.5, 0.0)", "who stands there parks, or leaves its place"),
        ("np.full(30, 20.0)", "0.5 * 8.0 * t**2 * np.clip(t, 0.0, 1.0)", ""),
    ],
    ids=["drives", "comes to a stop", "leaves its place", "bend"],
)
def test_check_tells_why_somebody_jumps_beside_its_lane(tmp_path: Path, speed: str, aside: str, cause: str) -> None:
    """An ego that parked was said to change lanes, and an option for that was named; so was one in a sharp bend."""
    heading = "np.arctan2(np.gradient(y), np.gradient(x))" if not cause else "0.0 * x"
    (tmp_path / "own.py").write_text(
        "import numpy as np\nfrom sbt import Parameter, Requirement, Scenario\nfrom sbt.problem.trace import Trace\n\n\n"
        f"def simulate(values, seed):\n    t = 0.1 * np.arange(30)\n    v = {speed}\n"
        "    x = 0.1 * np.cumsum(v) + 1e-9 * values['a']\n"
        f"    y = {aside}\n    heading = {heading}\n    columns = (x, y, heading, v, 0.0 * v)\n"
        "    return Trace(t, ('ego',), *(c[:, None] for c in columns), np.array([5.0]), np.array([1.8]))\n\n\n"
        "def x_max(trace):\n    return float(trace.x.max())\n\n\n"
        "SCENARIO = Scenario('own', [Parameter('a', 0.0, 3.5, 'm')], Requirement('x_max', high=-1.0), simulate, [x_max])\n"
    )
    told = next(f for f in check_scenario(ScenarioSpec(f"{tmp_path}/own.py:SCENARIO")) if "laws of motion" in f.rule).detail
    assert "lateral (acceleration across the heading, mean of 0.5 s)" in told
    assert ("sideways (" in told) == bool(cause)
    causes = ("SUMO changes lanes within a step unless", "who stands there parks, or leaves its place")
    assert [one for one in causes if one in told] == ([cause] if cause else [])


def test_who_is_stopped_dead_near_the_ego_is_told_in_the_row() -> None:
    """SUMO stops who would drive over a red light; a walker halts in one step, and who is moved as recorded has noise."""
    time = 0.1 * np.arange(20.0)
    speed = np.stack([np.full(20, 10.0), np.where(time > 0.95, 0.0, 10.0)], axis=1)
    x = np.cumsum(0.1 * speed, axis=0) + np.array([0.0, 60.0])
    acceleration = np.diff(speed, prepend=speed[:1], axis=0) / 0.1
    size = np.array([5.0, 5.0]), np.array([1.8, 1.8])
    trace = Trace(time, ("ego", "co"), x, 0.0 * x, 0.0 * x, speed, acceleration, *size)
    assert stopped_dead(trace, "ego") == [("co", pytest.approx(100.0), pytest.approx(1.0))]
    assert stopped_dead(dataclasses.replace(trace, unreacting=("co",)), "ego") == []
    walker = dataclasses.replace(trace, length=np.array([5.0, 0.2]), width=np.array([1.8, 0.5]))
    assert stopped_dead(walker, "ego") == []
    scenario = sbt.Scenario(
        "stops", [Parameter("a", 0, 1)], Requirement("d_min", high=1.0), simulate=lambda values, seed: trace, metrics=["d_min"]
    )  # fmt: skip
    outcome = run_job(scenario, Job(0, {"a": 0.5}, 1))
    assert outcome.unconfirmed == "stopped dead: 'co' at 1.000 s, by 100 m/s^2"
    assert doubts(outcome.unconfirmed) == (Doubt.STOPPED,)


def test_others_who_drive_into_each_other_and_on_are_told() -> None:
    """SUMO lists them and lets both drive on; nothing was said where the run's own failure came half a minute later."""
    t = 0.1 * np.arange(40.0)
    x = np.stack([0.0 * t, 60.0 - 10.0 * t, 20.0 + 10.0 * t], axis=1)  # two meet at 40 m, after 2 s
    speed = np.broadcast_to([0.0, 10.0, 10.0], x.shape)
    size = np.full(3, 5.0), np.full(3, 1.8)
    trace = Trace(t, ("ego", "a", "b"), x, 0.0 * x, 0.0 * x, speed, 0.0 * x, *size)

    def told(*listed: str) -> list[tuple[str, str, float]]:
        return drove_on(dataclasses.replace(trace, reported=listed), "ego")

    assert told("b>a@2.000", "a>b@2.100") == [("a", "b", 2.0)]
    assert told("a>b@0.500") == [], "bodies are apart: listed for a gap, or by shapes"
    assert told("ego>a@2.000", "a>gone@2.000", "a hit b", "a>b@", "@") == [], "not of the ego, nor what others write"
    assert drove_on(dataclasses.replace(trace.select(slice(21)), reported=("a>b@2.000",)), "ego") == [], "the run ends there"


@pytest.mark.sumo
def test_a_crash_of_others_in_sumo_is_told(tmp_path: Path) -> None:
    grid = ("--grid", "--grid.x-number", "2", "--grid.y-number", "1", "--grid.length", "600")
    run_program(tmp_path, "netgenerate", *grid, "-o", "net.net.xml")
    (tmp_path / "my.rou.xml").write_text("""<routes><vType id="blind" decel="0.1" emergencyDecel="0.1" tau="0.1" minGap="0"/>
<route id="r" edges="A0B0"/><route id="back" edges="B0A0"/>
<vehicle id="ego" route="back" depart="0" departPos="390" departSpeed="${v}"/>
<vehicle id="a" route="r" depart="0" departPos="190" departSpeed="0"><stop lane="A0B0_0" endPos="191" duration="60"/></vehicle>
<vehicle id="b" type="blind" route="r" depart="0" departPos="150" departSpeed="20" insertionChecks="none"/>
</routes>""")
    (tmp_path / "my.sumocfg").write_text(
        '<configuration><net-file value="net.net.xml"/><route-files value="my.rou.xml"/>'
        '<step-length value="0.1"/></configuration>'
    )
    (tmp_path / "scenario.yaml").write_text("""sumo: my.sumocfg
inputs: {v: {min: 5, max: 10, unit: m/s}}
ego: {id: ego}
duration: 8
metrics: [distance_min]
requirement: {metric: distance_min, critical: [-.inf, 0]}
""")
    scenario = ScenarioSpec(str(tmp_path / "scenario.yaml")).resolve()
    outcome = run_job(scenario, Job(0, {"v": 8.0}, 1))
    assert (outcome.status, doubts(outcome.unconfirmed)) == ("ok", (Doubt.DROVE_ON,)), outcome
    assert outcome.unconfirmed.startswith("drove on after a collision: 'a' and 'b' at ")
    result = sbt.run(campaign="coverage", scenario=scenario, budget=3, store=tmp_path / "s", executor="serial", report=False)
    assert any(said.startswith("In 3 of 3 runs two other road users near the ego collide") for said in result.sentences())
