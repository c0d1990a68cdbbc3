"""The ego of a user's own simulation: driven as in the files, by another model of SUMO, or by a controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.sumo.actors import Controller, State
from sbt.sumo.dynamics import MAX_SPEED, next_speed
from sbt.sumo.ego import SUMO, Ego
from sbt.sumo.elements import type_of
from sbt.sumo.files import SumoFiles
from sbt.sumo.formatting import plain
from sbt.sumo.guided import STRATEGIC_LANE_CHANGES
from sbt.sumo.insertion import LANE_REQUEST_DURATION, SPEED_MODE
from sbt.sumo.models import LANE_CHANGE, known_attributes, vtype_attributes
from sbt.sumo.template import fill

__all__ = ["EGO_TYPE", "EgoControl", "EgoVehicle"]

EGO_TYPE = "sbt_ego"
"""Id of the vehicle type of an ego that another model of SUMO drives."""
_COPIED = ("Length", "Width", "Height", "VehicleClass", "MaxSpeed", "MinGap", "Accel", "Decel", "EmergencyDecel", "Tau",
           "Imperfection", "SpeedFactor", "SpeedDeviation", "Color", "MaxSpeedLat", "MinGapLat", "LateralAlignment")  # fmt: skip
"""Properties that the ego keeps when its type changes, by the names of SUMO's getters and setters."""
_OF_FILES = ("actionStepLength", "apparentDecel", "impatience", "boardingDuration", "loadingDuration", "timeToTeleport")
"""Attributes that are taken from the type in the files, beside those of the models and of junctions (jm...)."""
_ATTRIBUTE = {"Imperfection": "sigma", "VehicleClass": "vClass", "SpeedDeviation": "speedDev", "LateralAlignment": "latAlignment"}
"""vType attributes of the properties whose names differ."""
_COMFORTABLE_DECELERATION = 3.0
"""Deceleration up to which the ego stops at a yellow light (m/s^2), about the 10 ft/s^2 behind ITE's yellow times."""
_STOP_LINE_LENGTH, _STOP_LINE_WIDTH = 0.1, 3.0
"""Size of the obstacle that stands for a red light (m)."""



class EgoControl(NamedTuple):
    """How an ego is driven.

    Attributes:
        step: called before every step with the time (s), the state of the ego, and the states of the others.
        driver: the controller.
    """

    step: Callable[[float, State, tuple[State, ...]], None]
    driver: Controller


@dataclass(frozen=True)
class EgoVehicle:
    """The vehicle under test in a user's own simulation.

    Args:
        id: its id in SUMO.
        driver: a controller, or (kind `sumo`) another car-following model; None: as in the user's files.
        set_speed: desired speed of a controller (m/s); None: the allowed speed where the ego departs.
        lights: a controller sees a red traffic light as a standing obstacle at the stop line. The controller alone
            sets the speed (speed mode 32); SUMO changes lanes for the route unless the controller requests a lane.
        may_leave: arriving at the end of its route before the duration is over is not an error.
        delay: how much later than its `depart` it may enter the road (s); None: not at all.
        type_id: of its vehicle type in SUMO, where another model of SUMO drives.

    Raises:
        InputError: the delay is negative or not finite.
    """

    id: str
    driver: Ego | None = None
    set_speed: float | None = None
    lights: bool = True
    may_leave: bool = False
    delay: float | None = None
    type_id: str = EGO_TYPE

    def __post_init__(self) -> None:
        if self.delay is not None and not 0.0 <= self.delay < math.inf:
            raise InputError(f"ego.delay must be >= 0 s and finite, but got {self.delay}")

    def further(self) -> EgoVehicle:
        """Return the same vehicle as a further one under test, with a vehicle type of its own."""
        return replace(self, type_id=f"{EGO_TYPE}_{self.id}")

    def with_driver(self, driver: Ego) -> EgoVehicle:
        """Return the same vehicle with another driver."""
        return replace(self, driver=driver)

    def bound(self, values: Values) -> EgoVehicle:
        """Return the vehicle of one run, with the values of its driver's settings that are inputs."""
        return self if self.driver is None else self.with_driver(self.driver.bind(values))

    def vehicle_type(self, files: SumoFiles, values: Values) -> str | None:
        """Return the XML of the vehicle type for another model of SUMO; None where none is needed.

        Args:
            files: whose type the vehicle has; what the settings do not mention is as there, as far as the models have it.
            values: of the inputs, for placeholders in it.
        """
        if self.driver is None or self.driver.kind != SUMO:
            return None
        found = type_of(files.templates, self.id)
        there = {} if found is None else {k: fill(v, values, found.place) for k, v in found.attributes.items()}
        settings = dict(self.driver.settings)
        if not {"lane_change", "laneChangeModel"} & settings.keys() and there.get("laneChangeModel") in LANE_CHANGE:
            settings["lane_change"] = there["laneChangeModel"]
        given = vtype_attributes(settings)
        known = {*known_attributes(given["carFollowModel"], given["laneChangeModel"]), *_OF_FILES}
        kept = {k: v for k, v in there.items() if k not in given and (k in known or k.startswith("jm"))}
        written = " ".join(f"{k}={quoteattr(v)}" for k, v in (kept | given).items())
        return f'<vType id="{self.type_id}" {written}/>'

    def take_over(self, sumo: Any, rng: np.random.Generator, *, walks: bool = False) -> EgoControl | None:
        """Give the ego its driver; to be called in the step in which it departs.

        Args:
            sumo: libsumo or traci.
            rng: for the controller.
            walks: it is a person, whom only SUMO's pedestrian model moves.

        Returns:
            How it is driven; None where SUMO drives.
        """
        if self.driver is None:
            return None
        if walks:
            rule = "a person as the ego is moved by SUMO (no ego.kind)"
            raise RunError(Status.FAILED, f"{rule}, but '{self.id}' has the kind {self.driver.kind}")
        if self.driver.kind == SUMO:
            self._change_type(sumo)
            return None
        allowed = sumo.vehicle.getAllowedSpeed(self.id)
        controller = self.driver.driver(rng, allowed if self.set_speed is None else self.set_speed)
        if controller is None:
            raise InputError(f"ego.kind must name a controller, but got '{self.driver.kind}'")
        sumo.vehicle.setSpeedMode(self.id, SPEED_MODE)
        sumo.vehicle.setLaneChangeMode(self.id, STRATEGIC_LANE_CHANGES)
        act = controller.act

        def control(t: float, own: State, others: tuple[State, ...]) -> None:
            light = _red_light(sumo, own) if self.lights else None
            action = act(t, own, others if light is None else (*others, light))
            if action.pose is not None:
                raise RunError(Status.FAILED, f"a controller of '{self.id}' must give speeds, but gave the pose {action.pose}")
            speed = action.speed
            if action.acceleration is not None:
                speed = next_speed(own.speed, action.acceleration, speed, own.step)
            if speed is not None:
                if not -MAX_SPEED < speed < MAX_SPEED:
                    raise RunError(Status.FAILED, f"the controller of '{self.id}' must give finite numbers, but gave {action}")
                sumo.vehicle.setSpeed(self.id, float(speed))
            if action.lane is not None:
                sumo.vehicle.changeLane(self.id, plain(action.lane), LANE_REQUEST_DURATION)

        return EgoControl(control, controller)

    def _change_type(self, sumo: Any) -> None:
        """Give the ego the type with the other model; properties that the settings do not mention stay as they are."""
        given = vtype_attributes(dict(self.driver.settings)) if self.driver is not None else {}
        for name in _COPIED:
            attribute = _ATTRIBUTE.get(name, name[0].lower() + name[1:])
            if attribute not in given:
                getattr(sumo.vehicletype, f"set{name}")(self.type_id, getattr(sumo.vehicle, f"get{name}")(self.id))
        factor = given.get("speedFactor", sumo.vehicle.getSpeedFactor(self.id))
        sumo.vehicle.setType(self.id, self.type_id)
        sumo.vehicle.setSpeedFactor(self.id, float(factor))


def _red_light(sumo: Any, own: State) -> State | None:
    """Return an obstacle at the stop line of the next traffic light that is red, or yellow with room for a comfortable stop."""
    for _, _, distance, color in sumo.vehicle.getNextTLS(own.name)[:1]:
        if color in "ru" or (color == "y" and own.speed**2 < 2.0 * _COMFORTABLE_DECELERATION * distance):
            line = State("red light", _STOP_LINE_LENGTH, _STOP_LINE_WIDTH, own.step)
            line.turn(own.angle)
            ahead = 0.5 * (own.length + _STOP_LINE_LENGTH) + distance
            line.x, line.y = own.x + ahead * own.cos, own.y + ahead * own.sin
            return line
    return None
