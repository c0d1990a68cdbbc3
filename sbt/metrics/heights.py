"""Which differences in height tell that two road users are on different levels, such as on and under a bridge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Mask, Vector

__all__ = ["DETOUR", "LEVEL_HEIGHT", "STACKED", "STEEPEST", "Path", "are_stacked", "on_one_level"]

LEVEL_HEIGHT = 3.0
"""Difference in height from which on two road users are on different levels, such as on and under a bridge (m)."""
STEEPEST = 0.15
"""Slope of no road: who is so much higher is above, also on a road that the ego's way leads to."""
DETOUR = 1.5
"""Largest ratio of the way to the beeline between road users on one level by their way: a ramp leads around, and above itself."""
STACKED = 15.0
"""Distance of places on roads within which they are one above the other, or not (m)."""
_PASSES = 10.0
"""Distance in the plane within which somebody passes the place of another one, on its lane or one beside it (m)."""
_CELL, _STEP = 5.0, 1.0
"""Recorded places that are closer in the plane, and in height, are one (m)."""


@dataclass(frozen=True, eq=False)
class Path:
    """Where a road user was recorded, at n instants.

    Attributes:
        x, y, z: (n,) m; z is NaN where it is not known.
        rise_x, rise_y: (n,) of the road under it in both directions of the plane (m/m).
    """

    x: Vector
    y: Vector
    z: Vector
    rise_x: Vector
    rise_y: Vector

    @property
    def along(self) -> Vector:
        """(n,) way since the first instant (m)."""
        return np.concatenate([[0.0], np.hypot(np.diff(self.x), np.diff(self.y)).cumsum()])


def are_stacked(path: Path, same: Mask) -> bool:
    """Return whether places of a recording lie one above the other.

    Args:
        path: of all road users, one after another.
        same: (n - 1,) whether an instant and the next one are of one road user.
    """
    from scipy.spatial import cKDTree

    points = np.stack([path.x, path.y, path.z], axis=1)
    moves = np.diff(points, axis=0)
    pieces = np.where(same, np.ceil(np.hypot(moves[:, 0], moves[:, 1]) / (0.5 * STACKED)), 1.0).astype(int).clip(1, 100)
    at = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(at)) - np.repeat(pieces.cumsum() - pieces, pieces)) / pieces[at]
    points = np.concatenate([points[at] + share[:, None] * moves[at], points[-1:]])
    points = points[~np.isnan(points[:, 2])]
    if len(points) == 0 or np.ptp(points[:, 2]) < LEVEL_HEIGHT:
        return False
    _, kept = np.unique(np.floor(points / (_CELL, _CELL, _STEP)), axis=0, return_index=True)
    pairs = cKDTree(points[kept, :2]).query_pairs(STACKED, output_type="ndarray")
    heights = points[kept, 2]
    return bool((np.abs(heights[pairs[:, 0]] - heights[pairs[:, 1]]) >= LEVEL_HEIGHT).any())


def on_one_level(a: Path, b: Path, at_a: np.ndarray, at_b: np.ndarray) -> Mask:
    """Return (t,) whether two road users are on one level at t instants; also where a height is not known.

    Who is far is so if it is as high as the slope of its road or the other's leads, or between, or on the way to or from it.

    Args:
        a: where one was recorded.
        b: likewise the other.
        at_a: (t,) indices of the instants.
        at_b: likewise.
    """
    dx, dy, height = b.x[at_b] - a.x[at_a], b.y[at_b] - a.y[at_a], b.z[at_b] - a.z[at_a]
    rises = np.stack([dx * one.rise_x[at] + dy * one.rise_y[at] for one, at in ((a, at_a), (b, at_b))])
    same = ~((height <= rises.min(axis=0) - LEVEL_HEIGHT) | (height >= rises.max(axis=0) + LEVEL_HEIGHT))
    far = np.hypot(dx, dy)
    (unsure,) = (~same & (np.abs(height) <= STEEPEST * far)).nonzero()
    if len(unsure):
        ways = (_leads(a, b, at_a[unsure], at_b[unsure], far[unsure]), _leads(b, a, at_b[unsure], at_a[unsure], far[unsure]))
        same[unsure] = ways[0] | ways[1]
    return same


def _leads(a: Path, b: Path, at_a: np.ndarray, at_b: np.ndarray, far: Vector) -> Mask:
    """Return (t,) whether the way of one, before or after, leads to the other's place without a detour; far: (t,) beeline (m)."""
    along = a.along
    near = np.hypot(a.x - b.x[at_b, None], a.y - b.y[at_b, None]) <= _PASSES  # (t, n)
    near &= np.abs(a.z - b.z[at_b, None]) < LEVEL_HEIGHT
    near &= np.abs(along - along[at_a, None]) <= DETOUR * far[:, None]
    return np.asarray(near.any(axis=1))
