"""How well a road user keeps to a line: lateral and heading error, measured against a curve in the plane."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sbt.arrays import Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["Curve", "lateral_metrics"]


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
        k = int(np.argmin((self.x - x) ** 2 + (self.y - y) ** 2))
        heading = float(self.heading[k])
        dx, dy = x - float(self.x[k]), y - float(self.y[k])
        cos, sin = np.cos(heading), np.sin(heading)
        along, left = float(dx * cos + dy * sin), float(dy * cos - dx * sin)
        bend = float(self.curvature[k])
        along /= 1.0 - bend * left  # the nearest point lies on an arc through point k
        return float(self.s[k]) + along, left - 0.5 * bend * along**2, heading + bend * along


def _integral(values: Vector, step: float) -> Vector:
    """Return the (n,) running integral by the trapezoidal rule, from 0."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))]) * step


@lru_cache(maxsize=8)
def _errors(trace: Trace, curve: Curve, ego: str) -> tuple[Vector, Vector]:
    """Return the (t,) distance to the left of the curve (m) and the heading relative to it (degrees)."""
    actor = trace.actor(ego)
    places = [curve.project(x, y) for x, y in zip(actor.x.tolist(), actor.y.tolist(), strict=True)]
    _, left, heading = np.array(places).T
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
