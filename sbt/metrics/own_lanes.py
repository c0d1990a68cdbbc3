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
from sbt.problem.trace import States, Trace

__all__ = ["between_changes"]

_SLIP, _MOVED, _TURN = 0.5, 0.5, 0.1
"""A vehicle is moved sideways, as by SUMO when it changes lanes, where that is more than this share of what it drives forward,
and so many metres, in a step in which it turns by less than this (rad): no tyre slips by 27 degrees."""
_UNEVEN = 0.05
"""Steps that differ by less (m) hide none: one with a move is longer than its neighbours."""


def between_changes(trace: Trace, ego: str, other: str) -> Iterator[tuple[int, Trace]]:
    """Yield the first instant and the trace (actors `ego` and `co`) of every stretch without a change of lanes of the two.

    Where they go on afterwards is the path that was driven, beside itself by the changes. Nothing where there is no change.

    Args:
        trace: of t instants at which both are there.
        ego: one of them.
        other: the other.
    """
    moves = {name: _moves(trace, name) for name in (ego, other)}
    found = [np.flatnonzero(np.abs(move).any(axis=1)) for move in moves.values() if move is not None]
    if not found:
        return
    edges = [0, *(np.unique(np.concatenate(found)) + 1).tolist(), len(trace.time)]
    for begin, end in pairwise(edges):
        part = trace.select(slice(begin, end), {ego: "ego", other: "co"})
        yield begin, _beside(part, {"ego": moves[ego], "co": moves[other]}, end)


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


def _beside(part: Trace, moves: dict[str, States | None], end: int) -> Trace:
    """Return a stretch that ends before instant `end`, its ways beside themselves by the moves from there on."""
    ways, parts = dict(part.ways), dict(part.parts)
    for name, move in moves.items():
        if move is None:
            continue
        offset = np.cumsum(move[end - 1 :], axis=0)
        if name in ways:
            ways[name] = _shifted(ways[name], offset)
        if name in parts:
            parts[name] = tuple(p if p.way is None else replace(p, way=_shifted(p.way, offset)) for p in parts[name])
    return replace(part, ways=ways, parts=parts)


def _shifted(way: States, offset: States) -> States:
    """Return a way (k, 3) of which the first points were recorded, each less what its road user was moved until then (m, 2)."""
    if not len(offset):
        return way
    rows = np.minimum(np.arange(len(way)), len(offset) - 1)
    return np.column_stack([way[:, :2] - offset[rows], way[:, 2]])
