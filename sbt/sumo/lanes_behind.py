"""The lanes behind a vehicle: where the parts of a long one are as long as nobody has seen it drive."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from sbt.sumo.trailing import TrailingBody

__all__ = ["Lanes", "path_behind", "trailing_body"]

_BESIDE = 4.0
"""Distance (m) that a vehicle may be beside the middle of its lane, and its lane's end beside the junction."""

Point = tuple[float, float]


class Lanes:
    """Which lanes of a network lead to which others, and their shapes; looked up once.

    Args:
        sumo: libsumo or traci.
    """

    def __init__(self, sumo: Any):
        self._sumo, self._lane = sumo, sumo.lane
        self._shapes: dict[str, Sequence[Point]] = {}
        self._before: dict[tuple[str, str], Sequence[str]] = {}
        self._known: dict[tuple[str, str, float], bool] = {}

    def leads_to(self, lane: str, other: str, travelled: float, front: Point) -> bool:
        """Return whether one leads to the other, over lanes that are no longer together than what is driven (m).

        Args:
            lane: id.
            other: id.
            travelled: speed times step (m).
            front: where the vehicle was on the first lane, whose end must not be farther.
        """
        room = math.ceil(1.5 * travelled) + 1.0
        if (lane, other, room) not in self._known:
            self._known[lane, other, room] = self._found(lane, other, room)
        return self._known[lane, other, room] and math.dist(front, self.shape(lane)[-1]) <= room + _BESIDE

    def shape(self, lane: str) -> Sequence[Point]:
        """Return the points of a lane's middle (m)."""
        if lane not in self._shapes:
            self._shapes[lane] = [point[:2] for point in self._lane.getShape(lane)]
        return self._shapes[lane]

    def before(self, lane: str, edge: str) -> Sequence[str]:
        """Return the lanes from which an edge leads to a lane, the nearest first: those inside the junction, and one of the edge.

        None where it does not lead there. Of several lanes of the edge that do, the one with the same number.
        """
        if (lane, edge) not in self._before:
            number = lane.rpartition("_")[2]
            beside = sorted(range(self._sumo.edge.getLaneNumber(edge)), key=lambda k: str(k) != number)
            ways = (self._way(f"{edge}_{k}", lane) for k in beside)
            self._before[lane, edge] = next(filter(None, ways), ())
        return self._before[lane, edge]

    def _way(self, first: str, lane: str) -> list[str]:
        """Return the lanes from the first one to this one, the nearest first; none where it does not lead there."""
        for link in self._lane.getLinks(first):
            found, inside = [first], link[4]
            while inside and inside != lane and inside not in found:
                found.append(inside)
                inside = next((one[4] for one in self._lane.getLinks(inside)), "")
            if lane in (inside, link[0]):
                return found[::-1]
        return []

    def _found(self, lane: str, other: str, room: float) -> bool:
        following = {link[4] or link[0] for link in self._lane.getLinks(lane)}
        if other in following:
            return True
        rooms = {name: room - self._lane.getLength(name) for name in following}
        return any(left >= 0.0 and self._found(name, other, left) for name, left in rooms.items())


def trailing_body(sumo: Any, lanes: Lanes, name: str, length: float) -> TrailingBody:
    """Return the body of a long vehicle that is in SUMO, which has not been seen to drive yet."""
    return TrailingBody(length, partial(path_behind, sumo, lanes, name, length=length), lanes.leads_to)


def path_behind(sumo: Any, lanes: Lanes, name: str, front: Point, length: float) -> list[Point]:
    """Return points of the lanes behind the front of a vehicle, the nearest first, as far beside their middles as it is.

    None where it is on no lane. Beyond the begin of its route nothing is known.

    Args:
        sumo: libsumo or traci.
        lanes: of the network.
        name: of the vehicle.
        front: middle of its front bumper (m).
        length: for which points are needed (m).
    """
    lane = sumo.vehicle.getLaneID(name)
    if not lane:
        return []
    shape = lanes.shape(lane)
    position = sumo.vehicle.getLanePosition(name) * _length(shape) / max(sumo.lane.getLength(lane), 1e-3)
    (ax, ay), side = _at(shape, position)
    if side is None or math.dist(front, (ax, ay)) > max(3.2, 0.1 * length):
        return []  # beside its lane
    ux, uy = _direction(shape[side], shape[side + 1])
    angle = math.radians(sumo.vehicle.getAngle(name))
    against = ux * math.sin(angle) + uy * math.cos(angle) < 0.0  # it overtakes on an opposite lane
    ux, uy = (-ux, -uy) if against else (ux, uy)
    left = ux * (front[1] - ay) - uy * (front[0] - ax)
    points, last, covered = list[Point](), (ax, ay), 0.0
    for x, y in shape[side + 1 :] if against else _middles(sumo, lanes, name, lane, shape[side::-1]):
        if (step := math.dist(last, (x, y))) > 1e-3:
            ux, uy = _direction((x, y), last)
            points.append((x - left * uy, y + left * ux))
            last, covered = (x, y), covered + step
        if covered > length + 1.0:
            break
    return points


def _middles(sumo: Any, lanes: Lanes, name: str, lane: str, here: Sequence[Point]) -> Iterator[Point]:
    """Yield the points behind a vehicle of the middle of its lane, which are these, and of the lanes before it on its route."""
    yield from here
    route, k = sumo.vehicle.getRoute(name), sumo.vehicle.getRouteIndex(name)
    known = k + 1 if lane.startswith(":") else k  # inside a junction the index is that of the edge before
    for edge in reversed(route[: max(known, 0)]):
        before = lanes.before(lane, edge)
        for lane in before:
            yield from reversed(lanes.shape(lane))
        if not before:
            return


def _direction(a: Point, b: Point) -> Point:
    """Return the direction from one point to another, which is not the same."""
    size = math.dist(a, b)
    return (b[0] - a[0]) / size, (b[1] - a[1]) / size


def _length(shape: Sequence[Point]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(shape))


def _at(shape: Sequence[Point], position: float) -> tuple[Point, int | None]:
    """Return the point at a distance along a line, and the segment that it lies on."""
    for k, (a, b) in enumerate(pairwise(shape)):
        step = math.dist(a, b)
        if position <= step + 1e-6 and step > 0:
            return (a[0] + position / step * (b[0] - a[0]), a[1] + position / step * (b[1] - a[1])), k
        position -= step
    return shape[-1], None
