"""Cut-in on a three-lane motorway: a slower car changes from the right lane into the lane of the ego.

Inputs, ranges, metric and critical interval are those of the scenario `Cut-In` of the Driving
Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/TITS.2022.3206882). What the paper
leaves open is chosen here, as named constants.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.metrics.longitudinal import longitudinal_metrics
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, EndCondition, Scene, State, VehicleType
from sbt.sumo.drivers import LaneChange
from sbt.sumo.ego import Ego
from sbt.sumo.simulation import SumoSimulation

__all__ = ["SCENARIO"]

CO_SPEED = 80 / 3.6
"""Speed of the car that cuts in (m/s), as in the paper."""
LANE_CHANGE = 3.0
"""Duration of the lane change (s): a quick one; naturalistic cut-ins take about 3 to 6 s."""
LANE_WIDTH = 3.5
"""Of the network `straight` (m)."""
DURATION = 6.0
"""Longest simulated time (s): the lane change and three more seconds."""
START = 20.0
"""Initial position of the ego's front (m)."""
CAR = VehicleType(length=5.0, width=1.8)
MARGIN = (LANE_WIDTH - CAR.width) / 2
"""Lateral clearance at which a car has crossed the lane marking (m): from then on it is in the ego's path."""


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego in the middle lane, d_v faster than co, and co in the right lane, a time gap d_t ahead."""
    speed = CO_SPEED + values["d_v"] / 3.6
    gap = values["d_t"] * speed
    kind, changes = ego.vehicle_type(CAR, speed), ego.changes_lanes(usual=False)
    return Scene(
        (
            Actor("ego", ("road",), 1, START, speed, ego.driver(rng, speed), kind, lane_changes=changes),
            Actor("co", ("road",), 0, START + gap + CAR.length, CO_SPEED, LaneChange(lane=1), CAR),
        ),
        end_condition(),
    )


def end_condition() -> EndCondition:
    """Return the end condition: the ego has passed co, or cannot come closer to it any more."""

    def over(t: float, states: Mapping[str, State]) -> str | None:
        ego, co = states["ego"], states["co"]
        if ego.x - co.x > 0.5 * (ego.length + co.length) + 1.0:
            return "passed"
        if t >= LANE_CHANGE and ego.speed <= co.speed:
            return "resolved"
        return None

    return over


SCENARIO = LogicalScenario(
    name="cut_in",
    description=(
        "Cut-in: a car shears in from the right lane ahead of the AV.\n"
        "Straight motorway with three lanes. Co drives in the right lane at a constant 80 km/h; ego, with ACC and AEB, "
        "is in the middle lane, d_v faster and a time gap d_t behind it. At t = 0 co changes into ego's lane."
    ),
    space=ParameterSpace(
        (
            Parameter("d_v", 0.0, 120.0, "km/h", description="speed of ego above that of co"),
            Parameter("d_t", 0.1, 10.0, "s", description="time gap from ego's front to co's rear at ego's speed"),
        )
    ),
    simulate=SumoSimulation(
        net="straight",
        scene=scene,
        duration=DURATION,
        step_length=0.05,
        lane_change_duration=LANE_CHANGE,
        isolations=("fresh", "reuse", "replicas"),
    ),
    metrics=longitudinal_metrics(MARGIN),
    requirement=Requirement("ttc_min", -5.0, 0.5),
    roles=Roles(margin=MARGIN),
)
