"""Criticality metrics of the ego among many: the worst over all other actors, whoever they are.

A run with background traffic has other actors every time; these metrics name none of them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.metrics.conflict import distance, time_behind
from sbt.metrics.longitudinal import FAR, HORIZON, first_contact, impact_speed
from sbt.metrics.paths import HORIZON as CONFLICT
from sbt.metrics.paths import ttc_on_paths
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["nearest_distance", "nearest_ttc", "others_braking", "struck", "struck_speed", "time_left"]

Pairwise = Callable[[Trace, str, str], float]


def _over_all(pairwise: Pairwise, ego: str, worst: Callable[[list[float]], float], without: float) -> Callable[[Trace], float]:
    """Return the worst of a pairwise metric over all other actors, `without` where there are none."""

    def function(trace: Trace) -> float:
        values = [pairwise(trace, ego, other) for other in trace.actors if other != ego]
        return worst(values) if values else without

    return function


def nearest_ttc(ego: str = "ego") -> Metric:
    """Return the smallest time to collision with anyone along the paths driven (s): 0 for a collision, 5 without a conflict."""

    def over_time(trace: Trace) -> Vector:
        times = np.full(len(trace.time), CONFLICT)
        for other in trace.actors:
            if other != ego:
                np.minimum(times, ttc_on_paths(trace, ego, other), out=times)
        return times

    return Metric(
        "ttc_path_min", lambda trace: float(over_time(trace).min()), "s", "low", CONFLICT,
        "smallest time until ego and anyone else would touch on the paths they drive at their present speeds",
        over_time=over_time,
    )  # fmt: skip


def nearest_distance(ego: str = "ego") -> Metric:
    """Return the smallest distance to anyone (m), 0 for a collision, at most 1,000."""
    return Metric(
        "distance_min", _over_all(lambda t, a, b: float(distance(t, a, b).min()), ego, min, FAR), "m", "low", FAR,
        "smallest distance between ego's rectangle and anyone else's",
    )  # fmt: skip


def time_left(ego: str = "ego", horizon: float = HORIZON, zone: tuple[float, float, float] | None = None) -> Metric:
    """Return the smallest time after which anyone comes where ego has been (s): 0 for a collision.

    Args:
        ego: whose conflicts.
        horizon: the value where nobody comes there by then (s); run so long after the last conflict.
        zone: x, y and radius of a circle (m): only where ego was in it counts; None: everywhere.
    """
    def function(trace: Trace) -> float:
        least = horizon
        for other in trace.actors:  # what came before need not be looked for again
            least = least if other == ego else time_behind(trace, ego, other, least, zone)
        return least

    return Metric(
        "pet_ego_first", function, "s", "low", horizon,
        "smallest time between ego leaving a spot and anyone else reaching it",
        "after Allen, Shin and Cooper (1978), Analysis of traffic conflicts and collisions",
    )  # fmt: skip


def struck(ego: str = "ego") -> Metric:
    """Return 1 where ego touched anyone, else 0."""
    return Metric(
        "collision", _over_all(lambda t, a, b: float(first_contact(t, a, b) is not None), ego, max, 0.0), "", "high", 0.0,
        "ego and anyone else touched",
    )  # fmt: skip


def struck_speed(ego: str = "ego") -> Metric:
    """Return the relative speed at ego's first contact with anyone (m/s), 0 without one."""
    return Metric(
        "impact_speed", _over_all(lambda t, a, b: impact_speed(a, b)(t), ego, max, 0.0), "m/s", "high", 0.0,
        "relative speed at the first contact of ego and anyone else",
    )  # fmt: skip


def others_braking(ego: str = "ego") -> Metric:
    """Return the hardest braking of anyone but ego (m/s^2, positive), 0 without any."""

    def function(trace: Trace) -> float:
        others = [k for k, name in enumerate(trace.actors) if name != ego]
        return max(0.0, float(-trace.acceleration[:, others].min())) if others else 0.0

    return Metric(
        "others_braking_max", function, "m/s^2", "high", 0.0, "hardest braking of anyone but ego: how much ego relies on them"
    )


OTHERS_BRAKING_MAX = others_braking()
PET_EGO_FIRST = time_left()
TTC_PATH_MIN = nearest_ttc()
