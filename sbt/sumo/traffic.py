"""Background traffic: columns of cars that SUMO's own models drive, drawn from the run's generator.

A column is there from the first step, spread over the road that leads to where it matters, so that a run
needs no warm-up and every car's start can be verified. What SUMO draws while they drive (the
imperfection `sigma` of its drivers) follows from the run's seed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sbt.errors import InputError
from sbt.sumo.actors import Actor, VehicleType
from sbt.sumo.ego import SUMO, Ego
from sbt.sumo.formatting import format_number

__all__ = ["DRIVER", "TrafficStream", "ego_type"]

DRIVER = (("carFollowModel", "Krauss"), ("accel", "2.6"), ("decel", "4.5"), ("emergencyDecel", "9"), ("minGap", "2"),
          ("tau", "1"), ("sigma", "0.5"), ("sigmaStep", "1"), ("speedDev", "0"))  # fmt: skip
"""SUMO's default passenger car, every number given: SUMO would draw what is left out. The imperfection is drawn once a
second, which makes it independent of the step."""
MIN_HEADWAY = 1.0
"""Smallest headway from front to front in a column (s) beyond the time a car needs to cover its own length."""


def ego_type(ego: Ego, speed: float, limit: float) -> VehicleType:
    """Return the type of an ego of 5.0 m x 1.8 m that wants to drive at a speed (m/s) where this limit (m/s) holds.

    Its driver is perfect (`sigma` 0) unless the ego's settings say otherwise.
    """
    margin = 1.0 + 1e-9  # SUMO refuses a start above the desired speed, which it computes as factor times limit
    attributes = dict(DRIVER) | {"sigma": "0", "speedFactor": format_number(speed / limit * margin)}
    if ego.kind != SUMO:
        return VehicleType(attributes=(("speedFactor", format_number(max(speed / limit, 1.0) * margin)),))
    del attributes["carFollowModel"]
    return ego.vehicle_type(VehicleType(attributes=tuple(attributes.items())), speed * margin)


@dataclass(frozen=True)
class TrafficStream:
    """Cars one behind the other in a lane, at random headways of a shifted exponential law.

    Args:
        name: cars are called `name_0`, `name_1`, ... from the front.
        route: edges; long enough that no car arrives before the run is over.
        lane: index on the first edge.
        limit: speed limit of the road (m/s), to which SUMO's speed factors refer.
        spread: standard deviation of the cars' speed factors (normal, at most two deviations off).
        type: rectangle and further vType attributes.
    """

    name: str
    route: tuple[str, ...]
    lane: int
    limit: float
    spread: float = 0.1
    type: VehicleType = field(default_factory=lambda: VehicleType(attributes=DRIVER))

    def driven(self, **attributes: float) -> TrafficStream:
        """Return the column with other vType attributes of its drivers, such as `tau`."""
        changed = dict(self.type.attributes) | {name: format_number(value) for name, value in attributes.items()}
        return replace(self, type=replace(self.type, attributes=tuple(changed.items())))

    def draw(
        self, rng: np.random.Generator, flow: float, speed: float, first: float, last: float, *, start: float | None = None
    ) -> tuple[Actor, ...]:
        """Return the cars between two positions, from the front one backwards.

        Args:
            rng: of the run.
            flow: cars an hour; the mean distance of two fronts is 3600 speed / flow.
            speed: mean desired speed (m/s); a car starts with its own.
            first: foremost position of a front on the first edge (m).
            last: hindmost position (m).
            start: mean speed at the start, where another limit holds than where the cars matter (m/s); None: `speed`.

        Raises:
            InputError: more cars than fit.
        """
        pace = speed if start is None else start
        shortest = MIN_HEADWAY + self.type.length / pace
        mean = 3600.0 / flow
        if mean <= shortest:
            raise InputError(f"a lane at {pace:g} m/s carries less than {3600 / shortest:.0f} cars an hour, but got {flow:g}")
        cars: list[Actor] = []
        position = first - pace * mean * rng.random()
        while position > last:
            factor = 1.0 + self.spread * float(np.clip(rng.standard_normal(), -2.0, 2.0))
            attributes = dict(self.type.attributes) | {"speedFactor": format_number(speed * factor / self.limit)}
            kind = VehicleType(self.type.length, self.type.width, tuple(attributes.items()))
            cars.append(Actor(f"{self.name}_{len(cars)}", self.route, self.lane, position, pace * factor, type=kind))
            position -= pace * (shortest + (mean - shortest) * rng.standard_exponential())
        return tuple(cars)
