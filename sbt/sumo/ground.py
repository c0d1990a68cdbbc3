"""Where road users are above the ground: who is on another level by its height, and the way that a long body covers."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbt.metrics.heights import DETOUR, LEVEL_HEIGHT, STEEPEST
from sbt.sumo.levels import is_known, road_of

__all__ = ["Ground", "Place", "Trails"]

_MOVED = 1.0
"""Distance between places that a trail keeps (m)."""

Place = Sequence[float]
"""x, y and z (m)."""


@dataclass(frozen=True)
class Ground:
    """Where the ego is in a step, and how the road rises there.

    Attributes:
        sumo: SUMO's client.
        domain: its vehicles or persons, whichever the ego is.
        ego, place: its name and position (x, y, z).
        rise: of the road in both directions of the plane (m/m).
        off: it is on no lane.
    """

    sumo: Any
    domain: Any
    ego: str
    place: Sequence[float]
    rise: tuple[float, float]
    off: bool = False

    @classmethod
    def under(cls, sumo: Any, domain: Any, ego: str, place: Sequence[float], *, off: bool = False) -> Ground:
        """Return the ground under the ego; flat where it is on no lane."""
        return cls(sumo, domain, ego, place, (0.0, 0.0) if off else _rise(domain, ego), off)

    def is_below(self, name: str, other: Sequence[float], *, person: bool, off: bool = False) -> bool:
        """Return whether a road user at (x, y, z), off: on no lane, is so much higher, or lower, that it is on another level.

        Roads rise: who is far is on the same level if it is as high as the slope of its road or of the ego's leads, or between,
        or on the way of one to the other.
        """
        dx, dy, height = (there - here for there, here in zip(other, self.place, strict=True))
        theirs = (0.0, 0.0) if off else _rise(self.sumo.person if person else self.sumo.vehicle, name)
        rises = [dx * x + dy * y for x, y in (self.rise, theirs)]
        if min(rises) - LEVEL_HEIGHT < height < max(rises) + LEVEL_HEIGHT:
            return False
        vehicle, far = self.sumo.vehicle, math.hypot(dx, dy)
        if abs(height) > STEEPEST * far or person or off or self.off or self.domain is not vehicle:
            return True
        ways = ((self.ego, name), (name, self.ego))
        return not any(0.0 <= _way(self.sumo, a, b) <= DETOUR * far for a, b in ways)


class Trails:
    """Where the fronts of very long vehicles have been, as far as their bodies are there now."""

    def __init__(self, sumo: Any):
        self._sumo, self._passed = sumo, dict[str, deque[tuple[float, Sequence[float], str]]]()

    def note(self, name: str, length: float) -> bool:
        """Note where a vehicle of a length (m) is; return whether SUMO knows it."""
        if not is_known(self._sumo, name):
            self._passed.pop(name, None)
            return False
        place, trail = self._sumo.vehicle.getPosition3D(name), self._passed.setdefault(name, deque())
        along, moved = (trail[-1][0], math.dist(trail[-1][1][:2], place[:2])) if trail else (0.0, math.inf)
        if moved >= _MOVED:
            trail.append((along + min(moved, length), place, road_of(self._sumo, name)))
        while len(trail) > 1 and trail[-1][0] - trail[1][0] > length:
            trail.popleft()
        return True

    def nearest(self, name: str, own: Sequence[float]) -> tuple[Sequence[float], str]:
        """Return the place (x, y, z) that its body covers next to a place, and the road there."""
        return min(self._passed[name], key=lambda passed: math.dist(passed[1][:2], own[:2]))[1:]

    def closest(self, name: str, other: str) -> tuple[Sequence[float], str]:
        """Return the place that the body of one covers next to the other's, and the road there."""
        places, others = (np.array([at[:2] for _, at, _ in self._passed[who]]) for who in (name, other))
        apart = np.hypot(*(places[:, None] - others[None]).transpose(2, 0, 1)).min(axis=1)
        return self._passed[name][int(apart.argmin())][1:]

    def __contains__(self, name: str) -> bool:
        """Return whether somebody's trail is kept."""
        return name in self._passed


def _rise(domain: Any, name: str) -> tuple[float, float]:
    """Return by how much the road under somebody rises in both directions of the plane (m/m)."""
    angle, slope = math.radians(domain.getAngle(name)), math.tan(math.radians(domain.getSlope(name)))
    return slope * math.sin(angle), slope * math.cos(angle)


def _way(sumo: Any, name: str, to: str) -> float:
    """Return how far a vehicle's route leads to another one (m); negative where it does not."""
    road = road_of(sumo, to)
    if not road:
        return -1.0
    try:
        at = road, sumo.vehicle.getLanePosition(to), sumo.vehicle.getLaneIndex(to)
        return float(sumo.vehicle.getDrivingDistance(name, *at))
    except sumo.TraCIException:  # a lane that is not on its way
        return -1.0
