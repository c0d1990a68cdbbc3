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
from sbt.sumo.projecting import Arrivals, arrivals_at, driver_value, taken_gap, time_to_reach
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
ENTRY, ACROSS = 68.5, 14.7
"""From the ego's start to the stop line, and from where it waits inside the junction until it is across (m)."""
INTO, OUT_OF = -11.5, 16.5
"""Where an oncoming car's front is when it enters the junction, and when its rear is out of it (m from the conflict)."""
ENOUGH = 6.0
"""Time beyond which more makes no difference (s)."""
LATE, CREEP = 0.23, 1.4
"""By how much oncoming cars are later than projected, and from the stop line to where the ego waits, in the mean (s)."""
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
    """Return which gap the ego takes, how well it suits and the PET there, rolling from the stop line or after it has waited."""
    speed, ego = values["v_ego"] / 3.6, scene.actors[0]
    accel, turning = driver_value(ego, "accel", 2.6), TURNING * speed / LIMIT
    impatience, spare = driver_value(ego, "impatience", 0.0), driver_value(ego, "jmTimegapMinor", 1.0)
    line = ENTRY / speed + 2.5 - 0.113 * speed
    across = float(time_to_reach(ACROSS, 0.0, turning, accel))
    drawn = arrivals_at(CONFLICT, scene.actors[1:], LIMIT)
    coming = Arrivals(drawn.time + LATE, drawn.speed)
    wanted = 4.48 + (1.0 - impatience) * (0.56 * across + 0.21 * spare) - 14.04 * impatience + 8.74 * impatience**2
    need = np.maximum(wanted + 0.194 * coming.speed, 1.0)
    rolling = taken_gap(coming, line, need, INTO, OUT_OF)
    found = {"line": line, "across": across, "rolling_next": rolling["offered"], "rolling_since": rolling["since"]}
    found |= {"rolling_wait": rolling["wait"], "rolling_slack": min(rolling["slack"], ENOUGH)}
    for name, way in (("stood", across), ("rolled", 20.0 / turning)):
        found[f"rolling_pet_{name}"] = min(rolling["until"] - way, ENOUGH)
    for name, more in (("bold", -0.5), ("likely", 0.0), ("shy", 0.5)):
        taken = taken_gap(coming, line + CREEP, need + more, INTO, OUT_OF)
        found |= {f"{name}_pet": min(taken["until"] - across, ENOUGH), f"{name}_slack": min(taken["slack"], ENOUGH)}
        if more == 0.0:
            found |= {key: taken[key] for key in ("wait", "closing", "missed")}
    return found | {"least_pet": min(found[f"{name}_pet"] for name in ("bold", "likely", "shy"))}


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
    roles=Roles(other=None, not_judged="ego turns across the others' way: the reference drivers drive along a lane"),
)
