"""Whom a failure is about, among several road users: whose sole presence makes the metric what it is, not who is nearest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sbt.metrics.conflict_types import conflict, conflict_type, describe_conflict_type, from_behind
from sbt.metrics.geometry import contact_index
from sbt.metrics.longitudinal import COLLISION
from sbt.metrics.pairwise import in_traffic
from sbt.metrics.planar import TTC_2D_MIN
from sbt.metrics.preventability import applicability, why_not
from sbt.metrics.stl import stl
from sbt.metrics.traffic import ttc_path_min
from sbt.problem.metric import Metric
from sbt.problem.requirement import CriticalInterval
from sbt.problem.trace import ActorTrace, Trace

CRITICAL = CriticalInterval(high=1.5)


def overtaken(*, gap: float = 18.0) -> Trace:
    """Return an ego that closes in on a standing car ahead, while another overtakes 0.8 m beside it; a fourth one is far away."""
    time = np.arange(0.0, 1.01, 0.1)
    still = np.zeros_like(time)
    x = np.stack([10.0 * time, gap + 10.0 + still, -10.0 + 20.0 * time, 400.0 + still], axis=1)
    y = np.stack([still, still, still + 2.6, still + 50.0], axis=1)
    speed = np.stack([still + 10.0, still, still + 20.0, still], axis=1)
    sizes = np.full(4, 5.0), np.full(4, 1.8)
    return Trace(time, ("ego", "stopped", "passing", "far"), x, y, np.zeros_like(x), speed, np.zeros_like(x), *sizes)


def decide_by_name(trace: Trace) -> float:
    gap = trace.actor("stopped").x - trace.actor("ego").x - 5.0
    return float((gap / 10.0).min())


@pytest.mark.parametrize(
    "metric",
    [
        in_traffic(TTC_2D_MIN, "ego"), ttc_path_min(), Metric("own", decide_by_name),
        stl("G(ttc > 1.5)", other=None), stl("G(stopped.distance > 20)", other=None),
    ],
    ids=["pairs", "paths", "a function that names it", "bare signals", "a signal by name"],
)  # fmt: skip
def test_a_failure_is_about_whose_presence_alone_makes_the_metric_what_it_is(metric):
    trace = overtaken()
    about = conflict(trace, "ego", [(metric, CRITICAL)])
    assert about is not None
    assert (about[0], conflict(trace, "ego")[0]) == ("stopped", "passing")
    told = [describe_conflict_type(conflict_type("ego", by)(trace)) for by in ((), [(metric, CRITICAL)])]
    assert told == ["left of ego, same direction", "ahead of ego, same direction"]


def test_the_first_critical_metric_decides_and_an_uncritical_run_is_told_by_who_is_nearest():
    trace, ttc = overtaken(), in_traffic(TTC_2D_MIN, "ego")
    alone = Metric("speed", lambda trace: float(trace.actor("ego").speed.max()), alone=True)
    everybody = Metric("count", lambda trace: float(len(trace.actors)))
    for decisive, about in (
        ([(ttc, CriticalInterval(high=0.01))], "passing"),  # not critical
        ([(ttc, CriticalInterval(high=0.01)), (ttc, CRITICAL)], "stopped"),
        ([(alone, CriticalInterval(low=1.0)), (ttc, CRITICAL)], "stopped"),  # about the ego alone
        ([(everybody, CriticalInterval(low=3.0))], "passing"),  # no single one decides
    ):
        assert conflict(trace, "ego", decisive)[0] == about
    gone = replace(trace, x=np.where([True, False, False, False], trace.x, np.nan))
    assert conflict(gone, "ego", [(ttc, CRITICAL)]) is None


def test_reference_drivers_judge_the_same_conflict():
    trace, ttc = overtaken(), in_traffic(TTC_2D_MIN, "ego")
    behind = replace(trace, heading=trace.heading + np.pi, x=-trace.x)  # the mirror image, driving backwards in x
    for each in (trace, behind):
        assert why_not(applicability("ego", [(ttc, CRITICAL)])(each)) == ""
    rammed = replace(trace, actors=("stopped", "ego", "passing", "far"))
    assert "from behind" in why_not(applicability("ego", [(ttc, CRITICAL)])(rammed)), "also where the ego stands"


def test_a_failure_is_told_as_it_was_when_it_was_decided():
    """The ego brakes hard behind one that stops, and stands 1 m behind it in the end: its TTC was smallest in motion."""
    time = np.arange(0.0, 8.0, 0.1)
    speed = np.maximum(13.0 - np.maximum(time - 2.0, 0.0) * 6.0, 0.0)
    ego = np.concatenate([[0.0], np.cumsum(speed[:-1]) * 0.1])
    x = np.stack([ego, np.full_like(ego, ego[-1] + 6.0)], axis=1)
    v = np.stack([speed, np.zeros_like(speed)], axis=1)
    trace = Trace(time, ("ego", "stopped"), x, np.zeros_like(x), np.zeros_like(x), v, np.zeros_like(x), *([np.full(2, 5.0)] * 2))
    ttc = in_traffic(TTC_2D_MIN, "ego")
    told = [describe_conflict_type(conflict_type("ego", by)(trace)) for by in ((), [(ttc, CriticalInterval(high=1.5))])]
    assert told == ["ahead of ego, same direction, ego stands", "ahead of ego, same direction"]
    at = conflict(trace, "ego", [(ttc, CriticalInterval(high=1.5))])[3]
    assert speed[at] > 1.0
    assert ttc(trace.select(slice(0, at + 1))) == ttc(trace) < ttc(trace.select(slice(0, at)))


def test_a_metric_that_needs_more_than_one_instant_is_decided_when_it_has_its_value():
    trace = overtaken()
    own = Metric("own", lambda trace: float(np.diff(trace.actor("stopped").x - trace.actor("ego").x).min()) and 1.0)
    assert conflict(trace, "ego", [(own, CRITICAL)])[0] == "stopped"


def met(ego, other, *, speeds=(0.0, 0.0), sizes=((5.0, 1.8), (5.0, 1.8)), step=0.5) -> Trace:
    """Return a run of two, each given as (x, y, heading) at every instant."""
    poses = np.stack([np.array(ego, dtype=float), np.array(other, dtype=float)], axis=1)  # (t, 2, 3)
    x, y, heading = np.moveaxis(poses, 2, 0).copy()
    v, (length, width) = np.zeros_like(x) + speeds, np.array(sizes).T
    return Trace(step * np.arange(len(x)), ("ego", "co"), x, y, heading, v, np.zeros_like(x), length, width)


def told(trace: Trace) -> str:
    return describe_conflict_type(conflict_type()(trace))


@pytest.mark.parametrize("closing", [1.0, 3.2, 4.0, 9.0, 14.0])
@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0])
def test_who_is_straight_ahead_or_behind_is_not_beside_however_far_a_step_drives_them_into_each_other(closing, turn):
    """After a step of the default (Euler) they overlap by more than their width: one failure was two modes."""
    cos, sin = np.cos(turn), np.sin(turn)

    def along(*at, back=False):
        return [(cos * d, sin * d, turn + np.pi * back) for d in at]

    gap = 5.25
    ahead = met(along(0.0, closing), along(gap, gap), speeds=(30.0, 10.0))
    oncoming = met(along(0.0, closing), along(gap, gap - 2.0, back=True), speeds=(30.0, 10.0))
    behind = met(along(gap, gap), along(0.0, closing), speeds=(10.0, 30.0))
    assert [told(trace) for trace in (ahead, oncoming, behind)] == [
        "ahead of ego, same direction", "ahead of ego, oncoming", "behind ego, same direction"
    ]  # fmt: skip
    assert [from_behind(t.actor("ego"), t.actor("co")) for t in (ahead, oncoming, behind)] == [False, False, True]
    assert why_not(applicability()(ahead)) == ""
    assert "from behind" in why_not(applicability()(behind))


def test_who_comes_from_the_side_is_beside():
    stays = [(0.0, 0.0, 0.0)] * 2
    for y, side in ((3.5, "left"), (-3.5, "right")):
        assert told(met(stays, [(0.5, y, 0.0), (0.5, 0.1 * y, 0.0)], speeds=(30.0, 30.0))) == f"{side} of ego, same direction"
    crossing = met(stays, [(0.0, -6.0, np.pi / 2), (0.0, 1.0, np.pi / 2)], speeds=(10.0, 14.0))
    assert told(crossing) == "right of ego, crossing from the right"


def test_who_has_been_passed_through_when_a_contact_ends_the_record_was_ahead():
    """A person who crosses is 15 m further within a step of a second: before the bumper at first, behind the car then."""
    person = [(8.0, -0.5, np.pi / 2), (8.0, 0.9, np.pi / 2)]
    trace = met([(0.0, 0.0, 0.0), (15.0, 0.0, 0.0)], person, speeds=(15.0, 1.4), sizes=((5.0, 1.8), (0.3, 0.5)), step=1.0)
    assert told(trace) == "ahead of ego, crossing from the right"


@pytest.mark.parametrize("decisive", [(), [(COLLISION, CriticalInterval(low=0.5))], [(TTC_2D_MIN, CriticalInterval(high=1.0))]])
@pytest.mark.parametrize("last", [30, 45, 60, 90, 150])
def test_the_side_of_a_contact_between_two_instants_does_not_depend_on_whether_the_record_goes_on(last, decisive):
    """Who was driven through within a step was nearest, and behind, at the next instant: the ego drove away from it."""
    rear_end = met([(d, 0.0, 0.0) for d in range(0, last + 1, 15)], [(24.0, 0.0, 0.0)] * (last // 15 + 1), speeds=(30.0, 0.0))
    found = conflict(rear_end, "ego", decisive)
    assert found is not None
    assert found[3] == 2
    assert describe_conflict_type(conflict_type("ego", decisive)(rear_end)) == "ahead of ego, same direction"


def test_a_part_that_a_step_drives_the_ego_into_deeply_is_told_by_what_it_reached_first():
    straight = met([(0.0, 0.0, 0.0), (9.0, 0.0, 0.0)], [(13.0, 0.0, 0.0), (13.5, 0.0, 0.0)], sizes=((5.0, 1.8), (12.0, 1.8)))
    co, still = straight.actor("co"), np.zeros(2)
    parts = tuple(ActorTrace(co.x + at, still, still, still, still, 4.0, 1.8) for at in (4.0, 0.0, -4.0))
    found = conflict(replace(straight, parts={"co": parts}), "ego")
    assert found is not None
    assert found[2] is not parts[0]
    assert found[2].x[1] == parts[2].x[1], "the rear one"


def test_who_is_first_seen_within_another_is_where_it_came_from_at_its_speed():
    at, there = [(0.0, 0.0, 0.0)], [(2.0, 0.3, 0.0)]
    assert told(met(at, there, speeds=(20.0, 10.0))) == "ahead of ego, same direction"
    assert told(met(there, at, speeds=(10.0, 20.0))) == "behind ego, same direction"
    assert told(met(at, [(-1.0, 0.3, -np.pi / 2)], speeds=(0.5, 10.0))) == "left of ego, crossing from the left"
    assert told(met(at, [(1.0, 1.5, 0.0)], speeds=(10.0, 10.0))) == "left of ego, same direction", "by the lesser overlap"


@given(
    st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.floats(3.0, 40.0), st.floats(-1.5, 1.5), st.floats(0.02, 0.98),
    st.sampled_from([0.1, 0.5, 1.0]),
)  # fmt: skip
@settings(max_examples=200)
def test_the_side_of_a_contact_does_not_depend_on_when_the_instants_are(heading, bearing, closing, aside, phase, step):
    """The other comes on a straight line, with some offset: sampled finely, and at the instants of a step."""
    to = np.array([-np.cos(bearing), -np.sin(bearing)])
    offset = aside * np.array([to[1], -to[0]])

    def sampled(times):
        way = to[:, None] * closing * times + offset[:, None] * np.ones_like(times)
        still = np.zeros_like(times)
        poses = np.stack([still, still, still], axis=1), np.stack([*way, still + heading], axis=1)
        return met(*poses, speeds=(0.2, closing), step=step)

    begin = -10.0 / closing
    fine = sampled(np.arange(begin, -begin, 0.002 / closing))
    k = contact_index(fine.actor("ego"), fine.actor("co"))
    assume(k is not None)
    exact = fine.select(slice(k - 1, k + 1))
    moves = [np.array([[0.0, d], [0.0, e]]) for d in (-0.02, 0.02) for e in (-0.02, 0.02)]
    shifted = [told(replace(exact, x=exact.x + x, y=exact.y + y)) for x, y in moves]
    assume(len({*shifted, told(exact)}) == 1)  # not at a corner
    coarse = sampled((np.arange(-2, 1) + phase) * step + begin + k * 0.002 / closing)
    last = contact_index(coarse.actor("ego"), coarse.actor("co"))
    assert told(coarse.select(slice(0, (last or 2) + 1))) == told(exact)
