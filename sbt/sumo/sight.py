"""Line of sight: which points a sensor sees past rectangles that stand or drive in between."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

import numpy as np

from sbt.arrays import Mask

__all__ = ["Boxes", "outline"]
_ALL = (0.0, 0.0, -1.0)
"""A line with every point beyond it."""


class _Rectangle(Protocol):
    """Anything with a centre, a direction and a size: a `State`."""

    x: float
    y: float
    heading: float
    length: float
    width: float


class Boxes:
    """Rectangles that hide what lies behind or inside them; a value.

    Args:
        rectangles: (m, 5) centre x, y (m), heading (rad), length, width (m).
    """

    def __init__(self, rectangles: Iterable[tuple[float, float, float, float, float]]):
        self._boxes = [(x, y, math.cos(a), math.sin(a), 0.5 * length, 0.5 * width) for x, y, a, length, width in rectangles]

    @classmethod
    def of(cls, states: Iterable[_Rectangle]) -> Boxes:
        """Return the rectangles of some actors as they are now."""
        return cls((s.x, s.y, s.heading, s.length, s.width) for s in states)

    def hides(self, eye: np.ndarray, points: np.ndarray) -> Mask:
        """Return which points cannot be seen from `eye`.

        Args:
            eye: (2,) x, y of the sensor (m).
            points: (n, 2) x, y (m).

        Returns:
            (n,) True where the segment from eye to point passes through a rectangle: between the lines of sight that
            touch it, and beyond those of its sides that face the eye.

        >>> wall = Boxes([(5.0, 0.0, 0.0, 1.0, 4.0)])
        >>> wall.hides(np.zeros(2), np.array([[10.0, 0.0], [3.0, 0.0], [10.0, 8.0]])).tolist()
        [True, False, False]
        """
        if not self._boxes:
            return np.zeros(len(points), dtype=bool)
        x, y = eye.tolist()
        lines = np.array([_shadow(x, y, *box) for box in self._boxes])  # (m, 4, 3)
        beyond = lines[:, :, :2] @ (points - eye).T > lines[:, :, 2:]  # (m, 4, n)
        return np.asarray(beyond.all(axis=1).any(axis=0))


def _shadow(
    x: float, y: float, middle_x: float, middle_y: float, cos: float, sin: float, ahead: float, left: float
) -> tuple[tuple[float, float, float], ...]:
    """Return the four lines, each (a, b, c), that bound a box's shadow: a dx + b dy > c, (dx, dy) from the eye at x, y.

    Reckoned in the box's frame, mirrored so that the eye is in its first quarter.
    """
    dx, dy = x - middle_x, y - middle_y
    u, v = cos * dx + sin * dy, cos * dy - sin * dx
    along, across = math.copysign(1.0, u), math.copysign(1.0, v)
    u, v = abs(u), abs(v)
    faces_u, faces_v = u > ahead, v > left  # the sides that face the eye
    if not (faces_u or faces_v):
        return (_ALL,) * 4
    upper = (-ahead if faces_v else ahead) - u, left - v  # from the eye to the corners that the lines of sight touch
    lower = ahead - u, (-left if faces_u else left) - v
    bounds = (
        (-upper[1], upper[0], 0.0),
        (lower[1], -lower[0], 0.0),
        (-1.0, 0.0, u - ahead) if faces_u else _ALL,
        (0.0, -1.0, v - left) if faces_v else _ALL,
    )
    return tuple((a * along * cos - b * across * sin, a * along * sin + b * across * cos, c) for a, b, c in bounds)


def outline(state: _Rectangle, per_side: int = 5) -> np.ndarray:
    """Return (4 per_side, 2) points on the sides of a rectangle, corners included, counter-clockwise from the front left."""
    share = np.arange(per_side) / per_side
    ahead, left = 0.5 * state.length, 0.5 * state.width
    corners = np.array([[ahead, left], [-ahead, left], [-ahead, -left], [ahead, -left]])
    following = np.roll(corners, -1, axis=0)
    points = (corners[:, None] + share[:, None] * (following - corners)[:, None]).reshape(-1, 2)
    cos, sin = np.cos(state.heading), np.sin(state.heading)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + np.array([state.x, state.y]))
