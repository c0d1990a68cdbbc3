"""Metrics where road users come and go: of every stretch, the worst, and nothing invented."""

from __future__ import annotations

import dataclasses
import gc
import weakref

import numpy as np
import pytest

from sbt.errors import InputError, RunError
from sbt.execution.worker import run_job
from sbt.metrics import longitudinal
from sbt.metrics.comfort import deceleration_max
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import FAR, HORIZON, collision, drac_max, ttc_min
from sbt.metrics.pairwise import in_traffic, worst_signal
from sbt.metrics.paths import ttc_on_paths
from sbt.metrics.planar import distance_min, pet, post_encroachment_time, severity, time_behind, ttc_2d, ttc_2d_min
from sbt.metrics.stl import stl
from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.problem.outcome import Job, Status
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

N = 41
TIME = np.arange(N) * 0.1


def traffic(**others: tuple[float, float, float, slice]) -> Trace:
    """An ego `v` at 20 m/s along x, and others: (x at 0, y, speed, when they are there)."""
    names = ("v", *others)
    x, y, speed = (np.full((N, len(names)), np.nan) for _ in range(3))
    x[:, 0], y[:, 0], speed[:, 0] = 20.0 * TIME, 0.0, 20.0
    for k, (start, side, v, when) in enumerate(others.values(), 1):
        x[when, k], y[when, k], speed[when, k] = (start + v * TIME)[when], side, v
    heading = np.where(np.isnan(x), np.nan, 0.0)
    return Trace(TIME, names, x, y, heading, speed, heading.copy(), np.full(len(names), 5.0), np.full(len(names), 1.8))


ALL = slice(None)


def test_the_worst_of_all_others_counts_in_either_direction():
    others = {"slow": (100.0, 0.0, 10.0, ALL), "fast": (30.0, 0.0, 30.0, ALL), "beside": (100.0, 8.0, 0.0, ALL)}
    trace, alone = traffic(**others), {name: traffic(**{name: start}) for name, start in others.items()}
    for metric, worst in ((ttc_min(passed=HORIZON), min), (distance_min(), min), (drac_max(), max), (collision(), max)):
        single = [in_traffic(metric, "v", name)(one) for name, one in alone.items()]
        assert in_traffic(metric, "v")(trace) == worst(single)
        assert in_traffic(metric, "v", "fast")(trace) == single[1]


def test_the_contact_of_a_pair_is_computed_once_per_trace_and_released_with_it(monkeypatch: pytest.MonkeyPatch):
    calls: list[None] = []
    real = longitudinal.contact_index
    monkeypatch.setattr(longitudinal, "contact_index", lambda a, b: (calls.append(None), real(a, b))[1])
    trace = traffic(**{f"car_{k}": (30.0 * k, 0.0, 10.0, ALL) for k in range(1, 20)})
    metrics = (nearest_distance("v"), any_collision("v"), any_impact_speed("v"), ttc_path_min("v"))
    first = [metric(trace) for metric in metrics]
    looked_at = len(calls)
    assert 1 <= looked_at <= 19, "who cannot touch is passed over"
    assert [metric(dataclasses.replace(trace)) for metric in metrics] == first
    assert len(calls) == 5 * looked_at, "another trace is another trace, equal or not"
    kept = weakref.ref(trace)
    del trace
    gc.collect()
    assert kept() is None


def test_road_users_are_measured_while_they_are_present():
    """Far away at first and at last; a car that jumps in from NaN sweeps over nobody."""
    trace = traffic(one=(45.0, 0.0, 10.0, slice(10, 20)), two=(200.0, 0.0, 20.0, slice(0, 5)))
    parts = joint_intervals(trace, "v", "one")
    assert [(i.start, i.stop, part.actors) for i, part in parts] == [(10, 20, ("ego", "co"))]
    gap = 45.0 - 10.0 * TIME[19] - 5.0
    assert in_traffic(ttc_min(passed=HORIZON), "v")(trace) == pytest.approx(gap / 10.0)
    assert in_traffic(collision(), "v")(trace) == 0.0
    twice = np.r_[5:10, 20:25]
    assert len(joint_intervals(traffic(one=(45.0, 0.0, 10.0, twice)), "v", "one")) == 2


def test_without_others_a_metric_has_its_value_without():
    for metric in (ttc_min(), distance_min(), drac_max(), collision()):
        assert in_traffic(metric, "v")(traffic()) == metric.without
    assert in_traffic(deceleration_max(), "v")(traffic()) == 0.0


def test_an_actor_that_is_never_present_is_an_error():
    with pytest.raises(RunError, match="no actor 'truck' in the trace, there are: v, one"):
        in_traffic(ttc_min(), "v", "truck")(traffic(one=(50.0, 0.0, 10.0, ALL)))


def test_signals_in_traffic_are_the_worst_at_every_instant():
    trace = traffic(one=(45.0, 0.0, 10.0, slice(10, 20)), two=(60.0, 0.0, 20.0, ALL))
    gap = worst_signal(trace, "gap", "v")
    first = 45.0 - 10.0 * TIME - 5.0
    assert gap[10:20] == pytest.approx(np.minimum(first, 55.0)[10:20])
    assert gap[:10] == pytest.approx(55.0)
    assert worst_signal(trace, "one.gap", "v")[:10] == pytest.approx(FAR)
    assert worst_signal(trace, "two.speed", "v") == pytest.approx(20.0)
    assert stl("G(gap > 20)", ego="v", other=None)(trace) == pytest.approx(first[19] - 20.0)
    with pytest.raises(InputError, match=r"in traffic 'lateral' needs a road user, such as lead\.lateral"):
        stl("G(lateral > 1)", ego="v", other=None)(trace)
    with pytest.raises(RunError, match=r"one\.speed must be defined at every instant"):
        stl("G(one.speed > 1)", ego="v", other=None)(trace)


def test_absent_is_nan_in_every_state_and_the_ego_never_is():
    """What a worker lets through: NaN in all states of another one; neither infinity, nor a part, nor the ego."""
    good = traffic(one=(45.0, 0.0, 10.0, slice(10, 20)))
    half, gone, wild = good.x.copy(), good.x.copy(), good.x.copy()
    half[12, 1], gone[3, 0], wild[12, 1] = np.nan, np.nan, np.inf
    third = np.arange(N)[:, None] == 3
    all_gone = {name: np.where(third, np.nan, getattr(good, name)) for name in ("x", "y", "heading", "speed")}
    traces = (good, *(dataclasses.replace(good, x=x) for x in (half, gone, wild)), dataclasses.replace(good, **all_gone))
    found = []
    for trace in traces:
        scenario = LogicalScenario(
            "t", ParameterSpace((Parameter("a", 0, 1),)), Requirement("collision", low=1.0),
            lambda values, seed, trace=trace: trace, (in_traffic(collision(), "v"),),
        )  # fmt: skip
        found.append(run_job(scenario, Job(0, {"a": 0.5}, 1)).status)
    assert found == [Status.OK] + [Status.FAILED] * 4
    assert len(good.rows()) == N + 10
    assert good.identical(dataclasses.replace(good, x=good.x.copy()))


# Among any number of road users


def driven(*tracks: tuple[np.ndarray, np.ndarray], dt: float = 0.1) -> Trace:
    """A trace of cars of 4 m x 2 m along (t,) x and y; speeds and headings follow from them."""
    x, y = np.stack([t[0] for t in tracks], axis=1), np.stack([t[1] for t in tracks], axis=1)
    dx, dy = np.gradient(x, dt, axis=0), np.gradient(y, dt, axis=0)
    n, m = x.shape
    names = ("ego", *(f"co_{k}" for k in range(m - 1)))
    speed = np.hypot(dx, dy)
    acceleration = np.gradient(speed, dt, axis=0)
    size = np.full(m, 4.0), np.full(m, 2.0)
    return Trace(np.arange(n) * dt, names, x, y, np.arctan2(dy, dx), speed, acceleration, *size)


def test_time_behind_counts_only_who_comes_after_ego() -> None:
    t = np.arange(0.0, 12.0, 0.1)
    ego, co = (10.0 * t - 50.0, 0.0 * t), (0.0 * t, 10.0 * t - 80.0)
    first, second = driven(ego, co), driven(co, ego)
    expected = 3.0 - 0.6  # centres come 3 s apart; half a length and half a width off, of both
    assert time_behind(first, "ego", "co_0") == pytest.approx(expected, abs=0.01)
    assert time_behind(first, "ego", "co_0") == pytest.approx(post_encroachment_time(first, "ego", "co_0"), abs=0.01)
    assert time_behind(second, "ego", "co_0") == 10.0
    assert pet_ego_first(horizon=5.0)(second) == 5.0
    assert time_behind(first, "ego", "co_0", zone=(0.0, 0.0, 8.0)) == pytest.approx(expected, abs=0.01)
    assert time_behind(first, "ego", "co_0", 4.0, zone=(40.0, 0.0, 8.0)) == 4.0


def crossing(dt: float, course: float, speeds: tuple[float, float], delay: float) -> Trace:
    """Two cars of 4 m x 2 m whose middle lines cross, the second one later by a delay (s)."""
    t = np.arange(0.0, 16.1, dt)
    ways = speeds[0] * (t - 8.0), speeds[1] * (t - 8.0 - delay)
    return driven((ways[0], 0.0 * t), (ways[1] * np.cos(course), ways[1] * np.sin(course)), dt=dt)


def test_the_pet_of_two_that_cross_does_not_hang_on_the_step_in_which_they_are_recorded() -> None:
    """Not even where both are over the crossing within a part of a step: no whole number of them has to touch."""
    rng = np.random.default_rng(5)
    between = 0
    for _ in range(40):
        ways = rng.uniform(0.5, 2.6), tuple(rng.uniform(5.0, 45.0, 2)), rng.uniform(-2.0, 2.0)
        exact = post_encroachment_time(crossing(0.05, *ways), other="co_0")
        for dt in (0.4, 1.0):
            trace = crossing(dt, *ways)
            accurate = pytest.approx(exact, abs=(dt + 0.05) / 1024)
            assert post_encroachment_time(trace, other="co_0") == accurate
            assert time_behind(trace, other=None) == (accurate if ways[2] > 0.0 else 10.0 if exact > 0.0 else 0.0)
            between += dt == 1.0 and exact > 0.0
    assert between > 20, "nothing was there to be missed"


def test_ttc_on_paths_is_gap_by_closing_speed_and_knows_bends() -> None:
    t = np.arange(0.0, 3.0, 0.1)
    follow = driven((12.0 * t, 0.0 * t), (24.0 + 6.0 * t, 0.0 * t))
    found = ttc_on_paths(follow, "ego", "co_0")
    assert found[:20] == pytest.approx((20.0 - 6.0 * t[:20]) / 6.0, abs=1e-6)
    assert ttc_path_min()(follow) == pytest.approx(found.min())
    angle = np.arange(0.0, 6.0, 0.1) * 0.5
    ring = driven(*((18.0 * np.cos(angle + p), 18.0 * np.sin(angle + p)) for p in (0.0, 1.2)))
    inner = slice(1, len(angle) - 40)
    assert ttc_2d(ring, "ego", "co_0").min() > 0
    assert ttc_on_paths(ring, "ego", "co_0")[inner].min() == 5.0, "equal speeds on one ring never meet"
    head_on = driven((10.0 * t, 0.0 * t), (100.0 - 10.0 * t, 3.0 + 0.0 * t))
    assert ttc_path_min()(head_on) == 5.0


def test_metrics_among_many_take_the_worst_of_all() -> None:
    t = np.arange(0.0, 4.0, 0.1)
    ego, far = (10.0 * t, 0.0 * t), (10.0 * t, 40.0 + 0.0 * t)
    braking = (60.0 + 10.0 * t - 2.0 * t**2, 0.0 * t)
    struck_one = (9.0 + 6.0 * t, 0.0 * t)
    calm, worse, crash = driven(ego, far), driven(ego, far, braking), driven(ego, far, struck_one)
    assert (nearest_distance()(calm), any_collision()(calm), any_impact_speed()(calm)) == (38.0, 0.0, 0.0)
    assert others_braking_max()(calm) == pytest.approx(0.0, abs=1e-9)
    assert others_braking_max()(worse) == pytest.approx(4.0)
    worst = [metric(crash) for metric in (any_collision(), nearest_distance(), ttc_path_min(), pet_ego_first())]
    assert worst == [1.0, 0.0, 0.0, 0.0]
    assert any_impact_speed()(crash) == pytest.approx(4.0)
    assert any_collision()(driven(far)) == 0.0


def wandering(rng: np.random.Generator) -> Trace:
    """An ego and seven others of different sizes, on bends, some of whom stand, reverse the direction, or come close."""
    t = np.arange(0.0, 12.0, 0.1)[:, None]
    start, course = rng.uniform(-45.0, 45.0, (2, 8)), rng.uniform(-np.pi, np.pi, 8)
    speed = np.maximum(rng.uniform(0.0, 14.0, 8) + rng.uniform(-1.5, 1.5, 8) * t, 0.0)
    heading = course + rng.uniform(-0.3, 0.3, 8) * t
    x, y = (s + np.cumsum(0.1 * speed * part, axis=0) for s, part in zip(start, (np.cos(heading), np.sin(heading)), strict=True))
    size = rng.uniform(0.5, 9.0, 8), rng.uniform(0.5, 2.5, 8)
    return Trace(t[:, 0], ("ego", *map(str, range(7))), x, y, heading, speed, np.zeros_like(x), *size)


def test_what_is_computed_for_all_others_at_once_is_what_each_alone_gives():
    """Who is passed over, as too far away, would have changed nothing."""
    rng = np.random.default_rng(3)
    conflicts = np.zeros(4, dtype=int)
    for _ in range(20):
        trace = wandering(rng)
        others = trace.actors[1:]
        alone = [trace.select(slice(None), {"ego": "ego", name: "co"}) for name in others]
        times = np.minimum.reduce([ttc_on_paths(one) for one in alone])
        assert np.array_equal(ttc_on_paths(trace, other=None), times)
        assert ttc_path_min()(trace) == times.min()
        behind = [time_behind(trace, "ego", name, 5.0) for name in others]
        assert pet_ego_first(horizon=5.0)(trace) == min(behind)
        assert nearest_distance()(trace) == min(distance_min()(one) for one in alone)
        assert any_collision()(trace) == max(collision()(one) for one in alone)
        conflicts += np.array([0.0 < times.min() < 5.0, 0.0 < min(behind) < 5.0, times.min() == 5.0, min(behind) == 5.0])
    assert (conflicts >= 1).all(), "nothing was there to be missed"


def coming_and_going(rng: np.random.Generator) -> Trace:
    """The same, where the others are there for some time only."""
    trace = wandering(rng)
    states = {name: getattr(trace, name).copy() for name in ("x", "y", "heading", "speed", "acceleration")}
    for k in range(1, len(trace.actors)):
        enters, leaves = np.sort(rng.integers(0, len(trace.time) + 1, 2))
        for values in states.values():
            values[:enters, k] = values[leaves:, k] = np.nan
    return dataclasses.replace(trace, **states)


def test_a_metric_of_a_trace_in_which_the_other_comes_and_goes_is_that_of_the_time_in_which_both_are_there():
    """Nobody who touches the ego is passed over because it was not there before, or is not later."""
    rng = np.random.default_rng(3)
    metrics = (collision(), any_collision(), any_impact_speed(), distance_min(), nearest_distance(), severity(), ttc_2d_min())
    touched = 0
    for _ in range(60):
        trace = coming_and_going(rng)
        for name in trace.actors[1:]:
            one = trace.select(slice(None), {"ego": "ego", name: "co"})
            if one.present[:, 1].sum() > 1:
                for metric in (*metrics, ttc_path_min()):
                    assert metric(one) == in_traffic(metric, "ego")(one), metric.name
                for metric in (pet(), pet_ego_first()):  # who comes when the ego has gone counts too
                    both = [metric(part) for _, part in joint_intervals(one, "ego", "co")]
                    assert in_traffic(metric, "ego")(one) == metric(one) <= min(both) + 1e-9, metric.name
                touched += collision()(one) > 0
        alone = [trace.select(slice(None), {"ego": "ego", name: "co"}) for name in trace.actors[1:]]
        assert pet_ego_first()(trace) == min(pet_ego_first()(one) for one in alone)
    assert touched >= 5, "nothing was there to be missed"


def test_who_is_not_seen_for_a_moment_after_the_contact_has_collided_all_the_same():
    """The next stretch began with overlapping rectangles, and counted as one of its own: a distance of -4 m."""
    whole = traffic(lead=(25.0, 0.0, 10.0, ALL))
    gap = traffic(lead=(25.0, 0.0, 10.0, np.flatnonzero(np.arange(N) != 28)))
    assert len(joint_intervals(gap, "v", "lead")) == 1
    for metric in (longitudinal.d_min(), ttc_min(), distance_min(), drac_max(), collision()):
        assert in_traffic(metric, "v")(gap) == in_traffic(metric, "v")(whole)
    before = traffic(lead=(25.0, 0.0, 10.0, np.flatnonzero(np.arange(N) != 8)))
    assert len(joint_intervals(before, "v", "lead")) == 2
