"""Contacts of persons, whom SUMO turns by up to 180 degrees within a step, however short."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sbt.metrics.conflict_types import conflict_type, describe_conflict_type
from sbt.metrics.geometry import contact_index, first_touch, overlap_depth, rectangle_distance, time_to_contact
from sbt.metrics.longitudinal import collision
from sbt.metrics.planar import TTC_2D_MIN
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.contacts import unconfirmed_contact

PERSON, CAR = (0.215, 0.478), (5.0, 1.8)


def body(poses, size=PERSON, speed=0.0) -> ActorTrace:
    """Return (x, y, degrees) at every instant."""
    x, y, heading = np.array(poses, dtype=float).T.copy()
    still = np.zeros_like(x)
    return ActorTrace(x, y, np.radians(heading), still + speed, still, *size)


def trace(a: ActorTrace, b: ActorTrace) -> Trace:
    states = (np.stack([getattr(a, n), getattr(b, n)], axis=1) for n in ("x", "y", "heading", "speed", "acceleration"))
    sizes = np.array([a.length, b.length]), np.array([a.width, b.width])
    return Trace(0.1 * np.arange(len(a.x)), ("ego", "co"), *states, *sizes)


@pytest.mark.parametrize(
    ("one", "other"),
    [  # recorded on a sidewalk of SUMO's striping model, in steps of 0.1 s
        ([(0, 0.296, 90), (0, 0.433, 90)], [(0, 0, 90), (-0.064, 0, -180)]),
        ([(0.064, -0.02, 67), (0, 0, 162)], [(0.116, 0.46, 90), (0.052, 0.468, 173)]),
        ([(0.064, -0.02, 67), (0, 0, 162)], [(-0.011, -0.489, 67), (-0.075, -0.469, 162)]),
    ],
)
def test_persons_in_a_queue_do_not_touch_as_sumo_turns_them(one, other):
    a, b = body([*one, one[-1]]), body([*other, other[-1]])  # they stay so
    assert contact_index(a, b) is None
    assert collision()(trace(a, b)) == 0.0
    assert TTC_2D_MIN(trace(a, b)) > 0.0
    assert (rectangle_distance(a, b) > 0.0).all()


angle, place = st.floats(-180, 180), st.floats(-1.5, 1.5)


@given(place, place, place, place, st.lists(angle, min_size=4, max_size=4), st.floats(0.0, 3.0), st.floats(0.1, 0.9))
@settings(max_examples=300)
def test_two_persons_are_discs_whatever_their_headings(x, y, u, v, headings, speed, width):
    a = body([(0, 0, headings[0]), (0, 0, headings[1])])
    b = body([(x, y, headings[2]), (u, v, headings[3])], (0.5, width), speed)
    reach = 0.5 * (0.215 + min(0.5, width))
    way = np.hypot(*(np.array([[x], [y]]) + np.linspace(0.0, 1.0, 2001) * np.array([[u - x], [v - y]])))
    assume(abs(way.min() - reach) > 1e-3)
    assume(np.abs(way[[0, -1]] - reach).min() > 1e-9)
    assert rectangle_distance(a, b) == pytest.approx(np.maximum(way[[0, -1]] - reach, 0.0))
    assert overlap_depth(a, b) == pytest.approx(reach - way[[0, -1]])
    assert contact_index(a, b) == (None if way.min() > reach else 0 if way[0] < reach else 1)
    if way[0] > reach > way.min():
        touch = first_touch(a, b, 1)
        assert touch is not None
        assert np.interp(touch[0], np.linspace(0.0, 1.0, 2001), way) == pytest.approx(reach, abs=1e-2)
    times = np.linspace(0.0, 20.0, 4001)
    ahead = np.hypot(u + speed * times * np.cos(b.heading[1]), v + speed * times * np.sin(b.heading[1]))
    found = time_to_contact(a, b)[1]
    if found < 20.0:
        assert np.interp(found, times, ahead) <= reach + 1e-2
    else:
        assert ahead.min() > reach - 1e-3


def test_a_person_and_a_vehicle_are_rectangles():
    beside = [(1.0, 1.1, 90), (1.0, 1.1, 180)]  # who turns beside a car reaches further to it
    assert contact_index(body([(0, 0, 0)] * 2, CAR), body(beside)) == 1
    assert contact_index(body([(0, 0, 0)] * 2, CAR), body([beside[0]] * 2)) is None


def test_two_persons_have_a_conflict_type():
    met = trace(body([(0, 0, 0), (0.1, 0, 0)], speed=1.0), body([(1, 0, 180), (0.2, 0, 180)], speed=8.0))
    assert describe_conflict_type(conflict_type()(met)) == "ahead of ego, oncoming"


def sumo():
    """A network of one edge, with as much of SUMO as the texts need."""

    def vehicles(lane):
        return SimpleNamespace(getLaneID=lambda _: lane, getLanePosition=lambda _: 50.0, getLength=lambda _: 5.0)

    edge = SimpleNamespace(getFromJunction=lambda _: "a", getToJunction=lambda _: "b")
    return SimpleNamespace(person=vehicles("road_0"), vehicle=vehicles("road_1"), edge=edge)


def test_a_contact_of_a_person_who_turns_within_a_step_is_told_so():
    car, still, turns = body([(0, 0, 0)] * 2, CAR), [(1.0, 1.0, 90)] * 2, [(1.0, 1.1, 90), (1.0, 1.1, 180)]

    def text(person):
        return unconfirmed_contact(sumo(), "av", "man", 3.0, (car, body(person)), persons=["man"])

    assert "'man' touches as it turns by 90 degrees within a step, else not" in text(turns)
    assert "turns" not in text(still)
    both = unconfirmed_contact(sumo(), "q", "man", 3.0, (body([(0, 0, 0)] * 2), body([(0.1, 0, 0)] * 2)), persons=["q", "man"])
    assert "SUMO does not compare pedestrians with each other" in both
