"""Highway merge: the ego enters dense motorway traffic from an on-ramp before the acceleration lane ends."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, Scene, State
from sbt.sumo.ego import Ego
from sbt.sumo.projecting import arrivals_at, beside, driver_value, time_to_reach
from sbt.sumo.road_ahead import on_road
from sbt.sumo.simulation import SumoSimulation
from sbt.sumo.traffic import TrafficStream, ego_type

__all__ = ["SCENARIO"]

NET = "on_ramp"
LIMIT = 120 / 3.6
"""Speed limit (m/s)."""
DESIRED = 100 / 3.6
"""Desired speed of the ego (m/s)."""
RAMP = 250.0
"""Length of the ramp (m); its last 150 m are parallel to the motorway."""
DISTANCE = 100.0
"""Initial distance from the ego's front to the nose, the end of the ramp (m)."""
NEAREST, FARTHEST = 890.0, 250.0
"""Range of the initial positions of the cars on the motorway (m); the nose is at 900 m."""
LANE_CHANGE = 3.0
"""Duration of a lane change (s)."""
NOSE = 900.0
"""Position of the nose on the motorway, prolonged (m)."""
ALONG = (0.0, 60.0, 130.0, 200.0)
"""Places along the acceleration lane (m behind the nose) at which the covariates tell who is beside the ego."""
MERGED = 400.0
"""x at which the ego is well past the acceleration lane (m), which ends at 250 m."""
WAITS, LAST, EDGE = 3.0, 200.0, -7.5
"""Speed (m/s), x from which on, and y up to which (m) the ego counts as waiting at the end of the acceleration lane. There
SUMO would move it sideways into the right lane while it stands, which no car can."""
HORIZON = 5.0
"""Post-encroachment time from which on there is no conflict (s)."""
DURATION = 30.0
"""Longest simulated time (s)."""
ROUTE = ("ramp", "merge", "after")
EGO = Ego.of("sumo", tau={"min": 0.4, "max": 1.6}, lcAssertive={"min": 1.0, "max": 5.0}, accel={"min": 1.5, "max": 3.5})
LANES = tuple(TrafficStream(name, ("main", "merge", "after"), lane, LIMIT) for lane, name in enumerate(("right", "left")))


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego on the ramp and a stream of cars in each lane of the motorway, the left one 10 % faster."""
    speed, flow = values["v_ego"] / 3.6, values["flow_co"]
    driver = on_road(ego.driver(rng, speed), NET, ROUTE, 0, RAMP - DISTANCE)
    right, left = (
        lane.draw(rng, flow, values["v_co"] / 3.6 * factor, NEAREST, FARTHEST)
        for lane, factor in zip(LANES, (1.0, 1.1), strict=True)
    )
    kind = ego_type(ego, DESIRED, LIMIT)
    changes = ego.changes_lanes(usual=True)
    car = Actor("ego", ROUTE, 0, RAMP - DISTANCE, speed, driver, kind, lane_changes=changes)
    return Scene((car, *right, *left), end_condition)


def end_condition(t: float, states: Mapping[str, State]) -> str | None:
    """End the run when the ego is well past the acceleration lane, or waits at its end."""
    ego = states["ego"]
    if ego.x > LAST and ego.y < EDGE and ego.speed < WAITS:
        return "waits"
    return "merged" if ego.x > MERGED else None


def covariates(values: Mapping[str, float], scene: Scene) -> dict[str, float]:
    """Return who is beside the ego at the nose and along the acceleration lane, if it goes on as if it were alone."""
    speed, accel = values["v_ego"] / 3.6, driver_value(scene.actors[0], "accel", 2.6)
    way = DISTANCE + np.array(ALONG)
    times, speeds = time_to_reach(way, speed, DESIRED, accel), np.minimum(np.sqrt(speed**2 + 2.0 * accel * way), DESIRED)
    right, left = ([a for a in scene.actors if a.name.startswith(lane.name)] for lane in LANES)
    found = {"nose": float(times[0])}
    for k, place in enumerate(ALONG):
        there = beside(arrivals_at(NOSE + place, right, LIMIT), float(times[k]), float(speeds[k]), 2 if k == 0 else 1)
        found |= {f"right_{place:g}_{name}": value for name, value in there.items()}
    there = beside(arrivals_at(NOSE, left, LIMIT), float(times[0]), float(speeds[0]))
    return found | {f"left_{name}": value for name, value in there.items()}


SCENARIO = LogicalScenario(
    name="highway_merge",
    description=(
        "Merging from an on-ramp into dense motorway traffic.\n"
        "Motorway with two lanes, an on-ramp and an acceleration lane of 250 m. Ego comes at v_ego and changes into the right "
        "lane, which carries flow_co cars an hour at v_co; the left lane carries as many, 10 % faster."
    ),
    space=ParameterSpace(
        (
            Parameter("flow_co", 1000.0, 2000.0, "1/h", description="cars an hour and lane"),
            Parameter("v_co", 60.0, 130.0, "km/h", description="mean desired speed in the right lane"),
            Parameter("v_ego", 40.0, 100.0, "km/h", description="speed of ego on the ramp at the start; it wants 100 km/h"),
            *EGO.inputs,
        )
    ),
    simulate=SumoSimulation(
        net=NET,
        scene=scene,
        duration=DURATION,
        step_length=0.1,
        ego=EGO,
        isolations=("fresh",),
        covariates=covariates,
        lane_change_duration=LANE_CHANGE,
    ),
    metrics=(
        ttc_path_min(),
        pet_ego_first(horizon=HORIZON),
        nearest_distance(),
        any_collision(),
        any_impact_speed(),
        others_braking_max(),
    ),
    requirement=Requirement("ttc_path_min", high=2.0),
    roles=Roles(other=None, not_judged="ego itself changes lanes: the reference drivers keep theirs"),
)
