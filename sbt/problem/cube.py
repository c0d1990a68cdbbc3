"""The unit cube where some inputs take single values only: which they are, and how far apart.

A whole number owns an interval of its coordinate, and so does a choice. Numbers are ordered; of choices none is nearer
to one than to another, so that a distance, a step or a metamodel must not be told their positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["CONTINUOUS", "Cube"]

_SIDE = math.sqrt(0.5)
"""Coordinate of a choice on its own axis: two choices are as far apart as the ends of a range."""
_LOOKED_AT, _AT_ONCE = 2**22, 2**16
"""Points of which feasible ones are counted, in all and at once; more have 4,096 feasible ones where a thousandth is."""


@dataclass(frozen=True)
class Cube:
    """The unit cube of the inputs; without inputs of single values it changes nothing.

    Args:
        whole: (column, number of values) of each whole-number input.
        nominal: (column, number of choices) of each input with choices.

    >>> Cube(nominal=((1, 3),)).embedded(np.array([[0.2, 0.1], [0.4, 0.9]])).round(2).tolist()
    [[0.2, 0.71, 0.0, 0.0], [0.4, 0.0, 0.0, 0.71]]
    """

    whole: tuple[tuple[int, int], ...] = ()
    nominal: tuple[tuple[int, int], ...] = ()

    @property
    def continuous(self) -> bool:
        """Whether every input is."""
        return not self.whole and not self.nominal

    def choices(self, u: Points) -> Points:
        """Return (n, c) positions of the choices at points u (n, d), a column for each input with choices."""
        return np.column_stack([_cell(u[:, k], n) for k, n in self.nominal]) if self.nominal else np.zeros((len(u), 0))

    def cells(self, u: Points) -> Points:
        """Return (n, w + c) positions of the whole numbers and choices at points u (n, d); zeros where there are none."""
        return np.column_stack([np.zeros(len(u)), *(_cell(u[:, k], n) for k, n in (*self.whole, *self.nominal))])

    def combinations(self, dimension: int, most: int, feasible: Callable[[Points], Mask] | None = None) -> Points | None:
        """Return all points (m, d) that can be run; None where a coordinate is continuous, or there are more than `most`.

        Where only some are `feasible`, these count; of more than four million points it is not asked.

        >>> Cube(whole=((0, 2),), nominal=((1, 2),)).combinations(2, 10).tolist()
        [[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]]
        """
        counts = dict((*self.whole, *self.nominal))
        total = math.prod(counts.values())
        if len(counts) < dimension or total > (most if feasible is None else _LOOKED_AT):
            return None
        shape, found = tuple(counts[k] for k in range(dimension)), np.empty((0, dimension))
        for start in range(0, total, _AT_ONCE):
            cells = np.unravel_index(np.arange(start, min(start + _AT_ONCE, total)), shape)
            points = (np.stack(cells, axis=1) + 0.5) / shape
            found = np.vstack([found, points if feasible is None else points[feasible(points)]])
            if len(found) > most:
                return None
        return found

    def snapped(self, u: Points) -> Points:
        """Return the points (n, d) that are run in place of u: single values at the middle of their interval."""
        if self.continuous:
            return u
        found = np.array(u, dtype=np.float64)
        for k, n in (*self.whole, *self.nominal):
            found[:, k] = (_cell(u[:, k], n) + 0.5) / n
        return found

    def embedded(self, u: Points) -> Points:
        """Return (n, e) coordinates in which distances mean something: snapped, a choice on an axis of its own."""
        if self.continuous:
            return u
        found = self.snapped(u)
        if not self.nominal:
            return found
        counts, parts = dict(self.nominal), []
        for k in range(u.shape[1]):
            cells = _cell(u[:, k], counts[k])[:, None] == np.arange(counts[k]) if k in counts else None
            parts.append(found[:, [k]] if cells is None else _SIDE * cells)
        return np.ascontiguousarray(np.column_stack(parts))

    def restored(self, embedded: Points, dimension: int) -> Points:
        """Return points (n, d) of coordinates (n, e) that need not be those of a point: the choice of the largest one."""
        if not self.nominal:
            return embedded
        counts, at, columns = dict(self.nominal), 0, []
        for k in range(dimension):
            n = counts.get(k, 1)
            part = embedded[:, at : at + n]
            columns.append((part.argmax(axis=1) + 0.5) / n if k in counts else part[:, 0])
            at += n
        return np.column_stack(columns)

    def spread(self, scale: Vector) -> Vector:
        """Return (e,) scales of the embedded coordinates from those (d,) of the inputs."""
        counts = dict(self.nominal)
        return np.repeat(scale, [counts.get(k, 1) for k in range(len(scale))])

    def exchanged(self, u: Points) -> Points:
        """Return each of the points (n, d) with the choices of each other one, where they differ: (m, d).

        >>> Cube(nominal=((0, 2),)).exchanged(np.array([[0.25, 0.1], [0.75, 0.4], [0.25, 0.5]])).round(2).tolist()
        [[0.75, 0.1], [0.25, 0.4], [0.25, 0.4], [0.75, 0.5]]
        """
        choices = self.choices(u)
        one, other = np.nonzero((choices[:, None, :] != choices[None, :, :]).any(axis=2))
        return self.with_choices_of(u[other], u[one])

    def with_choices_of(self, other: Points, u: Points) -> Points:
        """Return points u (..., d) with the choices of the other ones (..., d): there is nothing between choices."""
        columns = [k for k, _ in self.nominal]
        found = np.array(u, dtype=np.float64)
        found[..., columns] = other[..., columns]
        return found

    def flipped(self, u: Points, start: Points, chance: Vector | float, rng: np.random.Generator) -> Points:
        """Return points u (n, d) that were reached by steps from `start` (n, d), with its choices, or another one.

        A step along the positions of choices would favour neighbours in a list; any other choice is equally likely instead.
        Draws nothing where no input has choices.

        Args:
            u: after the step.
            start: before.
            chance: (n,) probability that a choice is drawn anew, for each input that has some.
            rng: the only source of randomness.
        """
        if not self.nominal:
            return u
        found = np.array(u, dtype=np.float64)
        for k, n in self.nominal:
            own = _cell(start[:, k], n)
            other = (own + rng.integers(1, n, len(u))) % n
            found[:, k] = (np.where(rng.random(len(u)) < chance, other, own) + 0.5) / n
        return found


CONTINUOUS = Cube()
"""The cube of inputs that all are continuous."""


def _cell(u: Vector, n: int) -> Vector:
    """Return (m,) positions 0, ..., n - 1 of the intervals that coordinates lie in."""
    return np.clip(np.floor(u * n), 0, n - 1)
