"""How rectangles that turn move between two instants: on arcs, and turning evenly."""

from __future__ import annotations

import math

import numpy as np

from sbt.metrics.discs import is_person
from sbt.problem.arrays import Mask, Vector
from sbt.problem.trace import ActorTrace

__all__ = [
    "SWING", "after_shares", "at_times", "finer", "is_coarse", "on_arcs", "parts_of_swing", "parts_of_turns",
    "swings", "while_passing",
]  # fmt: skip

SWING = 0.3
"""How far a corner may move in a step because its rectangle turns, before the step is divided (m)."""
_SHORT, _PARTS = 0.1, 16
"""Steps no longer than the first (s) are not divided; longer ones into so many parts, at most."""
_MOST_PASSING = 64
"""Parts of a step in which two pass each other, at most."""


def on_arcs(
    start: tuple[Vector, Vector, Vector], end: tuple[Vector, Vector, Vector], share: Vector, bend: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n, m) x, y and heading after shares (m,) of n steps.

    A centre drives a cubic from one instant to the next, along the headings at both; with a bend of 0 the chord.

    Args:
        start: (n,) x, y (m) and heading (rad) at the begin of each step.
        end: (n,) likewise at its end.
        share: (m,) in [0, 1], or (n, m) of each step its own.
        bend: share of the way from the chord to the arc.
    """
    (x, y, old), (to_x, to_y, new) = start, end
    s, dx, dy = np.atleast_2d(share), to_x - x, to_y - y
    turn = np.remainder(new - old + np.pi, 2.0 * np.pi) - np.pi
    half = 0.5 * turn
    length = np.hypot(dx, dy) / np.sinc(half / np.pi)  # of the arc over the chord
    length = np.copysign(length, dx * np.cos(old + half) + dy * np.sin(old + half))[:, None]  # it may drive backwards
    out, into = bend * s * (1.0 - s) ** 2 * length, -bend * s * s * (1.0 - s) * length
    come = s + bend * (s * s * (3.0 - 2.0 * s) - s)
    last = (old + turn)[:, None]
    old = old[:, None]
    at_x = x[:, None] + come * dx[:, None] + out * np.cos(old) + into * np.cos(last)
    at_y = y[:, None] + come * dy[:, None] + out * np.sin(old) + into * np.sin(last)
    return at_x, at_y, old + s * turn[:, None]


def is_coarse(step: float) -> bool:
    """Return whether what turns in a step (s) is looked at on its arc."""
    return step > _SHORT + 1e-9


def parts_of_turns(actor: ActorTrace, step: float) -> int:
    """Return into how many parts steps (s) are divided so that no corner of a rectangle swings far in one; a power of two.

    Persons are small, and SUMO turns them at once.
    """
    if not is_coarse(step) or is_person(actor):
        return 1
    return parts_of_swing(float(np.fmax.reduce(swings(actor), initial=0.0)))


def parts_of_swing(swing: float) -> int:
    """Return into how many parts a step is divided so that a corner that moves so far (m) moves little in each."""
    parts = 1
    while parts * SWING < swing and parts < _PARTS:
        parts *= 2
    return parts


def while_passing(a: ActorTrace, b: ActorTrace, where: Mask) -> tuple[ActorTrace, ActorTrace]:
    """Return two actors between the instants of some steps (t - 1,), so often that who passes the other is seen beside it."""
    way, far = np.hypot(np.diff(b.x - a.x), np.diff(b.y - a.y)), 0.25 * (a.length + b.length)
    (steps,) = (where & (way > far)).nonzero()
    parts = min(math.ceil(float(way[steps].max(initial=0.0)) / far), _MOST_PASSING)
    step, share = np.repeat(steps, max(parts - 1, 0)), np.tile(np.arange(1, parts) / max(parts, 1), len(steps))
    return after_shares(a, step, share), after_shares(b, step, share)


def swings(actor: ActorTrace) -> Vector:
    """Return (t - 1,) by how much (m) a corner moves because the rectangle of an actor turns, in each step."""
    half = 0.5 * (actor.heading[1:] - actor.heading[:-1])
    return np.asarray(np.hypot(actor.length, actor.width) * np.abs(np.sin(half)))


def finer(actor: ActorTrace, parts: int) -> ActorTrace:
    """Return an actor with every step divided into so many parts, on arcs."""
    if parts == 1:
        return actor
    at = np.arange((len(actor.x) - 1) * parts + 1)
    return after_shares(actor, at // parts, at % parts / parts)


def at_times(actor: ActorTrace, time: Vector, at: Vector) -> ActorTrace:
    """Return an actor, known at times (t,), at others (n,) within them, on arcs; (s)."""
    step = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    return after_shares(actor, step, (at - time[step]) / (time[step + 1] - time[step]))


def after_shares(actor: ActorTrace, step: np.ndarray, share: Vector) -> ActorTrace:
    """Return an actor after shares (n,) of steps (n,); between two instants it is there where it is at both."""
    here, end = step + (share >= 1.0), np.minimum(step + 1, len(actor.x) - 1)
    within = (share > 0.0) & (share < 1.0)
    states = actor.x, actor.y, actor.heading
    start, stop = (tuple(v[k] for v in states) for k in (step, end))
    arcs = on_arcs(start, stop, share[:, None])
    x, y, heading = (np.where(within, arc[:, 0], v[here]) for arc, v in zip(arcs, states, strict=True))
    speed, acceleration = (
        np.where(within, v[step] + share * (v[end] - v[step]), v[here]) for v in (actor.speed, actor.acceleration)
    )  # fmt: skip
    bodies = tuple(after_shares(part, step, share) for part in actor.parts)
    return ActorTrace(x, y, heading, speed, acceleration, actor.length, actor.width, bodies)
