"""Rectangles on their paths, and which of many pairs can come near each other on them, and when.

Before contacts are computed exactly, pairs that are too far apart are passed over: for all pairs at once, and not by the
arithmetic of the contacts, so that who is passed over is farther away by more than rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace

__all__ = ["Course", "near_steps"]

_SLACK = 1e-6
"""By how much farther apart than necessary those must be who are passed over (m)."""
_STRIDE = 5
"""Steps that are passed over at once."""


@dataclass(frozen=True, eq=False)
class Course:
    """A rectangle and the path on which it drives while it is recorded, and along its way after that."""

    actor: ActorTrace

    @cached_property
    def x(self) -> Vector:
        """Of the path (m)."""
        return self._joined(0, self.actor.x)

    @cached_property
    def y(self) -> Vector:
        """Of the path (m)."""
        return self._joined(1, self.actor.y)

    @cached_property
    def heading(self) -> Vector:
        """Along the path (rad), without jumps."""
        return np.unwrap(self._joined(2, self.actor.heading))

    @cached_property
    def way(self) -> Vector:
        """Distance along the path (m)."""
        x, y = self.x, self.y
        return np.concatenate([[0.0], np.cumsum(np.hypot(x[1:] - x[:-1], y[1:] - y[:-1]))])

    @cached_property
    def leaves(self) -> bool:
        """Whether it leaves the road at the end of the path."""
        way = self.actor.way
        return way is not None and len(way) > 0 and bool(np.isnan(way[-1, 0]))

    def _joined(self, column: int, recorded: Vector) -> Vector:
        way = self.actor.way
        return recorded if way is None else np.concatenate([recorded, way[~np.isnan(way[:, 0]), column]])


_Steps = tuple[int, np.ndarray, np.ndarray]
"""A pair, (n,) instants, and the (n,) steps after these in which the circles around its rectangles may touch."""


def near_steps(pairs: Sequence[tuple[Course, Course]], step: float, strides: int) -> Iterator[tuple[float, list[_Steps]]]:
    """Yield, stride by stride, when the circles around two rectangles may touch if both follow their paths at present speeds.

    Args:
        pairs: rectangles that are there at the same instants.
        step: of the prediction (s); in between, centres move on straight lines.
        strides: of 5 steps each.

    Yields:
        The begin of a stride (s after the instants), and the steps in it, by pair.
    """
    pair, instant, reach, pace = _near_instants(pairs, step * _STRIDE * strides)
    if not len(pair):
        return
    paths = _Paths(list(dict.fromkeys(course for both in pairs for course in both)), step * _STRIDE * strides)
    after = step * np.arange(_STRIDE * strides + 1)
    sides = [_Side(paths, [both[k] for both in pairs], pair, instant) for k in (0, 1)]
    coarse = np.abs(sides[1].at(after[::_STRIDE]) - sides[0].at(after[::_STRIDE]))  # (n, strides + 1)
    span = step * _STRIDE * pace[:, None]
    least = 0.5 * (coarse[:, :-1] + coarse[:, 1:] - span)  # no distance in the stride is smaller
    possible = least <= (reach + step * pace + _SLACK)[:, None]
    for k in range(strides):
        (rows,) = possible[:, k].nonzero()
        if len(rows):
            times = after[_STRIDE * k : _STRIDE * (k + 1) + 1]
            apart = sides[1].at(times, rows) - sides[0].at(times, rows)  # (rows, steps + 1)
            moved = np.abs(apart[:, 1:] - apart[:, :-1])
            found, steps = (np.abs(apart[:, 1:]) <= reach[rows, None] + moved + _SLACK).nonzero()
            if len(found):
                yield float(times[0]), _by_pair(pair[rows[found]], instant[rows[found]], _STRIDE * k + steps)


def _near_instants(pairs: Sequence[tuple[Course, Course]], horizon: float) -> tuple[np.ndarray, np.ndarray, Vector, Vector]:
    """Return the instants from which two can touch within the horizon (s).

    Returns:
        (n,) indices of the pairs, instants, radii of the two circles together (m) and speeds together (m/s).
    """
    found = []
    for k, (one, other) in enumerate(pairs):
        a, b = one.actor, other.actor
        reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
        pace = np.abs(a.speed) + np.abs(b.speed)
        (instants,) = (np.hypot(b.x - a.x, b.y - a.y) <= horizon * pace + reach).nonzero()
        found.append((np.full(len(instants), k), instants, np.full(len(instants), reach), pace[instants]))
    if not found:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0)
    pair, instant, reaches, paces = (np.concatenate(column) for column in zip(*found, strict=True))
    return pair, instant, reaches, paces


def _by_pair(pair: np.ndarray, instant: np.ndarray, steps: np.ndarray) -> list[_Steps]:
    """Divide what is in the order of pairs."""
    numbers, first = np.unique(pair, return_index=True)
    parts = zip(numbers.tolist(), np.split(instant, first[1:]), np.split(steps, first[1:]), strict=True)
    return [(k, own, of_pair) for k, own, of_pair in parts]


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
    """One rectangle of each pair at the instants of near ones."""

    def __init__(self, paths: _Paths, courses: list[Course], pair: np.ndarray, instant: np.ndarray) -> None:
        self._paths = paths
        at = np.cumsum([0, *(len(course.actor.x) for course in courses)])[pair] + instant
        self._origin = np.array([paths.origin[course] for course in courses])[pair]
        self._begin = self._origin + np.concatenate([course.way[: len(course.actor.x)] for course in courses])[at]
        self._speed = np.concatenate([course.actor.speed for course in courses])[at]

    def at(self, times: Vector, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return (n, k) positions at k times after some instants."""
        distance = self._begin[rows, None] + self._speed[rows, None] * times
        return self._paths.at(np.maximum(distance, self._origin[rows, None]))
