"""How well a road user keeps to a line: lateral and heading error, measured against a curve in the plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.problem.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["Curve", "lateral_metrics"]

_CELL = 16
"""Stored points of a curve that are looked at together."""


class Curve:
    """A plane curve whose curvature is piecewise linear: straights, arcs and the clothoids between them.

    Args:
        start: x, y (m) and heading (rad) at its beginning.
        pieces: (length (m), curvature at the end (1/m)) one after the other, from curvature 0; left is positive.
        spacing: of the points it is stored at (m).

    Attributes:
        s, x, y, heading, curvature: (n,) along the curve.
    """

    def __init__(self, start: tuple[float, float, float], pieces: Sequence[tuple[float, float]], spacing: float = 0.25):
        ends = np.concatenate([[0.0], np.cumsum([length for length, _ in pieces])])
        bends = np.array([0.0, *(bend for _, bend in pieces)])
        n = round(float(ends[-1]) / spacing)
        self.s = np.linspace(0.0, float(ends[-1]), n + 1)
        step = float(self.s[1])
        self.curvature = np.interp(self.s, ends, bends)
        fine = 8  # Simpson would do; a finer trapezoid is as exact as the points need
        s = np.linspace(0.0, float(ends[-1]), fine * n + 1)
        heading = start[2] + _integral(np.interp(s, ends, bends), step / fine)
        self.heading = heading[::fine]
        self.x = start[0] + _integral(np.cos(heading), step / fine)[::fine]
        self.y = start[1] + _integral(np.sin(heading), step / fine)[::fine]

    @property
    def length(self) -> float:
        """Length (m)."""
        return float(self.s[-1])

    def beside(self, s: Vector, left: float) -> np.ndarray:
        """Return the (n, 2) points at `s` along the curve, `left` metres to its left."""
        x, y, heading = (np.interp(s, self.s, values) for values in (self.x, self.y, self.heading))
        return np.stack([x - left * np.sin(heading), y + left * np.cos(heading)], axis=-1)

    def project(self, x: float, y: float) -> tuple[float, float, float]:
        """Return where a point is: s of the nearest point (m), distance to the left (m), heading there (rad)."""
        s, left, heading = self._seen_from(np.array([np.argmin((self.x - x) ** 2 + (self.y - y) ** 2)]), x, y)
        return float(s[0]), float(left[0]), float(heading[0])

    def project_all(self, x: Vector, y: Vector) -> tuple[Vector, Vector, Vector]:
        """Return what `project` says of (n,) points, (n,) each, without looking at the whole curve for each of them."""
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
        return self._seen_from(found[order[first]], x, y)

    def _seen_from(self, k: np.ndarray, x: Vector | float, y: Vector | float) -> tuple[Vector, Vector, Vector]:
        """Return s (m), distance to the left (m) and heading (rad) of points near the stored points k, (n,) each."""
        heading, bend = self.heading[k], self.curvature[k]
        dx, dy = x - self.x[k], y - self.y[k]
        cos, sin = np.cos(heading), np.sin(heading)
        along, left = dx * cos + dy * sin, dy * cos - dx * sin
        along = along / (1.0 - bend * left)  # the nearest point lies on an arc through point k
        return self.s[k] + along, left - 0.5 * bend * along**2, heading + bend * along


def _integral(values: Vector, step: float) -> Vector:
    """Return the (n,) running integral by the trapezoidal rule, from 0."""
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
    return (
        Metric(
            "pos_lat_abs_err_max", lambda trace: float(np.abs(_errors(trace, curve, ego)[0]).max()), "m", "high", 0.0,
            "largest distance of the ego's middle from the middle of its lane",
        ),
        Metric(
            "pos_lat_err_max", lambda trace: float(_errors(trace, curve, ego)[0].max()), "m", "high", 0.0,
            "furthest to the left of the middle of the lane",
        ),
        Metric(
            "pos_lat_err_min", lambda trace: float(_errors(trace, curve, ego)[0].min()), "m", "low", 0.0,
            "furthest to the right of the middle of the lane, negative",
        ),
        Metric(
            "theta_err_max", lambda trace: float(_errors(trace, curve, ego)[1].max()), "deg", "high", 0.0,
            "largest heading to the left of the lane's",
        ),
        Metric(
            "theta_err_min", lambda trace: float(_errors(trace, curve, ego)[1].min()), "deg", "low", 0.0,
            "largest heading to the right of the lane's, negative",
        ),
    )  # fmt: skip
