"""Whom a failure is about, among several road users: whose sole presence makes the metric what it is, not who is nearest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sbt.metrics.conflict_types import conflict, conflict_type, describe_conflict_type
from sbt.metrics.pairwise import in_traffic
from sbt.metrics.planar import TTC_2D_MIN
from sbt.metrics.preventability import applicability, why_not
from sbt.metrics.stl import stl
from sbt.metrics.traffic import ttc_path_min
from sbt.problem.metric import Metric
from sbt.problem.requirement import CriticalInterval
from sbt.problem.trace import Trace

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
