"""Traces between changes of lanes that SUMO makes within a step: before one, a road user is taken to keep its lane.

A change of lanes is a decision that comes later. Taken for a part of the path, it would lead who waits behind a standing car into
those it lets pass before it pulls out, and who swerves in the last instant around what it would have hit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace, States, Trace

__all__ = ["between_changes"]

_SLIP, _MOVED, _TURN = 0.5, 0.5, 0.1
"""A vehicle is moved sideways, as by SUMO when it changes lanes, where that is more than this share of what it drives forward,
and so many metres, in a step in which it turns by less than this (rad): no tyre slips by 27 degrees ..."""
_LANE, _OFF_TRACK, _BEND = 1.5, 0.25, 0.8
"""... or more than so many metres, and this share of its length for each radian of a turn, less than so many: in bends, or where
it drives far in a step."""
_SURPLUS = 1.0
"""Its front is moved by more than the former (m), and so much farther than it drives, where it enters an edge on another lane:
SUMO turns it until its rear is there. Of 4,846 changes of cars at steps of .1 to 1 s, 107 are not told; of .9 million other
steps 526 are, mostly where lanes do not meet."""
_NOWHERE: States = np.full((1, 4), np.nan)


def between_changes(trace: Trace, ego: str, other: str) -> Iterator[tuple[int, ActorTrace, ActorTrace]]:
    """Yield the first instant of every stretch without a change of lanes of the two, and these in it.

    Where they go on afterwards is the path that was driven, beside itself by the changes.

    Args:
        trace: of t instants at which both are there.
        ego: one of them.
        other: the other.
    """
    one, two = trace.actor(ego), trace.actor(other)
    moves = [_moves(trace).get(name) for name in (ego, other)]
    found = [np.flatnonzero(move[: len(trace.time) - 1].any(axis=1)) for move in moves if move is not None]
    if not found:
        yield 0, one, two
        return
    edges = [0, *(np.unique(np.concatenate(found)) + 1).tolist(), len(trace.time)]
    for begin, end in pairwise(edges):
        first, second = (_stretch(actor, begin, end, move) for actor, move in zip((one, two), moves, strict=True))
        yield begin, first, second


@per_trace
def _moves(trace: Trace) -> dict[str, States]:
    """Return by how much (m) who is moved sideways, without driving there, is in each step of its path and its way (n - 1, 2)."""
    paths, length = zip(*(_path(trace, k) for k in range(len(trace.actors))), strict=True)
    counts = [len(path) for path in paths]
    x, y, heading, driven = np.concatenate(paths).T
    half, driven = np.repeat(0.5 * np.array(length), counts), driven[1:]
    turn = np.remainder(heading[1:] - heading[:-1] + np.pi, 2.0 * np.pi) - np.pi
    cos, sin = np.cos(heading[1:] - 0.5 * turn), np.sin(heading[1:] - 0.5 * turn)
    forward, left = _along(x, y, cos, sin)
    ahead, front = _along(x + half * np.cos(heading), y + half * np.sin(heading), cos, sin)
    aside, turned = np.abs(left), np.abs(turn)
    changes = (aside > _SLIP * np.abs(forward)) & (aside > _MOVED) & (turned < _TURN)
    changes |= (aside > _LANE + 2.0 * _OFF_TRACK * half[1:] * turned) & (turned < _BEND)
    entering = (np.abs(front) > _LANE) & (np.hypot(ahead, front) > driven + _SURPLUS) & (turned < _BEND) & ~changes
    if not (changes | entering).any():
        return {}
    for k in np.flatnonzero(entering):  # until its rear is there it drives beside its heading
        after = slice(k + 1, k + 1 + int(np.searchsorted(np.cumsum(np.hypot(forward, left)[k + 1 : k + 200]), 2.0 * half[k])))
        changes[after] &= aside[after] > _LANE
    by = np.where(changes, left, np.where(entering, front, 0.0))
    move = np.where(by[:, None] != 0.0, np.stack([-sin * by, cos * by], axis=1), 0.0)
    begins = np.cumsum([0, *counts])
    each = {name: move[begins[k] : begins[k + 1] - 2] for k, name in enumerate(trace.actors)}
    return {name: found for name, found in each.items() if found.any()}


def _along(x: Vector, y: Vector, cos: Vector, sin: Vector) -> tuple[Vector, Vector]:
    """Return how far (m) points (n,) move along directions (n - 1,), and to the left of them."""
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    return dx * cos + dy * sin, dy * cos - dx * sin


def _path(trace: Trace, k: int) -> tuple[States, float]:
    """Return (n, 4) x, y, heading and what it drives in the step to there (m), of an actor and its way, and its length (m).

    A last row is NaN. Of a long vehicle it is the front part: SUMO turns its straight rectangle at once.
    """
    actor = trace.actor(trace.actors[k])
    front = actor.parts[0] if actor.parts else actor
    step = np.diff(trace.time, prepend=trace.time[:1])
    recorded = np.stack([front.x, front.y, front.heading, np.abs(actor.speed) * step], axis=1)
    way = [] if front.way is None else [np.column_stack([front.way, np.full(len(front.way), np.inf)])]
    return np.concatenate([recorded, *way, _NOWHERE]), front.length


def _stretch(actor: ActorTrace, begin: int, end: int, move: States | None) -> ActorTrace:
    """Return a road user from one instant to before another, its ways beside themselves by its moves from there on."""
    found = actor.during(slice(begin, end))
    if move is None or not len(rest := move[end - 1 :]):
        return found
    offset = np.cumsum(rest, axis=0)
    return replace(_beside(found, offset), parts=tuple(_beside(part, offset) for part in found.parts))


def _beside(actor: ActorTrace, offset: States) -> ActorTrace:
    """Return a road user whose way begins with recorded points, each less what it was moved until then (m, 2)."""
    if actor.way is None:
        return actor
    rows = np.minimum(np.arange(len(actor.way)), len(offset) - 1)
    return replace(actor, way=np.column_stack([actor.way[:, :2] - offset[rows], actor.way[:, 2]]))
