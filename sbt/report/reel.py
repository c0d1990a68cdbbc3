"""A run as the data of a film that a page plays: who was where when, the lanes around, and curves over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.metrics.geometry import rectangle_distance, time_to_contact
from sbt.metrics.moments import metric_so_far
from sbt.problem.metric import Metric
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement
from sbt.problem.trace import ActorTrace, Trace
from sbt.report.contacts import contacts_of
from sbt.report.scene import actor_kind, is_wide, view_of
from sbt.report.sight import hiding
from sbt.report.worst import worst_moment

if TYPE_CHECKING:
    from sbt.sumo.nets import Lane

__all__ = ["Film", "Reels"]

_INSTANTS = 400
"""Largest number of instants of a film; between them the page interpolates."""
_ACTORS = 40
"""Largest number of road users of a film: those that come nearest to ego."""
_WIDE, _TALL = 2.6, 1.5
"""Width by height of a scene along the x axis, and of any other."""
_MARGIN = 25.0
"""Lanes are kept within so much of what the view shows (m)."""
_HORIZON = 10.0
"""Largest time to contact that is drawn (s)."""


@dataclass(frozen=True, eq=False)
class Film:
    """A run to be shown.

    Args:
        run: its index.
        role: why it is shown, such as "failure mode 1".
        trace: its states.
        metric: of the requirement, shown over time.
        requirement: whose limits are drawn.
        lanes: of the network.
    """

    run: int
    role: str
    trace: Trace
    metric: Metric
    requirement: Requirement
    lanes: Sequence[Lane] = ()


@dataclass
class Reels:
    """Films as plain data; lanes that several of them show are kept once."""

    lanes: list[Json] = field(default_factory=list)
    _known: dict[Any, int] = field(default_factory=dict)

    def add(self, film: Film) -> Json:
        """Return a film as plain data: lengths in cm, headings in mrad, speeds in cm/s, series as differences."""
        trace = film.trace
        moment, opponent = worst_moment(trace, film.metric)
        step = max(-(-len(trace.time) // _INSTANTS), 1)
        at = np.unique(np.concatenate([np.arange(0, len(trace.time), step), [moment, len(trace.time) - 1]]))
        ratio = _WIDE if is_wide(trace, opponent) else _TALL
        view = view_of(trace, opponent, moment, ratio)
        origin = np.round(view.middle[0])
        shown = _nearest(trace, opponent)
        middle = (view.middle[at] - origin) * 100.0
        return {
            "run": film.run, "role": film.role, "ended": trace.ended,
            "time": _series(trace.time[at] * 1000.0), "ratio": ratio,
            "middle": [_series(middle[:, 0]), _series(middle[:, 1])], "half": [view.half_x, view.half_y],
            "actors": [_actor(trace, j, at, origin) for j in shown],
            "left_out": len(trace.actors) - len(shown),
            "opponent": None if opponent is None else shown.index(opponent),
            "moment": int(np.searchsorted(at, moment)),
            "contacts": [
                {"time": float(trace.time[c.instant]), "with": c.other, "x": float(c.x - origin[0]), "y": float(c.y - origin[1])}
                for c in contacts_of(trace)[:5]
            ],
            "lanes": self._around(film.lanes, view.middle, (view.half_x, view.half_y)),
            "origin": origin.tolist(),
            "curves": _curves(film, at, opponent), "view": _view(trace, shown),
        }  # fmt: skip

    def _around(self, lanes: Sequence[Lane], middle: np.ndarray, half: tuple[float, float]) -> list[int]:
        """Return the positions of the lanes that can be seen, the lowest first."""
        reach = np.array(half) + _MARGIN
        low, high = middle.min(axis=0) - reach, middle.max(axis=0) + reach
        found = []
        for lane in sorted(lanes, key=lambda each: (round(each.height / 3.0), _ORDER.index(each.kind))):
            points = np.array(lane.shape)
            if (points.max(axis=0) + lane.width >= low).all() and (points.min(axis=0) - lane.width <= high).all():
                found.append(self._kept(lane, points))
        return found

    def _kept(self, lane: Lane, points: np.ndarray) -> int:
        """Return the position of a lane, which is kept in the network's own coordinates."""
        if lane not in self._known:
            self._known[lane] = len(self.lanes)
            x, y = (_series(100.0 * points[:, k]) for k in (0, 1))
            self.lanes.append({"kind": lane.kind, "width": round(lane.width, 2), "x": x, "y": y})
        return self._known[lane]


_ORDER = ("area", "internal", "road", "walk", "walking_area", "crossing", "bike")


def _series(values: np.ndarray) -> list[int | None]:
    """Return whole numbers, each as the difference to the one before; None where there is none."""
    found: list[int | None] = []
    last = 0
    for value in np.where(np.isfinite(values), np.round(values), np.nan).tolist():
        if value != value:
            found.append(None)
        else:
            found.append(int(value) - last)
            last = int(value)
    return found


def _nearest(trace: Trace, opponent: int | None) -> list[int]:
    """Return the actors that are shown: ego first, then those that come nearest to it, in their own order."""
    if len(trace.actors) <= _ACTORS:
        return list(range(len(trace.actors)))
    away = np.hypot(trace.x - trace.x[:, :1], trace.y - trace.y[:, :1])
    nearest = np.min(np.where(np.isfinite(away), away, np.inf), axis=0)
    if opponent is not None:
        nearest[opponent] = 0.0
    return sorted(np.argsort(nearest, kind="stable")[:_ACTORS].tolist())


def _actor(trace: Trace, j: int, at: np.ndarray, origin: np.ndarray) -> Json:
    actor = trace.actor(trace.actors[j])
    return {
        "name": trace.actors[j], "kind": actor_kind(trace, j), "v": _series(actor.speed[at] * 100.0),
        **_states(actor, at, origin), "parts": [_states(part, at, origin) for part in actor.parts],
    }  # fmt: skip


def _states(actor: ActorTrace, at: np.ndarray, origin: np.ndarray) -> Json:
    heading, finite = actor.heading[at], np.isfinite(actor.heading[at])
    if finite.any():
        heading = heading.copy()
        heading[finite] = np.unwrap(heading[finite])
    return {
        "length": round(float(actor.length), 2), "width": round(float(actor.width), 2),
        "x": _series((actor.x[at] - origin[0]) * 100.0), "y": _series((actor.y[at] - origin[1]) * 100.0),
        "h": _series(heading * 1000.0),
    }  # fmt: skip


def _view(trace: Trace, shown: list[int]) -> Json | None:
    """Return where ego's sensor sees something; None as a length is no limit."""
    view = trace.view
    if view is None:
        return None
    reach, half_width = (round(v, 3) if np.isfinite(v) else None for v in (view.reach, view.half_width))
    return {
        "reach": reach, "ahead": round(view.ahead, 3), "half_angle": round(view.half_angle, 4), "half_width": half_width,
        "hidden_by": [shown.index(j) for j in hiding(trace, view) if j in shown],
    }  # fmt: skip


def _curves(film: Film, at: np.ndarray, opponent: int | None) -> list[Json]:
    """Return what is drawn over time: speeds, and with an opponent the gap and the time to contact; the metric so far."""
    trace = film.trace
    found = [_curve("speed", "m/s", trace.actors[0], trace.speed[at, 0])]
    if opponent is not None:
        ego, other = trace.actor(trace.actors[0]), trace.actor(trace.actors[opponent])
        name = trace.actors[opponent]
        found.append(_curve("speed", "m/s", name, trace.speed[at, opponent]))
        found.append(_curve("gap", "m", f"gap to {name}", rectangle_distance(ego, other)[at]))
        ttc = time_to_contact(ego, other)[at]
        found.append(_curve("TTC", "s", f"TTC to {name}", np.where(ttc <= _HORIZON, ttc, np.nan)))
    values = metric_so_far(trace, film.metric, at.tolist())
    values = np.where(values == film.metric.without, np.nan, values)
    limits = [end for end in (film.requirement.critical.low, film.requirement.critical.high) if np.isfinite(end)]
    found.append({**_curve(f"{film.metric.name} so far", film.metric.unit, "so far", values), "limits": limits})
    return found


def _curve(panel: str, unit: str, name: str, values: np.ndarray) -> Json:
    rounded = [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]
    return {"panel": panel, "unit": unit, "name": name, "values": rounded}
