"""Emergency braking: the car ahead in the same lane brakes suddenly.

Inputs, ranges, metric and critical interval are those of the scenario `Emergency Braking` of the
Driving Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/TITS.2022.3206882).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.metrics.longitudinal import longitudinal_metrics
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, EndCondition, Scene, State, VehicleType
from sbt.sumo.drivers import Braking
from sbt.sumo.ego import Ego
from sbt.sumo.simulation import SumoSimulation

__all__ = ["SCENARIO"]

LANE_CHANGE = 3.0
"""Duration of a lane change of an ego with `lane_change: true` (s)."""
JERK = 30.0
"""Rate at which the braking of co grows and ends (m/s^3): -10 m/s^2 after 0.33 s, as hydraulic brakes do in an emergency
stop. The data set names no jerk; "at once" is when it begins."""
DURATION = 20.0
"""Longest simulated time (s)."""
START = 20.0
"""Initial position of the ego's front (m)."""
CAR = VehicleType(length=5.0, width=1.8)


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego at its set speed, a time gap d_t behind co, and co, which brakes from the start."""
    v_ego, v_co = values["v_ego"] / 3.6, values["v_co"] / 3.6
    gap = values["d_t"] * v_ego
    final = values["v_co_min_frac"] * v_co
    kind, changes = ego.vehicle_type(CAR, v_ego), ego.changes_lanes(usual=False)
    return Scene(
        (
            Actor("ego", ("road",), 1, START, v_ego, ego.driver(rng, v_ego), kind, lane_changes=changes),
            Actor("co", ("road",), 1, START + gap + CAR.length, v_co, Braking(-values["a_co"], final, JERK), CAR),
        ),
        end_condition(final),
    )


def end_condition(final: float) -> EndCondition:
    """Return the end condition: co has reached its final speed, and the ego is not faster."""

    def over(t: float, states: Mapping[str, State]) -> str | None:
        ego, co = states["ego"], states["co"]
        if co.speed <= final + 1e-9 and ego.speed <= co.speed:
            return "resolved"
        return None

    return over


SCENARIO = LogicalScenario(
    name="emergency_braking",
    description=(
        "Emergency braking: the car ahead in the same lane brakes at once.\n"
        "Straight road, both in one lane. Ego follows with ACC and AEB at a time gap d_t; at t = 0 co brakes with a_co "
        "from v_co down to v_co_min_frac * v_co and holds that speed."
    ),
    space=ParameterSpace(
        (
            Parameter("a_co", -10.0, -1.0, "m/s^2", description="acceleration of co while it brakes"),
            Parameter("v_co_min_frac", 0.1, 1.0, "", description="final speed of co as a share of v_co"),
            Parameter("d_t", 0.5, 3.0, "s", description="time gap from ego's front to co's rear at ego's speed"),
            Parameter("v_co", 80.0, 150.0, "km/h", description="speed of co at the start"),
            Parameter("v_ego", 80.0, 150.0, "km/h", description="speed of ego at the start, also its set speed"),
        )
    ),
    simulate=SumoSimulation(
        "straight", scene, DURATION, lane_change_duration=LANE_CHANGE, isolations=("fresh", "reuse", "replicas")
    ),
    metrics=longitudinal_metrics(),
    requirement=Requirement("ttc_min", high=0.1),
)
