"""Geometry against shapely, metrics against values that can be worked out on paper."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from sbt.metrics.conflict_types import conflict_type
from sbt.metrics.geometry import contact_index, corners, rectangle_distance, swept_contact
from sbt.metrics.longitudinal import (
    BESIDE,
    FAR,
    HORIZON,
    OVERTAKEN,
    collision,
    d_min,
    drac_max,
    encounter,
    impact_speed,
    thw_min,
    ttc_min,
)
from sbt.metrics.planar import severity
from sbt.metrics.rss import Rss, rss_longitudinal_min, rss_violation
from sbt.problem.trace import ActorTrace, Trace

shapely = pytest.importorskip("shapely", reason="geometry is compared with shapely, which is not installed")
from shapely import affinity  # noqa: E402

METRICS = (ttc_min(), d_min(), thw_min(), drac_max(), collision(), impact_speed())
LENGTH, WIDTH = 5.0, 1.8

coordinate = st.floats(-8, 8).map(lambda v: round(v, 3))
angle = st.floats(-math.pi, math.pi).map(lambda v: round(v, 3))
size = st.floats(0.3, 6).map(lambda v: round(v, 2))
pose = st.tuples(coordinate, coordinate, angle)


def box(poses: list[tuple[float, float, float]], length: float = LENGTH, width: float = WIDTH) -> ActorTrace:
    x, y, heading = np.array(poses, dtype=float).T
    return ActorTrace(x, y, heading, np.zeros(len(x)), np.zeros(len(x)), length, width)


def polygon(p: tuple[float, float, float], length: float, width: float) -> shapely.Polygon:
    upright = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(upright, p[2], origin=(0, 0), use_radians=True), p[0], p[1])


def swept(start: tuple[float, float, float], end: tuple[float, float, float], length: float, width: float) -> shapely.Polygon:
    """What a rectangle of the end's heading covers on its straight way."""
    first, last = polygon((*start[:2], end[2]), length, width), polygon(end, length, width)
    return shapely.union(first, last).convex_hull


@given(pose, pose, size, size)
@settings(max_examples=300)
def test_distance_is_that_of_shapely(a, b, length, width):
    one, two = polygon(a, LENGTH, WIDTH), polygon(b, length, width)
    found = rectangle_distance(box([a]), box([b], length, width))[0]
    assert found == pytest.approx(one.distance(two), abs=1e-9)
    assert corners(box([a]))[0] == pytest.approx(np.array(_in_order(one, a)), abs=1e-9)


def _in_order(shape: shapely.Polygon, p: tuple[float, float, float]) -> list[tuple[float, float]]:
    """Counter-clockwise from the front left."""
    ring = list(shapely.geometry.polygon.orient(shape).exterior.coords)[:4]
    own = [affinity.rotate(shapely.Point(x - p[0], y - p[1]), -p[2], origin=(0, 0), use_radians=True) for x, y in ring]
    first = next(k for k, q in enumerate(own) if q.x > 0 and q.y > 0)
    return ring[first:] + ring[:first]


@given(pose, pose, pose, pose, size, size)
@settings(max_examples=300)
def test_swept_contact_is_that_of_shapely(a0, a1, b0, b1, length, width):
    """In the frame of b, a moves on a straight line: contact there is overlap with the convex hull of its way."""
    pairs = (a0, a1, LENGTH, WIDTH), (b0, b1, length, width)  # nobody turns on the spot
    a0, b0 = ((*p[:2], q[2]) if math.dist(p[:2], q[:2]) < 0.5 * math.hypot(*size) else p for p, q, *size in pairs)
    away = (a0[0] - b0[0] + b1[0], a0[1] - b0[1] + b1[1], a0[2])
    way, other = swept(away, a1, LENGTH, WIDTH), polygon(b1, length, width)
    gap, depth = way.distance(other), way.intersection(other).area
    assume(gap > 1e-6 or depth > 1e-6)  # touching to the last bit is nobody's business
    a, b = box([a0, a1]), box([b0, b1], length, width)
    share = swept_contact(a, b)[1]
    assert np.isfinite(share) == (depth > 0)
    if np.isfinite(share):
        at = tuple(p + share * (q - p) for p, q in zip(away[:2], a1[:2], strict=True))
        touching = polygon((*at, a1[2]), LENGTH, WIDTH)
        assert touching.distance(other) < 1e-6
        assert share == 0.0 or touching.intersection(other).area < 1e-4 * (1 + depth)
    before = polygon(a0, LENGTH, WIDTH).intersection(polygon(b0, length, width)).area
    assume(before > 1e-6 or polygon(a0, LENGTH, WIDTH).distance(polygon(b0, length, width)) > 1e-6)
    expected = 0 if before > 0 else 1 if depth > 0 else None
    assert contact_index(a, b) == expected


@given(st.floats(0.5, 500), st.integers(1, 40), angle)
@example(500.0, 1, 0.0)
@settings(max_examples=100)
def test_nothing_tunnels_however_coarse_the_step(distance, steps, turn):
    """A small fast box drives through a thin one across its way: always seen, at the same place."""
    way = np.linspace(-distance, distance, steps + 1)
    c, s = math.cos(turn), math.sin(turn)
    bullet = box([(c * v, s * v, turn) for v in way], 0.2, 0.2)
    wall = box([(0.0, 0.0, turn + math.pi / 2)] * (steps + 1), 3.0, 0.1)
    k = contact_index(bullet, wall)
    assert k is not None
    share = swept_contact(bullet, wall)[k]
    place = way[max(k - 1, 0)] + share * (way[k] - way[max(k - 1, 0)])
    assert place == pytest.approx(-0.15, abs=1e-6) or (k == 0 and abs(place) <= 0.15)
    beside = box([(c * v - s * 1.61, s * v + c * 1.61, turn) for v in way], 0.2, 0.2)
    assert contact_index(beside, wall) is None


def test_boxes_that_only_touch_are_in_contact():
    assert contact_index(box([(0, 0, 0)]), box([(5.0, 0, 0)])) == 0
    assert contact_index(box([(0, 0, 0)]), box([(5.0 + 1e-9, 0, 0)])) is None
    assert rectangle_distance(box([(0, 0, 0)]), box([(8.0, 5.8, 0)]))[0] == pytest.approx(5.0)


def drive(
    gap: float, v_ego: float, v_co: float, *, duration: float = 4.0, dt: float = 0.1, offset: float = 0.0, a_ego: float = 0.0
) -> Trace:
    """Both drive along x, ego's front `gap` behind co's rear at t = 0, co `offset` to the left."""
    t = np.arange(0.0, duration + dt / 2, dt)
    ego = 0.5 * a_ego * t**2 + v_ego * t
    x = np.column_stack([ego, gap + LENGTH + v_co * t])
    y = np.column_stack([np.zeros_like(t), np.full_like(t, offset)])
    speed = np.column_stack([v_ego + a_ego * t, np.full_like(t, v_co)])
    acceleration = np.column_stack([np.full_like(t, a_ego), np.zeros_like(t)])
    return Trace(t, ("ego", "co"), x, y, np.zeros_like(x), speed, acceleration, np.full(2, LENGTH), np.full(2, WIDTH))


def measured(trace: Trace, margin: float = 0.0) -> dict[str, float]:
    made = (ttc_min(margin=margin), d_min(margin=margin), thw_min(margin=margin), drac_max(margin=margin), *METRICS[4:])
    values = {metric.name: metric(trace) for metric in made}
    assert all(math.isfinite(v) for v in values.values())
    return values


def test_constant_closing_speed():
    """30 m at 20 against 15 m/s for 4 s: 10 m remain."""
    y = measured(drive(30.0, 20.0, 15.0))
    assert y["ttc_min"] == pytest.approx(10 / 5)
    assert y["d_min"] == pytest.approx(10.0)
    assert y["thw_min"] == pytest.approx(10 / 20)
    assert y["drac_max"] == pytest.approx(5**2 / (2 * 10))
    assert (y["collision"], y["impact_speed"]) == (0.0, 0.0)


def test_braking_in_time_has_its_smallest_ttc_where_calculus_says():
    """Gap 30 - 10 t + t^2, closing 10 - 2 t: TTC = gap / closing is smallest at t = 5 - sqrt(5)."""
    trace = drive(30.0, 20.0, 10.0, a_ego=-2.0, duration=5.0, dt=0.001)
    t = 5 - math.sqrt(5)
    y = measured(trace)
    assert y["ttc_min"] == pytest.approx((30 - 10 * t + t**2) / (10 - 2 * t), rel=1e-6)
    assert y["d_min"] == pytest.approx(5.0)
    assert y["drac_max"] == pytest.approx(10.0**2 / (2 * 30), rel=1e-6)


def test_rear_end_collision():
    """10 m at 10 m/s of closing speed: contact after 1 s, between two states too."""
    for dt in (0.1, 0.3, 0.6):  # a run ends with the step that touches
        y = measured(drive(10.0, 20.0, 10.0, duration=math.ceil(1 / dt) * dt, dt=dt))
        assert (y["ttc_min"], y["d_min"], y["collision"], y["impact_speed"]) == (0.0, 0.0, 1.0, 10.0)
        assert y["drac_max"] == 100.0
    grazing = measured(drive(10.0, 20.0, 10.0, duration=0.9))
    assert grazing["collision"] == 0.0
    assert grazing["ttc_min"] == pytest.approx(0.1)


def test_what_follows_a_collision_does_not_count():
    """A recorded trace may go on after the contact, one car inside the other."""
    until, beyond = (measured(drive(10.0, 20.0, 10.0, duration=d)) for d in (1.0, 3.0))
    assert until == beyond


def test_no_closing_in_is_the_horizon():
    y = measured(drive(30.0, 15.0, 20.0))
    assert (y["ttc_min"], y["drac_max"], y["collision"]) == (HORIZON, 0.0, 0.0)
    assert y["d_min"] == pytest.approx(30.0)
    far = measured(drive(500.0, 15.0, 14.0))
    assert far["ttc_min"] == HORIZON
    assert measured(drive(30.0, 15.0, 15.0))["ttc_min"] == HORIZON


def test_another_lane_is_no_interaction_until_it_comes_into_the_path():
    beside = drive(-3.0, 20.0, 20.0, offset=3.5)
    y = measured(beside)
    assert y == {m.name: m.without for m in METRICS}
    assert measured(drive(30.0, 20.0, 15.0, offset=3.5)) == y
    shared = measured(drive(30.0, 20.0, 15.0, offset=2.5), margin=0.85)
    assert shared["ttc_min"] == pytest.approx(2.0)
    assert shared["collision"] == 0.0


def test_beside_and_overtaken_have_their_own_values():
    assert measured(drive(-3.0, 20.0, 20.0, offset=2.5), margin=0.85)["ttc_min"] == BESIDE
    passing = drive(-3.0, 20.0, 10.0, offset=2.5)
    assert BESIDE <= measured(passing, margin=0.85)["ttc_min"] < 0
    overtaken = drive(-40.0, 20.0, 10.0, offset=3.5)
    assert (measured(overtaken)["ttc_min"], measured(overtaken)["d_min"]) == (OVERTAKEN, OVERTAKEN)


def test_a_side_impact_is_a_collision_with_its_relative_speed():
    t = np.arange(0, 2.01, 0.1)
    ego, co = 10.0 * t, np.full_like(t, 12.0)
    y = np.column_stack([np.zeros_like(t), 10.0 - 8.0 * t])
    heading = np.column_stack([np.zeros_like(t), np.full_like(t, -math.pi / 2)])
    speed = np.column_stack([np.full_like(t, 10.0), np.full_like(t, 8.0)])
    trace = Trace(
        t, ("ego", "co"), np.column_stack([ego, co]), y, heading, speed, 0 * speed, np.full(2, LENGTH), np.full(2, WIDTH)
    )
    assert collision()(trace) == 1.0
    assert impact_speed()(trace) == pytest.approx(math.hypot(10, 8))


def moved(trace: Trace, turn: float, dx: float, dy: float) -> Trace:
    c, s = math.cos(turn), math.sin(turn)
    return replace(trace, x=c * trace.x - s * trace.y + dx, y=s * trace.x + c * trace.y + dy, heading=trace.heading + turn)


@given(
    st.floats(-20, 60), st.floats(5, 40), st.floats(0, 40), st.sampled_from([0.0, 1.0, 2.5, 3.5, -2.5]), st.floats(-8, 2),
    angle, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3),
)  # fmt: skip
@settings(max_examples=150)
def test_metrics_are_finite_and_do_not_care_where_north_is(gap, v_ego, v_co, offset, a_ego, turn, dx, dy):
    trace = drive(gap, v_ego, v_co, offset=offset, a_ego=a_ego, duration=2.0)
    bumpers = trace.x[:, 1] - trace.x[:, 0] - LENGTH  # where a verdict changes the last bit may decide
    assume(min(np.abs(bumpers).min(), np.abs(bumpers + 2 * LENGTH).min()) > 1e-6)
    here, there = measured(trace, margin=0.85), measured(moved(trace, turn, dx, dy), margin=0.85)
    for name, value in here.items():
        if name == "drac_max" and value > 50:
            continue  # the formula has no limit as the gap closes
        assert there[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name


def test_more_road_users_only_add_collisions():
    one = drive(10.0, 20.0, 10.0, duration=2.0)
    extra = {
        name: np.column_stack([getattr(one, name), getattr(one, name)[:, 1] + (500.0 if name == "y" else 0.0)])
        for name in ("x", "y", "heading", "speed", "acceleration")
    }
    trio = replace(one, actors=("ego", "co", "far"), length=np.full(3, LENGTH), width=np.full(3, WIDTH), **extra)
    assert measured(trio) == measured(one)
    assert ttc_min(other="far")(trio) == OVERTAKEN  # in another lane, and passed in the end
    calm = replace(trio, x=trio.x + np.array([0.0, 500.0, 0.0]), y=trio.y - np.array([0.0, 0.0, 500.0]))
    assert (collision()(calm), ttc_min()(calm), impact_speed()(calm)) == (1.0, HORIZON, 0.0)


@given(st.integers(0, 3), st.integers(0, 3), st.floats(-40, 40), st.floats(-40, 40), angle, coordinate, coordinate)
def test_the_conflict_type_is_side_and_course_wherever_north_is(side, course, off, askew, turn, x, y):
    bearing, apart = math.radians(90 * side + off / 2), 9.0
    poses = [(x, y, turn), (x + apart * math.cos(turn + bearing), y + apart * math.sin(turn + bearing),
             turn + math.radians(90 * course + askew))]  # fmt: skip
    poses.append((x + 99.0, y, 0.0))  # further away
    now = np.array(poses)
    away = np.array([[0.0, 0.0, 0.0], [20.0 * math.cos(turn + bearing), 20.0 * math.sin(turn + bearing), 1.0], [40.0, 0.0, 2.0]])
    before = now + away  # further away still, where none drives through another on its way
    xs, ys, headings = np.moveaxis(np.stack([before, now, np.full_like(now, np.nan)]), 2, 0).copy()
    still = np.zeros_like(xs)
    sizes = np.full(3, 2.0), np.full(3, 2.0)  # as wide as long: bearings alone decide
    standing = Trace(np.arange(3.0), ("ego", "co", "far"), xs, ys, headings, still, still, *sizes)
    trace = replace(standing, speed=still + 1.0)
    assert conflict_type()(trace) == conflict_type()(standing) - 16 == 4 * side + course
    assert conflict_type("nobody")(trace) == 4 * side + course
    assert conflict_type()(replace(trace, x=np.where([True, False, False], xs, np.nan))) == -1


@pytest.mark.parametrize(("outer", "touch"), [(11.5, False), (9.5, True)])
@pytest.mark.parametrize("phase", np.linspace(0.0, 1.0, 7))
def test_who_turns_on_an_arc_within_a_step_touches_only_who_is_there(outer, touch, phase):
    """Two cars on concentric arcs, one step of a second: on chords with the last heading they would be turned into each other."""
    angle = -1.1 * np.arange(3) - phase

    def car(radius, lead):
        at = angle + lead
        still = np.zeros(3)
        return ActorTrace(-radius * np.sin(at), radius * np.cos(at), at, still + 1.1 * radius, still, 5.0, 1.8)

    leads = np.linspace(-0.5, 0.5, 9)
    met = [contact_index(car(8.0, 0.0), car(outer, lead)) is not None for lead in leads]
    assert any(met) == touch
    if touch:
        assert met[4]


@given(pose, pose, size, size)
@settings(max_examples=100)
def test_gap_and_path_are_those_of_the_corners_whatever_the_headings(one, other, length, width):
    """Who stands across the lane begins where its side is, not half of its length before its middle."""
    a, b = box([one, one]), box([other, other], length, width)
    trace = Trace(
        np.arange(2.0), ("ego", "co"), *(np.stack([getattr(c, n) for c in (a, b)], axis=1) for n in ("x", "y", "heading")),
        np.zeros((2, 2)), np.zeros((2, 2)), np.array([LENGTH, length]), np.array([WIDTH, width]),
    )  # fmt: skip
    away = corners(b)[0] - [one[0], one[1]]
    along = away @ [math.cos(one[2]), math.sin(one[2])]
    left = away @ [-math.sin(one[2]), math.cos(one[2])]
    found = encounter(trace)
    assert found.gap[0] == pytest.approx(along.min() - 0.5 * LENGTH, abs=1e-9)
    clear = max(left.min() - 0.5 * WIDTH, -0.5 * WIDTH - left.max())
    assume(abs(clear) > 1e-9)
    assert bool((found.ahead | found.beside)[0]) <= (clear < 0)
    if found.contact is None and along.min() > 0.5 * LENGTH:
        assert bool(found.ahead[0]) == (clear < 0)


@pytest.mark.parametrize("turn", [0.5 * math.pi, -0.5 * math.pi, 0.75 * math.pi])
def test_who_turns_on_the_spot_touches_only_who_is_there_meanwhile(turn):
    """A person who stands beside a car that goes by: it had the heading of the end of the step during all of it."""
    s, still = np.linspace(0.0, 1.0, 401), np.zeros(2)
    for beside, at in itertools.product(np.arange(0.95, 1.3, 0.05), np.arange(-3.5, 3.25, 0.25)):
        path = np.stack([at + 0.9 * s, 0.0 * s, 0.0 * s], axis=1)
        person = np.stack([0.05 * s, 0.0 * s + beside, 0.5 * math.pi + turn * s], axis=1)
        truth = rectangle_distance(box(path.tolist()), box(person.tolist(), 0.215, 0.478)).min()
        ends = [ActorTrace(each[[0, -1], 0], each[[0, -1], 1], each[[0, -1], 2], still + v, still, *size)
                for each, v, size in ((path, 9.0, (LENGTH, WIDTH)), (person, 0.0, (0.215, 0.478)))]  # fmt: skip
        now = rectangle_distance(*ends)
        found = contact_index(*ends)
        assert found == (0 if now[0] == 0.0 else 1 if now[1] == 0.0 else found)
        assert found is None or truth < 0.02, "a step is 16 parts, each with its last heading"


def test_a_part_in_the_path_behind_the_ego_is_not_beside_it():
    """Of a long vehicle in a turn, whose front is level with the ego but not in its path, and whose tail is in it, far behind."""
    still = np.zeros(2)
    front, tail = (ActorTrace(still + x, still + y, still, still, still, 6.0, 2.5) for x, y in ((0.0, 8.0), (-20.0, 0.0)))
    x, y, none = np.array([[0.0, -5.0]] * 2), np.array([[0.0, 4.0]] * 2), np.zeros((2, 2))
    size = np.array([4.5, 12.0]), np.array([1.8, 2.5])
    trace = Trace(np.arange(2.0), ("ego", "co"), x, y, none, none, none, *size, parts={"co": (front, tail)})
    assert not encounter(trace).beside.any()
    assert ttc_min()(trace) == HORIZON
    assert d_min()(trace) == FAR


@given(pose, pose, size, size, st.floats(0.0, 1.5))
@example((0.0, 0.0, 0.0), (-4.99, -2.38, -0.365), 5.0, 1.8, 0.0)  # turns out behind one that stands
@settings(max_examples=150)
def test_nobody_is_beside_whose_part_in_the_path_is_behind(one, other, length, width, margin):
    """What is left of the other in ego's strip, by shapely, tells whether it is there; a corner that turns past it does not."""
    a, b = box([one, one]), box([other, other], length, width)
    trace = Trace(
        np.arange(2.0), ("ego", "co"), *(np.stack([getattr(c, n) for c in (a, b)], axis=1) for n in ("x", "y", "heading")),
        np.zeros((2, 2)), np.zeros((2, 2)), np.array([LENGTH, length]), np.array([WIDTH, width]),
    )  # fmt: skip
    strip = polygon(one, 100.0, WIDTH + 2 * margin)
    shared = affinity.rotate(polygon(other, length, width).intersection(strip), -one[2], one[:2], use_radians=True)
    assume(shared.area > 1e-6)
    front = shared.bounds[2] - one[0]
    assume(abs(front + 0.5 * LENGTH) > 1e-6)
    found = encounter(trace, margin=margin)
    if found.beside[0]:
        assert front > -0.5 * LENGTH
    elif not found.ahead[0]:
        assert front < -0.5 * LENGTH
    if front < -0.5 * LENGTH:
        assert ttc_min(margin=margin, passed=HORIZON)(trace) == HORIZON
        assert d_min(margin=margin, passed=FAR)(trace) == FAR
        assert rss_longitudinal_min(margin=margin)(trace) == FAR
        assert rss_violation(rules=Rss(response=0.1, lateral_margin=margin))(trace) == 0.0


def _braking(speeds: list[list[float]], gap: float, step: float, *, ballistic: bool = True) -> tuple[Trace, float]:
    """Two on a line, 5 m long each, with (t, 2) speeds that change evenly within steps: their trace up to the contact, and the
    closing speed at the contact by small steps."""
    v = np.array(speeds)
    fine = np.linspace(0.0, 1.0, 20_001)[1:]
    x, way, closing = [np.zeros(2)], np.zeros(2), 0.0
    for before, after in itertools.pairwise(v):
        within = before + (after - before) * fine[:, None]
        path = way + step * np.cumsum(within, axis=0) / len(fine)
        way = path[-1]
        x.append(way.copy())
        touch = path[:, 0] - path[:, 1] >= gap
        if touch.any():
            closing = float(np.abs(np.subtract(*within[int(touch.argmax())])))
            break
    n = len(x)
    at = np.array(x) + np.array([0.0, gap + 5.0])
    zero = np.zeros((n, 2))
    size = np.full(2, 5.0), np.full(2, 1.8)
    made = Trace(step * np.arange(n), ("ego", "co"), at, zero, zero, v[:n], zero, *size, ballistic=ballistic)
    return made, closing


@given(
    st.lists(st.tuples(st.floats(5, 30), st.floats(0, 4)), min_size=3, max_size=6), st.floats(0.5, 40),
    st.sampled_from([0.05, 0.1, 0.5, 1.0]),
)  # fmt: skip
@settings(max_examples=150)
def test_the_impact_speed_is_that_at_the_contact_where_speeds_change_evenly_within_steps(speeds, gap, step):
    """It was that at the end of the step: too low by up to the braking times the step."""
    trace, closing = _braking([list(pair) for pair in speeds], gap, step)
    assume(closing > 0.0)
    assert impact_speed()(trace) == pytest.approx(closing, abs=5e-3)
    assert severity()(trace) == -impact_speed()(trace)
    by_jumps = replace(trace, ballistic=False)
    assert impact_speed()(by_jumps) == abs(trace.speed[-1, 0] - trace.speed[-1, 1])


@pytest.mark.parametrize("gap", [3.0, 12.0, 12.4])
def test_who_stops_within_the_step_of_the_contact_has_hit_before(gap):
    """From 20 m/s by 16 m/s^2 it stands after 12.5 m and 1.25 s, in a step of 2 s at whose end it has no speed."""
    x, speed = np.array([[0.0, gap + 5.0], [12.5, gap + 5.0]]), np.array([[20.0, 0.0], [0.0, 0.0]])
    zero, size = np.zeros((2, 2)), (np.full(2, 5.0), np.full(2, 1.8))
    trace = Trace(np.array([0.0, 2.0]), ("ego", "co"), x, zero, zero, speed, zero, *size, ballistic=True)
    assert impact_speed()(trace) == pytest.approx(math.sqrt(400.0 - 2.0 * 16.0 * gap), abs=0.02)


def test_who_is_moved_by_poses_has_the_speed_of_its_step():
    x, speed = np.array([[0.0, 15.0], [12.0, 15.0]]), np.array([[20.0, 0.0], [12.0, 0.0]])
    zero, size = np.zeros((2, 2)), (np.full(2, 5.0), np.full(2, 1.8))
    trace = Trace(np.array([0.0, 1.0]), ("ego", "co"), x, zero, zero, speed, zero, *size, ballistic=True)
    assert impact_speed()(trace) == 12.0


def test_a_selection_of_a_trace_knows_how_speeds_change():
    trace, closing = _braking([[20.0, 0.0], [14.0, 0.0], [8.0, 0.0], [2.0, 0.0]], 20.0, 1.0)
    assert closing > 8.0
    part = trace.select(slice(1, None), {"ego": "a", "co": "b"})
    assert impact_speed("a", "b")(part) == impact_speed()(trace) == pytest.approx(closing, abs=5e-3)
    assert not trace.identical(replace(trace, ballistic=False))
