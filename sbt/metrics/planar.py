"""Criticality metrics in the plane, for two road users on any paths: 2-D TTC, distance, PET, severity.

All of them are computed for rectangles that may turn, and account for contacts between two instants.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.metrics.arcs import is_coarse
from sbt.metrics.around import first_contacts
from sbt.metrics.geometry import rectangle_distance, select_instants, time_to_contact
from sbt.metrics.longitudinal import FAR, HORIZON, first_contact, relative_speed_at_contact
from sbt.metrics.nearest import least_distance
from sbt.metrics.shifts import evenly, least_shift, near_paths, paths_near
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = [
    "distance", "distance_min", "pet", "post_encroachment_time", "severity", "time_behind", "ttc_2d",
    "ttc_2d_min",
]  # fmt: skip


def _zero_at_contact(trace: Trace, ego: str, other: str, values: Vector) -> Vector:
    """Return the (t,) values with 0 at the instant of the first contact, which may lie within the step before it."""
    k = first_contact(trace, ego, other)
    if k is not None:
        values[k] = 0.0
    return values


def ttc_2d(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Vector:
    """Return the (t,) time until the rectangles touch at constant speeds and headings (s), at most 10."""
    a, b = trace.actor(ego), trace.actor(other)
    return _zero_at_contact(trace, ego, other, np.minimum(time_to_contact(a, b), HORIZON))


def ttc_2d_min(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest 2-D time to collision (s), 0 for a collision, at most 10."""
    return Metric(
        "ttc_2d_min", lambda trace: float(ttc_2d(trace, ego, other).min()), "s", "low", HORIZON,
        "smallest time until the rectangles would touch at constant speeds and headings",
        "swept separating axes, Ericson (2005), Real-Time Collision Detection, 5.5.8",
    )  # fmt: skip


def distance(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Vector:
    """Return the (t,) distance between the rectangles (m), at most 1,000, 0 where they overlap."""
    values = rectangle_distance(trace.actor(ego), trace.actor(other))
    return _zero_at_contact(trace, ego, other, np.fmin(values, FAR))


def distance_min(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance between the rectangles (m), 0 for a collision, at most 1,000."""
    return Metric(
        "distance_min", lambda trace: _smallest_distance(trace, ego, other), "m", "low", FAR,
        "smallest Euclidean distance between the rectangles, also between instants",
    )  # fmt: skip


def _smallest_distance(trace: Trace, ego: str, other: str) -> float:
    if first_contact(trace, ego, other) is not None:
        return 0.0
    return least_distance(trace.actor(ego), trace.actor(other), FAR)


def severity(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance (m) or, for a collision, the negative impact speed (m/s).

    Unlike a distance, it distinguishes collisions by their severity, which a metamodel can learn. The two parts
    meet at 0: a contact without relative speed.
    """

    def function(trace: Trace) -> float:
        if first_contact(trace, ego, other) is not None:
            return 0.0 - relative_speed_at_contact(trace, ego, other)
        return _smallest_distance(trace, ego, other)

    return Metric("severity", function, "m; -m/s", "low", FAR, "smallest distance, or minus the impact speed where they collide")


def post_encroachment_time(trace: Trace, ego: str = "ego", other: str = "co") -> float:
    """Return the smallest time between one road user leaving a spot and the other reaching it (s), at most 10.

    Computed as the smallest time shift of one of the two with which the rectangles would touch: the smallest number
    of steps with which they do while they move, and then refined to step / 1,024. Where one of them drives farther than
    its length in a step, parts of steps in which neither does so are tried, too: two that cross touch with shifts
    over more than that. 0 for a collision. Only the recorded trace counts.

    For straight paths that cross at right angles this is the time from the first road user leaving the conflict
    area to the second one entering it. (At an acute angle the conflict area is left later and entered earlier than
    any spot in it, and the PET of the conflict area is smaller.) For road users that follow each other it is the
    time gap, for which there is no conflict area.
    """
    if first_contact(trace, ego, other) is not None:
        return 0.0
    if len(trace.time) < 2:
        return HORIZON
    (a, b), step = evenly(trace, [trace.actor(ego), trace.actor(other)])
    if not paths_near(a, b):
        return HORIZON
    limit = min(len(a.x) - 1, int(HORIZON / step))
    arcs = is_coarse(step)
    return min(HORIZON, step * min(least_shift(own, [later], limit, arcs=arcs) for own, later in ((a, b), (b, a))))


def time_behind(
    trace: Trace, ego: str = "ego", other: str | None = "co", horizon: float = HORIZON,
    zone: tuple[float, float, float] | None = None,
) -> float:  # fmt: skip
    """Return the post-encroachment time of conflicts that the ego passes first (s), at most `horizon`; 0 for a collision.

    Like `post_encroachment_time`, but an ego that waits until the other has passed and then follows closely is not
    in conflict.

    Args:
        trace: of the run.
        ego: the road user that passes first.
        other: the road user that follows; None: anyone, the soonest counts.
        horizon: value if the other does not follow within this time (s).
        zone: x, y and radius of a circle (m) in which the ego's centre must be; None: anywhere.
    """
    touched = first_contacts(trace, ego) if other is None else first_contact(trace, ego, other) is not None
    if touched:
        return 0.0
    if len(trace.time) < 2:
        return horizon
    others = near_paths(trace, ego, horizon) if other is None else [other]
    (a, *following), step = evenly(trace, [trace.actor(name) for name in (ego, *others)])
    inside = np.arange(len(a.x)) if zone is None else np.flatnonzero(np.hypot(a.x - zone[0], a.y - zone[1]) <= zone[2])
    if inside.size < 2:
        return horizon
    first, n = int(inside[0]), int(inside[-1]) + 1 - int(inside[0])
    own = select_instants(a, slice(first, first + n))
    later = [select_instants(b, slice(first, None)) for b in following if other is None or paths_near(a, b)]
    limit = min(len(a.x) - first - 1, math.ceil(horizon / step))
    return min(horizon, step * least_shift(own, later, limit, arcs=is_coarse(step)))


def pet(ego: str = "ego", other: str = "co") -> Metric:
    """Return the post-encroachment time (s), 0 for a collision, at most 10."""
    return Metric(
        "pet", lambda trace: post_encroachment_time(trace, ego, other), "s", "low", HORIZON,
        "smallest time between one leaving a spot and the other reaching it",
        "after Allen, Shin and Cooper (1978), Analysis of traffic conflicts and collisions", lagged=True,
    )  # fmt: skip


TTC_2D_MIN = ttc_2d_min()
DISTANCE_MIN = distance_min()
SEVERITY = severity()
PET = pet()
