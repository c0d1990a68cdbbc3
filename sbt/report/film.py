"""A run as a film: the scene from above, and below it the metric of the run so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.metrics.moments import metric_so_far
from sbt.problem.metric import Metric
from sbt.problem.requirement import Requirement
from sbt.problem.trace import Trace
from sbt.report.contacts import Contacts
from sbt.report.scene import BICYCLE, EGO, FEW, OTHER, PERSON, ROAD, STANDING, Scenery, View, draw_lanes, is_wide, view_of
from sbt.report.style import CRITICAL, MODEL, REGION, figure_style, label
from sbt.report.video import check_format, write_video
from sbt.report.worst import worst_moment

if TYPE_CHECKING:
    from sbt.sumo.nets import Lane

__all__ = ["write_film"]

_FRAMES = 90
"""Largest number of frames; a long run has fewer frames a second, at the same speed."""
_FASTEST = 0.08
"""Shortest time of a frame (s)."""
_HOLD = 1.2
"""Time for which the last frame is shown (s)."""
_WIDE, _TALL = (5.6, 3.6), (5.6, 5.2)
"""Width and height of a picture (inch): of a scene along the x axis, and of any other."""
_DPI = 96
_COLORS = 48


def write_film(
    file: Path, trace: Trace, metric: Metric, requirement: Requirement, *, lanes: Sequence[Lane] = (), title: str = ""
) -> None:
    """Write a run as a film in real time: .gif, .webp, .mp4 or .webm.

    Args:
        file: to be written.
        trace: the run.
        metric: shown below, its value up to then.
        requirement: whose critical interval is shaded.
        lanes: of the network.
        title: above the scene.
    """
    check_format(file)
    with figure_style():
        images = _frames(trace, metric, requirement, lanes, title)
    step = _every(trace)
    shown = [max(round(100 * step * _dt(trace)), 2) * 10] * len(images)
    shown[-1] += round(1000 * _HOLD)
    write_video(file, images, shown)


def _dt(trace: Trace) -> float:
    return float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 0.1


def _every(trace: Trace) -> int:
    """Return how many instants a frame stands for."""
    return max(-(-len(trace.time) // _FRAMES), round(_FASTEST / _dt(trace) + 0.49), 1)


def _frames(trace: Trace, metric: Metric, requirement: Requirement, lanes: Sequence[Lane], title: str) -> list[Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    last = len(trace.time) - 1
    instants = [*range(0, last, _every(trace)), last]
    moment, opponent = worst_moment(trace, metric)
    size = _WIDE if is_wide(trace, opponent) else _TALL
    figure = Figure(figsize=size, dpi=_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    above, below = _two_axes(figure, size)
    box = above.get_position()
    view = view_of(trace, opponent, moment, box.width * size[0] / (box.height * size[1]))
    above.set_title(title, loc="left", fontsize=9)
    draw_lanes(above, _near(lanes, view))
    scenery = Scenery(above, trace, opponent, reach=2.0 * (view.half_x + view.half_y))
    contacts = Contacts(above, trace)
    halo = [withStroke(linewidth=2.0, foreground="white")]
    clock = above.text(0.99, 0.97, "", transform=above.transAxes, ha="right", va="top", fontsize=9, zorder=9, path_effects=halo)
    far = above.text(0.01, 0.03, "", transform=above.transAxes, ha="left", va="bottom", fontsize=8, zorder=9, path_effects=halo)
    now = _draw_metric(below, trace, metric, requirement, instants)
    above.set_visible(False)  # what does not change is drawn once
    now.set_visible(False)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    above.set_visible(True)
    now.set_visible(True)
    drawn = []
    for k in instants:
        scenery.show(k)
        words = contacts.show(k)
        x, y = view.middle[k]
        above.set_xlim(x - view.half_x, x + view.half_x)
        above.set_ylim(y - view.half_y, y + view.half_y)
        clock.set_text(f"{trace.time[k]:.1f} s   {3.6 * trace.speed[k, 0]:.0f} km/h")
        far.set_text(words or _out_of_view(trace, k, view, opponent))
        far.set_color(CRITICAL if words else "#555555")
        now.set_xdata([trace.time[k]] * 2)
        canvas.restore_region(still)
        for artist in (above, now):
            figure.draw_artist(artist)
        drawn.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return _with_one_palette(drawn)


def _two_axes(figure: Any, size: tuple[float, float]) -> tuple[Any, Any]:
    """Return the axes of the scene and, below it, those of the metric; both keep their margins in inches."""
    height = size[1]
    above = figure.add_axes((0.02, 1.3 / height, 0.96, (height - 1.55) / height))
    below = figure.add_axes((0.08, 0.43 / height, 0.89, 0.61 / height))
    above.grid(visible=False)
    for side in above.spines.values():
        side.set_visible(False)
    above.xaxis.set_visible(False)
    above.yaxis.set_visible(False)
    return above, below


def _near(lanes: Sequence[Lane], view: View) -> list[Lane]:
    """Return the lanes that can be seen at any instant."""
    half = np.array([view.half_x, view.half_y])
    low, high = view.middle.min(axis=0) - half, view.middle.max(axis=0) + half
    found = []
    for lane in lanes:
        points = np.array(lane.shape)
        if (points.max(axis=0) + lane.width >= low).all() and (points.min(axis=0) - lane.width <= high).all():
            found.append(lane)
    return found


def _out_of_view(trace: Trace, k: int, view: View, opponent: int | None) -> str:
    """Return who moves outside the view, and how far from ego; of many road users only the opponent."""
    hidden = []
    for j in range(1, len(trace.actors)) if len(trace.actors) <= FEW else [opponent or 0]:
        dx, dy = abs(trace.x[k, j] - view.middle[k, 0]), abs(trace.y[k, j] - view.middle[k, 1])
        if (dx > view.half_x or dy > view.half_y) and np.nanmax(trace.speed[:, j]) > 0.0:  # NaN is neither
            away = float(np.hypot(trace.x[k, j] - trace.x[k, 0], trace.y[k, j] - trace.y[k, 0]))
            hidden.append(f"{trace.actors[j]} {away:.0f} m away")
    return ", ".join(hidden[:3]) + (" ..." if len(hidden) > 3 else "")


def _draw_metric(axes: Any, trace: Trace, metric: Metric, requirement: Requirement, instants: list[int]) -> Any:
    """Draw the metric so far over time and return the line that marks the moment."""
    values = metric_so_far(trace, metric, instants)
    time = trace.time[instants]
    finite = values[np.isfinite(values)]
    finite = finite[finite != metric.without] if (finite != metric.without).any() else finite  # 1,000 m would hide the rest
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
    for color in (EGO, OTHER, PERSON, BICYCLE, STANDING, ROAD, MODEL, CRITICAL, REGION):  # each counts, however small it is drawn
        some = np.concatenate([some, np.full((30, width, 3), [int(color[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)])
    palette = Image.fromarray(some).quantize(_COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    return [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
