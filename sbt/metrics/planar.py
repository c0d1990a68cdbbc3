"""Criticality metrics in the plane, for two road users on any paths: 2-D TTC, distance, PET, severity.

All of them are computed for rectangles that may turn, and account for contacts between two instants.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sbt.metrics.around import around, first_contacts
from sbt.metrics.geometry import contact_index, contact_share, part_pairs, rectangle_distance, select_instants, time_to_contact
from sbt.metrics.longitudinal import FAR, HORIZON, first_contact, relative_speed_at_contact
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = [
    "distance", "distance_min", "pet", "post_encroachment_time", "severity", "time_behind", "ttc_2d",
    "ttc_2d_min",
]  # fmt: skip

_BLOCK = 8
"""Instants that are first looked at together."""
_BISECTIONS = 10
"""The PET is accurate to the step of the trace divided by 2 to this power."""


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
    return _zero_at_contact(trace, ego, other, np.minimum(values, FAR))


def distance_min(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance between the rectangles (m), 0 for a collision, at most 1,000."""
    return Metric(
        "distance_min", lambda trace: float(distance(trace, ego, other).min()), "m", "low", FAR,
        "smallest Euclidean distance between the rectangles",
    )  # fmt: skip


def severity(ego: str = "ego", other: str = "co") -> Metric:
    """Return the smallest distance (m) or, for a collision, the negative impact speed (m/s).

    Unlike a distance, it distinguishes collisions by their severity, which a metamodel can learn. The two parts
    meet at 0: a contact without relative speed.
    """

    def function(trace: Trace) -> float:
        if first_contact(trace, ego, other) is not None:
            return 0.0 - relative_speed_at_contact(trace, ego, other)
        return float(distance(trace, ego, other).min())

    return Metric("severity", function, "m; -m/s", "low", FAR, "smallest distance, or minus the impact speed where they collide")


def post_encroachment_time(trace: Trace, ego: str = "ego", other: str = "co") -> float:
    """Return the smallest time between one road user leaving a spot and the other reaching it (s), at most 10.

    Computed as the smallest time shift of one of the two with which the rectangles would touch: the shift is
    increased step by step until the swept rectangles touch (`contact_index`), and then refined by bisection to
    step / 1,024. 0 for a collision. Only the recorded trace counts.

    For straight paths that cross at right angles this is the time from the first road user leaving the conflict
    area to the second one entering it. (At an acute angle the conflict area is left later and entered earlier than
    any spot in it, and the PET of the conflict area is smaller.) For road users that follow each other it is the
    time gap, for which there is no conflict area.
    """
    a, b = trace.actor(ego), trace.actor(other)
    n = len(trace.time)
    if first_contact(trace, ego, other) is not None:
        return 0.0
    if n < 2 or not _paths_near(a, b):
        return HORIZON
    step = float(trace.time[-1] - trace.time[0]) / (n - 1)
    for k in range(1, min(n - 1, int(HORIZON / step)) + 1):
        found = [sign for sign in (1, -1) if _meet_shifted(a, b, sign, k)]
        if found:
            return min(HORIZON, step * min(_bisected(k, partial(_meet_shifted, a, b, sign)) for sign in found))
    return HORIZON


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
    a = trace.actor(ego)
    inside = np.arange(len(a.x)) if zone is None else np.flatnonzero(np.hypot(a.x - zone[0], a.y - zone[1]) <= zone[2])
    if inside.size < 2:
        return horizon
    first, n = int(inside[0]), int(inside[-1]) + 1 - int(inside[0])
    step = float(trace.time[-1] - trace.time[0]) / (len(trace.time) - 1)
    least = horizon
    others = _near_paths(trace, ego, math.ceil(horizon / step)) if other is None else [other]
    for name in others:  # larger times than the least so far do not matter
        b = trace.actor(name)
        if other is None or _paths_near(a, b):
            own, later = select_instants(a, slice(first, first + n)), select_instants(b, slice(first, None))
            k = _smallest_shift(own, later, min(len(later.x) - 1, math.ceil(least / step)))
            if k is not None:
                least = min(least, step * _bisected(k, _behind(own, later, k)))
    return least


def _near_paths(trace: Trace, ego: str, horizon: int) -> list[str]:
    """Return who may come within reach of where the ego was up to so many instants before, those who come nearest first."""
    seen, own = around(trace, ego), trace.actors.index(ego)
    blocks = np.arange(0, len(trace.time), _BLOCK)
    low, high = (np.stack([each.reduceat(s, blocks, axis=0) for s in (trace.x, trace.y)]) for each in (np.fmin, np.fmax))
    moved = np.fmax.reduce(np.hypot(trace.x[1:] - trace.x[:-1], trace.y[1:] - trace.y[:-1]), axis=0, initial=0.0)
    reach = seen.reach + moved + moved[own]
    near = np.zeros(len(trace.actors), dtype=bool)
    for k in range(min(len(blocks), -(-horizon // _BLOCK) + 2)):
        n = len(blocks) - k
        before = low[:, :n, own : own + 1], high[:, :n, own : own + 1]
        near |= ((low[:, k:] <= before[1] + reach) & (before[0] <= high[:, k:] + reach)).all(axis=0).any(axis=0)
    return [trace.actors[k] for k in seen.others if near[k]]


def _behind(a: ActorTrace, b: ActorTrace, k: int) -> Callable[[float], bool]:
    """Return whether a and b touch if b comes a number of steps in (k - 1, k) earlier, as a function of this number."""
    tests = [_rectangle_behind(p, q, k) for p, q in part_pairs(a, b)]
    return lambda shift: any(test(shift) for test in tests)


def _rectangle_behind(a: ActorTrace, b: ActorTrace, k: int) -> Callable[[float], bool]:
    """Return `_behind` for rectangles; circles around them select the instants."""
    n = min(len(a.x), len(b.x) - k)
    old, new = select_instants(b, slice(k - 1, k - 1 + n)), select_instants(b, slice(k, k + n))
    a = select_instants(a, slice(n))
    span = max(float(np.hypot(c.x[1:] - c.x[:-1], c.y[1:] - c.y[:-1]).max(initial=0.0)) for c in (a, old, new))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + 3.0 * span
    rows = np.flatnonzero(np.hypot(new.x - a.x, new.y - a.y) <= reach)
    before = np.maximum(rows - 1, 0)
    here, start = select_instants(a, rows), select_instants(a, before)
    ends, starts = ((select_instants(old, i), select_instants(new, i)) for i in (rows, before))

    def touches(shift: float) -> bool:
        share = shift - (k - 1)
        end, begin = _between(*ends, share), _between(*starts, share)
        return bool(np.isfinite(contact_share(here, end, begin.x - start.x, begin.y - start.y)).any())

    return touches


def _smallest_shift(a: ActorTrace, b: ActorTrace, limit: int) -> int | None:
    """Return the smallest number of steps, 1 to `limit`, by which b must come earlier to touch a; None if there is none.

    Circles around the rectangles, enlarged by the motion in a step, select the pairs of instants to be tested.
    """
    if a.parts or b.parts:
        return min((k for p, q in part_pairs(a, b) if (k := _smallest_shift(p, q, limit)) is not None), default=None)
    if limit < 1:
        return None
    steps = [(u[1:] - u[:-1], v[1:] - v[:-1]) for u, v in ((a.x, b.x), (a.y, b.y))]
    moved = np.hypot(*(max(v.max() - u.min(), u.max() - v.min()) for u, v in steps))  # the most, relative to each other
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + moved
    dx, dy = (_later(v, len(u), limit) - u[:, None] for u, v in ((a.x, b.x), (a.y, b.y)))  # (t, limit)
    i, shift = (dx * dx + dy * dy <= reach * reach).nonzero()
    before = np.maximum(i - 1, 0)  # no step leads to the first instant
    ends = select_instants(a, i), select_instants(b, i + shift + 1)
    hits = np.isfinite(contact_share(*ends, dx[before, shift], dy[before, shift]))
    return int(shift[hits].min()) + 1 if hits.any() else None


def _later(values: Vector, n: int, limit: int) -> np.ndarray:
    """Return the values 1 to `limit` instants after each of n, (n, limit); inf after the last one."""
    padded = np.full(n + limit, np.inf)
    known = values[1 : n + limit]
    padded[: len(known)] = known
    return sliding_window_view(padded, limit)[:n]


def _bisected(k: int, meets: Callable[[float], bool]) -> float:
    """Return the smallest shift in (k - 1, k] steps with which the rectangles touch; they do with k."""
    apart, touching = k - 1.0, float(k)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (apart + touching)
        if meets(middle):
            touching = middle
        else:
            apart = middle
    return touching


def _meet_shifted(a: ActorTrace, b: ActorTrace, sign: int, shift: float) -> bool:
    return contact_index(*_shifted(a, b, sign * shift)) is not None


def _shifted(a: ActorTrace, b: ActorTrace, shift: float) -> tuple[ActorTrace, ActorTrace]:
    """Return the common instants of a and b if b comes `shift` steps earlier (later, if negative)."""
    if shift < 0:
        later, earlier = _shifted(b, a, -shift)
        return earlier, later
    whole, share = int(shift), shift - int(shift)
    n = len(a.x) - whole - (share > 0)
    own, other = select_instants(a, slice(n)), select_instants(b, slice(whole, whole + n))
    if share == 0:
        return own, other
    return own, _between(other, select_instants(b, slice(whole + 1, whole + 1 + n)), share)


def _between(actor: ActorTrace, after: ActorTrace, share: float) -> ActorTrace:
    """Return an actor between two states of each instant, at a share of the way."""
    turn = after.heading - actor.heading
    return replace(
        actor,
        x=actor.x + share * (after.x - actor.x),
        y=actor.y + share * (after.y - actor.y),
        heading=actor.heading + share * np.arctan2(np.sin(turn), np.cos(turn)),
        parts=tuple(_between(p, q, share) for p, q in zip(actor.parts, after.parts, strict=True)),
    )


def _paths_near(a: ActorTrace, b: ActorTrace) -> bool:
    """Return whether the bounding boxes of the two paths overlap."""
    if a.parts or b.parts:
        return any(_paths_near(p, q) for p, q in part_pairs(a, b))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
    return all(u.min() - reach <= v.max() and v.min() - reach <= u.max() for u, v in ((a.x, b.x), (a.y, b.y)))


def pet(ego: str = "ego", other: str = "co") -> Metric:
    """Return the post-encroachment time (s), 0 for a collision, at most 10."""
    return Metric(
        "pet", lambda trace: post_encroachment_time(trace, ego, other), "s", "low", HORIZON,
        "smallest time between one leaving a spot and the other reaching it",
        "after Allen, Shin and Cooper (1978), Analysis of traffic conflicts and collisions",
    )  # fmt: skip


TTC_2D_MIN = ttc_2d_min()
DISTANCE_MIN = distance_min()
SEVERITY = severity()
PET = pet()
