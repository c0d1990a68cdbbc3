"""Background traffic: random streams of cars that SUMO's models drive.

All cars of a stream are inserted in the first step, along the road that leads to the place of interest, so that
a run needs no warm-up and every initial state can be verified. Random numbers that SUMO draws on the way (the
imperfection `sigma` of its drivers) are determined by the seed of the run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sbt.errors import InputError
from sbt.sumo.actors import Actor, VehicleType
from sbt.sumo.ego import SUMO, Ego
from sbt.sumo.formatting import format_number

__all__ = ["DEFAULT_DRIVER", "MIN_HEADWAY", "TrafficStream", "ego_type"]

SLIDING = (("lcMaxSpeedLatStanding", "0"), ("lcMaxSpeedLatFactor", "0.15"))
"""In a lane change a car moves sideways by 0.15 m a metre ahead at most: without these, SUMO's cars do so while they stand."""
DEFAULT_DRIVER = (("carFollowModel", "Krauss"), ("accel", "2.6"), ("decel", "4.5"), ("emergencyDecel", "9"), ("minGap", "2"),
                  ("tau", "1"), ("sigma", "0.5"), ("sigmaStep", "1"), ("speedDev", "0"), *SLIDING)  # fmt: skip
"""SUMO's default passenger car, with all values given because SUMO draws missing ones at random. The imperfection is drawn
once per second, so that it does not depend on the step."""
MIN_HEADWAY = 1.0
"""Smallest time headway in a stream (s), from the rear of a car to the front of the next one."""


def ego_type(ego: Ego, speed: float, limit: float) -> VehicleType:
    """Return the vehicle type of an ego in traffic, 5.0 m x 1.8 m large.

    Its driver has no imperfection (`sigma` 0) unless the settings of the ego give one.

    Args:
        ego: the AV under test.
        speed: desired speed (m/s).
        limit: speed limit of the road (m/s), to which SUMO's speed factor refers.
    """
    margin = 1.0 + 1e-9  # SUMO refuses an initial speed above the desired one, which it computes as factor times limit
    attributes = dict(DEFAULT_DRIVER) | {"sigma": "0", "speedFactor": format_number(speed / limit * margin)}
    if ego.kind != SUMO:
        return VehicleType(attributes=(("speedFactor", format_number(max(speed / limit, 1.0) * margin)), *SLIDING))
    del attributes["carFollowModel"]
    return ego.vehicle_type(VehicleType(attributes=tuple(attributes.items())), speed * margin)


@dataclass(frozen=True)
class TrafficStream:
    """A stream of cars in one lane, with time headways from a shifted exponential distribution.

    Args:
        name: prefix of the cars' names `name_0`, `name_1`, ..., numbered from the front.
        route: edges; so long that no car arrives before the run is over.
        lane: index on the first edge.
        limit: speed limit of the road (m/s), to which SUMO's speed factors refer.
        spread: standard deviation of the cars' speed factors (normal, truncated at two standard deviations).
        fastest: largest desired speed of a car (m/s), such as the one at which a bend can be driven.
        type: vehicle type of the cars.
    """

    name: str
    route: tuple[str, ...]
    lane: int
    limit: float
    spread: float = 0.1
    fastest: float = math.inf
    type: VehicleType = field(default_factory=lambda: VehicleType(attributes=DEFAULT_DRIVER))

    def with_driver(self, **attributes: float) -> TrafficStream:
        """Return the stream with other vType attributes of its drivers, such as `tau`."""
        changed = dict(self.type.attributes) | {name: format_number(value) for name, value in attributes.items()}
        return replace(self, type=replace(self.type, attributes=tuple(changed.items())))

    def draw(
        self, rng: np.random.Generator, flow: float, speed: float, first: float, last: float, *, start: float | None = None
    ) -> tuple[Actor, ...]:
        """Draw the cars between two positions, from the foremost one backwards.

        Args:
            rng: random generator of the run.
            flow: cars per hour; the mean distance of two fronts is 3600 speed / flow.
            speed: mean desired speed (m/s); each car starts at its own, or slower where it would have to brake at once
                for the car ahead.
            first: foremost position of a front bumper on the first edge (m).
            last: rearmost position (m).
            start: mean initial speed, where another limit holds than at the place of interest (m/s); None: `speed`.

        Raises:
            InputError: the flow exceeds the capacity of the lane.
        """
        pace = speed if start is None else start
        shortest = MIN_HEADWAY + self.type.length / pace
        mean = 3600.0 / flow
        if mean <= shortest:
            raise InputError(f"a lane at {pace:g} m/s carries less than {3600 / shortest:.0f} cars an hour, but got {flow:g}")
        cars: list[Actor] = []
        position = first - pace * mean * rng.random()
        while position > last:
            factor = min(1.0 + self.spread * min(max(rng.standard_normal(), -2.0), 2.0), self.fastest / speed)
            attributes = dict(self.type.attributes) | {"speedFactor": format_number(speed * factor / self.limit)}
            kind = VehicleType(self.type.length, self.type.width, tuple(attributes.items()))
            own = min(pace * factor, self._safe_speed(cars[-1], position)) if cars else pace * factor
            name = f"{self.name}_{len(cars)}"
            cars.append(Actor(name, self.route, self.lane, position, own, type=kind, lane_changes=True))
            position -= pace * (shortest + (mean - shortest) * rng.standard_exponential())
        return tuple(cars)

    def _safe_speed(self, ahead: Actor, position: float) -> float:
        """Return the speed up to which a driver at this position does not brake for the car ahead (m/s).

        Source:
            Krauss (1998), Microscopic Modeling of Traffic Flow, the safe speed of SUMO's default model.
        """
        driver = dict(self.type.attributes)
        tau, braking = float(driver.get("tau", 1.0)), float(driver.get("decel", 4.5))
        gap = max(ahead.position - ahead.type.length - float(driver.get("minGap", 2.5)) - position, 0.0)
        return -braking * tau + math.sqrt((braking * tau) ** 2 + ahead.speed**2 + 2.0 * braking * gap)
