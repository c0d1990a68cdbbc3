"""The shape of a long vehicle: rectangles that follow the path of its front, as SUMO's vehicles follow their lanes.

SUMO keeps the front and the rear of a vehicle on the lanes that it drives; a straight rectangle between them cuts
the inside of a bend by length^2 / (8 radius), 3 m for a bus of 12 m on a radius of 6 m, where no driver of a real
bus would be. So the rear parts follow the path of the front. The body at first sight is taken from the lane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

__all__ = ["LONGEST_RIGID", "TrailingBody", "path_behind"]

LONGEST_RIGID = 6.0
"""Length up to which a vehicle is one rectangle (m); above, no part is longer than 5 m, unless that takes too many."""
_PART = 5.0
_MOST_PARTS = 16
_SPACING = 0.5
"""Distance of the stored points of a path (m)."""
_JUMP = 3.0
"""Distance (m) beyond what the speed explains, from which on a vehicle has been moved and not driven."""

Point = tuple[float, float]
Pose = tuple[float, float, float]
"""x, y (m) and heading (rad) of the middle of a rectangle."""


class TrailingBody:
    """The parts of one long vehicle, updated with every step.

    Args:
        length: of the vehicle (m).
        behind: points of the path behind its front at first sight, the nearest first; straight on beyond the last one.
    """

    def __init__(self, length: float, behind: Sequence[Point] = ()):
        self.count = min(_MOST_PARTS, math.ceil(length / _PART))
        self.part_length = length / self.count
        self._length = length
        self._path: list[Point] = list(reversed(behind))  # the newest last
        self._front: Point | None = None
        self._lane = ""
        self._poses: tuple[Pose, ...] = ()

    def move(self, front: Point, cos: float, sin: float, lane: str, travelled: float) -> tuple[Pose, ...]:
        """Return the poses of the parts, the front one first.

        Args:
            front: middle of the front bumper (m).
            cos: of the vehicle's heading.
            sin: likewise.
            lane: id; another lane of the same edge is a change of lanes, which moves the whole body sideways.
            travelled: speed times step (m).
        """
        before, previous, self._front, self._lane = self._front, self._lane, front, lane
        if before == front and previous == lane:
            return self._poses
        if before is not None:
            self._drive(before, front, cos, sin, changed=_beside(previous, lane), travelled=travelled)
        self._poses = self._place(front, cos, sin)
        return self._poses

    def _drive(self, before: Point, front: Point, cos: float, sin: float, *, changed: bool, travelled: float) -> None:
        """Extend the path from the last front to the new one."""
        dx, dy = front[0] - before[0], front[1] - before[1]
        ahead = dx * cos + dy * sin
        if changed:  # sideways at once, and the body with it
            u, v = self._direction(before, cos, sin)
            along = dx * u + dy * v
            shift_x, shift_y = dx - along * u, dy - along * v
            self._path = [(x + shift_x, y + shift_y) for x, y in self._path]
            before = before[0] + shift_x, before[1] + shift_y
        elif ahead < -0.1 or math.hypot(dx, dy) > 1.5 * travelled + _JUMP:
            self._path = []  # backwards, or moved: straight as SUMO turns it
            return
        last = self._path[-1] if self._path else None
        if last is None or math.hypot(before[0] - last[0], before[1] - last[1]) >= _SPACING:
            self._path.append(before)
            needed = math.ceil(self._length / _SPACING) + 2
            if len(self._path) > 2 * needed:
                del self._path[:-needed]

    def _direction(self, front: Point, cos: float, sin: float) -> Point:
        """Return the direction of the path at the front."""
        if self._path:
            dx, dy = front[0] - self._path[-1][0], front[1] - self._path[-1][1]
            moved = math.hypot(dx, dy)
            if moved > 1e-3:
                return dx / moved, dy / moved
        return cos, sin

    def _place(self, front: Point, cos: float, sin: float) -> tuple[Pose, ...]:
        """Return the parts between points of the path that are a part's length apart along it."""
        part, (x, y), joint = self.part_length, front, front
        poses: list[Pose] = []
        left, k = part, len(self._path) - 1
        while len(poses) < self.count:
            if k >= 0:
                u, v = self._path[k]
            else:
                u, v = x - self._length * cos, y - self._length * sin
            dx, dy = u - x, v - y
            step = math.hypot(dx, dy)
            if step < left:
                left, x, y, k = left - step, u, v, k - 1
                if step > 0.0:
                    cos, sin = -dx / step, -dy / step  # straight on beyond the end of the path
                continue
            share = left / step
            x, y, left = x + share * dx, y + share * dy, part
            poses.append((0.5 * (joint[0] + x), 0.5 * (joint[1] + y), math.atan2(joint[1] - y, joint[0] - x)))
            joint = x, y
        return tuple(poses)


def _beside(lane: str, other: str) -> bool:
    """Return whether these are two lanes of one edge."""
    return lane != other and lane.rpartition("_")[0] == other.rpartition("_")[0] != ""


def path_behind(sumo: Any, name: str, front: Point, length: float) -> list[Point]:
    """Return points of the lane behind the front of a vehicle, the nearest first; none where it is on no lane.

    The lane's own shape only: beyond its beginning the body is straight.
    """
    lane = sumo.vehicle.getLaneID(name)
    if not lane:
        return []
    shape = sumo.lane.getShape(lane)
    position = sumo.vehicle.getLanePosition(name) * _length(shape) / max(sumo.lane.getLength(lane), 1e-3)
    (ax, ay), side = _at(shape, position)
    shift_x, shift_y = front[0] - ax, front[1] - ay
    if math.hypot(shift_x, shift_y) > max(3.2, 0.1 * length) or side is None:
        return []  # beside its lane
    points, start = [], 0.0
    for a, b in pairwise(shape):
        end = start + math.hypot(b[0] - a[0], b[1] - a[1])
        if start < position - 1e-3 and end > position - length - 1.0:
            points.append((a[0] + shift_x, a[1] + shift_y))
        start = end
    return points[::-1]


def _length(shape: Sequence[Point]) -> float:
    return sum(math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(shape))


def _at(shape: Sequence[Point], position: float) -> tuple[Point, int | None]:
    """Return the point at a distance along a line, and the segment that it lies on."""
    for k, (a, b) in enumerate(pairwise(shape)):
        step = math.hypot(b[0] - a[0], b[1] - a[1])
        if position <= step + 1e-6 and step > 0:
            return (a[0] + position / step * (b[0] - a[0]), a[1] + position / step * (b[1] - a[1])), k
        position -= step
    return shape[-1], None
