"""What the ego sees and expects in a film: the area in view of its sensor, and where road users would be if they kept on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.problem.trace import FieldOfView, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["HORIZON", "Sight", "area_in_view", "expected", "hiding"]

HORIZON = (1.0, 2.0, 3.0)
"""Times ahead at which an expected position is marked (s)."""
_RAYS = 121
"""Directions in which one looks, beside those of the corners of what hides."""
_BESIDE = 1e-4
"""Rays pass a corner so closely (rad, m)."""
_SLOW = 0.5
"""Who is slower keeps its place (m/s)."""


def hiding(trace: Trace, view: FieldOfView) -> list[int]:
    """Return the columns of the actors that hide what is behind them."""
    return [j for j in range(1, len(trace.actors)) if view.hidden_by is None or trace.actors[j] in view.hidden_by]


def area_in_view(view: FieldOfView, ego: Sequence[float], boxes: np.ndarray, most: float) -> np.ndarray:
    """Return the (n, 2) outline of what the sensor sees (m).

    Args:
        view: of the sensor.
        ego: x, y (m) and heading (rad) of its vehicle's middle.
        boxes: (m, 5) x, y, heading, length, width of what hides.
        most: seen so far where its reach is further (m).

    >>> wall = np.array([[10.0, 0.0, 0.0, 1.0, 4.0]])
    >>> float(area_in_view(FieldOfView(20.0, half_width=1.0), (0.0, 0.0, 0.0), wall, 99.0)[:, 0].max())
    9.5
    """
    x, y, heading = ego
    ways = np.array([math.cos(heading), math.sin(heading)])
    eye = np.array([x, y]) + view.ahead * ways
    reach = min(view.reach, most)
    corners = _corners(boxes) - eye  # (4 m, 2)
    if math.isfinite(view.half_width):
        beside = corners @ np.array([-ways[1], ways[0]])
        offsets = _with_edges(np.linspace(-view.half_width, view.half_width, 9), beside, view.half_width)
        starts = eye + offsets[:, None] * np.array([-ways[1], ways[0]])
        ends = starts + _free(starts, np.broadcast_to(ways, starts.shape), boxes, reach)[:, None] * ways
        return np.concatenate([starts, ends[::-1]])
    turn = np.arctan2(corners[:, 1], corners[:, 0]) - heading
    turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
    angles = heading + _with_edges(np.linspace(-view.half_angle, view.half_angle, _RAYS), turn, view.half_angle)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    starts = np.broadcast_to(eye, rays.shape)
    ends = eye + _free(starts, rays, boxes, reach)[:, None] * rays
    return ends if view.half_angle >= math.pi else np.concatenate([eye[None], ends])


def _with_edges(spread: np.ndarray, edges: np.ndarray, most: float) -> np.ndarray:
    """Return positions in order, those just beside edges among them."""
    beside = np.concatenate([edges - _BESIDE, edges + _BESIDE])
    return np.sort(np.concatenate([spread, beside[np.abs(beside) < most]]))


def _corners(boxes: np.ndarray) -> np.ndarray:
    if len(boxes) == 0:
        return np.empty((0, 2))
    x, y, heading, length, width = boxes.T
    cos, sin = np.cos(heading), np.sin(heading)
    at = [(x + 0.5 * (a * length * cos - b * width * sin), y + 0.5 * (a * length * sin + b * width * cos))
          for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]  # fmt: skip
    return np.concatenate([np.stack(corner, axis=1) for corner in at])


def _free(starts: np.ndarray, rays: np.ndarray, boxes: np.ndarray, reach: float) -> np.ndarray:
    """Return how far each ray (n, 2) goes before it meets a rectangle, at most `reach` (m): nothing where it begins in one."""
    found = np.full(len(rays), reach)
    for x, y, heading, length, width in boxes.tolist():
        cos, sin = math.cos(heading), math.sin(heading)
        dx, dy = starts[:, 0] - x, starts[:, 1] - y
        enter, leave = np.full(len(rays), -np.inf), np.full(len(rays), np.inf)
        for at, way, half in (
            (dx * cos + dy * sin, rays[:, 0] * cos + rays[:, 1] * sin, 0.5 * length),
            (dy * cos - dx * sin, rays[:, 1] * cos - rays[:, 0] * sin, 0.5 * width),
        ):
            pace = 1.0 / np.where(np.abs(way) < 1e-12, 1e-12, way)
            near, far = (-half - at) * pace, (half - at) * pace
            enter, leave = np.maximum(enter, np.minimum(near, far)), np.minimum(leave, np.maximum(near, far))
        hit = (enter <= leave) & (leave > 0.0)
        found[hit] = np.minimum(found[hit], np.maximum(enter[hit], 0.0))
    return found


def expected(trace: Trace, k: int, j: int) -> np.ndarray:
    """Return the (h, 2) places where an actor would be after each time of `HORIZON` if it kept on; none if it stands."""
    x, y, heading, speed = (float(v[k, j]) for v in (trace.x, trace.y, trace.heading, trace.speed))
    if not abs(speed) >= _SLOW:  # NaN too
        return np.empty((0, 2))
    times = np.array(HORIZON)
    return np.stack([x + speed * times * math.cos(heading), y + speed * times * math.sin(heading)], axis=1)


class Sight:
    """The area in view of ego's sensor and the expected places on axes; `show(k)` draws those of an instant.

    Args:
        axes: to draw on.
        trace: the run.
        named: columns of the actors whose expected places are shown.
        colors: of all actors.
        most: the area is drawn so far at most (m).
    """

    def __init__(self, axes: Axes, trace: Trace, named: Sequence[int], colors: Sequence[str], most: float):
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        self._trace, self._named, self._most = trace, named, most
        self._hiding = [] if trace.view is None else hiding(trace, trace.view)
        self._area: Any = None
        if trace.view is not None:
            style: dict[str, Any] = {"facecolor": "#ffe14d50", "edgecolor": "#b89600", "linewidth": 0.7, "zorder": 2}
            self._area = axes.add_patch(Polygon(np.zeros((3, 2)), **style))
        self._colors = [colors[j] for j in named]
        self._ways: Any = axes.add_collection(LineCollection([], linestyles=":", linewidths=1.1, zorder=3), autolim=False)
        self._marks: Any = axes.scatter([], [], s=7.0, zorder=3, linewidths=0.0)

    def show(self, k: int) -> None:
        """Draw what is in view and expected at instant k."""
        trace = self._trace
        if self._area is not None and trace.view is not None:
            there = [j for j in self._hiding if np.isfinite(trace.x[k, j])]
            sizes = zip(trace.length[there], trace.width[there], strict=True)
            poses = zip(trace.x[k, there], trace.y[k, there], trace.heading[k, there], strict=True)
            boxes = np.array([(*pose, *size) for pose, size in zip(poses, sizes, strict=True)])
            ego = [float(v[k, 0]) for v in (trace.x, trace.y, trace.heading)]
            self._area.set_visible(bool(np.isfinite(ego).all()))
            if np.isfinite(ego).all():
                self._area.set_xy(area_in_view(trace.view, ego, boxes.reshape(-1, 5), self._most))
        places = [expected(trace, k, j) for j in self._named]
        shown = [(p, np.concatenate([[[trace.x[k, j], trace.y[k, j]]], p]), c)
                 for j, p, c in zip(self._named, places, self._colors, strict=True) if len(p)]  # fmt: skip
        self._ways.set_segments([line for _, line, _ in shown])
        self._ways.set_color([color for *_, color in shown])
        self._marks.set_offsets(np.concatenate([p for p, *_ in shown]) if shown else np.empty((0, 2)))
        self._marks.set_color([color for p, _, color in shown for _ in p])
