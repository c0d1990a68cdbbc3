"""Line of sight: which points a sensor sees past rectangles, standing or moving, in between."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

import numpy as np

from sbt.problem.arrays import Mask, Vector

__all__ = ["Occluders", "outline"]
_TINY = 1e-300
"""Prevents a division by zero for a line of sight parallel to a side."""


class _Rectangle(Protocol):
    """Anything with a centre, a heading and a size, such as a `State`."""

    x: float
    y: float
    heading: float
    length: float
    width: float


class Occluders:
    """Opaque rectangles, at fixed positions.

    Args:
        rectangles: (m, 5) centre x, y (m), heading (rad), length, width (m).
    """

    def __init__(self, rectangles: Iterable[tuple[float, float, float, float, float]]):
        boxes = [(x, y, math.cos(a), math.sin(a), 0.5 * length, 0.5 * width) for x, y, a, length, width in rectangles]
        axes = [(cos, sin) for _, _, cos, sin, _, _ in boxes] + [(-sin, cos) for _, _, cos, sin, _, _ in boxes]
        self._axes = np.array(axes).reshape(-1, 2)  # (2 m, 2): the longitudinal axes, then the lateral ones
        middle = [(x, y) for x, y, *_ in boxes] * 2
        self._middle = np.array([x * u + y * v for (x, y), (u, v) in zip(middle, axes, strict=True)])
        self._half = np.array([box[4] for box in boxes] + [box[5] for box in boxes])[:, None]

    @classmethod
    def of(cls, states: Iterable[_Rectangle]) -> Occluders:
        """Return the rectangles of some actors in their current states."""
        return cls((s.x, s.y, s.heading, s.length, s.width) for s in states)

    def occlude(self, eye: np.ndarray, points: np.ndarray) -> Mask:
        """Return (n,) whether each point is hidden from `eye`: its line of sight passes through a rectangle.

        >>> wall = Occluders([(5.0, 0.0, 0.0, 1.0, 4.0)])
        >>> wall.occlude(np.zeros(2), np.array([[10.0, 0.0], [3.0, 0.0], [10.0, 8.0]])).tolist()
        [True, False, False]
        """
        return np.asarray(self.blocked_length(eye, points) > 0.0)

    def blocked_length(self, eye: np.ndarray, points: np.ndarray) -> Vector:
        """Return the length of each line of sight that lies inside rectangles.

        Args:
            eye: (2,) x, y of the sensor (m).
            points: (n, 2) x, y (m).

        Returns:
            (n,) metres, summed over the rectangles; continuous in the eye, the points and the rectangles.

        Source:
            Slab test of a segment and a box, Ericson (2005), Real-Time Collision Detection, 5.3.3.
        """
        ways = (points - eye).T
        pace = 1.0 / (self._axes @ ways + _TINY)  # (2 m, n): along and across each rectangle
        middle, reach = pace * (self._middle - self._axes @ eye)[:, None], np.abs(pace) * self._half
        enter, leave, m = middle - reach, middle + reach, len(self._half) // 2
        inside = np.minimum(np.minimum(leave[:m], leave[m:]), 1.0) - np.maximum(np.maximum(enter[:m], enter[m:]), 0.0)
        shares = np.maximum(inside, 0.0)
        return np.asarray((shares[0] if m == 1 else shares.sum(axis=0)) * np.hypot(*ways))


def outline(state: _Rectangle, per_side: int = 5) -> np.ndarray:
    """Return (4 per_side, 2) points on the sides of a rectangle, corners included, counter-clockwise from the front left."""
    share = np.arange(per_side) / per_side
    ahead, left = 0.5 * state.length, 0.5 * state.width
    corners = np.array([[ahead, left], [-ahead, left], [-ahead, -left], [ahead, -left]])
    following = np.roll(corners, -1, axis=0)
    points = (corners[:, None] + share[:, None] * (following - corners)[:, None]).reshape(-1, 2)
    cos, sin = np.cos(state.heading), np.sin(state.heading)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + np.array([state.x, state.y]))
