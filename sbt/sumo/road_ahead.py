"""The road ahead of a controller: how fast its bends can be driven, and where its lane ends."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from sbt.plugins import kept
from sbt.problem.arrays import Points, Vector
from sbt.sumo.actors import Action, Controller, State
from sbt.sumo.dynamics import next_speed
from sbt.sumo.nets import net_file

__all__ = ["RoadAhead", "on_road", "path_of"]

LATERAL_MAX = 4.0
"""Lateral acceleration at which a controller is slowed down in bends (m/s^2), the upper end of what drivers do."""
BRAKING = 3.0
"""Deceleration with which it slows down ahead of them and of the end of a lane (m/s^2)."""
_BASE = 3.0
"""Length of path over which the curvature is averaged (m), because lanes are polygonal lines."""
_SPACING = 0.5
_BESIDE = 2.0
"""From this distance beside its path (m) a vehicle is in another lane."""
_STOP = 1.0
"""Distance ahead of the end of a lane at which a vehicle stops (m)."""


class RoadAhead:
    """Largest speed along the path of a route: what its bends allow, down to a stop where its lane ends.

    Args:
        net: name or file of the network.
        route: edges.
        lane: index on the first edge; the path stays in its lane where the road has several.
    """

    def __init__(self, net: str, route: tuple[str, ...], lane: int):
        shapes, ends = path_of(str(net_file(net)), route, lane)
        points = np.concatenate([shape if k == 0 else shape[1:] for k, shape in enumerate(shapes)])
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        self._s = np.arange(0.0, along[-1] + _SPACING, _SPACING)
        self._x, self._y = np.interp(self._s, along, points[:, 0]), np.interp(self._s, along, points[:, 1])
        self._speed = self._allowed(ends=ends)

    def _allowed(self, *, ends: bool) -> Vector:
        """Return the largest speed at every point, with braking ahead of slower ones (m/s)."""
        heading = np.unwrap(np.arctan2(np.diff(self._y), np.diff(self._x)))
        n = round(_BASE / _SPACING)
        curvature = np.zeros(len(self._s))
        curvature[n // 2 : n // 2 + len(heading) - n] = np.abs(heading[n:] - heading[:-n]) / _BASE
        square = LATERAL_MAX / np.maximum(curvature, 1e-6)
        if ends:
            square[self._s > self._s[-1] - _STOP] = 0.0
        slowest = np.minimum.accumulate((square + 2.0 * BRAKING * self._s)[::-1])[::-1]
        return np.asarray(np.sqrt(slowest - 2.0 * BRAKING * self._s))

    def beside(self, s: float, x: float, y: float) -> bool:
        """Return whether the point x, y (m) is not on the path at distance s (m)."""
        return math.hypot(float(np.interp(s, self._s, self._x)) - x, float(np.interp(s, self._s, self._y)) - y) > _BESIDE

    def limit(self, s: float) -> float:
        """Return the largest speed (m/s) at distance s (m) along the path."""
        return float(np.interp(s, self._s, self._speed))


class _OnRoad:
    """A controller whose speed is limited by the road ahead."""

    def __init__(self, driver: Controller, road: RoadAhead, position: float):
        self._driver, self._road, self._position = driver, road, position
        self._last = 0.0
        self._speed: float | None = None

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the action of the controller, slowed down where the road demands it."""
        self._position += (own.speed if self._speed is None else 0.5 * (own.speed + self._speed)) * (t - self._last)
        self._last, self._speed = t, own.speed
        action = self._driver.act(t, own, others)
        speed = action.speed
        if action.acceleration is not None:
            speed = next_speed(own.speed, action.acceleration, speed, own.step)
        limit = self._road.limit(self._position + own.speed * own.step)
        x, y = own.x + 0.5 * own.length * own.cos, own.y + 0.5 * own.length * own.sin
        if (own.speed if speed is None else speed) <= limit or self._road.beside(self._position, x, y):
            return action
        return Action(speed=max(limit, own.speed - 2.0 * BRAKING * own.step, 0.0), lane=action.lane)


def on_road(driver: Controller | None, net: str, route: tuple[str, ...], lane: int, position: float) -> Controller | None:
    """Return a controller that also slows down for bends and where its lane ends; None where SUMO drives, which does both.

    Args:
        driver: the controller.
        net: name or file of the network.
        route: edges of its path.
        lane: index on the first edge.
        position: of the front bumper on the first edge at the start (m).
    """
    return None if driver is None else _OnRoad(driver, _road(net, route, lane), position)


@kept
def _road(net: str, route: tuple[str, ...], lane: int) -> RoadAhead:
    return RoadAhead(net, route, lane)


def path_of(file: str, route: tuple[str, ...], lane: int) -> tuple[list[Points], bool]:
    """Return the shapes of the lanes along a route, junctions included, and whether the last lane ends before the route does."""
    root = ET.parse(Path(file)).getroot()
    shapes = {
        element.attrib["id"]: np.array([[float(v) for v in pair.split(",")[:2]] for pair in element.attrib["shape"].split()])
        for element in root.iter("lane")
    }
    links = {
        (element.attrib["from"], int(element.attrib["fromLane"]), element.attrib["to"]): element.attrib
        for element in root.iter("connection")
    }
    path, at = [shapes[f"{route[0]}_{lane}"]], lane
    for edge, following in itertools.pairwise(route):
        link = links.get((edge, at, following))
        if link is None:
            return path, True
        at = int(link["toLane"])
        via = link.get("via")
        while via is not None:  # a turn may have several parts inside the junction
            path.append(shapes[via])
            inner, index = via.rsplit("_", 1)
            via = links.get((inner, int(index), following), {}).get("via")
        path.append(shapes[f"{following}_{at}"])
    return path, False
