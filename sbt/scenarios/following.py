"""Following: stop-and-go behind a car that accelerates, keeps its speed and brakes to a standstill.

Inputs, ranges, metric and critical interval are those of the scenario `Following` of the Driving
Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/TITS.2022.3206882). Eight of its
inputs are settings of the AV under test: limits of its ACC and AEB, and its dynamics.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.errors import InputError
from sbt.metrics.longitudinal import longitudinal_metrics
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, EndCondition, Scene, State, VehicleType
from sbt.sumo.drivers import SpeedProfile
from sbt.sumo.ego import Ego
from sbt.sumo.simulation import SumoSimulation

__all__ = ["SCENARIO"]

SET_SPEED = 70 / 3.6
"""Cruising speed of the ego (m/s): above the largest speed of co, so that co determines the speed."""
DURATION = 70.0
"""Longest simulated time (s): the slowest stop-and-go of co takes 54 s."""
START = 20.0
"""Initial position of the ego's front (m)."""
CAR = VehicleType(length=5.0, width=1.8)


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego and co at standstill, d_0 apart; the inputs of the ego are settings of its controller."""
    distance = values["f_safetyDistanceMin"]
    driver = ego.driver(
        rng, SET_SPEED,
        acc_accel=values["f_aEgo_max"], acc_braking=-values["f_acc_min"], aeb_braking=-values["f_aEgo_min"],
        time_gap=values["f_safetyDistanceTimeGap"], distance_min=distance, aeb_distance=distance, aeb_reserve=None,
        lag=values["v_t_1"], lag_2=values["v_t_2"], reaction_time=values["v_delay"],
    )  # fmt: skip
    if driver is None:
        raise InputError("ego.kind must be a controller in following: eight inputs are its settings, SUMO's models have others")
    profile = SpeedProfile(values["a_co_1"], values["v_co_max"] / 3.6, values["t_v_co_max"], -values["a_co_2"])
    front = START + values["d_0"] + CAR.length
    return Scene(
        (
            Actor("ego", ("road",), 1, START, 0.0, driver, ego.vehicle_type(CAR, SET_SPEED)),
            Actor("co", ("road",), 1, front, 0.0, profile, CAR),
        ),
        end_condition(profile.end),
    )


def end_condition(end: float) -> EndCondition:
    """Return the end condition: co stands still again, and so does the ego."""

    def over(t: float, states: Mapping[str, State]) -> str | None:
        if t >= end and states["ego"].speed <= 0.0:
            return "resolved"
        return None

    return over


SCENARIO = LogicalScenario(
    name="following",
    description=(
        "Following: stop-and-go behind another car.\n"
        "Straight road, both in one lane and standing, d_0 apart. Co accelerates with a_co_1 to v_co_max, holds it for "
        "t_v_co_max and brakes with a_co_2 to a stop; ego follows with ACC and AEB, whose limits and dynamics are inputs."
    ),
    space=ParameterSpace(
        (
            Parameter("d_0", 1.0, 5.0, "m", description="gap from ego's front to co's rear at the start"),
            Parameter("a_co_1", 0.5, 4.0, "m/s^2", description="acceleration of co at first"),
            Parameter("v_co_max", 5.0, 60.0, "km/h", description="speed that co holds"),
            Parameter("t_v_co_max", 0.0, 4.0, "s", description="time for which co holds it"),
            Parameter("a_co_2", -10.0, -1.0, "m/s^2", description="acceleration of co while it brakes to a stop"),
            Parameter("f_aEgo_max", 1.0, 3.0, "m/s^2", description="largest acceleration of ego's ACC"),
            Parameter("f_acc_min", -4.0, -2.0, "m/s^2", description="strongest braking of ego's ACC"),
            Parameter("f_aEgo_min", -10.0, -5.0, "m/s^2", description="strongest braking of ego, which AEB uses"),
            Parameter("f_safetyDistanceTimeGap", 0.5, 2.5, "s", description="time gap that ego's ACC keeps"),
            Parameter("f_safetyDistanceMin", 1.0, 5.0, "m", description="gap at which ego's AEB brakes; ACC stops at it"),
            Parameter("v_t_1", 0.015, 0.03, "s", description="first lag of ego's longitudinal dynamics"),
            Parameter("v_t_2", 0.015, 0.03, "s", description="second lag of ego's longitudinal dynamics"),
            Parameter("v_delay", 0.02, 0.3, "s", description="dead time of ego's longitudinal dynamics"),
        )
    ),
    simulate=SumoSimulation("straight", scene, DURATION, isolations=("fresh", "reuse", "replicas")),
    metrics=longitudinal_metrics(),
    requirement=Requirement("ttc_min", high=0.1),
)
