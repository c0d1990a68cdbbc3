"""A scene from above: lanes, vehicles as rectangles, people as circles, ego highlighted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sbt.metrics.geometry import rectangles
from sbt.problem.trace import ActorTrace, Trace
from sbt.report.sight import Sight

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sbt.sumo.nets import Lane

__all__ = [
    "BICYCLE", "EDGE", "EGO", "FEW", "OTHER", "PERSON", "ROAD", "STANDING", "Scenery", "View", "actor_kind", "draw_lanes",
    "is_person", "is_wide", "view_of",
]  # fmt: skip

EGO, OTHER, STANDING, ROAD, EDGE = "#1f6fb4", "#d9822b", "#8a8f94", "#dcdfe3", "#ffffff"
PERSON, BICYCLE = "#7b4fa3", "#2f7d4f"
_GROUND, _WALK, _BIKE, _STRIPE = "#f3f4f1", "#ebe6dc", "#e3d3cd", "#c9ccd1"
_FILL = {"road": ROAD, "internal": ROAD, "area": ROAD, "walk": _WALK, "walking_area": _WALK, "crossing": _STRIPE, "bike": _BIKE}
_ORDER = ("area", "internal", "road", "walk", "walking_area", "crossing", "bike")
"""Of what is drawn, from below."""
_BRIDGE = "#a9adb3"
"""The rim of what leads over something else."""
_NEAR = 60.0
"""A view that follows ego shows so much to each side at most (m)."""
_LEAST, _LEAST_IN_TRAFFIC = 30.0, 45.0
"""... and so much at least (m)."""
_ROOM = 7.0
"""Space around the middles of road users (m)."""
_SMOOTH = 0.5
"""Half the time over which the movement of the view is averaged (s)."""
_ATTENTION = 2.0
"""The view goes to the middle between ego and its opponent within this time before the worst moment (s)."""
_PERSON_SIZE = 1.0
"""Largest length and width of a person (m)."""
_RIM_OF_PERSON = 1.4
"""Width of the line around a person (pt), without which it would be a single pixel."""
FEW = 5
"""With so many road users, ego among them, it is clear who is who; with more it is traffic."""
_NARROW = 1.0
"""Largest width of a bicycle or motorcycle (m)."""
_LEVEL = 3.0
"""Lanes that differ so much in height are drawn above each other (m)."""


def is_person(trace: Trace, j: int) -> bool:
    """Return whether an actor is drawn and written as a person: it is as small as none but a person is."""
    return bool(max(trace.length[j], trace.width[j]) <= _PERSON_SIZE)


def stands_still(trace: Trace, j: int) -> bool:
    """Return whether an actor never moves."""
    there = np.isfinite(trace.x[:, j]) & np.isfinite(trace.y[:, j])
    x, y = trace.x[there, j], trace.y[there, j]
    return bool(len(x) == 0 or np.ptp(x) + np.ptp(y) < 1e-6)


def actor_kind(trace: Trace, j: int) -> str:
    """Return what an actor is drawn as: ego, standing, person, bicycle or other."""
    if j == 0:
        return "ego"
    if stands_still(trace, j):
        return "standing"
    if is_person(trace, j):
        return "person"
    return "bicycle" if trace.width[j] <= _NARROW else "other"


_COLOURS = {"ego": EGO, "standing": STANDING, "person": PERSON, "bicycle": BICYCLE, "other": OTHER}


def draw_lanes(axes: Axes, lanes: Sequence[Lane]) -> None:
    """Draw lanes to scale, their borders in white; bridges above what they lead over."""
    from matplotlib.collections import PolyCollection

    axes.set_facecolor(_GROUND)
    levels = np.array([round(lane.height / _LEVEL) for lane in lanes])
    for rank, level in enumerate(np.unique(levels)):
        here = sorted((lanes[int(k)] for k in np.flatnonzero(levels == level)), key=lambda lane: _ORDER.index(lane.kind))
        z = rank / (len(lanes) + 1.0)
        borders, surfaces = ([_outline(lane, grow) for lane in here] for grow in (0.5, -0.07))
        rim = _BRIDGE if rank else EDGE
        axes.add_collection(PolyCollection(borders, facecolors=rim, edgecolors="none", zorder=z), autolim=False)
        faces = [_FILL[lane.kind] for lane in here]
        z += 0.5 / (len(lanes) + 1.0)
        lines = [EDGE if lane.kind == "road" else "none" for lane in here]  # seen from any height
        axes.add_collection(PolyCollection(surfaces, facecolors=faces, edgecolors=lines, linewidths=0.5, zorder=z), autolim=False)
        stripes = [bar for lane in here if lane.kind == "crossing" for bar in _stripes(lane)]
        if stripes:
            axes.add_collection(PolyCollection(stripes, facecolors=EDGE, edgecolors="none", zorder=1.0), autolim=False)


def _outline(lane: Lane, grow: float) -> np.ndarray:
    """Return the outline of a lane or area, a lane's wider by `grow` to each side."""
    line = np.array(lane.shape)
    return line if lane.kind in ("area", "walking_area") else _beside(line, 0.5 * lane.width + grow)


def _beside(line: np.ndarray, distance: float) -> np.ndarray:
    """Return the (2 n, 2) outline of a strip around a line (n, 2), mitred at its bends."""
    step = np.diff(line, axis=0)
    length = np.hypot(*step.T)
    step = step[length > 1e-6] / length[length > 1e-6, None]
    if len(step) == 0:
        return np.repeat(line[:1], 4, axis=0)
    line = line[np.concatenate([[True], length > 1e-6])]
    normal = np.stack([-step[:, 1], step[:, 0]], axis=1)
    before, after = np.concatenate([normal[:1], normal]), np.concatenate([normal, normal[-1:]])
    across = (before + after) / np.maximum(1.0 + (before * after).sum(axis=1), 0.3)[:, None]
    return np.concatenate([line + distance * across, (line - distance * across)[::-1]])


def _stripes(lane: Lane) -> list[np.ndarray]:
    """Return the bars of a zebra crossing: half a metre wide, half a metre apart, along the driving direction."""
    line = np.array(lane.shape)
    start, end = line[0], line[-1]
    length = float(np.hypot(*(end - start)))
    if length < 1.0:
        return []
    along = (end - start) / length
    across = 0.4 * lane.width * np.array([-along[1], along[0]])
    found = []
    for s in np.arange(0.5, length - 0.4, 1.0):
        a, b = start + s * along, start + (s + 0.5) * along
        found.append(np.array([a + across, b + across, b - across, a - across]))
    return found


class View(NamedTuple):
    """What is shown: the middle at every instant (t, 2), half the width and half the height (m), and whether it follows ego."""

    middle: np.ndarray
    half_x: float
    half_y: float
    follows: bool


def view_of(trace: Trace, opponent: int | None, moment: int, ratio: float) -> View:
    """Return the view of a run.

    All of the run where that is small; else what is around ego, a little ahead, with the opponent at the worst moment.

    Args:
        trace: the run; states of road users that are not there are NaN.
        opponent: actor that must be in view at the worst moment, None: nobody.
        moment: instant of the worst moment.
        ratio: of the view, width by height.
    """
    low, high = (np.array([f(v) for v in (trace.x, trace.y)]) for f in (np.nanmin, np.nanmax))
    spans = high - low + 2 * _ROOM
    span = max(float(spans[0]), float(spans[1]) * ratio)
    if span <= 2 * _NEAR:
        return View(np.tile(0.5 * (low + high), (len(trace.time), 1)), 0.5 * span, 0.5 * span / ratio, follows=False)
    ego = trace.actor(trace.actors[0])
    place = np.stack([_filled(ego.x), _filled(ego.y)], axis=1)
    heading = _filled(np.unwrap(_filled(ego.heading)))
    half = _half_width(trace, opponent, moment, ratio)
    ahead = 0.4 * half * np.stack([np.cos(heading), np.sin(heading) / ratio], axis=1)  # or ego would leave a wide view
    if opponent is not None and np.isfinite(trace.x[moment, opponent]):
        between = 0.5 * (np.stack([trace.x[:, opponent], trace.y[:, opponent]], axis=1) - place)
        reach = np.array([half, half / ratio]) - 0.5 * _ROOM
        between = np.clip(np.where(np.isfinite(between), between, ahead), -reach, reach)
        weight = np.clip(2.0 - np.abs(trace.time - trace.time[moment]) / _ATTENTION, 0.0, 1.0)[:, None]
        ahead = weight * between + (1.0 - weight) * ahead
    return View(_smoothed(place + ahead, trace.time), half, half / ratio, follows=True)


def is_wide(trace: Trace, opponent: int | None) -> bool:
    """Return whether all that matters happens along the x axis, so that a wide view suits it."""
    y = trace.y[:, [0] if opponent is None else [0, opponent]]
    x = trace.x[:, [0] if opponent is None else [0, opponent]]
    everybody = float(np.nanmax(trace.y) - np.nanmin(trace.y)), float(np.nanmax(trace.x) - np.nanmin(trace.x))
    span = (float(np.nanmax(y) - np.nanmin(y)), float(np.nanmax(x) - np.nanmin(x)))
    small = everybody[0] <= 50.0 and everybody[0] <= max(everybody[1], 30.0)
    return small or span[0] <= 0.2 * span[1]


def _half_width(trace: Trace, opponent: int | None, moment: int, ratio: float) -> float:
    """Return half the width of a view that follows ego: the opponent is in it at the worst moment."""
    if opponent is None or not np.isfinite(trace.x[moment, opponent]):
        return _NEAR if len(trace.actors) > 1 else _LEAST
    least = _LEAST if len(trace.actors) <= FEW else _LEAST_IN_TRAFFIC
    scale = 0.4 if is_person(trace, 0) else 1.0  # a person would be lost in a view for cars
    dx, dy = (abs(float(v[moment, opponent] - v[moment, 0])) for v in (trace.x, trace.y))
    return min(max(scale * least, 0.7 * dx + 20.0 * scale, (0.7 * dy + 20.0 * scale) * min(ratio, 1.6)), _NEAR)


def _filled(values: np.ndarray) -> np.ndarray:
    """Return values with gaps (NaN) filled from the instants beside them."""
    good = np.isfinite(values)
    if not good.any():
        return np.zeros_like(values)
    at = np.arange(len(values))
    return np.asarray(np.interp(at, at[good], values[good]))


def _smoothed(path: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return a path (t, 2) averaged over a short time."""
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    width = round(_SMOOTH / step)
    if width < 1:
        return path
    how: dict[str, Any] = {"mode": "reflect", "reflect_type": "odd"} if len(path) > width else {"mode": "edge"}
    padded = np.pad(path, ((width, width), (0, 0)), **how)
    kernel = np.full(2 * width + 1, 1.0 / (2 * width + 1))
    return np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)


class Scenery:
    """The actors of a trace as shapes on axes; `show(k)` draws those that are there at an instant, to size.

    Args:
        axes: to draw on.
        trace: the run.
        opponent: actor that is marked and named, None: nobody.
        reach: what ego's sensor sees is drawn so far at most (m).
    """

    def __init__(self, axes: Axes, trace: Trace, opponent: int | None = None, *, reach: float = 2.0 * _NEAR):
        from matplotlib.collections import PolyCollection
        from matplotlib.patheffects import withStroke

        self._trace, self._opponent = trace, opponent
        self._there = np.isfinite(trace.x) & np.isfinite(trace.y) & np.isfinite(trace.heading)
        self._stands = [stands_still(trace, j) for j in range(len(trace.actors))]
        self._people = [is_person(trace, j) for j in range(len(trace.actors))]
        self._colors = [_COLOURS[actor_kind(trace, j)] for j in range(len(trace.actors))]
        self._shapes: Any = axes.add_collection(PolyCollection([], zorder=5), autolim=False)
        few = len(trace.actors) <= FEW
        named = [j for j in range(len(trace.actors)) if (few or j in (0, opponent)) and not self._stands[j]]
        self._sight = Sight(axes, trace, named, self._colors, reach)
        self._name = axes.annotate(
            "", (0.0, 0.0), (0, 9), textcoords="offset points", ha="center", fontsize=7.5, color="#222222", zorder=8,
            annotation_clip=True, visible=not few, path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )  # fmt: skip

    def show(self, k: int) -> None:
        """Draw everybody who is there at instant k; ego, and above it its opponent, on top."""
        self._sight.show(k)
        others = [j for j in range(1, len(self._people)) if self._there[k, j] and j != self._opponent]
        shown = [j for j in (*others, 0, self._opponent) if j is not None and self._there[k, j]]
        outlines = {j: self._outlines(k, j) for j in shown}
        drawn = [j for j in shown for _ in outlines[j]]
        self._shapes.set_verts([outline for j in shown for outline in outlines[j]])
        self._shapes.set_facecolor([self._colors[j] for j in drawn])
        self._shapes.set_edgecolor([self._colors[j] if self._people[j] else "#333333" for j in drawn])
        self._shapes.set_linewidth([self._rim(j) for j in drawn])
        if self._opponent in shown and self._opponent is not None:
            x, y = (float(v[k, self._opponent]) for v in (self._trace.x, self._trace.y))
            self._name.set_text(self._trace.actors[self._opponent][:20])
            self._name.xy = (x, y)
        else:
            self._name.set_text("")

    def _rim(self, j: int) -> float:
        """Return the width of the line around an actor (pt)."""
        if self._people[j]:
            return _RIM_OF_PERSON
        return (1.2 if j == self._opponent else 0.6) * (0.6 if self._colors[j] == BICYCLE else 1.0)

    def _outlines(self, k: int, j: int) -> list[np.ndarray]:
        """Return the outlines of an actor: of its rectangle, or of the parts of a long vehicle, the front one on top."""
        actor = self._trace.actor(self._trace.actors[j])
        return [self._outline(k, j, part, nose=n == 0) for n, part in enumerate(rectangles(actor))][::-1]

    def _outline(self, k: int, j: int, t: ActorTrace, *, nose: bool) -> np.ndarray:
        """Return the outline of a rectangle: people are round, the nose of a vehicle that moves is pointed a little."""
        x, y, heading = float(t.x[k]), float(t.y[k]), float(t.heading[k])
        a, b = 0.5 * t.length, 0.5 * t.width
        if self._people[j] or a == b:
            around = np.linspace(0.0, 2.0 * math.pi, 13)
            local = np.stack([a * np.cos(around), b * np.sin(around)], axis=1)
        else:
            sides = a - min(0.14 * a, 0.6) if nose and not self._stands[j] else a
            local = np.array([[a, 0.5 * b], [sides, b], [-a, b], [-a, -b], [sides, -b], [a, -0.5 * b]])
        cos, sin = math.cos(heading), math.sin(heading)
        return np.asarray(local @ np.array([[cos, sin], [-sin, cos]]) + (x, y))
