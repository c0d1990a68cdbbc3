"""Criticality metrics in the plane, for any two road users on any paths: 2-D TTC, distance, PET, severity.

All of them speak of two rectangles that may turn, and count a contact between two instants.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sbt.metrics.geometry import contact_index, contact_share, part, rectangle_distance, time_to_contact
from sbt.metrics.longitudinal import FAR, HORIZON, first_contact, impact_speed
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = [
    "distance", "distance_min", "pet", "post_encroachment_time", "severity", "time_behind", "ttc_2d",
    "ttc_2d_min",
]  # fmt: skip

_HALVINGS = 10
"""The PET is exact to the step of the trace divided by 2 to this power."""


def _touched(trace: Trace, ego: str, other: str, values: Vector) -> Vector:
    """Return (t,) values that are 0 at the first contact, which may have been before that instant."""
    k = first_contact(trace, ego, other)
    if k is not None:
        values[k] = 0.0
    return values


def ttc_2d(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Vector:
    """Return the (t,) time until the rectangles touch if both go straight on at their speeds (s), at most 10."""
    a, b = trace.actor(ego), trace.actor(other)
    return _touched(trace, ego, other, np.minimum(time_to_contact(a, b), HORIZON))


def ttc_2d_min(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest 2-D time to collision (s), 0 for a collision, 10 where their courses do not meet by then."""
    return Metric(
        "ttc_2d_min", lambda trace: float(ttc_2d(trace, ego, other).min()), "s", "low", HORIZON,
        "smallest time until the rectangles would touch at constant speeds and headings",
        "swept separating axes, Ericson (2005), Real-Time Collision Detection, 5.5.8",
    )  # fmt: skip


def distance(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Vector:
    """Return the (t,) distance between the rectangles (m), at most 1,000, 0 where they overlap."""
    values = rectangle_distance(trace.actor(ego), trace.actor(other))
    return _touched(trace, ego, other, np.minimum(values, FAR))


def distance_min(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance between the rectangles (m), 0 for a collision, at most 1,000."""
    return Metric(
        "distance_min", lambda trace: float(distance(trace, ego, other).min()), "m", "low", FAR,
        "smallest Euclidean distance between the rectangles",
    )  # fmt: skip


def severity(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance (m) or, after a collision, minus the impact speed (m/s).

    It goes on past the crash, where distances saturate: what a metamodel can learn. The two units meet
    at 0 in a touch without relative speed.
    """
    impact = impact_speed(ego, other)

    def function(trace: Trace) -> float:
        if first_contact(trace, ego, other) is not None:
            return 0.0 - impact(trace)
        return float(distance(trace, ego, other).min())

    return Metric("severity", function, "m; -m/s", "low", FAR, "smallest distance, or minus the impact speed where they collide")


def post_encroachment_time(trace: Trace, ego: str = "ego", other: str = "co") -> float:
    """Return the smallest time between one road user leaving a spot and the other reaching it (s), at most 10.

    Computed as the smallest shift in time of one of the two with which the rectangles would touch: the
    shifts grow step by step until the swept rectangles meet (`contact_index`), and the last step is
    halved down to step / 1,024. 0 for a collision. Only what is in the trace counts.

    Where straight paths cross at right angles this is the time from the first leaving the conflict area
    of both paths to the second entering it (at an acute angle the conflict area is emptied later and
    entered earlier than any one spot of it, and its PET is smaller). Behind one another on one path it
    is the time gap, which a conflict area does not have.
    """
    a, b = trace.actor(ego), trace.actor(other)
    n = len(trace.time)
    if first_contact(trace, ego, other) is not None:
        return 0.0
    if n < 2 or not _paths_near(a, b):
        return HORIZON
    step = float(trace.time[-1] - trace.time[0]) / (n - 1)
    for k in range(1, min(n - 1, int(HORIZON / step)) + 1):
        found = [sign for sign in (1, -1) if _meet(*_shifted(a, b, sign * k))]
        if found:
            return min(HORIZON, step * min(_halved(a, b, sign, k) for sign in found))
    return HORIZON


def time_behind(
    trace: Trace, ego: str = "ego", other: str = "co", horizon: float = HORIZON, zone: tuple[float, float, float] | None = None
) -> float:
    """Return how soon the other comes where ego has been: the PET with ego first (s), at most `horizon`; 0 for a collision.

    As `post_encroachment_time`, but waiting until someone has passed and driving right behind counts
    nothing: only who takes a spot before another does leaves that other a time.

    Args:
        trace: the run.
        ego: who is first.
        other: who comes after.
        horizon: the value where the other comes there no sooner (s).
        zone: x, y and radius of a circle (m); only where ego's centre was in it counts. None: everywhere.
    """
    a, b = trace.actor(ego), trace.actor(other)
    if first_contact(trace, ego, other) is not None:
        return 0.0
    inside = np.arange(len(a.x)) if zone is None else np.flatnonzero(np.hypot(a.x - zone[0], a.y - zone[1]) <= zone[2])
    if inside.size < 2 or not _paths_near(a, b):
        return horizon
    first, n = int(inside[0]), int(inside[-1]) + 1 - int(inside[0])
    a, b = part(a, slice(first, first + n)), part(b, slice(first, None))
    step = float(trace.time[-1] - trace.time[0]) / (len(trace.time) - 1)
    k = _first_shift(a, b, min(len(b.x) - 1, math.ceil(horizon / step)))
    if k is None:
        return horizon
    apart, touching = k - 1.0, float(k)
    for _ in range(_HALVINGS):
        middle = 0.5 * (apart + touching)
        apart, touching = (apart, middle) if _meet(*_behind(a, b, middle)) else (middle, touching)
    return min(horizon, step * touching)


def _behind(a: ActorTrace, b: ActorTrace, shift: float) -> tuple[ActorTrace, ActorTrace]:
    """Return the first n instants of a, and b so many steps later, as far as it is recorded."""
    padded = part(b, slice(len(a.x) + int(shift) + 1))
    _, there = _shifted(padded, padded, shift)
    n = min(len(a.x), len(there.x))
    return part(a, slice(n)), part(there, slice(n))


def _first_shift(a: ActorTrace, b: ActorTrace, most: int) -> int | None:
    """Return in how many steps, 1 to `most`, b first touches where a was; None: not by then.

    Circles tell which instants of both to look at, and how far they move in a step.
    """
    moved = sum(float(np.hypot(np.diff(c.x), np.diff(c.y)).max(initial=0.0)) for c in (a, b))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + moved
    near = (b.x[None, :] - a.x[:, None]) ** 2 + (b.y[None, :] - a.y[:, None]) ** 2 <= reach**2  # (t, t)
    i, j = np.nonzero(near)
    soon = (j > i) & (j - i <= most)
    i, j = i[soon], j[soon]
    start = np.maximum(i - 1, 0)  # no step leads to the first instant
    there = start + j - i
    hits = np.isfinite(contact_share(part(a, i), part(b, j), b.x[there] - a.x[start], b.y[there] - a.y[start]))
    return int((j - i)[hits].min()) if hits.any() else None


def _halved(a: ActorTrace, b: ActorTrace, sign: int, k: int) -> float:
    """Return the shift in (k - 1, k] steps from which on the rectangles touch."""
    apart, touching = k - 1.0, float(k)
    for _ in range(_HALVINGS):
        middle = 0.5 * (apart + touching)
        if _meet(*_shifted(a, b, sign * middle)):
            touching = middle
        else:
            apart = middle
    return touching


def _meet(a: ActorTrace, b: ActorTrace) -> bool:
    return contact_index(a, b) is not None


def _shifted(a: ActorTrace, b: ActorTrace, shift: float) -> tuple[ActorTrace, ActorTrace]:
    """Return the parts that meet where b comes `shift` steps earlier (later, if negative)."""
    if shift < 0:
        later, earlier = _shifted(b, a, -shift)
        return earlier, later
    whole, share = int(shift), shift - int(shift)
    n = len(a.x) - whole - (share > 0)
    here, there = part(a, slice(n)), part(b, slice(whole, whole + n))
    if share == 0:
        return here, there
    after = part(b, slice(whole + 1, whole + 1 + n))
    turn = after.heading - there.heading
    return here, replace(
        there,
        x=there.x + share * (after.x - there.x),
        y=there.y + share * (after.y - there.y),
        heading=there.heading + share * np.arctan2(np.sin(turn), np.cos(turn)),
    )


def _paths_near(a: ActorTrace, b: ActorTrace) -> bool:
    """Return whether the boxes around both paths overlap."""
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
    return all(u.min() - reach <= v.max() and v.min() - reach <= u.max() for u, v in ((a.x, b.x), (a.y, b.y)))


def pet(ego: str = "ego", other: str = "co") -> Metric:
    """Return the post-encroachment time (s), 0 for a collision, 10 where neither comes where the other was by then."""
    return Metric(
        "pet", lambda trace: post_encroachment_time(trace, ego, other), "s", "low", HORIZON,
        "smallest time between one leaving a spot and the other reaching it",
        "after Allen, Shin and Cooper (1978), Analysis of traffic conflicts and collisions",
    )  # fmt: skip


TTC_2D_MIN = ttc_2d_min()
DISTANCE_MIN = distance_min()
SEVERITY = severity()
PET = pet()
