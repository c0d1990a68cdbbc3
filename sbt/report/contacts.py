"""Marks the contacts of ego in a film: where, when and with whom."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import first_contact
from sbt.problem.outcome import UNCONFIRMED
from sbt.problem.trace import Trace
from sbt.report.style import CRITICAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Contact", "Contacts", "contacts_of"]


_SHOWN = 1.0
"""Time for which a contact is marked (s)."""


class Contact(NamedTuple):
    """The first contact of ego and another actor: instant, name, and a point between the two (m)."""

    instant: int
    other: str
    x: float
    y: float


def contacts_of(trace: Trace) -> tuple[Contact, ...]:
    """Return the contacts of the first actor, in the order of time.

    What never moves and does not end the run that touches it, such as a bar that hides a marking, is no road user.
    """
    ego = trace.actors[0]
    trace, found = trace.seen_by(ego), []
    for j, other in enumerate(trace.actors[1:], start=1):
        if trace.ended != "collision" and not np.nanmax(trace.speed[:, j], initial=0.0) > 0.0:
            continue
        for instants, part in joint_intervals(trace, ego, other):
            k = first_contact(part, "ego", "co")
            if k is not None:
                k += instants.start
                found.append(Contact(k, other, *_between(trace, k, j)))
                break
    return tuple(sorted(found))


def _between(trace: Trace, k: int, j: int) -> tuple[float, float]:
    """Return the middle of the points of two rectangles that are nearest to the centre of the other."""
    points = [_nearest_point(trace, k, a, b) for a, b in ((0, j), (j, 0))]
    x, y = np.mean(points, axis=0)
    return float(x), float(y)


def _nearest_point(trace: Trace, k: int, of: int, to: int) -> tuple[float, float]:
    """Return the point of one actor's rectangle that is nearest to the centre of another."""
    dx, dy = (float(v[k, to] - v[k, of]) for v in (trace.x, trace.y))
    cos, sin = math.cos(trace.heading[k, of]), math.sin(trace.heading[k, of])
    along = float(np.clip(dx * cos + dy * sin, -0.5 * trace.length[of], 0.5 * trace.length[of]))
    left = float(np.clip(-dx * sin + dy * cos, -0.5 * trace.width[of], 0.5 * trace.width[of]))
    return float(trace.x[k, of]) + along * cos - left * sin, float(trace.y[k, of]) + along * sin + left * cos


class Contacts:
    """A ring on axes at every contact, for a moment; `show(k)` draws those of an instant and returns all so far in words.

    A contact that SUMO does not list is called unconfirmed.
    """

    def __init__(self, axes: Axes, trace: Trace):
        self._contacts, self._time, self._unconfirmed = contacts_of(trace), trace.time, trace.unconfirmed
        look: dict[str, Any] = {"ms": 17, "mfc": "none", "mec": CRITICAL, "mew": 2.0, "zorder": 7, "visible": False}
        self._rings = [axes.plot([c.x], [c.y], "o", **look)[0] for c in self._contacts]

    def show(self, k: int) -> str:
        """Show the contacts at instant k, and return those up to then in words; "" where there is none."""
        words = []
        for contact, ring in zip(self._contacts, self._rings, strict=True):
            ring.set_visible(contact.instant <= k and self._time[k] - self._time[contact.instant] < _SHOWN)
            if contact.instant <= k:
                beginning = f"{UNCONFIRMED}'{contact.other}'"
                doubt = "unconfirmed " if any(text.startswith(beginning) for text in self._unconfirmed) else ""
                words.append(f"{doubt}contact with {contact.other[:20]} at {self._time[contact.instant]:.1f} s")
        return ", ".join(words[:2])
