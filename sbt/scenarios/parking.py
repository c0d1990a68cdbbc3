"""Parking: a car leaves a parking space between two others that occlude it from the AV.

Inputs, ranges, metric and critical interval are those of the scenario `Parking` of the Driving
Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/TITS.2022.3206882). The ego drives west
along the aisle (-x); the parking spaces are to its left, and the parked cars face north to the aisle (+y).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sbt.errors import InputError
from sbt.metrics.cache import per_trace
from sbt.metrics.geometry import contact_index, rectangle_distance, swept_contact
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.actors import Actor, EndCondition, Pose, Scene, State, VehicleType
from sbt.sumo.drivers import ArcExit, Stationary
from sbt.sumo.ego import Ego
from sbt.sumo.simulation import SumoSimulation

__all__ = ["SCENARIO"]

BAY = 3.0
"""Distance of the centres of two parking spaces (m), with room for the offsets and angles of cars 1.8 m wide."""
NOSES = -0.6
"""y of the fronts of cars without an offset (m): with the largest offset and angle they do not touch an ego at y = 1 m."""
CAR = VehicleType(length=5.0, width=1.8)
NORTH, WEST = 0.5 * math.pi, math.pi
PAST = 1.0
"""Distance of the ego's rear behind co 1 at which the run ends (m)."""
DURATION = 45.0
"""Longest simulated time (s)."""


def bay(number: int, values: Mapping[str, float]) -> Pose:
    """Return the initial pose of a car: co 1 in the middle, co 2 to its west, co 3 to its east, where the ego comes from."""
    column = {1: 0.0, 2: -BAY, 3: BAY}[number]
    heading = NORTH + math.radians(values.get(f"theta_co_{number}", 0.0))
    x = column + values[f"x_offset_co_{number}"]
    return x, NOSES - 0.5 * CAR.length + values[f"y_offset_co_{number}"], heading


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego in the aisle, co 1 about to leave, and the two cars beside it."""
    speed = values["v_ego"] / 3.6
    driver = ego.driver(
        rng, speed, threshold=values["d_detect_min"], delay=values["t_delay_ego"], braking=-values["a_ego"],
        jerk=values["j_ego"], target="co_1",
    )  # fmt: skip
    if driver is None:
        raise InputError("ego.kind must be a controller in parking: SUMO's own models see no car off their lane")
    start = bay(1, values)
    leaving = ArcExit(
        start, values["yaw_rad_co_1"], values["a_1_co_1"], values["v_max_co_1"] / 3.6, values["t_v_max_co_1"], -values["a_2_co_1"]
    )
    return Scene(
        (
            Actor("ego", ("aisle",), 0, 10.0, speed, driver, CAR, (values["x_ego"], values["y_ego"], WEST)),
            Actor("co_1", ("bay_1",), 0, CAR.length, 0.0, leaving, CAR, start),
            Actor("co_2", ("bay_2",), 0, CAR.length, 0.0, Stationary(), CAR, bay(2, values)),
            Actor("co_3", ("bay_3",), 0, CAR.length, 0.0, Stationary(), CAR, bay(3, values)),
        ),
        end_condition(leaving.end),
    )


def end_condition(end: float) -> EndCondition:
    """Return the end condition: the ego has passed co 1, or both stand still."""

    def over(t: float, states: Mapping[str, State]) -> str | None:
        ego, co = states["ego"], states["co_1"]
        if t >= end and ego.speed <= 0.0:
            return "resolved"
        if ego.x + 0.5 * ego.length + PAST < co.x - 0.5 * co.length:
            return "passed"
        return None

    return over


@per_trace
def _impact(trace: Trace) -> tuple[float, float] | None:
    """Return the speeds of the ego and co 1 at their first contact (km/h), None without a collision."""
    ego, co = trace.actor("ego"), trace.actor("co_1")
    k = contact_index(ego, co)
    if k is None:
        return None
    share = float(swept_contact(ego, co)[k])  # of the step before, after which they touch

    def speed(of: ActorTrace) -> float:
        before = float(of.speed[max(k - 1, 0)])
        return 3.6 * (before + share * (float(of.speed[k]) - before))

    return speed(ego), speed(co)


def _d_min(trace: Trace) -> float:
    if _impact(trace) is not None:
        return 0.0
    return float(rectangle_distance(trace.actor("ego"), trace.actor("co_1")).min())


def _criterion(trace: Trace) -> float:
    impact = _impact(trace)
    return _d_min(trace) if impact is None else -impact[0]


CRITERION = Metric(
    "criterion", _criterion, "", "low", math.inf,
    "smallest distance of ego and co 1 (m); in a collision minus ego's speed (km/h), 0 where it stood",
    "Driving Scenario Input Output Dataset, Parking",
)  # fmt: skip
D_MIN = Metric("d_min", _d_min, "m", "low", math.inf, "smallest distance of ego and co 1, 0 in a collision")
COLLISION = Metric("collision", lambda trace: float(_impact(trace) is not None), "", "high", 0.0, "ego and co 1 touched")
V_EGO = Metric(
    "v_ego_collision", lambda trace: (_impact(trace) or (0.0, 0.0))[0], "km/h", "high", 0.0, "speed of ego when they touch"
)
V_CO = Metric(
    "v_co_collision", lambda trace: (_impact(trace) or (0.0, 0.0))[1], "km/h", "high", 0.0, "speed of co 1 when they touch"
)

SCENARIO = LogicalScenario(
    name="parking",
    description=(
        "Parking: a car drives out of a bay between two others that hide it.\n"
        "Ego crosses a parking lot straight on. Co 1, hidden by the parked co 2 and co 3, drives out on an arc, "
        "accelerates, holds its speed and brakes. Ego brakes once what it sees of co 1 has moved by d_detect_min."
    ),
    space=ParameterSpace(
        (
            Parameter("v_ego", 5.0, 20.0, "km/h", description="speed of ego"),
            Parameter("x_ego", 5.0, 50.0, "m", description="distance of ego's middle from co 1's bay along the aisle"),
            Parameter("y_ego", 1.0, 5.0, "m", description="distance of ego's middle from the edge of the aisle"),
            Parameter("t_delay_ego", 0.1, 1.0, "s", description="dead time of ego"),
            Parameter("a_ego", -9.0, -3.0, "m/s^2", description="acceleration of ego in the emergency stop"),
            Parameter("j_ego", 5.0, 20.0, "m/s^3", description="jerk with which it builds up"),
            Parameter("d_detect_min", 0.1, 0.8, "m", description="movement of co 1's uppermost visible point that ego reacts to"),
            Parameter("yaw_rad_co_1", 10.0, 70.0, "m", description="radius of co 1's arc"),
            Parameter("y_offset_co_1", -0.5, 0.5, "m", description="how much further into the aisle co 1 stands"),
            Parameter("x_offset_co_1", -0.4, 0.4, "m", description="how much further east co 1 stands"),
            Parameter("a_1_co_1", 0.5, 3.0, "m/s^2", description="acceleration of co 1 at first"),
            Parameter("v_max_co_1", 3.0, 10.0, "km/h", description="speed that co 1 holds"),
            Parameter("a_2_co_1", -9.0, -3.0, "m/s^2", description="acceleration of co 1 while it brakes"),
            Parameter("t_v_max_co_1", 0.1, 2.0, "s", description="time for which co 1 holds its speed"),
            Parameter("x_offset_co_2", -0.4, 0.4, "m", description="how much further east co 2 stands"),
            Parameter("x_offset_co_3", -0.4, 0.4, "m", description="how much further east co 3 stands"),
            Parameter("y_offset_co_2", -0.5, 0.5, "m", description="how much further into the aisle co 2 stands"),
            Parameter("y_offset_co_3", -0.5, 0.5, "m", description="how much further into the aisle co 3 stands"),
            Parameter("theta_co_2", -5.0, 5.0, "deg", description="angle of co 2 in its bay"),
            Parameter("theta_co_3", -5.0, 5.0, "deg", description="angle of co 3 in its bay"),
        )
    ),
    simulate=SumoSimulation(
        net="parking_lot", scene=scene, duration=DURATION, step_length=0.05, ego=Ego("emergency_stop"),
    ),
    metrics=(CRITERION, D_MIN, COLLISION, V_EGO, V_CO),
    roles=Roles(other="co_1", not_judged="a car leaves a parking space: no manoeuvre of the models"),
    requirement=Requirement("criterion", high=-10.0),
)  # fmt: skip
