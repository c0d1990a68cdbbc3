"""The ego of the user's own files: left to SUMO, with another of SUMO's models, or driven by a controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import State
from sbt.sumo.ego import SUMO, Ego
from sbt.sumo.formatting import plain
from sbt.sumo.models import checked

__all__ = ["EGO_TYPE", "OwnEgo", "Pilot"]

EGO_TYPE = "sbt_ego"
"""Id of the vehicle type that an ego with another of SUMO's models gets."""
_KEPT = ("Length", "Width", "Height", "VehicleClass", "MaxSpeed", "MinGap", "Accel", "Decel", "EmergencyDecel", "Tau",
         "Imperfection", "SpeedFactor", "SpeedDeviation", "Color", "MaxSpeedLat", "MinGapLat", "LateralAlignment")  # fmt: skip
_ATTRIBUTE = {"Imperfection": "sigma", "VehicleClass": "vClass", "SpeedDeviation": "speedDev", "LateralAlignment": "latAlignment"}
_FASTEST = 1e4
_COMFORT = 3.0
"""Deceleration with which one still stops at yellow (m/s^2)."""
_LINE, _ACROSS = 0.1, 3.0
"""Length and width of a stop line (m)."""
_OBEDIENT = 32
"""SUMO's speed mode in which a command is all that counts. (24, 28 and 30, which know lights, stop at a red one in a single
step, with 78 m/s^2; 31 brakes for everything itself.)"""
_FOR_THE_ROUTE = 513
"""SUMO's lane-change mode in which only the route is a reason, and others are respected."""

Pilot = Callable[[float, State, tuple[State, ...]], None]


@dataclass(frozen=True)
class OwnEgo:
    """The vehicle under test among those of the user's files.

    Args:
        id: SUMO's id of it.
        driver: a controller, or (`kind: sumo`) another car-following model; None: as the files have it.
        set_speed: what a controller would keep (m/s); None: the speed allowed where it departs.
        lights: a red traffic light is a standing obstacle at its stop line to a controller. It decides alone on
            the speed (SUMO's speed mode 32); lanes are changed as the route needs it, or the controller says.
        may_leave: reaching the end of its route before the duration is no failure.
    """

    id: str
    driver: Ego | None = None
    set_speed: float | None = None
    lights: bool = True
    may_leave: bool = False

    def driven_by(self, driver: Ego) -> OwnEgo:
        """Return the same vehicle with another driver."""
        return replace(self, driver=driver)

    def vehicle_type(self) -> str | None:
        """Return the XML of the type that SUMO's other model needs; None where it needs none."""
        if self.driver is None or self.driver.kind != SUMO:
            return None
        settings = checked(dict(self.driver.settings))
        return '<vType id="{}" {}/>'.format(EGO_TYPE, " ".join(f"{k}={quoteattr(v)}" for k, v in settings.items()))

    def take_over(self, sumo: Any, rng: np.random.Generator) -> Pilot | None:
        """Give the ego its driver in the step in which it departs.

        Returns:
            What has to be called before every step; None where SUMO drives.
        """
        if self.driver is None:
            return None
        if self.driver.kind == SUMO:
            self._retype(sumo)
            return None
        allowed = sumo.vehicle.getAllowedSpeed(self.id)
        controller = self.driver.driver(rng, allowed if self.set_speed is None else self.set_speed)
        if controller is None:
            raise InputError(f"ego.kind must name a controller, but got '{self.driver.kind}'")
        sumo.vehicle.setSpeedMode(self.id, _OBEDIENT)
        sumo.vehicle.setLaneChangeMode(self.id, _FOR_THE_ROUTE)
        act = controller.act

        def pilot(t: float, own: State, others: tuple[State, ...]) -> None:
            light = _red_light(sumo, own) if self.lights else None
            action = act(t, own, others if light is None else (*others, light))
            if action.pose is not None:
                raise RunError(Status.FAILED, f"a controller of '{self.id}' must give speeds, but gave the pose {action.pose}")
            speed = _speed_after(action.acceleration, action.speed, own)
            if speed is not None:
                if not -_FASTEST < speed < _FASTEST:
                    raise RunError(Status.FAILED, f"the controller of '{self.id}' must give finite numbers, but gave {action}")
                sumo.vehicle.setSpeed(self.id, float(speed))
            if action.lane is not None:
                sumo.vehicle.changeLane(self.id, plain(action.lane), 3600.0)

        return pilot

    def _retype(self, sumo: Any) -> None:
        """Change the ego's type to the one with the other model; what that does not say stays as it is."""
        given = checked(dict(self.driver.settings)) if self.driver is not None else {}
        for name in _KEPT:
            attribute = _ATTRIBUTE.get(name, name[0].lower() + name[1:])
            if attribute not in given:
                getattr(sumo.vehicletype, f"set{name}")(EGO_TYPE, getattr(sumo.vehicle, f"get{name}")(self.id))
        factor = given.get("speedFactor", sumo.vehicle.getSpeedFactor(self.id))
        sumo.vehicle.setType(self.id, EGO_TYPE)
        sumo.vehicle.setSpeedFactor(self.id, float(factor))


def _red_light(sumo: Any, own: State) -> State | None:
    """Return the stop line of the next light, standing across the way, if it is red, or yellow and one can stop comfortably."""
    for _, _, distance, color in sumo.vehicle.getNextTLS(own.name)[:1]:
        if color in "ru" or (color == "y" and own.speed**2 < 2.0 * _COMFORT * distance):
            line = State("red light", _LINE, _ACROSS, own.step)
            line.turn(own.angle)
            ahead = 0.5 * (own.length + _LINE) + distance
            line.x, line.y = own.x + ahead * own.cos, own.y + ahead * own.sin
            return line
    return None


def _speed_after(acceleration: float | None, speed: float | None, own: State) -> float | None:
    """Return the speed at the end of the step that an action means (m/s); None where it means none."""
    if acceleration is None:
        return speed
    if math.isnan(acceleration):
        return acceleration
    reached = max(own.speed + acceleration * own.step, 0.0)
    if speed is None:
        return reached
    return max(reached, speed) if acceleration < 0 else min(reached, speed)
