"""Where vehicles go on: the lanes of their routes ahead, for predictions beyond the end of what is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sbt.problem.trace import States

__all__ = ["LEFT_THE_ROAD", "line_ahead", "rectangle_ways"]

LEFT_THE_ROAD: States = np.full((1, 3), np.nan)
"""The way of a vehicle that has arrived: there is none."""
_LENGTH = 200.0
"""Length of a way (m): 5 s at 40 m/s."""
_STEP = 1.0
"""Distance of its points (m)."""


def line_ahead(sumo: Any, name: str) -> States | None:
    """Return the (k, 2) points of the lanes ahead of the front of a vehicle, at its lateral place; None where it has no lane.

    Args:
        sumo: libsumo or traci.
        name: of a vehicle on the road.
    """
    vehicle, lane = sumo.vehicle, sumo.lane
    here = vehicle.getLaneID(name)
    if not here:
        return None
    shape = _points(lane.getShape(here))
    along = _along(shape)
    at = vehicle.getLanePosition(name) * along[-1] / max(lane.getLength(here), 1e-9)
    ahead = [shape[along > at]]
    length = along[-1] - at
    inside = lane.getLinks(here)[:1] if here.startswith(":") else ()  # SUMO's next links are those after the junction
    for link in (*inside, *vehicle.getNextLinks(name)):
        if length > _LENGTH:
            break
        for part in (*_inside(lane, link[4]), link[0]):
            ahead.append(_points(lane.getShape(part)))
            length += float(_along(ahead[-1])[-1])
    return _beside(np.concatenate(ahead), vehicle.getLateralLanePosition(name))


def rectangle_ways(behind: States, ahead: States, length: float, offsets: Sequence[float] = (0.0,)) -> list[States]:
    """Return the (k, 3) centre and heading of rectangles whose front and rear go along a line, as SUMO places them.

    Args:
        behind: (n, 2) points that the body stands on now, from its rear to its front.
        ahead: (m, 2) points in front of it.
        length: of the rectangles (m).
        offsets: from the front of the body to that of each rectangle (m).

    Returns:
        One for each offset; none where there is no line ahead.
    """
    line = np.concatenate([behind, ahead])
    along = _along(line)
    start = float(_along(behind)[-1])
    ahead_of_body = np.arange(start + _STEP, min(along[-1], start + _LENGTH), _STEP)
    if not ahead_of_body.size:
        return []
    front = ahead_of_body - np.array(offsets)[:, None]  # (rectangles, k)
    ends = [np.stack([np.interp(s, along, line[:, k]) for k in (0, 1)], axis=2) for s in (front, front - length)]
    chord = ends[0] - ends[1]
    heading = np.unwrap(np.arctan2(chord[:, :, 1], chord[:, :, 0]), axis=1)
    return list(np.concatenate([0.5 * (ends[0] + ends[1]), heading[:, :, None]], axis=2))


def _inside(lane: Any, first: str) -> list[str]:
    """Return the lanes of a junction that follow each other from the first one on: a turn that waits in the middle has two."""
    found: list[str] = []
    while first and first not in found:
        found.append(first)
        links = lane.getLinks(first)
        first = links[0][4] if links else ""
    return found


def _points(shape: Any) -> States:
    return np.array([point[:2] for point in shape], dtype=np.float64).reshape(-1, 2)


def _along(points: States) -> States:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _beside(points: States, left: float) -> States:
    """Return a polyline moved to the left (m)."""
    if left == 0.0 or len(points) < 2:
        return points
    step = np.gradient(points, axis=0)
    return points + left * np.stack([-step[:, 1], step[:, 0]], axis=1) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
