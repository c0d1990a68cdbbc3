"""A run as an animated GIF: the scene from above, and below it the metric of the run so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.errors import RunError
from sbt.problem.arrays import Vector
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace
from sbt.report.scene import EGO, OTHER, ROAD, STANDING, Scenery, draw_lanes, window
from sbt.report.style import CRITICAL, MODEL, REGION, figure_style, label

if TYPE_CHECKING:
    from sbt.sumo.nets import Lane

__all__ = ["metric_so_far", "write_film"]

_FRAMES = 90
"""Largest number of frames; a long run has fewer frames a second, at the same speed."""
_FASTEST = 0.08
"""Shortest time of a frame (s)."""
_HOLD = 1.2
"""Time for which the last frame is shown (s)."""
_SIZE = (5.6, 3.6)
_DPI = 96
_COLORS = 48


def metric_so_far(trace: Trace, metric: Metric, instants: Sequence[int]) -> Vector:
    """Return the metric of the run up to each of these instants, NaN where it has no value yet.

    A metric over the paths that were driven uses the whole paths at every instant.

    >>> import numpy as np
    >>> from sbt.problem.trace import Trace
    >>> x = np.array([[0.0], [3.0], [1.0]])
    >>> run = Trace(np.arange(3.0), ("ego",), x, x, x, x, x, np.ones(1), np.ones(1))
    >>> metric_so_far(run, Metric("furthest", lambda t: float(t.x.max())), [0, 1, 2]).tolist()
    [0.0, 3.0, 3.0]
    """
    if metric.over_time is not None:
        worst = np.minimum if metric.direction == "low" else np.maximum
        return np.asarray(worst.accumulate(metric.over_time(trace))[list(instants)])
    values = []
    for k in instants:
        try:
            values.append(metric(_until(trace, k)))
        except RunError:
            values.append(float("nan"))
    return np.array(values)


def _until(trace: Trace, k: int) -> Trace:
    """Return the trace up to instant k."""
    end = slice(0, k + 1)
    return Trace(
        trace.time[end], trace.actors, trace.x[end], trace.y[end], trace.heading[end], trace.speed[end], trace.acceleration[end],
        trace.length, trace.width, trace.ended, trace.reported, {name: v[end] for name, v in trace.signals.items()},
    )  # fmt: skip


def write_film(
    file: Path, trace: Trace, metric: Metric, requirement: Requirement, *, lanes: Sequence[Lane] = (), title: str = ""
) -> None:
    """Write a run as an animated GIF in real time.

    Args:
        file: to be written.
        trace: the run.
        metric: shown below, its value up to then.
        requirement: whose critical interval is shaded.
        lanes: of the network.
        title: above the scene.
    """
    with figure_style():
        images = _frames(trace, metric, requirement, lanes, title)
    step = _every(trace)
    shown = [max(round(100 * step * _dt(trace)), 2) * 10] * len(images)
    shown[-1] += round(1000 * _HOLD)
    images[0].save(file, save_all=True, append_images=images[1:], duration=shown, loop=0, optimize=True, disposal=1)


def _dt(trace: Trace) -> float:
    return float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 0.1


def _every(trace: Trace) -> int:
    """Return how many instants a frame stands for."""
    return max(-(-len(trace.time) // _FRAMES), round(_FASTEST / _dt(trace) + 0.49), 1)


def _frames(trace: Trace, metric: Metric, requirement: Requirement, lanes: Sequence[Lane], title: str) -> list[Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    last = len(trace.time) - 1
    instants = [*range(0, last, _every(trace)), last]
    figure = Figure(figsize=_SIZE, dpi=_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    above, below = figure.add_axes((0.02, 0.36, 0.96, 0.57)), figure.add_axes((0.08, 0.12, 0.89, 0.17))
    width, height = 0.96 * _SIZE[0], 0.57 * _SIZE[1]
    middle, (half_x, half_y) = window(trace, width / height)
    above.grid(visible=False)
    for side in above.spines.values():
        side.set_visible(False)
    above.set_xticks([])
    above.set_yticks([])
    above.set_title(title, loc="left", fontsize=9)
    draw_lanes(above, lanes)
    scenery = Scenery(above, trace)
    clock = above.text(0.99, 0.96, "", transform=above.transAxes, ha="right", va="top", fontsize=9, zorder=9)
    far = above.text(0.01, 0.05, "", transform=above.transAxes, ha="left", va="bottom", fontsize=8, color="#555555", zorder=9)
    now = _draw_metric(below, trace, metric, requirement, instants)
    drawn = []
    for k in instants:
        scenery.show(k)
        above.set_xlim(middle[k, 0] - half_x, middle[k, 0] + half_x)
        above.set_ylim(middle[k, 1] - half_y, middle[k, 1] + half_y)
        clock.set_text(f"{trace.time[k]:.1f} s   {3.6 * trace.speed[k, 0]:.0f} km/h")
        far.set_text(_out_of_view(trace, k, middle[k], half_x, half_y))
        now.set_xdata([trace.time[k]] * 2)
        canvas.draw()
        drawn.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return _with_one_palette(drawn)


def _out_of_view(trace: Trace, k: int, middle: np.ndarray, half_x: float, half_y: float) -> str:
    """Return who moves outside the view, and how far from ego."""
    hidden = []
    for j, name in enumerate(trace.actors[1:], start=1):
        outside = abs(trace.x[k, j] - middle[0]) > half_x or abs(trace.y[k, j] - middle[1]) > half_y
        if outside and trace.speed[:, j].max() > 0.0:
            hidden.append(f"{name} {float(np.hypot(trace.x[k, j] - trace.x[k, 0], trace.y[k, j] - trace.y[k, 0])):.0f} m away")
    return ", ".join(hidden[:3]) + (" ..." if len(hidden) > 3 else "")


def _draw_metric(axes: Any, trace: Trace, metric: Metric, requirement: Requirement, instants: list[int]) -> Any:
    """Draw the metric so far over time and return the line that marks the moment."""
    values = metric_so_far(trace, metric, instants)
    time = trace.time[instants]
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    both = (requirement.critical.low, requirement.critical.high)
    ends = sorted((e for e in both if np.isfinite(e)), key=lambda e: abs(e - low))
    edges = [e for e in ends if abs(e - low) < 3 * (high - low) + 2] or ends[:1]  # always the nearest
    low, high = min([low, *edges]), max([high, *edges])
    margin = 0.1 * (high - low) + 1e-3
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(0.0, max(float(trace.time[-1]), _dt(trace)))
    axes.axhspan(max(requirement.critical.low, low - margin), min(requirement.critical.high, high + margin), color=REGION, lw=0)
    for edge in edges:
        axes.axhline(edge, color=CRITICAL, linewidth=0.9, linestyle="--")
    axes.plot(time, values, color=MODEL, drawstyle="default")
    axes.set_xlabel("time (s)", labelpad=1)
    axes.set_title(f"{label(metric.name, metric.unit)} so far", loc="left", fontsize=8, pad=2)
    return axes.axvline(0.0, color="#222222", linewidth=1.0)


def _with_one_palette(frames: list[np.ndarray]) -> list[Any]:
    """Return the frames as images of the same few colours: then a GIF only stores what changes."""
    from PIL import Image

    some = np.concatenate([frames[k] for k in sorted({0, len(frames) // 2, len(frames) - 1})])
    width = some.shape[1]
    for color in (EGO, OTHER, STANDING, ROAD, MODEL, CRITICAL, REGION):  # each counts, however small it is drawn
        some = np.concatenate([some, np.full((30, width, 3), [int(color[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)])
    palette = Image.fromarray(some).quantize(_COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    return [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
