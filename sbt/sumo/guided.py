"""Road users of a user's own simulation that this package moves, such as a leader whose speed is an input's profile."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.profile import Curve, Profile
from sbt.sumo.dynamics import next_speed
from sbt.sumo.insertion import SPEED_MODE

__all__ = ["STRATEGIC_LANE_CHANGES", "GuidedVehicle", "Motion", "Participant", "Placed"]

STRATEGIC_LANE_CHANGES = 513
"""SUMO's lane-change mode with strategic changes only, respecting other vehicles."""
_TOLERANCE = 1e-3
"""Difference between the commanded and the realised speed that is accepted (m/s)."""
_HARDEST = 10.0
"""Largest change of the speed when a profile takes over, in the step (m/s^2)."""


class Placed(NamedTuple):
    """Where a road user was put by position: SUMO knows neither its speed nor, off the lanes, that it is near.

    x, y (m) of the front bumper of a vehicle or the centre of a person; angle in degrees, clockwise from north; speed in m/s;
    z (m), NaN where it is not known.
    """

    x: float
    y: float
    angle: float
    speed: float
    person: bool = False
    z: float = math.nan


class Motion(Protocol):
    """Moves road users during one run."""

    def before_step(self, t: float | None) -> None:
        """Command the next step; t: time since the departure of the ego (s), None before it."""
        ...

    def after_step(self) -> Mapping[str, Placed]:
        """Look at the step; return the road users that were put somewhere by position."""
        ...


class Participant(Protocol):
    """Road users that this package moves."""

    def begin(self, sumo: Any, values: Mapping[str, float]) -> Motion:
        """Return what moves them in one run; SUMO is started, but has made no step."""
        ...


@dataclass(frozen=True)
class GuidedVehicle:
    """A vehicle of the user's files whose speed or acceleration follows a profile.

    From time 0 of the scenario (the departure of the ego) on the profile alone decides: the vehicle ignores others and
    lights (speed mode 32), and SUMO changes lanes only as its route needs it. Before, SUMO drives it. A speed below 0 is 0.

    Args:
        id: in SUMO.
        profile: over the time of the scenario (s).
        quantity: `speed` (m/s) or `acceleration` (m/s^2), which begins from the vehicle's speed.
    """

    id: str
    profile: Profile
    quantity: Literal["speed", "acceleration"] = "speed"

    def begin(self, sumo: Any, values: Mapping[str, float]) -> Motion:
        """Return what guides the vehicle in one run."""
        return _Guidance(sumo, self, self.profile.curve(values))


class _Guidance:
    """Guides one vehicle during one run."""

    def __init__(self, sumo: Any, guided: GuidedVehicle, curve: Curve):
        self._sumo, self._guided, self._curve = sumo, guided, curve
        self._dt = float(sumo.simulation.getDeltaT())
        self._present = False
        self._speed: float | None = None  # commanded last

    def before_step(self, t: float | None) -> None:
        """Command the speed at the end of the step."""
        if t is None or not self._present:
            return
        now = self._sumo.vehicle.getSpeed(self._guided.id) if self._speed is None else self._speed
        if self._guided.quantity == "acceleration":
            wanted = next_speed(now, self._curve(t + 0.5 * self._dt), None, self._dt)
        else:
            wanted = max(self._curve(t + self._dt), 0.0)
        if self._speed is None:
            self._take_over(t, now)
        self._sumo.vehicle.setSpeed(self._guided.id, wanted)
        self._speed = wanted

    def after_step(self) -> Mapping[str, Placed]:
        """Notice departure and arrival, and compare the speed with the commanded one."""
        name, simulation = self._guided.id, self._sumo.simulation
        if not self._present:
            self._present = name in simulation.getDepartedIDList()
        elif name in simulation.getArrivedIDList():
            self._present = False
        elif self._speed is not None and abs(self._sumo.vehicle.getSpeed(name) - self._speed) > _TOLERANCE:
            rule = f"'{name}' must drive {self._speed:g} m/s at t = {simulation.getTime():g} s, as its profile says"
            actual = self._sumo.vehicle.getSpeed(name)
            raise RunError(Status.INVALID, f"{rule}, but SUMO gave {actual:g} m/s (a stop on its route, or too little friction?)")
        return {}

    def _take_over(self, t: float, now: float) -> None:
        name, profile = self._guided.id, self._guided.profile
        first = max(self._curve(t), 0.0)
        if self._guided.quantity == "speed" and abs(first - now) > _HARDEST * self._dt + _TOLERANCE:
            rule = f"'{name}' must begin with the speed of the profile {profile.name}, {first:g} m/s"
            remedy = f'depart it with the ego, with departSpeed="${{{profile.parameters[0].name}}}", or guide its acceleration'
            raise RunError(Status.INVALID, f"{rule}, but it drives {now:g} m/s at t = {t:g} s of the scenario: {remedy}")
        self._sumo.vehicle.setSpeedMode(name, SPEED_MODE)
        self._sumo.vehicle.setLaneChangeMode(name, STRATEGIC_LANE_CHANGES)
