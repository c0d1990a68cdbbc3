"""Criticality metrics in the plane, for two road users on any paths: 2-D TTC, distance, PET, severity.

All of them are computed for rectangles that may turn, and account for contacts between two instants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sbt.metrics.arcs import at_times, finer, parts_of_turns
from sbt.metrics.around import around, first_contacts
from sbt.metrics.geometry import (
    Rectangles,
    contact_share,
    part_pairs,
    rectangle_distance,
    select_instants,
    time_to_contact,
)
from sbt.metrics.longitudinal import FAR, HORIZON, first_contact, relative_speed_at_contact
from sbt.metrics.nearest import least_distance
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = [
    "distance", "distance_min", "pet", "post_encroachment_time", "severity", "time_behind", "ttc_2d",
    "ttc_2d_min",
]  # fmt: skip

_BLOCK = 8
"""Instants that are first looked at together."""
_DIVISIONS = (16, 8, 8)
"""The PET is accurate to the step of the trace divided by the product of these."""
_FINEST = 64
"""Parts of a step, at most, in which shifts are looked for; a power of two, and a divisor of that product."""
_EVEN = 1e-3
"""Share of a step by which steps may differ before they are taken to be uneven: recorded traffic, with gaps."""
_STRIDE = 5
"""Shifts of which the middle one tells whether any of them may matter; an odd number."""
_SLACK = 1e-6
"""By how much farther apart than necessary those must be who are passed over (m)."""
_Pair = tuple[ActorTrace, ActorTrace]
_Poses = tuple[Vector, Vector, Vector]
"""(n,) x, y (m) and heading (rad)."""


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
    (a, b), step = _on_their_ways(trace, [trace.actor(ego), trace.actor(other)])
    if not _paths_near(a, b):
        return HORIZON
    limit = min(len(a.x) - 1, int(HORIZON / step))
    return min(HORIZON, step * min(_least_shift(own, [later], limit) for own, later in ((a, b), (b, a))))


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
    others = _near_paths(trace, ego, math.ceil(horizon / _step(trace))) if other is None else [other]
    (a, *following), step = _on_their_ways(trace, [trace.actor(name) for name in (ego, *others)])
    inside = np.arange(len(a.x)) if zone is None else np.flatnonzero(np.hypot(a.x - zone[0], a.y - zone[1]) <= zone[2])
    if inside.size < 2:
        return horizon
    first, n = int(inside[0]), int(inside[-1]) + 1 - int(inside[0])
    own = select_instants(a, slice(first, first + n))
    later = [select_instants(b, slice(first, None)) for b in following if other is None or _paths_near(a, b)]
    limit = min(len(a.x) - first - 1, math.ceil(horizon / step))
    return min(horizon, step * _least_shift(own, later, limit))


def _step(trace: Trace) -> float:
    """Return the mean step of a trace (s)."""
    return float(trace.time[-1] - trace.time[0]) / (len(trace.time) - 1)


def _on_their_ways(trace: Trace, actors: list[ActorTrace]) -> tuple[list[ActorTrace], float]:
    """Return actors at instants of even distance, between which none of them turns far, and the time between these (s)."""
    steps, step = np.diff(trace.time), _step(trace)
    if np.ptp(steps) > _EVEN * step:
        count = min(round(_step(trace) / float(steps.min()) * len(steps)), _FINEST * len(steps))
        at = np.linspace(trace.time[0], trace.time[-1], count + 1)
        actors, step = [at_times(actor, trace.time, at) for actor in actors], float(at[1] - at[0])
    parts = parts_of_turns(actors, step)
    return [finer(actor, parts) for actor in actors], step / parts


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


def _least_shift(own: ActorTrace, others: Sequence[ActorTrace], limit: int) -> float:
    """Return the least number of steps, at most `limit`, by which one of the others must come earlier to touch; inf: never."""
    if limit < 1:
        return math.inf
    most = _longest(own) / own.length
    pairs, parts = list[_Pair](), list[int]()
    for other in others:
        found = list(part_pairs(own, other))
        pairs += found
        parts += [_parts_of_step(max(most, _longest(other) / other.length))] * len(found)
    least = _first_shifts(pairs, [1] * len(pairs), limit)
    divided = [k for k, n in enumerate(parts) if n > 1]
    if divided:
        soonest = int(min(limit, least.min()))
        between = _first_shifts([pairs[k] for k in divided], [parts[k] for k in divided], soonest)
        least[divided] = np.minimum(least[divided], between)
    apart = least - 1.0 / np.array(parts, dtype=np.float64)  # shifts with which they do not touch yet
    (near,) = (apart < np.min(least, initial=math.inf)).nonzero()
    refined = (_refined(least[k], parts[k], _behind(*pairs[k], math.ceil(least[k]))) for k in near.tolist())
    return min(refined, default=math.inf)


def _parts_of_step(lengths: float) -> int:
    """Return into how many parts a step is divided so that nobody who drives so many of its lengths drives more than one."""
    return min(1 << (math.ceil(lengths) - 1).bit_length(), _FINEST) if lengths > 1.0 else 1


def _behind(a: ActorTrace, b: ActorTrace, k: int) -> Callable[[Vector], np.ndarray]:
    """Return whether two rectangles touch if b comes some numbers (s,) of steps in (k - 1, k) earlier, (s,).

    Circles around them select the instants.
    """
    n = min(len(a.x), len(b.x) - k)
    old, new = select_instants(b, slice(k - 1, k - 1 + n)), select_instants(b, slice(k, k + n))
    a = select_instants(a, slice(n))
    span = max(_longest(c) for c in (a, old, new))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + 3.0 * span
    rows = np.flatnonzero(np.hypot(new.x - a.x, new.y - a.y) <= reach)

    def touches(shifts: Vector) -> np.ndarray:
        at, share = np.tile(rows, len(shifts)), np.repeat(shifts - (k - 1), len(rows))
        before = np.maximum(at - 1, 0)
        here, start = select_instants(a, at), select_instants(a, before)
        ends, starts = ((select_instants(old, i), select_instants(new, i)) for i in (at, before))
        end, begin = _between(*ends, share), _between(*starts, share)
        shares = contact_share(here, end, begin.x - start.x, begin.y - start.y)
        return np.asarray(np.isfinite(shares).reshape(len(shifts), len(rows)).any(axis=1))

    return touches


def _first_shifts(pairs: Sequence[_Pair], parts: Sequence[int], limit: int) -> Vector:
    """Return (n,) the smallest number of steps, at most `limit`, by which the second of each pair must come earlier to touch.

    Circles around the rectangles, enlarged by the motion in a step, select the pairs of instants to be tested.

    Args:
        pairs: rectangles, the second ones with as many instants as each other, or more.
        parts: (n,) into how many a step is divided; 1: whole steps are tried, else what lies between them.
        limit: of the steps.

    Returns:
        The numbers; inf where they do not touch.
    """
    least = np.full(len(pairs), np.inf)
    near = [_near_shifts(a, b, limit, n) for (a, b), n in zip(pairs, parts, strict=True)]
    counts = [len(shifts) for shifts, *_ in near]
    if not any(counts):
        return least
    shifts, dx, dy = (np.concatenate([f[c] for f in near]) for c in (0, 1, 2))
    first = _joined([(a, poses) for (a, _), (*_, poses, _) in zip(pairs, near, strict=True)])
    second = _joined([(b, poses) for (_, b), (*_, poses) in zip(pairs, near, strict=True)])
    hits = np.isfinite(contact_share(first, second, dx, dy))
    np.minimum.at(least, np.repeat(np.arange(len(pairs)), counts)[hits], shifts[hits])
    return least


def _near_shifts(a: ActorTrace, b: ActorTrace, limit: int, parts: int) -> tuple[Vector, Vector, Vector, _Poses, _Poses]:
    """Return (n,) shifts with which b may touch a at some instants, how far apart they were a step before, and both then."""
    steps = [(u[1:] - u[:-1], v[1:] - v[:-1]) for u, v in ((a.x, b.x), (a.y, b.y))]
    ends = [[(np.fmin.reduce(s, initial=np.inf), np.fmax.reduce(s, initial=-np.inf)) for s in both] for both in steps]
    moved = np.hypot(*(max(v[1] - u[0], u[1] - v[0], 0.0) for u, v in ends))  # the most, relative to each other
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + moved
    stride = 1 if np.isnan(b.x).any() else _STRIDE
    far = reach + (stride // 2 + (parts > 1)) * _longest(b) + _SLACK
    x, y = (_later(v, len(a.x), -(-limit // stride) * stride)[:, stride // 2 :: stride] for v in (b.x, b.y))  # middles
    x, y = x - a.x[:, None], y - a.y[:, None]
    rows, which = (x * x + y * y <= far * far).nonzero()
    i, shift = np.repeat(rows, stride), (stride * which[:, None] + np.arange(stride)).ravel()
    known = (shift < limit) & (i + shift + 1 < len(b.x))
    i, shift, share = i[known], shift[known], None
    if parts > 1:
        share = np.tile(np.arange(1.0, parts) / parts, len(i))
        i, shift = np.repeat(i, parts - 1), np.repeat(shift, parts - 1)
    later, before = i + shift + 1, np.maximum(i - 1, 0)  # no step leads to the first instant
    x, y = _at(b.x, later, share), _at(b.y, later, share)
    dx, dy = x - a.x[i], y - a.y[i]
    near = dx * dx + dy * dy <= reach * reach
    i, shift, before, later, x, y = i[near], shift[near], before[near], later[near], x[near], y[near]
    share = None if share is None else share[near]
    heading = _at(b.heading, later, share, turns=True)
    later = before + shift + 1
    apart = _at(b.x, later, share) - a.x[before], _at(b.y, later, share) - a.y[before]
    return shift + (1.0 if share is None else share), *apart, (a.x[i], a.y[i], a.heading[i]), (x, y, heading)


def _at(values: Vector, k: np.ndarray, share: Vector | None, *, turns: bool = False) -> Vector:
    """Return values after a share of the step before each of some instants, None: all of it; turns: angles (rad)."""
    if share is None:
        return np.asarray(values[k])
    change = values[k] - values[k - 1]
    return np.asarray(values[k - 1] + share * (np.arctan2(np.sin(change), np.cos(change)) if turns else change))


def _joined(some: Sequence[tuple[ActorTrace, _Poses]]) -> Rectangles:
    """Return rectangles of some actors, one after another."""
    x, y, heading = (np.concatenate([poses[c] for _, poses in some]) for c in (0, 1, 2))
    counts = [len(poses[0]) for _, poses in some]
    return Rectangles(x, y, heading, *(np.repeat([getattr(actor, s) for actor, _ in some], counts) for s in ("length", "width")))


def _longest(actor: ActorTrace) -> float:
    """Return the longest way of a step (m)."""
    x, y = actor.x, actor.y
    return float(np.fmax.reduce(np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]), initial=0.0))


def _later(values: Vector, n: int, limit: int) -> np.ndarray:
    """Return the values 1 to `limit` instants after each of n, (n, limit); the last one after its end."""
    padded = np.full(n + limit, values[-1])
    known = values[1 : n + limit]
    padded[: len(known)] = known
    return sliding_window_view(padded, limit)[:n]


def _refined(least: float, parts: int, meet: Callable[[Vector], np.ndarray]) -> float:
    """Return the smallest shift in one of so many parts of a step with which the rectangles touch; they do at its end."""
    width = 1.0 / parts
    for each in _DIVISIONS:
        done = min(each, parts)
        parts, divisions = parts // done, each // done
        begin, width = least - width, width / divisions
        met = np.flatnonzero(meet(begin + width * np.arange(1.0, divisions))) if divisions > 1 else np.empty(0)
        least = begin + width * (int(met[0]) + 1 if met.size else divisions)
    return least


def _between(actor: ActorTrace, after: ActorTrace, share: float | Vector) -> ActorTrace:
    """Return an actor between two states of each instant, at a share of the way, or (t,) shares."""
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
    low, high = np.fmin.reduce, np.fmax.reduce
    return all(low(u) - reach <= high(v) and low(v) - reach <= high(u) for u, v in ((a.x, b.x), (a.y, b.y)))


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
