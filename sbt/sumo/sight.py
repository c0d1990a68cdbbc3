"""Line of sight: which points a sensor sees past rectangles that stand or drive in between."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from sbt.arrays import Mask

__all__ = ["Boxes", "outline"]

_NEVER = 1e-300


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
        table = np.array(list(rectangles), dtype=np.float64).reshape(-1, 5)
        cos, sin = np.cos(table[:, 2]), np.sin(table[:, 2])
        self._centre = table[:, None, :2]  # (m, 1, 2)
        self._axes = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -1)  # (m, 2, 2): world to box
        self._half = 0.5 * table[:, None, 3:]  # (m, 1, 2)

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
            (n,) True where the segment from eye to point passes through a rectangle.

        Source:
            slab test of a segment and a box, Ericson (2005), Real-Time Collision Detection, 5.3.3.

        >>> wall = Boxes([(5.0, 0.0, 0.0, 1.0, 4.0)])
        >>> wall.hides(np.zeros(2), np.array([[10.0, 0.0], [3.0, 0.0], [10.0, 8.0]])).tolist()
        [True, False, False]
        """
        start = (eye - self._centre) @ self._axes  # (m, 1, 2)
        along = (points - eye) @ self._axes  # (m, n, 2)
        along = np.where(along == 0.0, _NEVER, along)
        first, last = (-self._half - start) / along, (self._half - start) / along
        near, far = np.minimum(first, last), np.maximum(first, last)
        enter = np.maximum(near[..., 0], near[..., 1])  # (m, n); faster than a reduction over two
        leave = np.minimum(far[..., 0], far[..., 1])
        hit = (enter < leave) & (leave > 0.0) & (enter < 1.0)
        return np.asarray(hit.any(axis=0))


def outline(state: _Rectangle, per_side: int = 5) -> np.ndarray:
    """Return (4 per_side, 2) points on the sides of a rectangle, corners included, counter-clockwise from the front left."""
    share = np.arange(per_side) / per_side
    ahead, left = 0.5 * state.length, 0.5 * state.width
    corners = np.array([[ahead, left], [-ahead, left], [-ahead, -left], [ahead, -left]])
    following = np.roll(corners, -1, axis=0)
    points = (corners[:, None] + share[:, None] * (following - corners)[:, None]).reshape(-1, 2)
    cos, sin = np.cos(state.heading), np.sin(state.heading)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + np.array([state.x, state.y]))
