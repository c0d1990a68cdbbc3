"""Time to collision along the paths that were driven: for roads that bend and turn, where straight courses mislead.

On a ring or in a turn the headings of two that never come near each other point at one another all the
time. Here both are taken to go on along their own recorded paths at the speeds they have; only the speeds are extrapolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metrics.geometry import contact_share
from sbt.metrics.longitudinal import first_contact
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["HORIZON", "ttc_on_paths"]

HORIZON = 5.0
"""Time to collision from which on there is no interaction (s)."""
_STEP = 0.2
"""Grid of the look ahead (s); between its instants centres move on straight lines and contacts are found exactly."""


@dataclass(frozen=True, eq=False)
class _Ahead:
    """Where one actor would be: (t, k) positions and headings for k instants after each of t."""

    x: np.ndarray
    y: np.ndarray
    heading: np.ndarray


def ttc_on_paths(trace: Trace, ego: str = "ego", other: str = "co") -> Vector:
    """Return the (t,) time until the rectangles touch if both follow their recorded paths at their present speeds (s).

    At most 5 s; 0 at a contact. Past the end of its path an actor goes straight on.
    """
    a, b = trace.actor(ego), trace.actor(other)
    after = np.arange(0.0, HORIZON + 0.5 * _STEP, _STEP)
    times = np.full(len(trace.time), HORIZON)
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
    farthest = HORIZON * (np.abs(a.speed) + np.abs(b.speed)) + reach
    near = np.flatnonzero(np.hypot(b.x - a.x, b.y - a.y) <= farthest)
    if near.size:
        p, q = _ahead(a, near, after), _ahead(b, near, after)
        dx, dy = q.x - p.x, q.y - p.y  # (t, k)
        moved = np.hypot(np.diff(dx, axis=1), np.diff(dy, axis=1))
        rows, steps = np.nonzero(np.hypot(dx[:, 1:], dy[:, 1:]) <= reach + moved)  # circles: the exact test only there
        share = contact_share(_picked(a, p, rows, steps + 1), _picked(b, q, rows, steps + 1), dx[rows, steps], dy[rows, steps])
        np.minimum.at(times, near[rows], _STEP * (steps + share))
    contact = first_contact(trace, ego, other)
    if contact is not None:
        times[contact:] = 0.0
    return np.minimum(times, HORIZON)


def _ahead(actor: ActorTrace, rows: np.ndarray, after: Vector) -> _Ahead:
    """Return where the actor would be so long after each of these instants."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(actor.x), np.diff(actor.y)))])
    heading = np.unwrap(actor.heading)
    asked = way[rows, None] + actor.speed[rows, None] * after
    beyond = np.maximum(asked - way[-1], 0.0)
    return _Ahead(
        np.interp(asked, way, actor.x) + beyond * np.cos(heading[-1]),
        np.interp(asked, way, actor.y) + beyond * np.sin(heading[-1]),
        np.interp(asked, way, heading),
    )


def _picked(actor: ActorTrace, ahead: _Ahead, rows: np.ndarray, steps: np.ndarray) -> ActorTrace:
    """Return the states at some of the instants ahead, one behind the other."""
    still = np.zeros(len(rows))
    x, y, heading = (field[rows, steps] for field in (ahead.x, ahead.y, ahead.heading))
    return ActorTrace(x, y, heading, still, still, actor.length, actor.width)
