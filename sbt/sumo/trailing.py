"""The shape of a long vehicle: rectangles that follow the path of its front, as SUMO's vehicles follow their lanes.

SUMO keeps the front and the rear of a vehicle on the lanes that it drives; a straight rectangle between them cuts
the inside of a bend by length^2 / (8 radius), 3 m for a bus of 12 m on a radius of 6 m, where no driver of a real
bus would be. So the rear parts follow the path of the front. Where that is not known, at first sight and after a jump, they
are on the lanes behind (`sbt.sumo.lanes_behind`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from sbt.metrics.geometry import LANE_CHANGE
from sbt.problem.trace import ActorTrace, States

__all__ = ["LONGEST_RIGID", "TrailingBody", "part_traces"]

LONGEST_RIGID = 6.0
"""Length up to which a vehicle is one rectangle (m); above, no part is longer than 5 m, unless that takes too many."""
_PART = 5.0
_MOST_PARTS = 16
_SPACING = 0.5
"""Distance of the stored points of a path (m)."""
_SAGITTA = 0.05
"""How far (m) a way of one step may bend beside its chord before the lanes between are asked for."""
_JUMP = 3.0
"""Distance (m) beyond what the speed explains, from which on a vehicle has been moved and not driven."""

Point = tuple[float, float]
_LeadsTo = Callable[[str, str, float, Point], bool]
_Instant = tuple[int, int, float, float, float, float]
"""Number of the path, of its points, x and y of the front (m), cosine and sine of the heading."""


class TrailingBody:
    """The parts of one long vehicle. A step only notes where its front is; the parts are placed for those who ask.

    Args:
        length: of the vehicle (m).
        behind: gives points of the path behind its front (m) now, the nearest first; straight on beyond the last one.
        leads_to: whether a lane leads to another within some metres of a point (`Lanes.leads_to`).
    """

    def __init__(
        self, length: float, behind: Callable[[Point], Sequence[Point]] = lambda _: (), leads_to: _LeadsTo | None = None
    ):
        self.count = min(_MOST_PARTS, math.ceil(length / _PART))
        self.part_length = length / self.count
        self._kept = math.ceil(length / _SPACING) + 2
        self._paths = list[_Path]()
        self._behind = behind
        self._instants: list[_Instant] = []
        self._lane = ""
        self._leads_to = leads_to

    def move(self, front: Point, cos: float, sin: float, lane: str, travelled: float) -> int:
        """Note a step, and return the number by which `poses` knows it.

        Args:
            front: middle of the front bumper (m).
            cos: of the vehicle's heading.
            sin: likewise.
            lane: id; one to which the last one does not lead is a change of lanes, which moves the whole body sideways.
            travelled: speed times step (m).
        """
        previous, self._lane = self._lane, lane
        if self._instants:
            x, y = self._instants[-1][2:4]
            if (x, y) == front and previous == lane:
                return len(self._instants) - 1
            self._drive((x, y), front, cos, sin, changed=self._changes(previous, lane, travelled, (x, y)), travelled=travelled)
        else:
            self._begin(front)
        self._instants.append((len(self._paths) - 1, len(self._paths[-1].x), *front, cos, sin))
        return len(self._instants) - 1

    def poses_among(self, at: Sequence[int | None]) -> np.ndarray:
        """Return what `poses` does, NaN where there is no step (None): (n, parts, 3)."""
        found = np.full((len(at), self.count, 3), np.nan)
        rows = [k for k, step in enumerate(at) if step is not None]
        found[rows] = self.poses([step for step in at if step is not None])
        return found

    def _changes(self, lane: str, other: str, travelled: float, front: Point) -> bool:
        """Return whether who was on one lane and is on another has changed lanes: on one edge, or while it entered one.

        So has who overtakes on the lane of opposite traffic and returns: lanes of two edges, which a turnaround may connect.
        """
        if lane == other or not lane or not other:
            return False
        if lane.rpartition("_")[0] == other.rpartition("_")[0]:
            return True
        return self._leads_to is not None and not self._leads_to(lane, other, travelled, front)

    def _drive(self, before: Point, front: Point, cos: float, sin: float, *, changed: bool, travelled: float) -> None:
        """Extend the path from the last front to the new one."""
        dx, dy = front[0] - before[0], front[1] - before[1]
        path = self._paths[-1]
        u, v = path.direction(before) or (cos, sin)
        if math.hypot(dx, dy) > 1.5 * travelled + (LANE_CHANGE if changed else _JUMP):
            self._begin(front)  # moved, or away meanwhile
            return
        if changed:  # sideways at once, and the body with it
            along = dx * u + dy * v
            shift_x, shift_y = dx - along * u, dy - along * v
            kept = zip(path.x[-self._kept :], path.y[-self._kept :], strict=True)
            path = _Path([(x + shift_x, y + shift_y) for x, y in kept])
            self._paths.append(path)
            before = before[0] + shift_x, before[1] + shift_y
        elif max(dx * cos + dy * sin, dx * u + dy * v) < -0.1:
            self._paths.append(_Path())  # backwards (in a tight turn the front drives against the chord): straight
            return
        path.extend(before, _SPACING)
        if not changed and abs(u * dy - v * dx) > 8.0 * _SAGITTA:  # how far the way bends beside the chord
            for point in self._between(before, front, math.hypot(dx, dy)):
                path.extend(point, 1e-3)

    def _between(self, before: Point, front: Point, chord: float) -> list[Point]:
        """Return points of the way between two fronts, the first one first: along the lanes, moving sideways evenly."""
        points, along = [front], [0.0]
        for point in self._behind(front):
            along.append(along[-1] + math.dist(points[-1], point))
            points.append(point)
            if along[-1] >= chord or math.dist(point, front) >= chord:
                break
        if len(points) < 2:
            return []
        (x, y), (u, v) = points[-2:]
        step = along[-1] - along[-2]
        ux, uy = (u - x) / step, (v - y) / step
        ahead = (before[0] - x) * ux + (before[1] - y) * uy
        left = (before[1] - y) * ux - (before[0] - x) * uy  # of the lanes at the place where the front is now
        share = left / max(along[-2] + ahead, 1e-3)
        return [(p[0] - share * s * uy, p[1] + share * s * ux) for p, s in zip(points[-2:0:-1], along[-2:0:-1], strict=True)]

    def _begin(self, front: Point) -> None:
        """Begin a path that ends at the front: what is behind it has not been seen."""
        self._paths.append(_Path(self._behind(front)[::-1]))

    def poses(self, instants: Sequence[int]) -> np.ndarray:
        """Return the poses of the parts in these steps, the front one first: (instants, parts, 3)."""
        table = np.array([self._instants[k] for k in instants])
        result = np.empty((len(table), self.count, 3))
        behind = self.part_length * np.arange(1, self.count + 1)
        for k in np.unique(table[:, 0]):
            here = table[:, 0] == k
            points, *state = table[here, 1:].T
            result[here] = self._paths[int(k)].place(points.astype(int), np.stack(state), behind)
        return result


class _Path:
    """A line that grows at its end, with the distance along it from its first point to each (m)."""

    def __init__(self, points: Iterable[Point] = ()):
        self.x: list[float] = []
        self.y: list[float] = []
        self._along: list[float] = []
        for point in points:
            self.extend(point, 1e-6)

    def extend(self, point: Point, spacing: float) -> None:
        """Append a point, unless it is closer to the last one than the spacing (m)."""
        step = math.hypot(point[0] - self.x[-1], point[1] - self.y[-1]) if self.x else math.inf
        if step >= spacing:
            self._along.append(self._along[-1] + step if self.x else 0.0)
            self.x.append(point[0])
            self.y.append(point[1])

    def direction(self, front: Point) -> Point | None:
        """Return the direction from the last point to the front; None where that is the same point."""
        dx, dy = (front[0] - self.x[-1], front[1] - self.y[-1]) if self.x else (0.0, 0.0)
        moved = math.hypot(dx, dy)
        return (dx / moved, dy / moved) if moved > 1e-3 else None

    def place(self, points: np.ndarray, state: np.ndarray, behind: np.ndarray) -> np.ndarray:
        """Return the parts between joints that are as far behind the front along the path as is said.

        Args:
            points: (n,) number of points that the path had then.
            state: (4, n) x and y of the front (m), cosine and sine of the heading.
            behind: (parts,) distances of the joints from the front (m); straight on beyond the first point of the path.

        Returns:
            (n, parts, 3) poses.
        """
        fx, fy, cos, sin = (column[:, None] for column in state)
        there = points[:, None] > 0
        x, y, along = (np.array(column or [0.0]) for column in (self.x, self.y, self._along))
        last = np.maximum(points - 1, 0)[:, None]
        to_x, to_y = np.where(there, x[last] - fx, -cos), np.where(there, y[last] - fy, -sin)
        gap = np.hypot(to_x, to_y)  # from the front to the last point
        unit_x, unit_y = (np.where(gap > 0, -d / np.where(gap > 0, gap, 1.0), h) for d, h in ((to_x, cos), (to_y, sin)))
        at = np.where(there, along[last] + gap, 0.0) - behind  # (n, parts), from the first point on
        jx = np.where(at > along[last], fx - behind * unit_x, np.interp(at, along, x))
        jy = np.where(at > along[last], fy - behind * unit_y, np.interp(at, along, y))
        two = points[:, None] > 1
        if len(x) > 1:
            unit_x = np.where(two, (x[1] - x[0]) / along[1], unit_x)
            unit_y = np.where(two, (y[1] - y[0]) / along[1], unit_y)
        before = at < 0
        jx = np.where(before, np.where(there, x[0], fx) + at * unit_x, jx)
        jy = np.where(before, np.where(there, y[0], fy) + at * unit_y, jy)
        ahead_x, ahead_y = np.hstack([fx, jx[:, :-1]]), np.hstack([fy, jy[:, :-1]])
        return np.stack([0.5 * (ahead_x + jx), 0.5 * (ahead_y + jy), np.arctan2(ahead_y - jy, ahead_x - jx)], axis=2)


def part_traces(
    poses: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, length: float, width: float, ways: Sequence[States] = ()
) -> tuple[ActorTrace, ...]:
    """Return the parts of a long vehicle from their (t, parts, 3) poses, with their ways where these are known."""
    return tuple(
        ActorTrace(x, y, heading, speed, acceleration, length, width, way=ways[j] if ways else None)
        for j, (x, y, heading) in enumerate(poses.transpose(1, 2, 0))
    )
