"""Unprotected left turn: the ego turns left across oncoming traffic at a junction without traffic lights.

Gap acceptance at a permissive left turn is the pre-crash scenario "left turn across path, opposite direction"
(Najm, Smith and Yanagisawa 2007, Pre-Crash Scenario Typology for Crash Avoidance Research, DOT HS 810 767).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, others_braking_max, pet_ego_first, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, EndCondition, Scene, State
from sbt.sumo.ego import Ego
from sbt.sumo.projecting import arrivals_at, driver_value, gaps
from sbt.sumo.road_ahead import on_road
from sbt.sumo.simulation import SumoSimulation
from sbt.sumo.traffic import TrafficStream, ego_type

__all__ = ["SCENARIO"]

NET = "left_turn"
LIMIT = 50 / 3.6
"""Speed limit of all roads (m/s)."""
ARM = 1000.0
"""Length of the western arm up to the centre of the junction (m), in the network `left_turn`."""
DISTANCE = 80.0
"""Initial distance from the ego's front to the centre of the junction (m)."""
NEAREST, FARTHEST = 880.0, 100.0
"""Range of the initial positions of the oncoming cars, on the 900 m from the east to the junction (m)."""
CLEAR = 15.0
"""y beyond which the ego has left the junction (m)."""
HORIZON = 5.0
"""Post-encroachment time from which on there is no conflict (s)."""
DURATION = 38.0
"""Longest simulated time (s); even the fastest oncoming car has not arrived by then."""
CONFLICT = 900.0
"""Position on the eastern arm, prolonged, at which the oncoming cars meet the ego's path (m)."""
ENTRY, ACROSS = 68.5, 13.0
"""From the ego's start to the stop line, and from where it waits inside the junction until it is across (m)."""
TURNING = 5.8
"""Largest speed in the turn, of a driver whose speed factor is 1 (m/s)."""
ROUTE = ("in_west", "out_north")
EGO = Ego.of("sumo", impatience={"min": 0.0, "max": 1.0}, jmTimegapMinor={"min": 0.0, "max": 2.0}, accel={"min": 1.5, "max": 3.5})
ONCOMING = TrafficStream("oncoming", ("in_east", "out_west"), 0, LIMIT)


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego before the junction, about to turn left, and a stream of oncoming cars."""
    speed = values["v_ego"] / 3.6
    driver = on_road(ego.driver(rng, speed), NET, ROUTE, 0, ARM - DISTANCE)
    cars = ONCOMING.draw(rng, values["flow_co"], values["v_co"] / 3.6, NEAREST, FARTHEST)
    car = Actor("ego", ROUTE, 0, ARM - DISTANCE, speed, driver, ego_type(ego, speed, LIMIT))
    return Scene((car, *cars), end_condition())


def end_condition() -> EndCondition:
    """Return the end condition: the ego left the junction `HORIZON` ago."""
    left: list[float] = []

    def over(t: float, states: Mapping[str, State]) -> str | None:
        if not left and states["ego"].y > CLEAR:
            left.append(t)
        return "passed" if left and t >= left[0] + HORIZON else None

    return over


def covariates(values: Mapping[str, float], scene: Scene) -> dict[str, float]:
    """Return the gaps in the oncoming stream from when the ego is at the junction, and how long it takes across."""
    speed, accel = values["v_ego"] / 3.6, driver_value(scene.actors[0], "accel", 2.6)
    turning = TURNING * speed / LIMIT
    across = ACROSS / turning + 0.5 * turning / accel
    return {"across": across, **gaps(arrivals_at(CONFLICT, scene.actors[1:], LIMIT), ENTRY / speed)}


SCENARIO = LogicalScenario(
    name="unprotected_left_turn",
    description=(
        "Unprotected left turn across oncoming traffic.\n"
        "Urban main road at 50 km/h, one lane each way, a side road to the north, no signals. Ego approaches at v_ego and "
        "turns left as soon as its driver model accepts a gap in the oncoming traffic, flow_co cars an hour at v_co."
    ),
    space=ParameterSpace(
        (
            Parameter("flow_co", 200.0, 1000.0, "1/h", description="oncoming cars an hour"),
            Parameter("v_co", 40.0, 80.0, "km/h", description="mean desired speed of the oncoming cars"),
            Parameter("v_ego", 20.0, 50.0, "km/h", description="speed of ego at the start and desired"),
            *EGO.inputs,
        )
    ),
    simulate=SumoSimulation(
        net=NET, scene=scene, duration=DURATION, step_length=0.1, ego=EGO, isolations=("fresh",), covariates=covariates
    ),
    metrics=(
        pet_ego_first(horizon=HORIZON),
        ttc_path_min(),
        nearest_distance(),
        any_collision(),
        any_impact_speed(),
        others_braking_max(),
    ),
    requirement=Requirement("pet_ego_first", high=1.5),
    roles=Roles(not_judged="ego turns across the others' way: the reference drivers drive along a lane"),
)
