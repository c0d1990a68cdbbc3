"""The smallest distance of two road users, at instants and between them."""

from __future__ import annotations

import math

import numpy as np

from sbt.metrics.arcs import on_arcs, swings
from sbt.metrics.discs import discs_of
from sbt.metrics.geometry import part_pairs, rectangle_distance, select_instants
from sbt.problem.arrays import Mask, Vector
from sbt.problem.trace import ActorTrace

__all__ = ["least_distance"]

_EXACT = 0.05
"""A step in which they can be nearer by no more than this is not looked into (m)."""
_SHARES, _ROUNDS = 16, 2
"""Half the parts of a step that are compared at a time, and how often; those about the best are divided again."""
_SLOPE = 0.01
"""Share of a step from which on slopes at its ends are taken."""
_CHANGES = 0.25
"""Share by which a way may differ from the one before so that slopes tell of the step between."""
_TURNED = 0.05
"""A step in which no point moves farther than this because its rectangle turns has one heading (m)."""


def least_distance(a: ActorTrace, b: ActorTrace, least: float = np.inf) -> float:
    """Return the smallest distance of two that do not touch (m), or `least` where it is none.

    Between instants they move as for contacts (`geometry.contact_index`): a rectangle that turns keeps the heading of the end of
    its step on the chord, or turns evenly on an arc; the way on which the two stay farther apart counts.
    """
    for p, q in part_pairs(a, b):
        least = _least_of_rectangles(p, q, least)
    return least


def _least_of_rectangles(a: ActorTrace, b: ActorTrace, least: float) -> float:
    dx, dy = b.x - a.x, b.y - a.y
    apart = np.hypot(dx, dy)
    reach = 0.5 * (math.hypot(a.length, a.width) + math.hypot(b.length, b.width))
    chord = np.hypot(dx[1:] - dx[:-1], dy[1:] - dy[:-1])
    most = float(np.fmin.reduce(apart, initial=least))  # no rectangle is farther away than its centre
    near = apart <= most + reach
    into = apart[1:] + apart[:-1] - chord < 2.0 * (most + reach)
    near[1:] |= into
    near[:-1] |= into
    (rows,) = near.nonzero()
    if not rows.size:
        return least
    distance = np.full(len(apart), np.nan)
    distance[rows] = rectangle_distance(select_instants(a, rows), select_instants(b, rows))
    least = float(np.fmin.reduce(distance[rows], initial=least))
    (steps,) = (into & (distance[1:] + distance[:-1] - chord < 2.0 * (least - _EXACT))).nonzero()
    if steps.size:
        steps = steps[~(_steady(dx, dy, steps) & (_extended(distance, steps) >= least - _EXACT))]
    if steps.size:
        steps = steps[_bound(a, b, steps, distance) < least - _EXACT]
    if not steps.size:
        return least
    found, turned = _within(a, b, steps, bend=False), np.maximum(swings(a)[steps], swings(b)[steps]) > _TURNED
    if turned.any() and discs_of(a, b) is None:  # two persons are discs, which SUMO turns at once
        found[turned] = np.maximum(found[turned], _within(a, b, steps[turned], bend=True))
    return float(np.fmin.reduce(found, initial=least))


def _steady(dx: Vector, dy: Vector, steps: np.ndarray) -> Mask:
    """Return (n,) whether two move relative to each other in steps much as in the steps before and after."""
    x, y = dx[1:] - dx[:-1], dy[1:] - dy[:-1]
    known = (steps > 0) & (steps < len(x) - 1)
    before, after = np.maximum(steps - 1, 0), np.minimum(steps + 1, len(x) - 1)
    u, v = x[steps], y[steps]
    most = _CHANGES**2 * (u * u + v * v)
    return np.logical_and.reduce([known, *((x[k] - u) ** 2 + (y[k] - v) ** 2 < most for k in (before, after))])


def _extended(distance: Vector, steps: np.ndarray) -> Vector:
    """Return (n,) what the distance hardly falls below in steps, as it is convex, from the instants about them; NaN: unknown."""
    padded = np.concatenate([[np.nan], distance, [np.nan]])
    before, begin, end, after = (padded[steps + k] for k in range(4))
    return _met(begin, end, before - begin, after - end)


def _bound(a: ActorTrace, b: ActorTrace, steps: np.ndarray, distance: Vector) -> Vector:
    """Return (n,) what the distance of two that keep their headings does not fall below in steps, from slopes at their ends."""
    share = np.array([0.0, _SLOPE, 1.0 - _SLOPE])
    found = rectangle_distance(*(_placed(each, steps, share, bend=False) for each in (a, b))).reshape(-1, 3)
    begin, end = found[:, 0], distance[steps + 1]
    return _met(begin, end, (begin - found[:, 1]) / _SLOPE, (end - found[:, 2]) / _SLOPE)


def _met(begin: Vector, end: Vector, falls: Vector, rises: Vector) -> Vector:
    """Return (n,) where tangents of a convex function meet in a step, by how much the first falls and the last rises in it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.clip((begin - end + rises) / (falls + rises), 0.0, 1.0)
    inside = ~((falls <= 0.0) | (rises <= 0.0))
    return np.where(inside, begin - falls * at, np.minimum(begin, end))


def _within(a: ActorTrace, b: ActorTrace, steps: np.ndarray, *, bend: bool) -> Vector:
    """Return (n,) the smallest distance within some steps: on arcs, or on chords with the headings at their ends."""
    rows, centre, width = np.arange(len(steps)), 0.5, 0.5
    for _ in range(_ROUNDS):
        share = np.clip(centre + width * np.linspace(-1.0, 1.0, 2 * _SHARES + 1), 0.0, 1.0) * np.ones((len(steps), 1))
        found = rectangle_distance(*(_placed(each, steps, share, bend=bend) for each in (a, b))).reshape(share.shape)
        best = np.argmin(found, axis=1)
        centre, width = share[rows, best][:, None], width / _SHARES
    return np.asarray(found[rows, best])


def _placed(actor: ActorTrace, steps: np.ndarray, share: np.ndarray, *, bend: bool) -> ActorTrace:
    """Return an actor after shares (n, m) of n steps, (n m,)."""
    states = actor.x, actor.y, actor.heading
    start, end = (tuple(v[i] for v in states) for i in (steps, steps + 1))
    x, y, heading = on_arcs(start, end, share, float(bend))
    if not bend:
        heading = np.broadcast_to(actor.heading[steps + 1][:, None], x.shape)
    still = np.zeros(x.size)
    return ActorTrace(x.ravel(), y.ravel(), heading.ravel(), still, still, actor.length, actor.width)
