"""Times to collision along paths, where road users come, go, and go on after the end of a run."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from own_scenarios import make, program, tools

from sbt.config.scenario_file import from_file
from sbt.metrics.closeness import path_clearance, worst_pair
from sbt.metrics.geometry import rectangle_distance, select_instants
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.pairwise import in_traffic
from sbt.metrics.paths import path_of, ttc_on_paths
from sbt.metrics.planar import TTC_2D_MIN
from sbt.metrics.traffic import TTC_PATH_MIN, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.sumo.ways import LEFT_THE_ROAD
from sbt.workflows.comparing import compared_times

T = np.arange(0.0, 6.0, 0.1)
Line = tuple[np.ndarray, np.ndarray]


def trace_of(*lines: Line, ways: dict[str, np.ndarray] | None = None) -> Trace:
    """Rectangles of 4 x 2 m on these lines; NaN: not there."""
    x, y = (np.stack([line[k] for line in lines], axis=1) for k in (0, 1))
    dx, dy = np.gradient(x, 0.1, axis=0), np.gradient(y, 0.1, axis=0)
    speed = np.hypot(dx, dy)
    heading = np.arctan2(dy, dx)
    for column in range(len(lines)):  # one-sided at the ends of a presence
        there = np.flatnonzero(~np.isnan(x[:, column]))
        for values in (speed, heading):
            values[there, column] = np.interp(there, there[1:-1], values[there[1:-1], column])
    names = ("ego", *(f"co_{k}" for k in range(len(lines) - 1)))
    size = np.full(len(lines), 4.0), np.full(len(lines), 2.0)
    return Trace(T, names, x, y, heading, speed, np.zeros_like(x), *size, ways=ways or {})


def during(line: Line, low: float, high: float) -> Line:
    there = (low - 1e-9 <= T) & (high + 1e-9 >= T)
    return np.where(there, line[0], np.nan), np.where(there, line[1], np.nan)


EAST = (10.0 * T - 20.0, 0.0 * T)


def test_who_comes_late_counts_from_then_on():
    """The same conflict is found, whenever the other is recorded for the first time."""
    lead = (30.0 + 4.0 * T, 0.0 * T)
    whole = ttc_on_paths(trace_of(EAST, lead), "ego", "co_0")
    for begin in (0.5, 2.0, 4.0):
        late = ttc_on_paths(trace_of(EAST, during(lead, begin, 9.0)), "ego", "co_0")
        there = begin + 0.15 < T
        assert late[there] == pytest.approx(whole[there], abs=1e-9)
        assert (late[begin - 0.05 > T] == 5.0).all(), "nobody is there"


def test_the_path_of_ego_after_the_other_is_gone_is_known():
    """Ego turns away before it would reach the place that the other passed: straight ahead it would have touched it."""
    turn = (np.minimum(10.0 * T - 20.0, 10.0), np.maximum(10.0 * T - 30.0, 0.0))
    waiting = (np.full_like(T, 25.0), -3.0 + 0.5 * T)
    trace = trace_of(turn, during(waiting, 0.0, 2.0))
    assert in_traffic(TTC_PATH_MIN, "ego")(trace) == 5.0
    assert ttc_path_min()(trace) == 5.0
    ((_, part),) = joint_intervals(trace, "ego", "co_0")
    x, y, _ = path_of(part.actor("ego"))
    assert (x[-1], y[-1]) == (trace.x[-1, 0], trace.y[-1, 0])


def test_a_way_goes_on_where_the_record_ends():
    """Two meet, or do not, by where their ways go after the last instant."""
    north = (np.full_like(T, 60.0), 8.0 * T - 64.0)  # both would be at (60, 0) about 2 s after the end
    straight = trace_of(EAST, north)
    assert ttc_on_paths(straight, "ego", "co_0")[-1] < 3.0
    bend = np.array([[40.0, 0.0, 0.0], [45.0, 5.0, math.pi / 2], [45.0, 90.0, math.pi / 2]])
    assert ttc_on_paths(trace_of(EAST, north, ways={"ego": bend}), "ego", "co_0").min() == 5.0
    assert ttc_on_paths(trace_of(EAST, north, ways={"ego": LEFT_THE_ROAD}), "ego", "co_0").min() == 5.0, "gone before"
    meets = np.array([[60.0, -10.0, math.pi / 2], [60.0, 90.0, math.pi / 2]])
    assert ttc_on_paths(trace_of(EAST, north, ways={"co_0": meets}), "ego", "co_0") == pytest.approx(
        ttc_on_paths(straight, "ego", "co_0"), abs=1e-9
    )


def test_check_says_which_metric_invents_conflicts():
    """Oncoming in a bend, 3.5 m apart: straight ahead they would collide, on their lanes they never meet."""
    angle = 0.5 * T
    inner, outer = ((r * np.cos(a), r * np.sin(a)) for r, a in ((20.0, angle), (23.5, 2.0 - 0.4 * angle)))
    trace = trace_of(inner, outer)
    assert worst_pair(trace, TTC_2D_MIN, "ego").value < 1.5
    found = worst_pair(trace, TTC_PATH_MIN, "ego")
    assert (found.value, found.other) == (5.0, "co_0")
    assert found.clearance == pytest.approx(1.5 - 1.0, abs=0.25), "3.5 m less the widths of 2 m and what corners reach out"
    assert path_clearance(trace.actor("ego"), trace_of(inner, (inner[1], inner[0])).actor("co_0")) == 0.0, "crossing paths meet"
    scenario = LogicalScenario(
        "bend", ParameterSpace((Parameter("v", 0, 1),)), Requirement("ttc_path_min", high=1.5), lambda values, seed: trace,
        (ttc_path_min(),), roles=Roles("ego", None),
    )  # fmt: skip
    said = dict(compared_times(scenario, [({"v": 0.5}, 1)] * 3))
    assert said["ttc_path_min"].startswith("0 of 3 runs at most 1.5 s")
    assert "3 of these 3 with somebody whose path never meets that of the ego" in said["ttc_2d_min"]
    assert dict(compared_times(replace(scenario, roles=Roles()), [({"v": 0.5}, 1)])) == {}, "a named opponent has its own metrics"


@pytest.mark.skipif(program("netgenerate") is None or tools() is None, reason="pip install 'sumo-sbt[tools]'")
@pytest.mark.sumo
def test_ways_are_those_that_are_driven(tmp_path: Path):
    """A run that ends earlier predicts the paths of the same run that ends later, and so the times to collision."""
    make("numeric", tmp_path / "n")

    def run(duration: float) -> Trace:
        path = tmp_path / f"scenario{duration:g}.yaml"
        path.write_text(
            "sumo: {config: n/my.sumocfg, options: {seed: 3, time-to-teleport: '${patience}'}}\n"
            "inputs: {patience: {min: 500, max: 600}}\nego: 30\nothers: {within: 60}\n"
            f"duration: {duration}\nmetrics: [ttc_path_min]\nrequirement: {{metric: ttc_path_min, critical: [-.inf, 1.0]}}\n"
        )
        simulate = from_file(str(path), tmp_path).simulate
        assert simulate is not None
        return simulate({"patience": 550.0}, 4)

    short, long = run(12.0), run(20.0)
    n, off, apart = len(short.time), [], []
    assert np.array_equal(short.x[:, 0], long.x[:n, 0])
    for name in [name for name in short.actors if short.present[-1, short.actors.index(name)] and name in short.ways]:
        k = long.actors.index(name)
        later = slice(n, n + int(np.argmin(np.append(long.present[n:, k], False))))
        actor = short.actor(name)
        x, y, _ = path_of(replace(select_instants(actor, slice(n - 2, n)), way=actor.way))
        dense = np.arange(0.0, 1.0, 0.0004) * (len(x) - 1)
        line = np.stack([np.interp(dense, np.arange(len(x)), v) for v in (x, y)], axis=1)
        driven = np.stack([long.x[later, k], long.y[later, k]], axis=1)
        if len(driven):
            off.append(np.hypot(*(driven[:, None] - line[None]).transpose(2, 0, 1)).min(axis=1).max())
        if name != "30":
            apart.append(np.abs(ttc_on_paths(short, "30", name) - ttc_on_paths(long, "30", name)[:n])[-20:].max())
    assert len(off) >= 4
    assert np.median(off) < 0.1
    assert max(off) < 1.0, f"{off} m: where a car turns round"
    assert max(apart) < 0.05



@pytest.mark.parametrize("gap", [-0.3, -0.05, 0.07, 0.2, 1.0])
def test_the_tail_of_what_turns_touches_only_what_it_hits(gap):
    """A long rectangle turns past a standing car: a contact is predicted exactly where there will be one, and for that time."""
    turn = 0.8 * np.arange(0.0, 2.5, 0.05)
    x, y = 10.0 * np.cos(turn), 10.0 * np.sin(turn)
    outer = np.hypot(10.0 + 1.25, 4.0)  # of the corner of the truck that reaches farthest out
    far = outer + gap + 1.0
    at = 0.8 * 1.5
    ones = np.ones_like(turn)
    xs, ys = np.stack([far * np.cos(at) * ones, x], 1), np.stack([far * np.sin(at) * ones, y], 1)
    headings, speeds = np.stack([at * ones, turn], 1) + 0.5 * np.pi, np.stack([0 * ones, 8.0 * ones], 1)
    sizes = np.array([4.0, 8.0]), np.array([2.0, 2.5])
    trace = Trace(np.arange(0.0, 2.5, 0.05), ("ego", "truck"), xs, ys, headings, speeds, 0 * speeds, *sizes)
    distance = rectangle_distance(trace.actor("ego"), trace.actor("truck"))
    touched = np.flatnonzero(distance == 0.0)
    times = ttc_on_paths(trace, "ego", "truck")[trace.time < 1.0]
    if len(touched):
        assert times + trace.time[: len(times)] == pytest.approx(trace.time[touched[0]], abs=0.06)
    else:
        assert distance.min() > 0.0
        assert (times > 1.4).all(), "what comes after the recording goes straight on"


def changing(*lines: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Trace:
    """Cars of 4 x 2 m that head east, at x and y, and their speeds: a change of lanes is one step."""
    x, y, speed = (np.stack([line[k] for line in lines], axis=1) for k in range(3))
    names = ("ego", *(f"co_{k}" for k in range(len(lines) - 1)))
    none = np.zeros_like(x)
    return Trace(T, names, x, y, none, speed, none, np.full(len(lines), 4.0), np.full(len(lines), 2.0))


@pytest.mark.parametrize("gap", [0.4, 0.7, 3.0])
@pytest.mark.parametrize("step", [20, 33])
def test_who_changes_lanes_within_a_step_cuts_no_corner(gap, step):
    """Ego is clear ahead of the lead, and faster, when SUMO moves it sideways: at no instant its path leads through the lead."""
    x, still = 13.0 * T, np.zeros_like(T)
    ego = np.where(T[step] > T, 3.2, 0.0)
    lead = 10.0 * T + x[step] - 4.0 - gap - 10.0 * T[step]  # at that instant `gap` is between the bumpers
    clear = changing((x, ego, still + 13.0), (lead, still, still + 10.0))
    assert ttc_on_paths(clear, "ego", "co_0").min() == 5.0
    nearer = changing((x, ego, still + 13.0), (lead + gap + 0.5, still, still + 10.0))  # too early: it hits it sideways
    assert ttc_on_paths(nearer, "ego", "co_0")[step] == 0.0


@pytest.mark.parametrize("step", [1, 2, 9])
def test_who_swerves_within_a_step_would_have_hit_what_was_ahead(step):
    still = np.zeros_like(T)
    ego = (20.0 * T, np.where(T[step] > T, 0.0, 3.2), still + 20.0)
    found = ttc_on_paths(changing(ego, (still + 34.0, still, still)), "ego", "co_0")
    assert found[:step] == pytest.approx(1.5 - T[:step])
    assert (found[step:] == 5.0).all()


def test_who_waits_until_somebody_has_passed_is_in_no_conflict_with_it():
    """Ego brakes behind what stands, and changes lanes when the other is gone: at its first speed it would have met it."""
    x, speed = np.where(T > 4.0, 20.0, 10.0 * T - 1.25 * T**2), np.maximum(10.0 - 2.5 * T, 0.0)
    waits = (x, np.where(T > 5.0, 3.2, 0.0), speed)
    passes = (12.0 * T - 20.0, np.full_like(T, 3.2), np.full_like(T, 12.0))
    stands = (np.full_like(T, 24.5), np.zeros_like(T), np.zeros_like(T))
    trace = changing(waits, passes, stands)
    assert ttc_on_paths(trace, "ego", "co_0").min() == 5.0
    assert 0.5 < ttc_on_paths(trace, "ego", "co_1").min() < 3.0  # what stands is ahead of it, in its lane
