"""Deviation from a reference line: lateral and heading error against a polyline or a smooth curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from sbt.metrics.cache import per_trace
from sbt.problem.arrays import Points, Vector, as_points
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["Curve", "deviation", "heading_error_max", "lateral_error_max", "lateral_metrics"]

_CELL = 16
"""Stored points of a curve that are searched together."""


class Curve:
    """A plane curve with piecewise linear curvature: straight lines, arcs and clothoids.

    Args:
        start: x, y (m) and heading (rad) at its beginning.
        pieces: (length (m), curvature at the end (1/m)) of consecutive pieces, from curvature 0 on; left is positive.
        spacing: of the stored points (m).

    Attributes:
        s: (n,) arc length of the stored points (m).
        x: (n,) their x (m).
        y: (n,) their y (m).
        heading: (n,) of the curve (rad).
        curvature: (n,) of the curve (1/m).
    """

    def __init__(self, start: tuple[float, float, float], pieces: Sequence[tuple[float, float]], spacing: float = 0.25):
        ends = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
        bends = np.array([0.0, *(bend for _, bend in pieces)])
        n = round(float(ends[-1]) / spacing)
        self.s = np.linspace(0.0, float(ends[-1]), n + 1)
        step = float(self.s[1])
        self.curvature = np.interp(self.s, ends, bends)
        fine = 8  # sub-steps of the trapezoidal rule, as accurate as the spacing requires
        s = np.linspace(0.0, float(ends[-1]), fine * n + 1)
        heading = start[2] + _integral(np.interp(s, ends, bends), step / fine)
        self.heading = heading[::fine]
        self.x = start[0] + _integral(np.cos(heading), step / fine)[::fine]
        self.y = start[1] + _integral(np.sin(heading), step / fine)[::fine]

    @property
    def length(self) -> float:
        """Length (m)."""
        return float(self.s[-1])

    def offset_points(self, s: Vector, left: float) -> np.ndarray:
        """Return the (n, 2) points at the arc lengths `s`, `left` metres to the left of the curve."""
        x, y, heading = (np.interp(s, self.s, values) for values in (self.x, self.y, self.heading))
        return np.stack([x - left * np.sin(heading), y + left * np.cos(heading)], axis=-1)

    def project(self, x: float, y: float) -> tuple[float, float, float]:
        """Return the arc length (m) and heading (rad) at the nearest point of the curve, and the distance to its left (m).

        Returns:
            (arc length, distance to the left, heading).
        """
        s, left, heading = self._near(np.array([np.argmin((self.x - x) ** 2 + (self.y - y) ** 2)]), x, y)
        return float(s[0]), float(left[0]), float(heading[0])

    def project_all(self, x: Vector, y: Vector) -> tuple[Vector, Vector, Vector]:
        """Return `project` for (n,) points, (n,) each, without comparing each point with the whole curve."""
        middle = np.arange(_CELL // 2, len(self.s) + _CELL // 2, _CELL)  # of cells of points; the last one may be short
        spots = np.minimum(middle, len(self.s) - 1)
        far = np.hypot(self.x[spots] - x[:, None], self.y[spots] - y[:, None])  # (n, cells)
        reach = _CELL * float(self.s[1])  # no point of a cell is further from its middle than half of this
        row, cell = np.nonzero(far <= far.min(axis=1, keepdims=True) + reach)
        points = np.minimum(middle[cell, None] + np.arange(-(_CELL // 2), _CELL // 2), len(self.s) - 1)  # (pairs, _CELL)
        square = (self.x[points] - x[row, None]) ** 2 + (self.y[points] - y[row, None]) ** 2
        best = square.argmin(axis=1)[:, None]
        found, least = np.take_along_axis(points, best, 1)[:, 0], np.take_along_axis(square, best, 1)[:, 0]
        order = np.lexsort((least, row))
        _, first = np.unique(row[order], return_index=True)
        return self._near(found[order[first]], x, y)

    def _near(self, k: np.ndarray, x: Vector | float, y: Vector | float) -> tuple[Vector, Vector, Vector]:
        """Return arc length (m), distance to the left (m) and heading (rad) of points near the stored points k, (n,) each."""
        heading, bend = self.heading[k], self.curvature[k]
        dx, dy = x - self.x[k], y - self.y[k]
        cos, sin = np.cos(heading), np.sin(heading)
        along, left = dx * cos + dy * sin, dy * cos - dx * sin
        along = along / (1.0 - bend * left)  # the nearest point lies on an arc through point k
        return self.s[k] + along, left - 0.5 * bend * along**2, heading + bend * along


def _integral(values: Vector, step: float) -> Vector:
    """Return the (n,) cumulative integral by the trapezoidal rule, from 0."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))]) * step


@per_trace
def _errors(trace: Trace, curve: Curve, ego: str) -> tuple[Vector, Vector]:
    """Return the (t,) distance to the left of the curve (m) and the heading relative to it (degrees)."""
    actor = trace.actor(ego)
    _, left, heading = curve.project_all(actor.x, actor.y)
    angle = (actor.heading - heading + np.pi) % (2 * np.pi) - np.pi
    return left, np.degrees(angle)


def lateral_metrics(curve: Curve, ego: str = "ego") -> tuple[Metric, ...]:
    """Return the metrics of lateral and heading error against a curve; left is positive."""

    def metric(name: str, error: int, worst: Callable[[Vector], float], direction: str, description: str) -> Metric:
        unit = ("m", "deg")[error]
        return Metric(name, lambda trace: float(worst(_errors(trace, curve, ego)[error])), unit, direction, 0.0, description)

    absolute = "largest distance of the ego's middle from the middle of its lane"
    return (
        metric("pos_lat_abs_err_max", 0, lambda values: np.abs(values).max(), "high", absolute),
        metric("pos_lat_err_max", 0, np.max, "high", "furthest to the left of the middle of the lane"),
        metric("pos_lat_err_min", 0, np.min, "low", "furthest to the right of the middle of the lane, negative"),
        metric("theta_err_max", 1, np.max, "high", "largest heading to the left of the lane's"),
        metric("theta_err_min", 1, np.min, "low", "largest heading to the right of the lane's, negative"),
    )


def deviation(actor: ActorTrace, line: Points) -> tuple[Vector, Vector]:
    """Return the deviation of an actor's centre from the nearest point of a polyline.

    Beyond an end of it the line goes on straight, where no other part of it is nearer than that end.

    Args:
        actor: t instants.
        line: (n, 2) points in the direction of travel, n >= 2, consecutive points distinct (m).

    Returns:
        (t,) offset, positive to the left of the line (m), and (t,) heading relative to the line, in
        (-pi, pi] (rad). At a corner the earlier segment counts.

    Raises:
        ValueError: the line has another shape, or a segment of length 0.
    """
    points = as_points(line, 2)
    segment = np.diff(points, axis=0)  # (n - 1, 2)
    square = (segment**2).sum(axis=1)
    if len(points) < 2 or not (square > 0).all():
        raise ValueError("a line must have at least two points, each apart from the next")
    dx, dy = actor.x[:, None] - points[:-1, 0], actor.y[:, None] - points[:-1, 1]  # (t, n - 1)
    along = (dx * segment[:, 0] + dy * segment[:, 1]) / square
    share = np.clip(along, 0.0, 1.0)
    nearest = np.hypot(dx - share * segment[:, 0], dy - share * segment[:, 1]).argmin(axis=1)
    low, high = np.zeros(len(segment)), np.ones(len(segment))
    low[0], high[-1] = -np.inf, np.inf
    rows = np.arange(len(nearest))
    share = np.clip(along[rows, nearest], low[nearest], high[nearest])
    off = np.hypot(dx[rows, nearest] - share * segment[nearest, 0], dy[rows, nearest] - share * segment[nearest, 1])
    left = segment[nearest, 0] * dy[rows, nearest] - segment[nearest, 1] * dx[rows, nearest]
    turn = actor.heading - np.arctan2(segment[nearest, 1], segment[nearest, 0])
    return np.copysign(off, left), -np.arctan2(np.sin(-turn), np.cos(turn))


def _largest(name: str, error: int, unit: str, description: str, line: ArrayLike, ego: str) -> Metric:
    """Return the largest absolute offset (error 0) or relative heading (error 1) from a polyline as a metric."""
    points = as_points(line, 2)

    def function(trace: Trace) -> float:
        return float(np.nanmax(np.abs(deviation(trace.actor(ego), points)[error]), initial=0.0))

    return Metric(name, function, unit, "high", 0.0, description)


def lateral_error_max(line: ArrayLike, ego: str = "ego") -> Metric:
    """Return the largest absolute distance of the ego's centre from a polyline (m).

    Args:
        line: (n, 2) points in the direction of travel (m).
        ego: the road user.
    """
    return _largest("lateral_error_max", 0, "m", "largest distance of the ego's centre from its line", line, ego)


def heading_error_max(line: ArrayLike, ego: str = "ego") -> Metric:
    """Return the largest absolute angle between the ego's heading and a polyline (rad).

    Args:
        line: (n, 2) points in the direction of travel (m).
        ego: the road user.
    """
    return _largest("heading_error_max", 1, "rad", "largest angle between the ego's heading and its line", line, ego)
