"""How far a road user departs from a reference line: lateral and heading error against a polyline."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sbt.problem.arrays import Points, Vector, as_points
from sbt.problem.scenario import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["departure", "heading_error_max", "lateral_error_max"]


def departure(actor: ActorTrace, line: Points) -> tuple[Vector, Vector]:
    """Return how an actor's centre stands to the nearest point of a polyline.

    The first and the last piece go on straight beyond the ends.

    Args:
        actor: t instants.
        line: (n, 2) points in the order of travel, n >= 2, neighbours not equal (m).

    Returns:
        (t,) offset, positive to the left of the line (m), and (t,) heading less the line's, in
        (-pi, pi] (rad). At a corner the earlier piece counts.

    Raises:
        ValueError: the line has another shape, or a piece without a length.
    """
    points = as_points(line, 2)
    piece = np.diff(points, axis=0)  # (n - 1, 2)
    square = (piece**2).sum(axis=1)
    if len(points) < 2 or not (square > 0).all():
        raise ValueError("a line must have at least two points, each apart from the next")
    dx, dy = actor.x[:, None] - points[:-1, 0], actor.y[:, None] - points[:-1, 1]  # (t, n - 1)
    low, high = np.zeros(len(piece)), np.ones(len(piece))
    low[0], high[-1] = -np.inf, np.inf
    share = np.clip((dx * piece[:, 0] + dy * piece[:, 1]) / square, low, high)
    off = np.hypot(dx - share * piece[:, 0], dy - share * piece[:, 1])
    nearest = off.argmin(axis=1)
    rows = np.arange(len(nearest))
    left = piece[nearest, 0] * dy[rows, nearest] - piece[nearest, 1] * dx[rows, nearest]
    turn = actor.heading - np.arctan2(piece[nearest, 1], piece[nearest, 0])
    return np.copysign(off[rows, nearest], left), -np.arctan2(np.sin(-turn), np.cos(turn))


def lateral_error_max(line: ArrayLike, ego: str = "ego") -> Metric:
    """Return the largest absolute distance of ego's centre from a line (m).

    Args:
        line: (n, 2) points in the order of travel (m).
        ego: the road user.
    """
    points = as_points(line, 2)

    def function(trace: Trace) -> float:
        return float(np.abs(departure(trace.actor(ego), points)[0]).max())

    return Metric("lateral_error_max", function, "m", "high", 0.0, "largest distance of the ego's centre from its line")


def heading_error_max(line: ArrayLike, ego: str = "ego") -> Metric:
    """Return the largest absolute angle between ego's heading and a line (rad).

    Args:
        line: (n, 2) points in the order of travel (m).
        ego: the road user.
    """
    points = as_points(line, 2)

    def function(trace: Trace) -> float:
        return float(np.abs(departure(trace.actor(ego), points)[1]).max())

    return Metric("heading_error_max", function, "rad", "high", 0.0, "largest angle between the ego's heading and its line")
