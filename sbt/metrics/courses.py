"""Rectangles on their paths, and which of many pairs can come near each other on them, and when.

Before contacts are computed exactly, pairs that are too far apart are passed over: for all pairs at once, and not by the
arithmetic of the contacts, so that who is passed over is farther away by more than rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sbt.metrics.arcs import finer, parts_of_turns
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace

__all__ = ["Course", "near_steps"]

_SLACK = 1e-6
"""By how much farther apart than necessary those must be who are passed over (m)."""
_STRIDE = 5
"""Steps that are passed over at once."""
_BLOCK = 600
"""Strides that are looked at together."""


@dataclass(frozen=True, eq=False)
class Course:
    """A rectangle and the path on which it drives while it is recorded, and along its way after that.

    Args:
        actor: the rectangle.
        step: longest time between two of its instants (s); where it turns far in one, it drives on arcs, else on chords.
    """

    actor: ActorTrace
    step: float = 0.0

    @cached_property
    def x(self) -> Vector:
        """Of the path (m)."""
        return self._path.x

    @cached_property
    def y(self) -> Vector:
        """Of the path (m)."""
        return self._path.y

    @cached_property
    def heading(self) -> Vector:
        """Along the path (rad), without jumps."""
        heading = self._path.heading
        return heading if np.ptp(heading) < np.pi else np.unwrap(heading)

    @cached_property
    def way(self) -> Vector:
        """Distance along the path (m)."""
        x, y = self.x, self.y
        return np.concatenate([[0.0], np.cumsum(np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]))])

    @cached_property
    def begin(self) -> Vector:
        """Distance along the path of each instant (m)."""
        return self.way[: len(self.actor.x) * self._parts : self._parts]

    @cached_property
    def leaves(self) -> bool:
        """Whether it leaves the road at the end of the path."""
        way = self.actor.way
        return way is not None and len(way) > 0 and bool(np.isnan(way[-1, 0]))

    @cached_property
    def _points(self) -> ActorTrace:
        actor, way = self.actor, self.actor.way
        if way is None:
            return actor
        on = way[:-1] if self.leaves else way
        x, y, heading = np.concatenate([[actor.x, actor.y, actor.heading], on.T], axis=1)
        return ActorTrace(x, y, heading, x, x, actor.length, actor.width)  # of speeds a path knows nothing

    @cached_property
    def _parts(self) -> int:
        return parts_of_turns(self._points, self.step)

    @cached_property
    def _path(self) -> ActorTrace:
        return finer(self._points, self._parts)


_Steps = tuple[float, np.ndarray, np.ndarray, np.ndarray]
"""Begin of the earliest stride (s), and (n,) pairs, in order, instants and steps after these."""


def near_steps(pairs: Sequence[tuple[Course, Course]], step: float, strides: int) -> Iterator[_Steps]:
    """Yield, in blocks, when the circles around two rectangles may touch if both follow their paths at present speeds.

    Args:
        pairs: rectangles that are there at the same instants.
        step: of the prediction (s); in between, centres move on straight lines.
        strides: of 5 steps each.

    Yields:
        The begin of a block's earliest stride (s after the instants), none after that of the next block, and the (n,) pairs,
        in their order, instants and steps after these.
    """
    if not pairs:
        return
    pair, instant, at, reach, pace = _near_instants(pairs, step * _STRIDE * strides)
    if not len(pair):
        return
    after = step * np.arange(_STRIDE * strides + 1.0)
    paths = _Paths(list(dict.fromkeys(course for both in pairs for course in both)), float(after[-1]))
    a, b = (_Side(paths, [both[k] for both in pairs], instant, at, after) for k in (0, 1))
    every, begins = np.arange(len(pair)), _STRIDE * np.arange(strides + 1)
    coarse = np.abs(b.at(begins, every) - a.at(begins, every))  # (n, strides + 1)
    least = 0.5 * (coarse[:, :-1] + coarse[:, 1:] - (step * _STRIDE * pace)[:, None])  # no distance in the stride is smaller
    stride, row = (least <= (reach + step * pace + _SLACK)[:, None]).T.nonzero()
    for k in range(0, len(row), _BLOCK):
        rows, first = row[k : k + _BLOCK], begins[stride[k : k + _BLOCK]]
        steps = first[:, None] + np.arange(_STRIDE + 1)
        apart = b.at(steps, rows) - a.at(steps, rows)  # (rows, steps + 1)
        moved = np.abs(apart[:, 1:] - apart[:, :-1])
        found, which = (np.abs(apart[:, 1:]) <= reach[rows, None] + moved + _SLACK).nonzero()
        if len(found):
            order = np.argsort(pair[rows[found]], kind="stable")
            found, which = found[order], which[order]
            yield float(after[first[0]]), pair[rows[found]], instant[rows[found]], first[found] + which


def _near_instants(
    pairs: Sequence[tuple[Course, Course]], horizon: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Vector, Vector]:
    """Return the instants from which two can touch within the horizon (s).

    Returns:
        (n,) indices of the pairs, instants, these among the instants of all pairs, radii of the two circles together (m) and
        speeds together (m/s).
    """
    actors = [(one.actor, other.actor) for one, other in pairs]
    counts = [len(a.x) for a, _ in actors]
    x, y, speed = ([np.concatenate([getattr(both[k], name) for both in actors]) for k in (0, 1)] for name in ("x", "y", "speed"))
    radii = 0.5 * np.hypot(*np.array([[(each.length, each.width) for each in both] for both in actors]).T)  # (2, pairs)
    reach, pace = np.repeat(radii[0] + radii[1], counts), np.abs(speed[0]) + np.abs(speed[1])
    (at,) = (np.hypot(x[1] - x[0], y[1] - y[0]) <= horizon * pace + reach).nonzero()
    pair = np.repeat(np.arange(len(pairs)), counts)[at]
    return pair, at - np.cumsum([0, *counts])[pair], at, reach[at], pace[at]


class _Paths:
    """Many paths as one function of the distance along them, straight ahead at their ends.

    Attributes:
        origin: course to where its path begins.
    """

    def __init__(self, courses: list[Course], horizon: float) -> None:
        self.origin: dict[Course, float] = {}
        distances, points, begin = [], [], 0.0
        for course in courses:
            way, heading = course.way, float(course.actor.heading[-1] if course.actor.way is None else course.heading[-1])
            on = 1.0 + horizon * float(np.abs(course.actor.speed).max())
            end = complex(course.x[-1], course.y[-1]) + on * complex(np.cos(heading), np.sin(heading))
            self.origin[course] = begin
            distances.append(np.concatenate([begin + way, [begin + way[-1] + on]]))
            points.append(np.concatenate([course.x + 1j * course.y, [end]]))
            begin = float(distances[-1][-1]) + 1.0
        self._distance, self._point = np.concatenate(distances), np.concatenate(points)

    def at(self, distance: np.ndarray) -> np.ndarray:
        """Return where paths lead, as complex numbers."""
        return np.interp(distance, self._distance, self._point)


class _Side:
    """One rectangle of each pair, at n instants, which are given also among those of all pairs, and k times after them."""

    def __init__(self, paths: _Paths, courses: list[Course], instant: np.ndarray, at: np.ndarray, after: np.ndarray) -> None:
        self._paths, self._after, self._at = paths, after, at
        if shared := len(set(courses)) == 1:  # the ego: predicted once an instant
            courses, self._at = courses[:1], instant
        counts = [len(course.actor.x) for course in courses]
        self._origin = np.repeat([paths.origin[course] for course in courses], counts)
        self._begin = self._origin + np.concatenate([course.begin for course in courses])
        self._speed = np.concatenate([course.actor.speed for course in courses])
        self._known = self._positions(np.arange(len(after)), np.arange(len(self._begin))) if shared else None

    def at(self, steps: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return positions (n, k), as complex numbers, at some times (k,), or (n, k), after some of the instants (n,)."""
        at = self._at[rows]
        return self._positions(steps, at) if self._known is None else self._known[at[:, None], steps]

    def _positions(self, steps: np.ndarray, at: np.ndarray) -> np.ndarray:
        distance = self._begin[at, None] + self._speed[at, None] * self._after[steps]
        return self._paths.at(np.maximum(distance, self._origin[at, None]))
