"""Metrics of two road users know what happens between instants: coarse traces of a drive give what fine ones give."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sbt.metrics.around import smallest_distance
from sbt.metrics.exposure import tet, tit
from sbt.metrics.paths import smallest_ttc_on_paths, ttc_on_paths
from sbt.metrics.planar import distance_min, post_encroachment_time, severity, time_behind
from sbt.metrics.rss import Rss, rss_lateral_min, rss_longitudinal_min, rss_violation
from sbt.metrics.shifts import evenly
from sbt.problem.trace import Trace

Way = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(t,) times to x, y and heading."""


def straight(x: float, y: float, heading: float, speed: float) -> Way:
    return lambda t: (x + speed * t * math.cos(heading), y + speed * t * math.sin(heading), np.full(len(t), heading))


def bend(radius: float, speed: float, phase: float) -> Way:
    """To the left about the origin."""

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angle = phase + speed / radius * t
        return radius * np.cos(angle), radius * np.sin(angle), angle + math.pi / 2

    return at


def trace_of(ways: dict[str, Way], sizes: tuple[float, float], step: float, duration: float, offset: float = 0.0) -> Trace:
    time = np.arange(0.0, duration + 1e-9, step)
    x, y, heading = (np.column_stack(states) for states in zip(*(way(time + offset) for way in ways.values()), strict=True))
    speed = np.hypot(*(np.gradient(states, step, axis=0) for states in (x, y)))
    length, width = (np.full(len(ways), size) for size in sizes)
    return Trace(time, tuple(ways), x, y, heading, speed, np.zeros_like(x), length, width)


@settings(max_examples=30, deadline=None)
@given(st.floats(5.0, 9.0), st.floats(3.0, 6.5), st.floats(-1.0, 0.0), st.floats(0.6, 1.5), st.sampled_from((0.5, 1.0)))
def test_who_turn_side_by_side_have_no_conflict_however_coarse_the_step(radius, speed, phase, gap, step):
    """Outlines of concentric drives never meet: the outer corner of the inner one stays within `reach` of the middle."""
    length, width = 4.5, 1.8
    reach = math.hypot(radius + width / 2, length / 2)
    ways = {"ego": bend(radius, speed, phase), "co": bend(reach + gap + width / 2, speed, phase)}
    trace = trace_of(ways, (length, width), step, 4.0)
    assert post_encroachment_time(trace) == 10.0
    assert time_behind(trace, other=None) == 10.0
    assert distance_min()(trace) > 0.0


@pytest.mark.parametrize("gap", [0.4, 1.0])
def test_the_pet_of_a_drive_across_a_bend_is_that_of_small_steps(gap):
    ways = {"ego": bend(6.0, 5.0, -1.0), "co": straight(6.0, -25.0, math.pi / 2, 8.0)}
    late = {**ways, "co": lambda t: ways["co"](t - gap)}
    fine = post_encroachment_time(trace_of(late, (4.5, 1.8), 0.02, 6.0))
    assert 0.0 < fine < 10.0
    for step in (0.1, 0.5, 1.0):
        assert post_encroachment_time(trace_of(late, (4.5, 1.8), step, 6.0)) == pytest.approx(fine, abs=0.1), step


@pytest.mark.parametrize("known", [lambda k: (k <= 25) | (k % 5 == 0), lambda k: (k < 31) | (k > 44), lambda k: k % 3 != 1])
def test_the_pet_of_a_recording_with_gaps_is_in_seconds(known):
    """It was in steps of the mean length: 1.1 s for .66 s."""
    ways = {"ego": straight(97.5, 0.0, 0.0, 20.0), "co": straight(130.0, -52.5, math.pi / 2, 20.0)}
    whole = trace_of(ways, (5.0, 1.8), 0.1, 5.0)
    k = np.flatnonzero(known(np.arange(51)))
    states = (v[k] for v in (whole.x, whole.y, whole.heading, whole.speed, whole.acceleration))
    gaps = Trace(whole.time[k], whole.actors, *states, whole.length, whole.width)
    assert np.ptp(np.diff(gaps.time)) > 0.05
    for found in (post_encroachment_time(gaps), time_behind(gaps, other=None)):
        assert found == pytest.approx((50.0 - 0.9) / 20.0 - (130.9 + 5.0 - 100.0) / 20.0, abs=1e-3)


def test_two_instants_close_together_do_not_make_a_recording_long():
    """A millisecond between two rows divided all steps by 64, which took 12 GB."""
    way = straight(0.0, 0.0, 0.0, 10.0)
    ways = {"ego": way, "co": lambda t: way(t - 2.0)}
    time = np.sort(np.append(np.arange(300) * 0.04, 4.0001))
    x, y, heading = (np.column_stack(states) for states in zip(*(each(time) for each in ways.values()), strict=True))
    trace = Trace(time, tuple(ways), x, y, heading, np.full_like(x, 10.0), np.zeros_like(x), np.full(2, 5.0), np.full(2, 1.8))
    (first, _), step = evenly(trace, [trace.actor("ego"), trace.actor("co")])
    assert len(first.x) <= 4 * len(time)
    assert step == pytest.approx(0.04, rel=0.01)
    assert post_encroachment_time(trace) == pytest.approx(1.5, abs=2e-3)


@pytest.mark.parametrize("step", [0.1, 0.2, 0.5, 1.0])
def test_oncoming_traffic_that_passes_between_two_instants_is_as_near_as_it_is(step):
    ways = {"ego": straight(0.0, 0.0, 0.0, 25.0), "co": straight(150.0, 3.2, math.pi, 25.0)}
    for offset in np.linspace(0.0, step, 5):
        trace = trace_of(ways, (5.0, 1.8), step, 6.0, float(offset))
        assert distance_min()(trace) == pytest.approx(1.4, abs=2e-3)
        assert severity()(trace) == pytest.approx(1.4, abs=2e-3)
        assert smallest_distance(trace, "ego") == pytest.approx(1.4, abs=2e-3)
        assert rss_lateral_min()(trace) == pytest.approx(1.4 - 0.25, abs=1e-3)


@pytest.mark.parametrize("gap", [0.1, 1.0])
def test_who_stands_before_and_after_the_step_in_which_it_passes_is_as_near_as_it_is(gap):
    """Slopes of the steps beside it said that nothing happens between."""
    t = np.arange(6.0)
    x = np.column_stack([np.zeros(6), np.where(t < 3, -20.0, 20.0)])
    y = np.column_stack([np.zeros(6), np.full(6, 1.8 + gap)])
    still = np.zeros_like(x)
    trace = Trace(t, ("ego", "co"), x, y, still, still, still, np.full(2, 5.0), np.full(2, 1.8))
    assert distance_min()(trace) == pytest.approx(gap, abs=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-4.0, 4.0), st.floats(2.0, 20.0), st.floats(2.0, 20.0), st.floats(0.0, 0.5))
def test_the_smallest_distance_of_straight_drives_is_that_of_small_steps(heading, aside, speed, other, offset):
    ways = {
        "ego": straight(-3.0 * speed, 0.0, 0.0, speed),
        "co": straight(aside - 3.0 * other * math.cos(heading), aside - 3.0 * other * math.sin(heading), heading, other),
    }  # fmt: skip
    fine = distance_min()(trace_of(ways, (5.0, 1.8), 0.005, 6.0))
    coarse = distance_min()(trace_of(ways, (5.0, 1.8), 0.5, 6.5, offset - 0.5))
    assert coarse == pytest.approx(fine, abs=0.03 if fine else 1e-9)


@settings(max_examples=60, deadline=None)
@given(st.floats(5.0, 20.0), st.floats(3.0, 4.5), st.sampled_from((0.1, 0.2, 0.5, 1.0)))
def test_exposure_ends_with_the_contact_within_the_step(speed, contact, step):
    """Of an ego that drives into who stands: 3 s below 3 s, in which TTC falls evenly to 0."""
    length = 12.0
    ways = {"ego": straight(0.0, 0.0, 0.0, speed), "co": straight(speed * contact + length, 0.0, 0.0, 0.0)}
    trace = trace_of(ways, (length, 1.8), step, 6.0)
    assert tit()(trace) == pytest.approx(4.5, abs=step**2 / 8.0 + 1e-6)
    assert tet()(trace) == pytest.approx(3.0, abs=step / 2.0 + 1e-6)
    assert rss_violation(rules=Rss(response=5.0))(trace) == pytest.approx(contact, abs=1e-6)
    assert tit()(trace.select(slice(0, math.floor(contact / step + 1e-9) + 2))) == tit()(trace)


@settings(max_examples=40, deadline=None)
@given(st.floats(9.0, 30.0), st.floats(0.35, 0.6), st.sampled_from((0.3, 0.8, -0.3)), st.sampled_from((1, -1)), st.booleans())
def test_who_turns_is_on_its_arc_from_instant_to_instant(radius, rate, gap, side, short):
    """A post beside what a car sweeps, or just in it, has the TTC of small steps, also where the post goes before."""
    length, width, post = 4.5, 1.8, 0.5
    edge = radius - width / 2 - gap if side < 0 else math.hypot(radius + width / 2, length / 2) + gap
    at = -1.5 + rate * 3.7  # between instants
    spot = (edge + side * post / 2) * np.array([math.cos(at), math.sin(at)])
    ways = {"ego": bend(radius, rate * radius, -1.5), "co": lambda t: (*(np.full(len(t), v) for v in spot), np.full(len(t), at))}

    def seen(step: float) -> Trace:
        trace = trace_of(ways, (length, width), step, 8.0)
        speed = np.stack([np.full(len(trace.time), rate * radius), np.zeros(len(trace.time))], axis=1)
        states = {name: getattr(trace, name).copy() for name in ("x", "y", "heading")}
        if short:
            for v in (*states.values(), speed):
                v[trace.time > 2.0 + 1e-9, 1] = np.nan
        sizes = np.array([length, post]), np.array([width, post])
        return Trace(trace.time, trace.actors, *states.values(), speed, 0.0 * speed, *sizes)

    coarse, fine = seen(1.0), seen(0.1)
    assert ttc_on_paths(coarse)[:3] == pytest.approx(ttc_on_paths(fine)[:21:10], abs=0.03)
    assert (ttc_on_paths(coarse)[:3] == 5.0).all() == (gap > 0.0)
    if gap > 0.0:
        assert smallest_ttc_on_paths(coarse) == 5.0


@pytest.mark.parametrize("step", [0.05, 0.1, 0.2, 0.5, 1.0])
def test_the_margins_of_rss_end_as_the_two_begin_to_touch(step):
    """At the instant after it the ego was past whom it hit: level with it, or without any duty."""
    ways = {"ego": straight(-30.0, 0.0, 0.0, 20.0), "co": straight(0.0, 0.0, 0.0, 0.0)}
    trace = trace_of(ways, (4.5, 1.8), step, 4.0)
    contact = (30.0 - 4.5) / 20.0
    assert rss_violation()(trace) == pytest.approx(contact)
    assert rss_longitudinal_min()(trace) == pytest.approx(-float(Rss().same_direction(20.0, 0.0)))
    assert rss_lateral_min()(trace) == 1000.0
    behind = trace_of({"ego": ways["co"], "co": ways["ego"]}, (4.5, 1.8), step, 4.0)
    for metric, value in ((rss_violation(), 0.0), (rss_longitudinal_min(), 1000.0), (rss_lateral_min(), 1000.0)):
        assert metric(behind) == value


def test_a_car_beside_the_rear_of_a_bus_is_level_with_it_whether_or_not_it_has_parts():
    """Of parts that are as far aside the first one decided, which was ahead of the car."""
    whole = trace_of({"ego": straight(0.0, 0.0, 0.0, 10.0), "co": straight(-5.0, 7.0, 0.0, 10.0)}, (12.0, 2.0), 0.1, 1.0)
    own = whole.actor("ego")
    parts = tuple(replace(own, x=own.x + dx, length=4.0) for dx in (4.0, 0.0, -4.0))
    sized = replace(whole, length=np.array([12.0, 4.0]))
    assert rss_lateral_min()(replace(sized, parts={"ego": parts})) == pytest.approx(rss_lateral_min()(sized)) != 1000.0
