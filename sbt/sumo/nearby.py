"""Who is near the ego of a user's own simulation: by distances between bodies, as SUMO's subscriptions know fronts alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from sbt.sumo.levels import is_known
from sbt.sumo.off_lanes import ANGLE, POSITION, SPEED, VEHICLE
from sbt.sumo.trailing import LONGEST_RIGID

__all__ = ["VERY_LONG", "Nearby"]

_VEHICLES, _PERSONS = 0xA4, 0xAE
"""TraCI domains: CMD_GET_VEHICLE_VARIABLE, CMD_GET_PERSON_VARIABLE."""
VERY_LONG = 20.0
"""Length from which on every vehicle is followed one by one, as no subscription reaches to its front (m)."""
_WIDTHS = 3.0
"""Half the widths of two road users, at most (m)."""
_FASTEST, _GAINED = 60.0, 5.0
"""Speed of others, at most (m/s), and how much of it (m/s^2) a road user gains, or loses, within a step."""
_APART = 1e-6
"""SUMO merges subscriptions of one road user with the same range (m), and their filters: no loop asks for such a range."""
_KNOWN = (POSITION, ANGLE, SPEED)

_Variables = Mapping[int, Any]
_Ends = tuple[list[tuple[float, float]], float]
"""Ends of the middle line of a body, and how far that may go on, by whatever bends, beyond them (m)."""


class Nearby:
    """Road users whose bodies are within a radius around that of the ego, or may touch it in the step before or after.

    Args:
        sumo: libsumo or traci, started.
        ego: id of the vehicle under test.
        within: radius (m).
        dt: step (s).

    Attributes:
        very_long: lengths of the vehicles that may be near although the subscription does not tell of their fronts (m).
    """

    def __init__(self, sumo: Any, ego: str, within: float, dt: float):
        self._sumo, self._ego, self._within, self._dt = sumo, ego, within, dt
        self._farthest, self._driven = within, 0.0
        self._domain: Any = sumo.vehicle
        self._size = self._breadth = self._longest = 0.0
        self._subscribed = False
        self._sizes: dict[str, tuple[float, float]] = {}
        self._own: _Ends = [], 0.0
        self.very_long: dict[str, float] = {}

    def depart(self, name: str, length: float) -> None:
        """Note a vehicle of this length (m)."""
        if length > (self._longest if self._subscribed else VERY_LONG):
            self.very_long[name] = length
        else:
            self._longest = max(self._longest, length)

    def forget(self, name: str) -> None:
        """Forget a vehicle that has left: another one may have its name."""
        self.very_long.pop(name, None)
        self._sizes.pop(name, None)

    def subscribe(self, *, walks: bool) -> None:
        """Subscribe to the surroundings of the ego, which has just departed; walks: it is a person."""
        self._domain, ego = self._sumo.person if walks else self._sumo.vehicle, self._ego
        self._size, self._breadth = self._domain.getLength(ego), 0.5 * self._domain.getWidth(ego)
        self._subscribed = True
        self._farthest = max(self._within, self._way(self._domain.getMaxSpeed(ego)) + self._way(_FASTEST))
        reach = self._farthest + self._size + self._longest + _WIDTHS + _APART
        self._domain.subscribeContext(ego, _VEHICLES, reach, _KNOWN)
        self._domain.subscribeContext(ego, _PERSONS, reach, (*_KNOWN, VEHICLE))

    def subscribed(self) -> Mapping[str, _Variables]:
        """Return the variables of those whom the subscriptions tell of, near and somewhat farther."""
        found: Mapping[str, _Variables] = self._domain.getContextSubscriptionResults(self._ego)
        if all(SPEED in one and POSITION in one and ANGLE in one for one in found.values()):
            return found
        return {name: one for name, one in found.items() if all(known in one for known in _KNOWN)}  # a loop asks for others

    def around(self, own: _Variables) -> None:
        """Take the ego to have these variables in this step."""
        self._driven = self._way(own[SPEED])
        self._own = _ends(own, self._size, self._within)

    def _way(self, speed: float) -> float:
        """Return how far one of this speed (m/s) comes in a step, at most (m)."""
        return (max(speed, 0.0) + _GAINED * self._dt) * self._dt

    def _radius(self, speed: float) -> float:
        """Return within which radius one of this speed (m/s) is near: no less than what the two drive in a step (m)."""
        return self._within if self._farthest <= self._within else max(self._within, self._driven + self._way(speed))

    def is_near(self, name: str, variables: _Variables) -> bool:
        """Return whether the body of a road user may be within the radius around that of the ego, or touch it within a step."""
        apart = math.dist(self._own[0][0], variables[POSITION][:2])
        if name == self._ego or apart <= self._within:
            return True
        radius, size = self._radius(variables[SPEED]), self._sizes.get(name)
        if size is None:
            walks = VEHICLE in variables or not is_known(self._sumo, name)  # whom a loop asks for it may ask for less
            domain = self._sumo.person if walks else self._sumo.vehicle
            size = self._sizes[name] = domain.getLength(name), domain.getWidth(name)
        return apart <= radius + self._size + size[0] + _WIDTHS and self._is_body_near(variables, *size, radius)

    def _is_body_near(self, variables: _Variables, length: float, width: float, radius: float) -> bool:
        (own, slack), (ends, more) = self._own, _ends(variables, length, self._within)
        reach = radius + slack + more + self._breadth + 0.5 * width
        nearest = min(math.dist(a, b) for a in own for b in ends)  # of the bodies' sides no point is nearer than so
        return nearest <= math.hypot(reach, 0.5 * (self._size + length))

    def far(self, near: Mapping[str, Any]) -> Iterator[str]:
        """Yield the very long vehicles of which a part may be within the radius although they are not among those near."""
        return (name for name, length in self.very_long.items() if name not in near and self._may_be_near(name, length))

    def _may_be_near(self, name: str, length: float) -> bool:
        of, reach = self._sumo.vehicle, self._size + _WIDTHS + length
        apart = math.dist(of.getPosition(name), self._own[0][0]) - reach
        return apart <= self._within or (apart <= self._farthest and apart <= self._radius(of.getSpeed(name)))


def _ends(variables: _Variables, length: float, within: float) -> _Ends:
    """Return the ends of a body, straight behind its front, and how far it may be beyond them, in a bend.

    A radius (m) of twice its length or more takes it for straight: with a smaller one no body that touches is missed.
    """
    x, y = variables[POSITION][:2]
    angle = math.radians(variables[ANGLE])
    ends = [(x, y), (x - length * math.sin(angle), y - length * math.cos(angle))]
    return ends, max(length - 0.5 * within, 0.0) if length > LONGEST_RIGID else 0.0
