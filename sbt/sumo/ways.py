"""Where vehicles go on: the lanes of their routes ahead, for predictions beyond the end of what is recorded."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from sbt.problem.trace import States

__all__ = ["LEFT_THE_ROAD", "goes_straight", "ways_ahead"]

LEFT_THE_ROAD: States = np.full((1, 3), np.nan)
"""The way of a vehicle that has arrived: there is none."""
_LENGTH = 200.0
"""Length of a way (m): 5 s at 40 m/s."""
_STEP = 1.0
"""Distance of its points (m)."""
_STRAIGHT = 0.02
"""How far beside a straight line lanes may be that are taken for straight ones (m): coordinates are rounded to 1 cm."""


def ways_ahead(
    sumo: Any, name: str, poses: States, length: float, *, bends: bool, reach: float = _LENGTH
) -> tuple[States, ...]:
    """Return the ways (k, 3) of a vehicle's rectangle and, if it bends, of its parts; none where it has no lane ahead.

    Args:
        sumo: libsumo or traci.
        name: of a vehicle on the road.
        poses: (n, 3) of its parts, the front one first.
        length: of the vehicle (m).
        bends: whether its parts are recorded.
        reach: how far the ways must lead (m), at most 200.
    """
    reach = min(reach, _LENGTH)
    if (ahead := _line_ahead(sumo, name, reach)) is None:
        return ()
    behind, size = _line_behind(poses, length), length / len(poses)
    ways = _rectangle_ways(behind, ahead, length, reach)
    if ways and bends:
        ways += _rectangle_ways(behind, ahead, size, reach, [k * size for k in range(len(poses))])
    return tuple(ways)


def goes_straight(sumo: Any, name: str, heading: float, reach: float) -> bool:
    """Return whether the lanes ahead of a vehicle lead straight on from where it is, so that its way says nothing new.

    Args:
        sumo: libsumo or traci.
        name: of a vehicle on the road.
        heading: of the vehicle (rad).
        reach: how far ahead is looked (m).
    """
    (x, y), cos, sin = sumo.vehicle.getPosition(name)[:2], math.cos(heading), math.sin(heading)
    for u, v in _middle_ahead(sumo, name):
        ahead, left = (u - x) * cos + (v - y) * sin, (v - y) * cos - (u - x) * sin
        if ahead < -_STRAIGHT or abs(left) > _STRAIGHT:
            return False
        if ahead > min(reach, _LENGTH):
            break
    return True


def _middle_ahead(sumo: Any, name: str) -> Iterator[tuple[float, float]]:
    """Yield the points ahead on the lane of a vehicle, and those that its route leads to; none where it has no lane."""
    lane, here = sumo.lane, sumo.vehicle.getLaneID(name)
    if here:
        shape = lane.getShape(here)
        along = _line(shape)[1]
        yield from (point[:2] for point in shape[int(along.searchsorted(_at(sumo, name, here, along), side="right")) :])
        for following, inside in _links_ahead(sumo, name, here):
            for part in (*_inside(lane, inside), following):
                yield from (point[:2] for point in lane.getShape(part))


def _line_ahead(sumo: Any, name: str, reach: float) -> States | None:
    """Return the (k, 2) points of the lanes ahead of the front of a vehicle, at its lateral place; None where it has no lane."""
    vehicle, lane = sumo.vehicle, sumo.lane
    here, front = vehicle.getLaneID(name), np.array(vehicle.getPosition(name)[:2])
    if not here:
        return None
    shape, along = _line(lane.getShape(here))
    at = _at(sumo, name, here, along)
    if (own := _beside_opposite(sumo, name, here, shape, along, at)) is not None:
        here, (shape, along) = own, _line(lane.getShape(own))
        at = _nearest(shape, front)
    foot, direction = _place(shape, along, at)
    ahead = [foot[None], shape[along > at]]
    length = along[-1] - at
    for following, inside in _links_ahead(sumo, name, here):
        if length > reach:
            break
        for part in (*_inside(lane, inside), following):
            points, distances = _line(lane.getShape(part))
            ahead.append(points)
            length += float(distances[-1])
    beside = front - foot
    return _beside(np.concatenate(ahead), float(direction[0] * beside[1] - direction[1] * beside[0]))[1:]


def _at(sumo: Any, name: str, here: str, along: States) -> float:
    """Return how far along the points of its lane a vehicle is (m); SUMO's own length of a lane may be another one."""
    return float(sumo.vehicle.getLanePosition(name) * float(along[-1]) / max(sumo.lane.getLength(here), 1e-9))


def _beside_opposite(sumo: Any, name: str, here: str, shape: States, along: States, at: float) -> str | None:
    """Return the lane of its route beside which a vehicle overtakes, if it is on one of opposite traffic.

    Such a lane is of another edge than the route has here, and its direction `at` (m) is not that of the vehicle.
    """
    vehicle, edge = sumo.vehicle, here.rpartition("_")[0]
    route, k, angle = vehicle.getRoute(name), vehicle.getRouteIndex(name), np.radians(vehicle.getAngle(name))
    if here.startswith(":") or not 0 <= k < len(route) or route[k] == edge:
        return None
    if float(_place(shape, along, at)[1] @ np.array([np.sin(angle), np.cos(angle)])) >= 0.0:
        return None
    return f"{route[k]}_{sumo.edge.getLaneNumber(route[k]) - 1}"


def _links_ahead(sumo: Any, name: str, here: str) -> Iterator[tuple[str, str]]:
    """Yield the lanes that a vehicle's route leads to from the lane here, and the lane inside the junction before each, or "".

    Much as `vehicle.getNextLinks`; beyond SUMO's best lanes both guess. That draws random numbers for who ignores others at a
    junction (jmIgnoreFoeProb): what is simulated would depend on who looks.
    """
    vehicle, lane = sumo.vehicle, sumo.lane
    route, k, kind = vehicle.getRoute(name), max(vehicle.getRouteIndex(name), 0), vehicle.getVehicleClass(name)
    if here.startswith(":"):
        links = lane.getLinks(here)[:1]
        for link in links:
            yield link[0], link[4]
        here, k = links[0][0] if links else "", k + 1
    wanted = next((list(best[5][1:]) for best in vehicle.getBestLanes(name) if best[0] == here), [])
    for edge in route[k + 1 :] if here else ():
        links = next((found for one in _lanes_beside(sumo, here) if (found := _links_to(lane, one, edge, kind))), [])
        best = wanted.pop(0) if wanted else ""
        link = next((one for one in links if one[0] == best), links[0] if links else None)
        if link is None:
            return
        yield link[0], link[4]
        here = link[0]


def _lanes_beside(sumo: Any, here: str) -> Iterator[str]:
    """Yield a lane and the others of its edge, the nearest first."""
    yield here
    edge, _, index = here.rpartition("_")
    others = sorted(range(sumo.edge.getLaneNumber(edge)), key=lambda k: abs(k - int(index)))
    yield from (f"{edge}_{k}" for k in others[1:])


def _links_to(lane: Any, here: str, edge: str, kind: str) -> list[Any]:
    """Return the links from a lane to those of an edge that a vehicle class may use."""
    links = [link for link in lane.getLinks(here) if link[0].rpartition("_")[0] == edge]
    return [link for link in links if not (allowed := lane.getAllowed(link[0])) or kind in allowed]


def _line_behind(poses: States, length: float) -> States:
    """Return the points of a vehicle from its rear to its front, of the (n, 3) poses of its parts, the front one first."""
    reach = 0.5 * length / len(poses) * np.stack([np.cos(poses[::-1, 2]), np.sin(poses[::-1, 2])], axis=1)
    return np.vstack([poses[::-1, :2] - reach, poses[:1, :2] + reach[-1]])


def _rectangle_ways(
    behind: States, ahead: States, length: float, reach: float, offsets: Sequence[float] = (0.0,)
) -> list[States]:
    """Return the (k, 3) centre and heading of rectangles whose front and rear go along a line, as SUMO places them.

    Args:
        behind: (n, 2) points that the body stands on now, from its rear to its front.
        ahead: (m, 2) points in front of it.
        length: of the rectangles (m).
        reach: how far they go (m).
        offsets: from the front of the body to that of each rectangle (m).

    Returns:
        One for each offset; none where there is no line ahead.
    """
    line = np.concatenate([behind, ahead])
    along = _along(line)
    start = float(along[len(behind) - 1])
    ahead_of_body = np.arange(start + _STEP, min(along[-1], start + reach), _STEP)
    if not ahead_of_body.size:
        return []
    front = ahead_of_body - np.array(offsets)[:, None]  # (rectangles, k)
    (ax, ay), (bx, by) = ([np.interp(s, along, line[:, k]) for k in (0, 1)] for s in (front, front - length))
    ways = np.empty((*front.shape, 3))
    ways[:, :, 0], ways[:, :, 1], heading = 0.5 * (ax + bx), 0.5 * (ay + by), np.arctan2(ay - by, ax - bx)
    ways[:, :, 2] = np.unwrap(heading, axis=1) if np.ptp(heading) >= math.pi else heading
    return list(ways)


def _inside(lane: Any, first: str) -> list[str]:
    """Return the lanes of a junction that follow each other from the first one on: a turn that waits in the middle has two."""
    found: list[str] = []
    while first and first not in found:
        found.append(first)
        links = lane.getLinks(first)
        first = links[0][4] if links else ""
    return found


@lru_cache(maxsize=1024)
def _line(shape: tuple[tuple[float, ...], ...]) -> tuple[States, States]:
    """Return the (n, 2) points of a lane, and their distances along it (m)."""
    points = np.array([point[:2] for point in shape], dtype=np.float64).reshape(-1, 2)
    return points, _along(points)


def _along(points: States) -> States:
    along = np.zeros(max(len(points), 1))
    step = points[1:] - points[:-1]
    np.cumsum(np.hypot(step[:, 0], step[:, 1]), out=along[1:])
    return along


def _place(points: States, along: States, at: float) -> tuple[States, States]:
    """Return the point at a distance along a polyline (m), and the direction of its segment there, (2,) each."""
    k = min(max(int(along.searchsorted(at, side="right")) - 1, 0), len(points) - 2)
    step = points[k + 1] - points[k]
    direction = step / (size := max(float(np.hypot(step[0], step[1])), 1e-9))
    return points[k] + direction * min(max(float(at - along[k]), 0.0), size), direction


def _nearest(points: States, to: States) -> float:
    """Return how far along a polyline it is nearest to a point (m)."""
    step = np.diff(points, axis=0)
    size = np.maximum(np.hypot(*step.T), 1e-9)
    part = np.clip(((to - points[:-1]) * step).sum(axis=1) / size, 0.0, size)
    apart = np.hypot(*(points[:-1] + step * (part / size)[:, None] - to).T)
    k = int(np.argmin(apart))
    return float(_along(points)[k] + part[k])


def _beside(points: States, left: float) -> States:
    """Return a polyline moved to the left (m), each point once: a lane begins where the one before it ends."""
    if len(points) > 1:
        apart = points[1:] - points[:-1]
        points = np.concatenate([points[:1], points[1:][np.hypot(apart[:, 0], apart[:, 1]) > 1e-3]])
    if left == 0.0 or len(points) < 2:
        return points
    step = np.empty_like(points)
    step[0], step[1:-1], step[-1] = points[1] - points[0], (points[2:] - points[:-2]) / 2.0, points[-1] - points[-2]
    across = np.empty_like(points)
    across[:, 0], across[:, 1] = -step[:, 1], step[:, 0]
    return points + left * across / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]
