"""Roundabout entry: the ego yields to circulating traffic, part of which leaves just before the ego's entry.

A compact roundabout with one lane, whose centre line has a radius of 18 m (inscribed circle diameter about 40 m).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, Scene, State
from sbt.sumo.ego import Ego
from sbt.sumo.projecting import Arrivals, arrivals_at, driver_value, first_gap, gaps
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
YIELD, YIELDING = 56.0, 4.0
"""From the ego's start to its yield line (m), and its speed there (m/s)."""
BEND, BEND_SPEED, RING_WAY = 9.8, 5.1, 20.0
"""Of the entry of the cars from the west: its length (m), its largest speed (m/s), and from there to the ego's entry (m)."""
ENTERING = 2.2
"""Time that entering takes (s)."""
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


def covariates(values: Mapping[str, float], scene: Scene) -> dict[str, float]:
    """Return the gaps between the cars that pass the ego's entry, from when it is at its yield line, and who leaves before."""
    ego, cars = scene.actors[0], scene.actors[1:]
    ready = _at_yield_line(values["v_ego"] / 3.6, driver_value(ego, "accel", 2.6), driver_value(ego, "decel", 4.5))
    every = _at_entry(cars)
    leaves = np.array([car.route == LEAVING for car in cars], dtype=bool)
    passing = every.where(~leaves)
    found = {"ready": ready, **gaps(passing, ready, (3.0, 4.0, 5.0, 6.0))}
    found |= {f"with_leaving_{name}": value for name, value in gaps(every, ready, (4.0,), 2).items()}
    coming = leaves[every.time > ready]
    found |= {f"leaves_{k + 1}": float(coming[k]) if k < len(coming) else -1.0 for k in range(3)}
    need = ENTERING + driver_value(ego, "jmTimegapMinor", 1.0)
    for k, spare in enumerate((-1.0, 0.0, 1.0)):
        first = first_gap(passing, ready, need + spare)
        found |= {f"accepted_{k}_{name}": value for name, value in first.items()} | {f"accepted_{k}_spare": first["gap"] - need}
    return found


def _at_yield_line(speed: float, accel: float, braking: float) -> float:
    """Return when the ego is at its yield line (s): it accelerates up to the limit and brakes in time."""
    square = (2.0 * accel * braking * YIELD + braking * speed**2 + accel * YIELDING**2) / (accel + braking)
    peak = max(min(np.sqrt(square), LIMIT), speed)
    even = YIELD - (peak**2 - speed**2) / (2.0 * accel) - (peak**2 - YIELDING**2) / (2.0 * braking)
    return float((peak - speed) / accel + (peak - YIELDING) / braking + max(even, 0.0) / peak)


def _at_entry(cars: Sequence[Actor]) -> Arrivals:
    """Return when the cars from the west would pass the ego's entry; each slows down for the bend of its own one."""
    arm = arrivals_at(ARM - 23.0, cars, LIMIT, delay=0.4)
    factor = np.array([driver_value(car, "speedFactor", 1.0) for car in cars])
    bend, ring = BEND_SPEED * factor, np.minimum(RING_LIMIT * factor, RING_LIMIT)
    time = arm.time + (LIMIT * factor - bend) ** 2 / (2.0 * 4.5 * LIMIT * factor) + BEND / bend + RING_WAY / ring
    for k in range(1, len(cars)):
        time[k] = max(time[k], time[k - 1] + driver_value(cars[k], "tau", 1.0) + (cars[k].type.length + 2.0) / bend[k])
    return Arrivals(time, ring)


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
    simulate=SumoSimulation(
        net=NET, scene=scene, duration=DURATION, step_length=0.1, ego=EGO, isolations=("fresh",), covariates=covariates
    ),
    metrics=(
        pet_ego_first(horizon=HORIZON, zone=ENTRY),
        ttc_path_min(),
        nearest_distance(),
        any_collision(),
        any_impact_speed(),
        others_braking_max(),
    ),
    requirement=Requirement("pet_ego_first", high=FOLLOW_UP),
    roles=Roles(other=None, not_judged="ego gives way at a junction: the reference drivers drive along a lane"),
)
