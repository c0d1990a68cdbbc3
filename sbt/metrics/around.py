"""Everyone around the ego at once: who can be how near, and who touches it, before pairs are looked at one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.metrics.longitudinal import FAR, first_contact
from sbt.metrics.nearest import least_distance
from sbt.problem.arrays import Vector
from sbt.problem.trace import States, Trace

__all__ = ["Around", "around", "first_contacts", "smallest_distance"]

_SLACK = 1e-6
"""By how much farther away than necessary those must be who are passed over (m): more than rounding."""


@dataclass(frozen=True, eq=False)
class Around:
    """Centres of m actors relative to the ego at t instants; NaN while one of the two is not there.

    Attributes:
        dx, dy: (t, m) from the ego's centre (m).
        apart: (t, m) distance of the centres (m).
        reach: (m,) distance of the centres from which on the rectangles cannot touch (m).
        others: columns of all but the ego, those that come nearest first.
    """

    dx: States
    dy: States
    apart: States
    reach: Vector
    others: tuple[int, ...]


@per_trace
def around(trace: Trace, ego: str) -> Around:
    """Return where everyone is."""
    own = trace.actors.index(ego)
    dx, dy = trace.x - trace.x[:, own : own + 1], trace.y - trace.y[:, own : own + 1]
    bent = np.array([name in trace.parts for name in trace.actors])
    radius = np.where(bent, 1.5, 0.5) * np.hypot(trace.length, trace.width)
    reach = radius + radius[own] + _SLACK
    apart = np.hypot(dx, dy)
    order = np.argsort(np.fmin.reduce(apart, axis=0) - reach, kind="stable")
    return Around(dx, dy, apart, reach, tuple(k for k in order.tolist() if k != own))


@per_trace
def first_contacts(trace: Trace, ego: str) -> dict[str, int]:
    """Return the index of the first contact with everyone who touches the ego, by name."""
    seen = around(trace, ego)
    near = _least_apart(trace, ego) <= seen.reach
    found = ((trace.actors[k], first_contact(trace, ego, trace.actors[k])) for k in seen.others if near[k])
    return {name: k for name, k in found if k is not None}


@per_trace
def _least_apart(trace: Trace, ego: str) -> Vector:
    """Return (m,) the smallest distance of everyone's centre to the ego's, at an instant or between two (m)."""
    seen = around(trace, ego)
    moved = np.hypot(seen.dx[1:] - seen.dx[:-1], seen.dy[1:] - seen.dy[:-1])
    between = 0.5 * (seen.apart[1:] + seen.apart[:-1] - moved)  # none in the step is smaller
    return np.asarray(np.fmin.reduce(np.concatenate([seen.apart, between]), axis=0, initial=np.inf))


def smallest_distance(trace: Trace, ego: str) -> float:
    """Return the smallest distance of the ego's rectangle to anyone else's (m), 0 for a contact, at most 1,000."""
    if first_contacts(trace, ego):
        return 0.0
    seen, least, own = around(trace, ego), FAR, trace.actor(ego)
    within = _least_apart(trace, ego) - seen.reach
    for k in seen.others:
        if within[k] < least:
            least = least_distance(own, trace.actor(trace.actors[k]), least)
    return least
