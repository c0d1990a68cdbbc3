"""Overlap of road users at one instant, and the braking that keeps them apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from sbt.metrics.geometry import overlap_depth, part_pairs
from sbt.problem.trace import ActorTrace
from sbt.sumo.actors import State

__all__ = ["Rectangle", "deepest_overlap", "instant", "is_behind", "may_touch", "required_braking", "state_in_sumo"]

Rectangle = tuple[float, float, float, float, float]
"""x, y (m), heading (rad), length and width (m)."""

_TOLERANCE = 1e-3
"""Distance up to which rectangles count as overlapping (m): SUMO's positions are rounded, and touching is no start."""
_SLACK = 1e-6
"""Below this distance (m) of two rectangles the quick separation test does not decide, but the exact one."""
_SAME_DIRECTION = math.cos(math.radians(45.0))


def deepest_overlap(ego: ActorTrace, others: Mapping[str, ActorTrace]) -> tuple[str, float] | None:
    """Return who overlaps the ego most, and by how much (m, >= 0); None if nobody does. Touching is overlapping.

    Args:
        ego: its body, at one instant.
        others: those of the others, by name.
    """
    found: tuple[str, float] | None = None
    for name, other in others.items():
        reach = ego.length + ego.width + other.length + other.width
        if max(abs(float(other.x[0] - ego.x[0])), abs(float(other.y[0] - ego.y[0]))) > reach:
            continue
        depth = max(float(overlap_depth(a, b)[0]) for a, b in part_pairs(ego, other))
        if depth >= -_TOLERANCE and (found is None or depth > found[1]):
            found = name, max(depth, 0.0)
    return found


def required_braking(ego: State, other: State, delay: float = 0.0) -> float:
    """Return the constant deceleration (m/s^2) by which the one behind avoids the one ahead, which keeps its speed.

    0 where they do not drive in one direction, one behind the other, or the gap grows; inf without a gap. A delay is the time (s)
    until the one behind begins to brake.
    """
    if ego.cos * other.cos + ego.sin * other.sin < _SAME_DIRECTION:
        return 0.0
    along = (other.x - ego.x) * ego.cos + (other.y - ego.y) * ego.sin
    across = (other.y - ego.y) * ego.cos - (other.x - ego.x) * ego.sin
    if abs(across) >= 0.5 * (ego.width + other.width):
        return 0.0
    closing = ego.speed - other.speed if along > 0 else other.speed - ego.speed
    if closing <= 0.0:
        return 0.0
    gap = abs(along) - 0.5 * (ego.length + other.length) - closing * delay
    return closing**2 / (2.0 * gap) if gap > 0.0 else math.inf


def is_behind(ego: State, other: State) -> bool:
    """Return whether the other's middle is behind the ego's."""
    return (other.x - ego.x) * ego.cos + (other.y - ego.y) * ego.sin < 0.0


def state_in_sumo(domain: Any, name: str, *, person: bool = False) -> State:
    """Return the present state of a vehicle or person, as in a trace: its centre."""
    state = State(name, float(domain.getLength(name)), float(domain.getWidth(name)))
    state.turn(float(domain.getAngle(name)))
    half = 0.0 if person else 0.5 * state.length
    x, y = domain.getPosition(name)
    state.x, state.y, state.speed = x - half * state.cos, y - half * state.sin, float(domain.getSpeed(name))
    return state


def instant(state: State) -> ActorTrace:
    """Return a state as a trace of one instant, a rectangle."""
    x, y, heading, speed, acceleration = np.array(
        [[state.x], [state.y], [state.heading], [state.speed], [state.acceleration]]
    )
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)


def may_touch(
    own: Sequence[Rectangle], own_0: Sequence[Rectangle], other: Sequence[Rectangle], other_0: Sequence[Rectangle]
) -> bool:
    """Return whether no axis separates any rectangle of one body from any of another during a step, from the states _0 on."""
    pairs = product(zip(own, own_0, strict=True), zip(other, other_0, strict=True))
    return any(not _separate(a, b, a_0, b_0) for (a, a_0), (b, b_0) in pairs)


def _separate(a: Rectangle, b: Rectangle, a_0: Rectangle, b_0: Rectangle) -> bool:
    """Return whether an axis of one rectangle separates both during a whole step, from the states _0 on."""
    dx, dy, dx_0, dy_0 = b[0] - a[0], b[1] - a[1], b_0[0] - a_0[0], b_0[1] - a_0[1]
    turn = b[2] - a[2]
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    for one, other in ((a, b), (b, a)):
        cos, sin = math.cos(one[2]), math.sin(one[2])
        reach = 0.5 * (one[3] + c * other[3] + s * other[4]) + _SLACK
        along, along_0 = dx * cos + dy * sin, dx_0 * cos + dy_0 * sin
        if (along > reach and along_0 > reach) or (along < -reach and along_0 < -reach):
            return True
        reach = 0.5 * (one[4] + s * other[3] + c * other[4]) + _SLACK
        left, left_0 = dy * cos - dx * sin, dy_0 * cos - dx_0 * sin
        if (left > reach and left_0 > reach) or (left < -reach and left_0 < -reach):
            return True
    return False
