"""Roundabout entry: the ego yields to circulating traffic, part of which leaves just before the ego's entry.

A compact roundabout with one lane, whose centre line has a radius of 18 m (inscribed circle diameter about 40 m).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, Scene, State
from sbt.sumo.ego import Ego
from sbt.sumo.road_ahead import on_road
from sbt.sumo.simulation import SumoSimulation
from sbt.sumo.traffic import TrafficStream, ego_type

__all__ = ["SCENARIO"]

NET = "roundabout"
LIMIT, RING_LIMIT = 50 / 3.6, 8.5
"""Speed limit of the arms, and what the bend of the ring allows: 4 m/s^2 (m/s)."""
ARM = 600.0
"""From the centre of the roundabout to the end of an arm (m)."""
DISTANCE = 80.0
"""Initial distance from the ego's front to the centre of the roundabout (m)."""
NEAREST, FARTHEST = 530.0, 60.0
"""Range of the initial positions of the circulating cars, on the western arm (m), whose entry begins at 577 m: all can still
slow down for its curve."""
CLEAR = 35.0
"""y at which the ego has left the roundabout (m)."""
ENTRY = (0.0, -18.0, 12.0)
"""x, y and radius of a circle around the ego's entry (m): beyond it the ego follows other cars and does not yield."""
FOLLOW_UP = 2.5
"""Time gap (s) at which drivers in a queue follow each other into a one-lane roundabout (Highway Capacity Manual, 6th
edition: 2.6 s): who has the right of way must not be left less."""
HORIZON = 5.0
"""Post-encroachment time from which on there is no conflict (s)."""
DURATION = 27.0
"""Longest simulated time (s); even the fastest car has not arrived by then."""
EGO = Ego.of("sumo", impatience={"min": 0.0, "max": 1.0}, jmTimegapMinor={"min": 0.0, "max": 2.0}, accel={"min": 1.5, "max": 3.5},
             jmSigmaMinor=1.0)  # fmt: skip
RING = ("ring_south_east", "ring_east_north", "out_north")
ROUTE = ("in_south", *RING)
PASSING = TrafficStream("co", ("in_west", "ring_west_south", *RING), 0, RING_LIMIT, fastest=RING_LIMIT)
LEAVING = ("in_west", "ring_west_south", "out_south")


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego on the southern arm and cars from the western one, which pass the ego's entry or leave before it."""
    speed = values["v_ego"] / 3.6
    driver = on_road(ego.driver(rng, speed), NET, ROUTE, 0, ARM - DISTANCE)
    cars = PASSING.with_driver(tau=values["tau_co"]).draw(
        rng, values["flow_co"], values["v_co"] / 3.6, NEAREST, FARTHEST, start=values["v_co"] / 3.6 * LIMIT / RING_LIMIT
    )
    leaves = rng.random(len(cars)) < values["p_leave"]
    cars = tuple(replace(car, route=LEAVING) if out else car for car, out in zip(cars, leaves, strict=True))
    car = Actor("ego", ROUTE, 0, ARM - DISTANCE, speed, driver, ego_type(ego, LIMIT, LIMIT))
    return Scene((car, *cars), end_condition)


def end_condition(t: float, states: Mapping[str, State]) -> str | None:
    """End the run when the ego is on the northern arm: a car in conflict at its entry has passed there by then."""
    return "passed" if states["ego"].y > CLEAR else None


SCENARIO = LogicalScenario(
    name="roundabout_entry",
    description=(
        "Entry into a roundabout with circulating traffic.\n"
        "One-lane roundabout, 30 km/h in the ring. Ego comes from the south at v_ego and enters as soon as its driver model "
        "accepts a gap between the cars from the west, flow_co an hour at v_co in the ring; a share p_leave of them leaves "
        "just before ego."
    ),
    space=ParameterSpace(
        (
            Parameter("flow_co", 200.0, 1000.0, "1/h", description="cars an hour that come from the west"),
            Parameter("v_co", 20.0, 40.0, "km/h", description="mean desired speed of these cars in the ring"),
            Parameter("p_leave", 0.0, 0.6, "", description="share of these cars that leaves at the exit before ego's entry"),
            Parameter("tau_co", 0.4, 1.4, "s", description="time gap that these cars keep"),
            Parameter("v_ego", 20.0, 50.0, "km/h", description="speed of ego at the start"),
            *EGO.inputs,
        )
    ),
    simulate=SumoSimulation(net=NET, scene=scene, duration=DURATION, step_length=0.1, ego=EGO, isolations=("fresh",)),
    metrics=(
        pet_ego_first(horizon=HORIZON, zone=ENTRY),
        ttc_path_min(),
        nearest_distance(),
        any_collision(),
        any_impact_speed(),
        others_braking_max(),
    ),
    requirement=Requirement("pet_ego_first", high=FOLLOW_UP),
    roles=Roles(not_judged="ego gives way at a junction: the reference drivers drive along a lane"),
)
