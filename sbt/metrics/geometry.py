"""Oriented rectangles: contact while moving, and distance; vectorised over time.

Where one of two is not there, its states are NaN: nothing touches it, and distances are NaN.

Two persons are discs of their lesser size: SUMO turns who walks by up to 180 degrees within a step, however short, and nobody's
shoulders touch another by that.

The shape of a long vehicle is several rectangles (`ActorTrace.parts`): `contact_index`, `time_to_contact` and
`rectangle_distance` compare all of them, the other functions single rectangles.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sbt.metrics.arcs import on_arcs
from sbt.metrics.discs import disc_span, discs_of
from sbt.problem.arrays import Mask, Vector
from sbt.problem.trace import ActorTrace, select_parts

__all__ = [
    "FASTER",
    "LANE_CHANGE",
    "STEPPED",
    "Rectangles",
    "contact_index",
    "contact_moment",
    "contact_part",
    "contact_share",
    "corners",
    "farthest",
    "first_touch",
    "overlap_depth",
    "part_pairs",
    "rectangle_at",
    "rectangle_distance",
    "rectangles",
    "select_instants",
    "swept_contact",
    "time_to_contact",
    "touching_first",
]  # fmt: skip


LANE_CHANGE = 8.0
"""How far SUMO may move a road user beside what it drives, where it changes lanes within a step (m)."""
STEPPED = 4.0
"""How far SUMO may move a walker beside its way, onto a crossing or a walking area (m): 3.4 in 2 million steps, four networks."""
FASTER = 1.3
"""How much farther than by its speed somebody may get within a step: outer lanes of a bend are longer."""
_MAX_SPEED = 150.0
_DRIVES, _TURNED, _SWINGS, _ARCS = 0.5, 0.05, 0.3, 16
"""A step in which a corner moves by more than this (m) because its rectangle turns is one along an arc, of so many parts; by more
than the second, if it drives (m/s), also where nothing touches on the chord."""


def farthest(elapsed: Any) -> Any:
    """Return how far (m) a road user may move within a time (s), of any shape, without being teleported: its track is cut there.

    At 150 m/s, but no less than 8 m: SUMO changes lanes within a step, however short.
    """
    return np.maximum(_MAX_SPEED * elapsed, LANE_CHANGE)


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Any n rectangles: (n,) centres, headings, lengths and widths."""

    x: Vector
    y: Vector
    heading: Vector
    length: Vector
    width: Vector


def rectangle_at(actor: ActorTrace, k: int) -> Rectangles:
    """Return the rectangle of an actor at an instant, as one of one."""
    i = slice(k, k + 1)
    return Rectangles(actor.x[i], actor.y[i], actor.heading[i], np.array([actor.length]), np.array([actor.width]))


def rectangles(actor: ActorTrace) -> tuple[ActorTrace, ...]:
    """Return the rectangles that are the shape of an actor, the front one first."""
    return actor.parts or (actor,)


def part_pairs(a: ActorTrace, b: ActorTrace) -> Iterator[tuple[ActorTrace, ActorTrace]]:
    """Yield every pair of rectangles of two actors."""
    return itertools.product(rectangles(a), rectangles(b))


def overlap_depth(a: ActorTrace, b: ActorTrace) -> Vector:
    """Return (t,) how far two rectangles would have to move so as not to overlap (m); negative where they are apart.

    The least overlap on the four axes; where they are apart, minus a lower bound of their distance.
    """
    discs = discs_of(a, b)
    if discs is not None:
        return discs - np.hypot(b.x - a.x, b.y - a.y)
    cos, sin = _axes(a, b)
    apart: Vector = np.abs((b.x - a.x) * cos + (b.y - a.y) * sin)
    return (_reaches(a, b, cos, sin) - apart).min(axis=0)


def corners(actor: ActorTrace) -> np.ndarray:
    """Return the (t, 4, 2) corners of the rectangle, counter-clockwise from the front left."""
    cos, sin = np.cos(actor.heading), np.sin(actor.heading)
    along = 0.5 * actor.length * np.array([1.0, -1.0, -1.0, 1.0])
    across = 0.5 * actor.width * np.array([1.0, 1.0, -1.0, -1.0])
    x = actor.x[:, None] + cos[:, None] * along - sin[:, None] * across  # (t, 4)
    y = actor.y[:, None] + sin[:, None] * along + cos[:, None] * across
    return np.stack([x, y], axis=-1)


def _axes(a: ActorTrace | Rectangles, b: ActorTrace | Rectangles) -> tuple[np.ndarray, np.ndarray]:
    """Return the (4, t) directions of the separating axes: along and across each rectangle."""
    angle = np.empty((4, len(a.heading)))
    angle[0], angle[2] = a.heading, b.heading
    angle[1::2] = angle[::2] + np.pi / 2
    return np.cos(angle), np.sin(angle)


def _reaches(a: ActorTrace | Rectangles, b: ActorTrace | Rectangles, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
    """Return the (4, t) sums of the half extents of two rectangles along their four axes."""
    ahead = np.abs(cos[::2, None] * cos + sin[::2, None] * sin)  # (2, 4, t): of each rectangle to every axis
    aside = np.abs(cos[::2, None] * sin - sin[::2, None] * cos)
    half = [0.5 * (each.length * ahead[k] + each.width * aside[k]) for k, each in enumerate((a, b))]
    return half[0] + half[1]


def swept_contact(a: ActorTrace, b: ActorTrace) -> Vector:
    """Return (t,) the fraction of the step before each instant after which the rectangles touch; inf without a contact.

    Between instants the centres move on straight lines, and the headings are those at the end of the step. The
    relative motion is tested on the separating axes, so that no contact is missed, whatever the step. The first
    instant at which both are there has no step before it; its value is 0 if the rectangles overlap.

    Source:
        Separating axes of moving convex bodies, e.g. Ericson (2005), Real-Time Collision Detection, 5.5.8.
    """
    dx, dy = b.x - a.x, b.y - a.y
    return contact_share(a, b, np.concatenate([dx[:1], dx[:-1]]), np.concatenate([dy[:1], dy[:-1]]))


def contact_share(a: ActorTrace | Rectangles, b: ActorTrace | Rectangles, dx: Vector, dy: Vector) -> Vector:
    """Return (t,) the fraction of each of t independent steps after which the rectangles touch; inf without a contact.

    Args:
        a: states at the end of the steps; the heading is that during the whole step.
        b: likewise.
        dx: (t,) x from the centre of a to that of b at the start of the steps (m); NaN: one of them was not there, and
            the end counts alone.
        dy: (t,) y, likewise (m).
    """
    cos, sin = _axes(a, b)
    reach = _reaches(a, b, cos, sin)  # (4, t)
    end_x, end_y = b.x - a.x, b.y - a.y
    absent = np.isnan(dx)
    if absent.any():
        dx, dy = np.where(absent, end_x, dx), np.where(absent, end_y, dy)
    end = end_x * cos + end_y * sin  # (4, t) centre distance along each axis
    start = dx * cos + dy * sin
    enter, leave = _overlap_span(start, end - start, reach)
    discs = discs_of(a, b)
    if discs is not None:
        enter, leave = disc_span((enter, leave), dx, dy, end_x - dx, end_y - dy, discs)
    hit = (enter <= leave) & (leave >= 0) & (enter <= 1)
    return np.where(hit, np.maximum(enter, 0.0), np.inf)


def _overlap_span(start: np.ndarray, rate: np.ndarray, reach: np.ndarray) -> tuple[Vector, Vector]:
    """Return (t,) the times at which moving rectangles begin and end to overlap on all four axes; begin > end if never.

    Args:
        start: (4, t) distance of the centres along each axis at time 0.
        rate: (4, t) its rate of change.
        reach: (4, t) sum of the half extents.
    """
    signed = np.sign(rate) * reach
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        first, last = (-signed - start) / rate, (signed - start) / rate
    still = rate == 0
    if still.any():
        outside = np.abs(start) > reach
        first = np.where(still, np.where(outside, np.inf, -np.inf), first)
        last = np.where(still, np.where(outside, -np.inf, np.inf), last)
    return first.max(axis=0), last.min(axis=0)


def time_to_contact(a: ActorTrace, b: ActorTrace) -> Vector:
    """Return (t,) the time from each instant until the rectangles touch at constant speeds and headings (s), inf if never.

    0 where they overlap. Exact: convex bodies touch when their projections overlap on all separating axes.

    Source:
        Separating axes of moving convex bodies, e.g. Ericson (2005), Real-Time Collision Detection, 5.5.8.
    """
    if a.parts or b.parts:
        return np.minimum.reduce([time_to_contact(p, q) for p, q in part_pairs(a, b)])
    cos, sin = _axes(a, b)
    reach = _reaches(a, b, cos, sin)  # (4, t)
    start = (b.x - a.x) * cos + (b.y - a.y) * sin
    rate_x = b.speed * np.cos(b.heading) - a.speed * np.cos(a.heading)
    rate_y = b.speed * np.sin(b.heading) - a.speed * np.sin(a.heading)
    enter, leave = _overlap_span(start, rate_x * cos + rate_y * sin, reach)
    discs = discs_of(a, b)
    if discs is not None:
        enter, leave = disc_span((enter, leave), b.x - a.x, b.y - a.y, rate_x, rate_y, discs)
    return np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)


def contact_index(a: ActorTrace, b: ActorTrace) -> int | None:
    """Return the index of the first instant at which, or in the step before which, the rectangles touch; None if never."""
    found = contact_part(a, b)
    return None if found is None else found[0]


def contact_part(a: ActorTrace, b: ActorTrace) -> tuple[int, ActorTrace, ActorTrace] | None:
    """Return the index of the first contact (as `contact_index`) and the rectangles that touch; None if there is none."""
    found = [(k, p, q) for p, q in part_pairs(a, b) if (k := _rectangle_contact(p, q)) is not None]
    if len(found) < 2:
        return found[0] if found else None
    first = min(k for k, *_ in found)
    return (first, *touching_first([(p, q) for k, p, q in found if k == first], first))


def touching_first(pairs: Sequence[tuple[ActorTrace, ActorTrace]], k: int) -> tuple[ActorTrace, ActorTrace]:
    """Return which of some pairs of rectangles touch first in the step before an instant; the first pair where none does."""
    touches = [first_touch(p, q, k) for p, q in pairs]
    shares = [math.inf if touch is None else touch[0] for touch in touches]
    return pairs[shares.index(min(shares))]


def contact_moment(a: ActorTrace, b: ActorTrace, k: int) -> float:
    """Return after which fraction of the step before an instant, the first at which they have touched, two actors touch.

    1 where no rectangles do on chords with their last headings.
    """
    step = slice(max(k - 1, 0), k + 1)
    pairs = part_pairs(select_instants(a, step), select_instants(b, step))
    return float(np.fmin(min(swept_contact(p, q)[-1] for p, q in pairs), 1.0))


def first_touch(a: ActorTrace, b: ActorTrace, k: int) -> tuple[float, Rectangles, Rectangles] | None:
    """Return after which share of the step before an instant two rectangles begin to touch, and both as they are then.

    Within the step they move, and turn, as for `contact_index`. Where one of them was not there before and they overlap at the
    instant, the share is 0, and they are as when they would have begun to at their present speeds and headings. None: they do not
    touch.
    """
    if k == 0 or np.isnan(a.x[k - 1] + b.x[k - 1]):
        return _touch_before(a, b, k)
    turning = discs_of(a, b) is None and max(_swing(each, slice(k, k + 1))[0][0] for each in (a, b)) > _TURNED
    (x, y, one), (u, v, other) = (_on_arc(each, k, 1.0) if turning else _on_chord(each, k) for each in (a, b))
    shares = contact_share(one, other, u - x, v - y)
    j = int(np.isfinite(shares).argmax())
    if np.isinf(shares[j]):
        return None
    return (j + float(shares[j])) / len(x), _within(x, y, one, j, shares[j]), _within(u, v, other, j, shares[j])


def _touch_before(a: ActorTrace, b: ActorTrace, k: int) -> tuple[float, Rectangles, Rectangles] | None:
    """Return the same for two that nothing is known about before the instant."""
    one, other = rectangle_at(a, k), rectangle_at(b, k)
    cos, sin = _axes(one, other)
    rate_x = b.speed[k] * np.cos(b.heading[k]) - a.speed[k] * np.cos(a.heading[k])
    rate_y = b.speed[k] * np.sin(b.heading[k]) - a.speed[k] * np.sin(a.heading[k])
    start = (other.x - one.x) * cos + (other.y - one.y) * sin
    enter, leave = _overlap_span(start, rate_x * cos + rate_y * sin, _reaches(one, other, cos, sin))
    if not enter[0] <= 0.0 <= leave[0]:
        return None
    if np.isfinite(enter[0]):
        other = replace(other, x=other.x + enter * rate_x, y=other.y + enter * rate_y)
    return 0.0, one, other


def _on_chord(actor: ActorTrace, k: int) -> tuple[Vector, Vector, Rectangles]:
    """Return what `_on_arc` does, in one part."""
    return actor.x[k - 1 : k], actor.y[k - 1 : k], rectangle_at(actor, k)


def _within(x: Vector, y: Vector, end: Rectangles, j: int, share: float) -> Rectangles:
    """Return one of several rectangles after a share of its way to there from x and y."""
    i = slice(j, j + 1)
    to_x, to_y = x[i] + share * (end.x[i] - x[i]), y[i] + share * (end.y[i] - y[i])
    return Rectangles(to_x, to_y, end.heading[i], end.length[i], end.width[i])


def _rectangle_contact(a: ActorTrace, b: ActorTrace) -> int | None:
    dx, dy = b.x - a.x, b.y - a.y
    reach = 0.5 * (math.hypot(a.length, a.width) + math.hypot(b.length, b.width))
    moved = max(float(np.fmax.reduce(np.abs(d[1:] - d[:-1]), initial=0.0)) for d in (dx, dy))
    (near,) = (dx * dx + dy * dy <= (reach + 1.5 * moved) ** 2).nonzero()  # circumscribed circles first
    if near.size == 0:
        return None
    first = max(int(near[0]) - 1, 0)
    i = slice(first, int(near[-1]) + 1)
    touch = np.isfinite(swept_contact(select_instants(a, i), select_instants(b, i)))
    turns, drives = zip(_swing(a, i), _swing(b, i), strict=True)
    if discs_of(a, b) is not None:
        turns = np.zeros_like(turns[0]), np.zeros_like(turns[1])
    swing, wide = np.fmax(*turns), np.fmax(*(np.where(d, turn, 0.0) for turn, d in zip(turns, drives, strict=True))) > _SWINGS
    found = (k for k in (first + np.flatnonzero(touch | wide)).tolist())
    return next((k for k in found if _touch_in(a, b, k, turning=swing[k - first] > _TURNED, slid=bool(touch[k - first]))), None)


def _swing(actor: ActorTrace, i: slice) -> tuple[Vector, Mask]:
    """Return by how much (m) a corner moves because its rectangle turns, in the steps before some instants, and if it drives."""
    before = slice(max(i.start - 1, 0), i.stop)
    x, y, heading, drives = actor.x[before], actor.y[before], actor.heading[before], np.abs(actor.speed[before]) > _DRIVES
    turn, moves = np.abs(np.remainder(heading[1:] - heading[:-1] + math.pi, math.tau) - math.pi), drives[1:] | drives[:-1]
    radius = 0.5 * math.hypot(actor.length, actor.width)
    stays = np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]) < radius  # it turns on the spot
    swing = np.where(moves | stays, radius * turn, 0.0)
    if i.start:
        return swing, moves
    return np.concatenate([[0.0], swing]), np.concatenate([[False], moves])  # nothing is known before the first instant


def _touch_in(a: ActorTrace, b: ActorTrace, k: int, *, turning: bool, slid: bool) -> bool:
    """Return whether rectangles touch in the step before an instant; `slid`: they do on chords, with the headings at their ends.

    Where one is turning, they turn evenly, on arcs: on the chord with the heading at its end a car that turns within a step of a
    second touches what it drives around, and a person who turns on the spot what has gone by. Where they do not touch there, they
    must on the chord, too, with headings that change evenly: parts of long vehicles move beside their headings.
    """
    if not turning or k == 0 or np.isnan(a.x[k - 1] + b.x[k - 1]):  # who comes has no step before: the end counts alone
        return slid
    for bend in (1.0,) if slid else (1.0, 0.0):
        (x, y, one), (u, v, other) = (_on_arc(each, k, bend) for each in (a, b))
        if not np.isfinite(contact_share(one, other, u - x, v - y)).any():
            return False
    return True


def _on_arc(actor: ActorTrace, k: int, bend: float) -> tuple[Vector, Vector, Rectangles]:
    """Return a rectangle at the ends of the parts of a step, and where its centre was at their begins."""
    start, end = (tuple(v[i : i + 1] for v in (actor.x, actor.y, actor.heading)) for i in (k - 1, k))
    x, y, heading = (v[0] for v in on_arcs(start, end, np.linspace(0.0, 1.0, _ARCS + 1), bend))  # type: ignore[arg-type]
    size = np.full(_ARCS, actor.length), np.full(_ARCS, actor.width)
    return x[:-1], y[:-1], Rectangles(x[1:], y[1:], heading[1:], *size)


def select_instants(actor: ActorTrace, i: slice | np.ndarray) -> ActorTrace:
    """Return an actor at some instants only."""
    a = actor
    parts = select_parts(a.parts, i) if a.parts else ()
    return ActorTrace(a.x[i], a.y[i], a.heading[i], a.speed[i], a.acceleration[i], a.length, a.width, parts)


def rectangle_distance(a: ActorTrace, b: ActorTrace) -> Vector:
    """Return the (t,) smallest distance between the rectangles (m), 0 where they overlap."""
    if a.parts or b.parts:
        return np.minimum.reduce([rectangle_distance(p, q) for p, q in part_pairs(a, b)])
    discs = discs_of(a, b)
    if discs is not None:
        return np.maximum(np.hypot(b.x - a.x, b.y - a.y) - discs, 0.0)
    cos, sin = _axes(a, b)
    along = np.abs((b.x - a.x) * cos + (b.y - a.y) * sin)
    overlap = (along <= _reaches(a, b, cos, sin)).all(axis=0)
    corner_a, corner_b = corners(a), corners(b)
    distance = np.minimum(_point_distance(corner_a, b), _point_distance(corner_b, a))
    return np.where(overlap, 0.0, distance)


def _point_distance(points: np.ndarray, box: ActorTrace) -> Vector:
    """Return the (t,) smallest distance of (t, 4, 2) points to a rectangle."""
    dx, dy = points[..., 0] - box.x[:, None], points[..., 1] - box.y[:, None]
    c, s = np.cos(box.heading)[:, None], np.sin(box.heading)[:, None]
    u = np.maximum(np.abs(c * dx + s * dy) - box.length / 2, 0.0)
    v = np.maximum(np.abs(-s * dx + c * dy) - box.width / 2, 0.0)
    return np.hypot(u, v).min(axis=1)
