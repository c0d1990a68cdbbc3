"""Criticality metrics of the ego among any number of road users: the worst over all of them.

Runs with background traffic have different actors every time; these metrics refer to none of them by name.
"""

from __future__ import annotations

import numpy as np

from sbt.metrics.around import first_contacts, smallest_distance
from sbt.metrics.longitudinal import FAR, HORIZON, relative_speed_at_contact
from sbt.metrics.paths import HORIZON as PATH_HORIZON
from sbt.metrics.paths import smallest_ttc_on_paths, ttc_on_paths
from sbt.metrics.physics import persons
from sbt.metrics.planar import time_behind
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["any_collision", "any_impact_speed", "nearest_distance", "others_braking_max", "pet_ego_first", "ttc_path_min"]

def ttc_path_min(ego: str = "ego") -> Metric:
    """Return the smallest time to collision with any road user along the paths driven (s), 0 for a collision, at most 5."""
    return Metric(
        "ttc_path_min", lambda trace: smallest_ttc_on_paths(trace, ego), "s", "low", PATH_HORIZON,
        "smallest time until ego and anyone else would touch on the paths they drive at their present speeds",
        over_time=lambda trace: ttc_on_paths(trace, ego, None),
    )  # fmt: skip


def nearest_distance(ego: str = "ego") -> Metric:
    """Return the smallest distance to any road user (m), 0 for a collision, at most 1,000."""
    return Metric(
        "distance_min", lambda trace: smallest_distance(trace, ego), "m", "low", FAR,
        "smallest distance between ego's rectangle and anyone else's",
    )  # fmt: skip


def pet_ego_first(ego: str = "ego", horizon: float = HORIZON, zone: tuple[float, float, float] | None = None) -> Metric:
    """Return the smallest post-encroachment time of a conflict that the ego passes first (s): 0 for a collision.

    Args:
        ego: the road user under test.
        horizon: value if no other road user follows within this time (s); runs should go on this long after the conflict.
        zone: x, y and radius of a circle (m) in which the ego must be; None: anywhere.
    """
    return Metric(
        "pet_ego_first", lambda trace: time_behind(trace, ego, None, horizon, zone), "s", "low", horizon,
        "smallest time between ego leaving a spot and anyone else reaching it",
        "after Allen, Shin and Cooper (1978), Analysis of traffic conflicts and collisions", lagged=True,
    )  # fmt: skip


def any_collision(ego: str = "ego") -> Metric:
    """Return 1 if the ego touched any road user, else 0."""
    return Metric(
        "collision", lambda trace: float(bool(first_contacts(trace, ego))), "", "high", 0.0,
        "ego and anyone else touched",
    )  # fmt: skip


def any_impact_speed(ego: str = "ego") -> Metric:
    """Return the largest relative speed at the first contact of the ego with each road user (m/s), 0 without a contact."""
    def function(trace: Trace) -> float:
        return max((relative_speed_at_contact(trace, ego, other) for other in first_contacts(trace, ego)), default=0.0)

    return Metric(
        "impact_speed", function, "m/s", "high", 0.0,
        "relative speed at the first contact of ego and anyone else",
    )  # fmt: skip


def others_braking_max(ego: str = "ego") -> Metric:
    """Return the strongest deceleration of any other vehicle (m/s^2, positive), 0 without braking; persons halt in one step.

    Of one who touched the ego only what was before.
    """

    def function(trace: Trace) -> float:
        walking = persons(trace)
        others = [k for k, name in enumerate(trace.actors) if name != ego and not walking[k]]
        braking = -trace.acceleration
        for name, k in first_contacts(trace, ego).items():
            braking[k + 1 :, trace.actors.index(name)] = 0.0
        return float(np.nanmax(braking[:, others], initial=0.0)) + 0.0  # no -0

    return Metric(
        "others_braking_max", function, "m/s^2", "high", 0.0, "hardest braking of other vehicles: how much ego relies on them"
    )


OTHERS_BRAKING_MAX = others_braking_max()
PET_EGO_FIRST = pet_ego_first()
TTC_PATH_MIN = ttc_path_min()
