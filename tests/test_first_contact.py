"""Metrics of two road users at their first contact: at it, between two instants or not, and after it, in records that go on."""

from __future__ import annotations

import numpy as np
import pytest

from sbt.metrics.braking import btn_max, drac, mttc_min
from sbt.metrics.longitudinal import d_min, drac_max, first_contact, impact_speed, thw_min, ttc_min
from sbt.metrics.rss import rss_lateral_min, rss_longitudinal_min
from sbt.metrics.signals import signal
from sbt.metrics.traffic import others_braking_max
from sbt.problem.trace import Trace

CAR, PERSON = (5.0, 1.8), (0.215, 0.478)
STEPS = (0.05, 0.1, 0.2, 0.5, 1.0)


def rear_end(step: float, size: tuple[float, float] = CAR, speed: float = 20.0, until: float = 6.0) -> Trace:
    """Ego drives through one who stands, whom it reaches after 3.1 s."""
    time = np.arange(0.0, until + 1e-9, step)
    zero = np.zeros_like(time)
    x = np.column_stack([speed * time, zero + 3.1 * speed + 0.5 * (CAR[0] + size[0])])
    still = np.column_stack([zero, zero])
    length, width = np.array([CAR, size]).T
    return Trace(time, ("ego", "co"), x, still, still, np.column_stack([zero + speed, zero]), still, length, width)


@pytest.mark.parametrize("size", [CAR, PERSON])
@pytest.mark.parametrize("speed", [20.0, 30.0])
@pytest.mark.parametrize("step", STEPS)
def test_a_rear_end_collision_has_no_time_and_no_gap_left_however_far_the_step_goes(step, speed, size):
    """Where the ego was past the other at the next instant, the smallest TTC was .1 s and the smallest gap 2 m."""
    trace = rear_end(step, size, speed)
    assert impact_speed()(trace) == speed
    metrics = {"ttc": ttc_min(), "gap": d_min(), "thw": thw_min(), "mttc": mttc_min()}
    assert {name: metric(trace) for name, metric in metrics.items()} == dict.fromkeys(metrics, 0.0)
    for name, metric in metrics.items():
        assert metric(trace) == signal(trace, name).min()
    assert drac_max()(trace) == drac(trace, "ego", "co", 0.0).max() == 100.0
    assert btn_max()(trace) == 12.5


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("size", [CAR, PERSON])
def test_the_margins_of_rss_end_at_the_contact(step, size):
    """Those of an ego that was beside the other only after it had driven through it were those of passing it."""
    whole = rear_end(step, size)
    k = first_contact(whole, "ego", "co")
    ended = whole.select(slice(0, k + 1))
    for metric in (rss_longitudinal_min(), rss_lateral_min()):
        assert metric(whole) == metric(ended), metric.name
    for name in ("rss_longitudinal", "rss_lateral"):
        values = signal(whole, name)
        assert values[: k + 1].tolist() == signal(ended, name).tolist()
        assert (values[k:] == values[k]).all()


def test_braking_of_who_was_hit_is_none_that_the_ego_relies_on():
    whole = rear_end(0.1, speed=20.0)
    k = first_contact(whole, "ego", "co")
    time, late = whole.time, np.arange(len(whole.time))
    for start, found in ((k - 3, 9.0), (k, 9.0), (k + 1, 2.0)):
        hit = np.where(late >= start, -9.0, 0.0)
        third = np.column_stack([np.zeros_like(hit), hit, np.where(late == len(late) - 1, -2.0, 0.0)])
        x = np.column_stack([whole.x, whole.x[:, 0]])
        y = np.column_stack([whole.y, whole.y[:, 0] + 9.0])
        heading = np.zeros_like(x)
        trace = Trace(time, ("ego", "co", "other"), x, y, heading, heading, third, np.full(3, 5.0), np.full(3, 1.8))
        assert others_braking_max()(trace) == found
        assert trace.acceleration.min() == -9.0
