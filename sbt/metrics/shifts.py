"""With which shift in time two road users would touch: what the post-encroachment time is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sbt.metrics.arcs import SWING, after_shares, at_times, parts_of_swing, swings
from sbt.metrics.around import around
from sbt.metrics.discs import is_person
from sbt.metrics.geometry import Rectangles, contact_share, part_pairs, select_instants
from sbt.problem.arrays import Mask, Vector
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["evenly", "least_shift", "near_paths", "paths_near"]

_BLOCK = 8
"""Instants that are first looked at together."""
_DIVISIONS = (16, 8, 8)
"""The PET is accurate to the step of the trace divided by the product of these."""
_FINEST = 64
"""Parts of a step, at most, in which shifts are looked for; a power of two, and a divisor of that product."""
_EVEN = 1e-3
"""Share of a step by which steps may differ before they are taken to be uneven."""
_SHORTEST, _MORE = 0.1, 4
"""Of uneven steps the even ones are as short as the shortest tenth, but there are no more than so many times as many."""
_ROWS = 20_000
"""Steps that are looked at on arcs together."""
_STRIDE = 5
"""Shifts of which the middle one tells whether any of them may matter; an odd number."""
_SLACK = 1e-6
"""By how much farther apart than necessary those must be who are passed over (m)."""
_Pair = tuple[ActorTrace, ActorTrace]
_Poses = tuple[Vector, Vector, Vector]
"""(n,) x, y (m) and heading (rad)."""
_Near = tuple[Vector, Vector, Vector, _Poses, _Poses, np.ndarray]
"""(n,) shifts, how far apart in x and y two were a step before, both then, and the instants of the first."""


def evenly(trace: Trace, actors: list[ActorTrace]) -> tuple[list[ActorTrace], float]:
    """Return actors at instants of even distance, and the time between these (s): recorded traffic may have gaps."""
    steps = np.diff(trace.time)
    step = float(trace.time[-1] - trace.time[0]) / len(steps)
    if np.ptp(steps) <= _EVEN * step:
        return actors, step
    step = max(float(np.quantile(steps, _SHORTEST)), step / _MORE)
    at = np.linspace(trace.time[0], trace.time[-1], round(float(trace.time[-1] - trace.time[0]) / step) + 1)
    return [at_times(actor, trace.time, at) for actor in actors], float(at[1] - at[0])


def near_paths(trace: Trace, ego: str, horizon: float) -> list[str]:
    """Return who may come within reach of where the ego was up to so long before (s), those who come nearest first."""
    within = math.ceil(horizon / float(np.diff(trace.time).min()))
    seen, own = around(trace, ego), trace.actors.index(ego)
    blocks = np.arange(0, len(trace.time), _BLOCK)
    low, high = (np.stack([each.reduceat(s, blocks, axis=0) for s in (trace.x, trace.y)]) for each in (np.fmin, np.fmax))
    moved = np.fmax.reduce(np.hypot(trace.x[1:] - trace.x[:-1], trace.y[1:] - trace.y[:-1]), axis=0, initial=0.0)
    reach = seen.reach + moved + moved[own]
    near = np.zeros(len(trace.actors), dtype=bool)
    for k in range(min(len(blocks), -(-within // _BLOCK) + 2)):
        n = len(blocks) - k
        before = low[:, :n, own : own + 1], high[:, :n, own : own + 1]
        near |= ((low[:, k:] <= before[1] + reach) & (before[0] <= high[:, k:] + reach)).all(axis=0).any(axis=0)
    return [trace.actors[k] for k in seen.others if near[k]]


def least_shift(own: ActorTrace, others: Sequence[ActorTrace], limit: int, *, arcs: bool) -> float:
    """Return the least number of steps, at most `limit`, by which one of the others must come earlier to touch; inf: never.

    `arcs`: where somebody turns in a step, both are looked at on their arcs.
    """
    if limit < 1:
        return math.inf
    most = _longest(own) / own.length
    pairs, parts = list[_Pair](), list[int]()
    for other in others:
        found = list(part_pairs(own, other))
        pairs += found
        parts += [_parts_of_step(max(most, _longest(other) / other.length))] * len(found)
    least = _first_shifts(pairs, [1] * len(pairs), limit, arcs=arcs)
    divided = [k for k, n in enumerate(parts) if n > 1]
    if divided:
        soonest = int(min(limit, least.min()))
        between = _first_shifts([pairs[k] for k in divided], [parts[k] for k in divided], soonest, arcs=arcs)
        least[divided] = np.minimum(least[divided], between)
    apart = least - 1.0 / np.array(parts, dtype=np.float64)  # shifts with which they do not touch yet
    (near,) = (apart < np.min(least, initial=math.inf)).nonzero()
    refined = (_refined(least[k], parts[k], _behind(*pairs[k], math.ceil(least[k]), arcs=arcs)) for k in near.tolist())
    return min(refined, default=math.inf)


def _parts_of_step(lengths: float) -> int:
    """Return into how many parts a step is divided so that nobody who drives so many of its lengths drives more than one."""
    return min(1 << (math.ceil(lengths) - 1).bit_length(), _FINEST) if lengths > 1.0 else 1


def _behind(a: ActorTrace, b: ActorTrace, k: int, *, arcs: bool) -> Callable[[Vector], np.ndarray]:
    """Return whether two rectangles touch if b comes some numbers (s,) of steps in (k - 1, k) earlier, (s,).

    Circles around them select the instants.
    """
    n = min(len(a.x), len(b.x) - k)
    old, new = select_instants(b, slice(k - 1, k - 1 + n)), select_instants(b, slice(k, k + n))
    own = select_instants(a, slice(n))
    span = max(_longest(c) for c in (own, old, new))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width)) + 3.0 * span
    rows = np.flatnonzero(np.hypot(new.x - own.x, new.y - own.y) <= reach)
    before = np.maximum(rows - 1, 0)
    turn = new.heading[rows] - old.heading[rows]
    turn = np.arctan2(np.sin(turn), np.cos(turn))

    def touches(shifts: Vector) -> np.ndarray:
        share = (shifts - (k - 1))[:, None]
        both = (old.x, new.x), (old.y, new.y)
        x, y, u, v = ((start[i] + share * (end[i] - start[i])).ravel() for i in (rows, before) for start, end in both)
        heading, at = (old.heading[rows] + share * turn).ravel(), np.tile(rows, len(shifts))
        here = _joined([(a, (own.x[at], own.y[at], own.heading[at]))])
        first = np.tile(before, len(shifts))
        hits = np.isfinite(contact_share(here, _joined([(b, (x, y, heading))]), u - own.x[first], v - own.y[first]))
        if arcs:
            _look_on_arcs(a, b, at, np.repeat(shifts, len(rows)), hits)
        return np.asarray(hits.reshape(len(shifts), len(rows)).any(axis=1))

    return touches


def _look_on_arcs(a: ActorTrace, b: ActorTrace, at: np.ndarray, shifts: Vector, hits: Mask) -> None:
    """Correct whether two touch in the steps before instants (n,) of a, where b comes some steps (n,) earlier and one turns."""
    swing_a, swing_b = (np.concatenate([[0.0], swings(each) * (not is_person(each))]) for each in (a, b))
    first = np.minimum(np.floor(at - 1 + shifts + 1e-9).astype(np.intp) + 1, len(b.x) - 1)
    last = np.minimum(np.ceil(at + shifts - 1e-9).astype(np.intp), len(b.x) - 1)
    swing = np.fmax(swing_a[at], np.fmax(swing_b[first], swing_b[last]))
    (rows,) = ((at > 0) & (swing > SWING)).nonzero()
    if not rows.size:
        return
    parts = parts_of_swing(float(swing[rows].max()))
    share = np.arange(parts + 1) / parts
    for k in range(0, len(rows), _ROWS):
        some = rows[k : k + _ROWS]
        time = (at[some] - 1)[:, None] + share
        one, two = (_at_time(each, when.ravel()) for each, when in ((a, time), (b, time + shifts[some, None])))
        ends = (np.arange(time.size).reshape(time.shape)[:, 1:]).ravel()
        here, there, start = select_instants(one, ends), select_instants(two, ends), ends - 1
        touches = np.isfinite(contact_share(here, there, (two.x - one.x)[start], (two.y - one.y)[start]))
        hits[some] = touches.reshape(len(some), parts).any(axis=1)


def _at_time(actor: ActorTrace, time: Vector) -> ActorTrace:
    """Return an actor at times (n,) in steps, on arcs; after its end as at its end."""
    step = np.clip(np.floor(time).astype(np.intp), 0, len(actor.x) - 2)
    return after_shares(actor, step, np.clip(time - step, 0.0, 1.0))


def _first_shifts(pairs: Sequence[_Pair], parts: Sequence[int], limit: int, *, arcs: bool) -> Vector:
    """Return (n,) the smallest number of steps, at most `limit`, by which the second of each pair must come earlier to touch.

    Circles around the rectangles, enlarged by the motion in a step, select the pairs of instants to be tested.

    Args:
        pairs: rectangles, the second ones with as many instants as each other, or more.
        parts: (n,) into how many a step is divided; 1: whole steps are tried, else what lies between them.
        limit: of the steps.
        arcs: see `least_shift`.

    Returns:
        The numbers; inf where they do not touch.
    """
    least = np.full(len(pairs), np.inf)
    near = [_near_shifts(a, b, limit, n) for (a, b), n in zip(pairs, parts, strict=True)]
    counts = [len(shifts) for shifts, *_ in near]
    if not any(counts):
        return least
    shifts, dx, dy = (np.concatenate([f[c] for f in near]) for c in (0, 1, 2))
    first = _joined([(a, f[3]) for (a, _), f in zip(pairs, near, strict=True)])
    second = _joined([(b, f[4]) for (_, b), f in zip(pairs, near, strict=True)])
    hits = np.isfinite(contact_share(first, second, dx, dy))
    if arcs:
        ends = np.cumsum(counts)
        for pair, f, end, count in zip(pairs, near, ends.tolist(), counts, strict=True):
            _look_on_arcs(*pair, f[5], f[0], hits[end - count : end])
    np.minimum.at(least, np.repeat(np.arange(len(pairs)), counts)[hits], shifts[hits])
    return least


def _near_shifts(a: ActorTrace, b: ActorTrace, limit: int, parts: int) -> _Near:
    """Return with which shifts b may touch a."""
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
    return shift + (1.0 if share is None else share), *apart, (a.x[i], a.y[i], a.heading[i]), (x, y, heading), i


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


def paths_near(a: ActorTrace, b: ActorTrace) -> bool:
    """Return whether the bounding boxes of the two paths overlap."""
    if a.parts or b.parts:
        return any(paths_near(p, q) for p, q in part_pairs(a, b))
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
    low, high = np.fmin.reduce, np.fmax.reduce
    return all(low(u) - reach <= high(v) and low(v) - reach <= high(u) for u, v in ((a.x, b.x), (a.y, b.y)))
