"""A scene from above: lanes, vehicles as rectangles, people as circles, ego highlighted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.problem.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sbt.sumo.nets import Lane

__all__ = ["EDGE", "EGO", "OTHER", "ROAD", "STANDING", "Scenery", "draw_lanes", "window"]

EGO, OTHER, STANDING, ROAD, EDGE = "#1f6fb4", "#d9822b", "#8a8f94", "#e9eaec", "#ffffff"
_NEAR = 60.0
"""A view that follows ego shows so much to each side at most (m)."""


def draw_lanes(axes: Axes, lanes: Sequence[Lane]) -> None:
    """Draw lanes to scale, their borders in white."""
    from matplotlib.patches import Polygon

    axes.set_facecolor("#f7f7f5")
    for color, grow, z in ((EDGE, 0.5, 0), (ROAD, 0.0, 1)):
        for lane in lanes:
            outline = _beside(np.array(lane.shape), 0.5 * lane.width + grow - (0.07 if grow == 0.0 else 0.0))
            axes.add_patch(Polygon(outline, closed=True, facecolor=color, edgecolor="none", zorder=z))


def _beside(line: np.ndarray, distance: float) -> np.ndarray:
    """Return the (2 n, 2) outline of a strip around a line (n, 2)."""
    step = np.gradient(line, axis=0)
    across = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    return np.concatenate([line + distance * across, (line - distance * across)[::-1]])


def window(trace: Trace, ratio: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the middle of the view at every instant (t, 2), and its half width and half height (m).

    All of the run where that is small, else what is around ego, a little ahead.

    Args:
        trace: the run.
        ratio: of the view, width by height.
    """
    middle = np.array([0.5 * (v.min() + v.max()) for v in (trace.x, trace.y)])
    span = max(float(np.ptp(trace.x)) + 14.0, (float(np.ptp(trace.y)) + 14.0) * ratio)
    if span <= 2 * _NEAR:
        return np.tile(middle, (len(trace.time), 1)), (0.5 * span, 0.5 * span / ratio)
    ego = trace.actor(trace.actors[0])
    apart = [float(np.hypot(trace.x[:, k] - ego.x, trace.y[:, k] - ego.y).min()) for k in range(1, len(trace.actors))]
    nearest = min(apart, default=0.0)
    half = min(max(nearest + 20.0, 30.0), _NEAR)
    ahead = 0.4 * half  # less where ego drives up or down, or it would leave a wide view
    follow = np.stack([ego.x + ahead * np.cos(ego.heading), ego.y + ahead / ratio * np.sin(ego.heading)], axis=1)
    return follow, (half, half / ratio)


class Scenery:
    """The actors of a trace as shapes on axes; `show(k)` moves them to an instant."""

    def __init__(self, axes: Axes, trace: Trace):
        from matplotlib.patches import Circle, Polygon

        self._trace = trace
        self._shapes: list[Any] = []
        self._stands = stands = [bool(np.ptp(trace.x[:, k]) + np.ptp(trace.y[:, k]) < 1e-6) for k in range(len(trace.actors))]
        for k, (length, width) in enumerate(zip(trace.length.tolist(), trace.width.tolist(), strict=True)):
            color = EGO if k == 0 else STANDING if stands[k] else OTHER
            look: dict[str, Any] = {"facecolor": color, "edgecolor": "#333333", "linewidth": 0.6}
            look |= {"zorder": 5 if k else 6, "alpha": 0.7 if stands[k] else 1.0}
            shape = (
                Circle((0.0, 0.0), 0.5 * length, **look) if length == width else Polygon(np.zeros((5, 2)), closed=True, **look)
            )
            self._shapes.append(axes.add_patch(shape))

    def show(self, k: int) -> None:
        """Move every shape to instant k; the nose of a vehicle that moves is pointed a little."""
        t = self._trace
        for j, shape in enumerate(self._shapes):
            x, y, heading = float(t.x[k, j]), float(t.y[k, j]), float(t.heading[k, j])
            if hasattr(shape, "set_center"):
                shape.set_center((x, y))
                continue
            a, b = 0.5 * float(t.length[j]), 0.5 * float(t.width[j])
            nose = a if self._stands[j] else 0.86 * a
            local = np.array([[a, 0.0], [nose, b], [-a, b], [-a, -b], [nose, -b]])
            cos, sin = math.cos(heading), math.sin(heading)
            shape.set_xy(local @ np.array([[cos, sin], [-sin, cos]]) + (x, y))
