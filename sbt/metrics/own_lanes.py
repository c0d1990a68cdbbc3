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
from sbt.problem.trace import ActorTrace, States, Trace

__all__ = ["between_changes"]

_SLIP, _MOVED, _TURN = 0.5, 0.5, 0.1
"""A vehicle is moved sideways, as by SUMO when it changes lanes, where that is more than this share of what it drives forward,
and so many metres, in a step in which it turns by less than this (rad): no tyre slips by 27 degrees."""
_UNEVEN = 0.05
"""Steps that differ by less (m) hide none: one with a move is longer than its neighbours."""


def between_changes(trace: Trace, ego: str, other: str) -> Iterator[tuple[int, ActorTrace, ActorTrace]]:
    """Yield the first instant of every stretch without a change of lanes of the two, and these in it.

    Where they go on afterwards is the path that was driven, beside itself by the changes.

    Args:
        trace: of t instants at which both are there.
        ego: one of them.
        other: the other.
    """
    one, two = trace.actor(ego), trace.actor(other)
    moves = _moves(trace, ego), _moves(trace, other)
    found = [np.flatnonzero(np.abs(move).any(axis=1)) for move in moves if move is not None]
    if not found:
        yield 0, one, two
        return
    edges = [0, *(np.unique(np.concatenate(found)) + 1).tolist(), len(trace.time)]
    for begin, end in pairwise(edges):
        first, second = (_stretch(actor, begin, end, move) for actor, move in zip((one, two), moves, strict=True))
        yield begin, first, second


@per_trace
def _moves(trace: Trace, name: str) -> States | None:
    """Return by how much (m) a road user is moved sideways in each step (t - 1, 2), without driving there; None: in none."""
    actor = trace.actor(name)
    dx, dy = np.diff(actor.x), np.diff(actor.y)
    steps = np.hypot(dx, dy)
    if len(steps) < 2 or np.abs(np.diff(steps)).max() < _UNEVEN:
        return None
    turn = np.diff(np.unwrap(actor.heading))
    cos, sin = np.cos(actor.heading[1:] - 0.5 * turn), np.sin(actor.heading[1:] - 0.5 * turn)
    forward, left = dx * cos + dy * sin, dy * cos - dx * sin
    changes = (np.abs(left) > _SLIP * np.abs(forward)) & (np.abs(left) > _MOVED) & (np.abs(turn) < _TURN)
    if not changes.any():
        return None
    return np.where(changes[:, None], np.stack([-sin * left, cos * left], axis=1), 0.0)


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
