"""Lane keeping: a winding road with lane markings that are occluded in places.

Inputs, ranges, metric and critical interval are those of the scenario `Lane-Keeping` of the Driving
Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/TITS.2022.3206882), whose coordinate
system is kept: the centre line of the ego's lane passes (-38, 121) at 3.9 degrees. The course of the road and the
positions of the bars, which the paper leaves open, are chosen here, as named constants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sbt.errors import InputError
from sbt.metrics.reference_line import Curve, lateral_metrics
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.sumo.actors import Actor, EndCondition, Obstacle, Scene, State, VehicleType
from sbt.sumo.ego import Ego
from sbt.sumo.lane_keeping import LaneKeeping
from sbt.sumo.simulation import SumoSimulation

__all__ = ["BARS", "ROAD", "SCENARIO", "bars"]

BEFORE = 30.0
"""Length of the road before the start (m)."""
_HEADING = math.radians(3.9)
ROAD = Curve(
    (-38.0 - BEFORE * math.cos(_HEADING), 121.0 - BEFORE * math.sin(_HEADING), _HEADING),
    (
        (BEFORE + 15.0, 0.0),
        (15.0, 1 / 40), (42.0, 1 / 40),     # left-hand bend
        (20.0, -1 / 45), (35.0, -1 / 45),   # right-hand bends
        (15.0, -1 / 35), (32.0, -1 / 35), (15.0, 0.0),
        (25.0, 0.0),
        (15.0, -1 / 40), (35.0, -1 / 40), (15.0, 0.0),
        (30.0, 0.0),
    ),
)  # fmt: skip
"""Centre line of the lane, as in the network `winding`. Clothoids connect straight lines and arcs."""
LANE = 3.5
"""Width of the lane (m)."""
DASH, DASH_GAP = 4.0, 8.0
"""Lengths of the dashes of the left marking and of the gaps between them (m); the right marking is continuous."""
SPACING = 1.0
"""Distance of the points of a marking that the sensor detects (m)."""
BAR = (20.0, 4.0)
"""Length and width of a bar (m)."""
BARS = ((52.0, 2.0), (92.0, -2.0), (150.0, 2.0), (262.0, -2.0))
"""Centres of the bars: distance from the start along the road, and to the left of the centre line (m), just beyond the
marking. The inputs turn the bars about their centres: parallel to the road they lie along its edge, otherwise across
it. A bar occludes what is behind a metre of it, but is no obstacle for driving."""
END = 20.0
"""Distance before the end of the road at which the run ends (m)."""
LOST = 6.0
"""Distance from the centre line at which the run ends because the ego has left the road (m)."""
CHECK_PERIOD = 0.2
"""Period at which the end condition is checked (s)."""
BLIND_TIME = 1.0
"""Time without any visible point of one marking after which the lane counts as lost (s)."""
DURATION = 70.0
"""Longest simulated time (s)."""
CAR = VehicleType(length=5.0, width=1.8)


def bars(values: Mapping[str, float]) -> tuple[Obstacle, ...]:
    """Return the four bars, turned by the inputs."""
    placed = []
    for k, (s, left) in enumerate(BARS, start=1):
        x, y = ROAD.offset_points(np.array([BEFORE + s]), left)[0]
        placed.append(Obstacle(f"bar_{k}", (float(x), float(y), math.radians(values[f"theta_obs_{k}"])), *BAR, solid=False))
    return tuple(placed)


def markings() -> tuple[np.ndarray, np.ndarray]:
    """Return the (n, 2) points of the dashed left and of the continuous right marking."""
    s = np.arange(0.0, ROAD.length, SPACING)
    return ROAD.offset_points(s[s % (DASH + DASH_GAP) <= DASH], 0.5 * LANE), ROAD.offset_points(s, -0.5 * LANE)


LEFT, RIGHT = markings()


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego at its initial pose, and the bars."""
    speed = values["v_ego"] / 3.6
    obstacles = bars(values)
    driver = ego.driver(
        rng, speed, preview=values["f_t"], p=values["f_p"], i=values["f_i"], d=values["f_d"], lag_1=values["v_t_1"],
        lag_2=values["v_t_2"], delay=values["v_delay"], left=LEFT, right=RIGHT, lane=LANE, obstacles=obstacles,
    )  # fmt: skip
    if driver is None:
        raise InputError("ego.kind must be a controller in lane_keeping: SUMO's own models see no markings")
    pose = (values["x_ego"], values["y_ego"], math.radians(values["theta_ego"]))
    signals = {}
    if isinstance(driver, LaneKeeping):
        sensor = driver.sensor
        signals = {"seen_left": lambda: sensor.seen[0], "seen_right": lambda: sensor.seen[1]}
    return Scene((Actor("ego", ("road",), 0, BEFORE, speed, driver, CAR, pose),), end_condition(), obstacles, signals)


def end_condition() -> EndCondition:
    """Return the end condition: the ego has reached the end of the road, or left the road."""
    due = 0.0

    def over(t: float, states: Mapping[str, State]) -> str | None:
        nonlocal due
        if t < due - 1e-9:
            return None
        due = t + CHECK_PERIOD
        s, left, _ = ROAD.project(states["ego"].x, states["ego"].y)
        if abs(left) > LOST:
            return "lost"
        return "passed" if s > ROAD.length - END else None

    return over


def _lane_lost(trace: Trace) -> float:
    if "seen_left" not in trace.signals:
        return 0.0
    blind = np.minimum(trace.signal("seen_left"), trace.signal("seen_right")) < 1.0
    last_seen = np.maximum.accumulate(np.where(blind, -np.inf, trace.time))
    return float(np.any(trace.time - np.maximum(last_seen, 0.0) >= BLIND_TIME))


LANE_LOST = Metric(
    "lane_lost", _lane_lost, "", "high", 0.0, f"the sensor saw nothing of one marking for {BLIND_TIME:g} s (0 for an own ego)"
)

SCENARIO = LogicalScenario(
    name="lane_keeping",
    description=(
        "Lane keeping: a winding road whose markings are hidden in places.\n"
        "A one-lane road with a left-hand bend, right-hand bends, a straight and a right-hand bend. Ego's sensor sees the "
        "markings within 20 m except where one of four bars hides them; a PID with preview keeps it in the lane."
    ),
    space=ParameterSpace(
        (
            Parameter("x_ego", -38.5, -37.5, "m", description="x of ego at the start"),
            Parameter("y_ego", 120.5, 121.5, "m", description="y of ego at the start"),
            Parameter("theta_ego", 3.7, 4.1, "deg", description="heading of ego at the start"),
            Parameter("v_ego", 20.0, 40.0, "km/h", description="speed of ego"),
            Parameter("theta_obs_1", -120.0, -45.0, "deg", description="orientation of bar 1"),
            Parameter("theta_obs_2", -105.0, 25.0, "deg", description="orientation of bar 2"),
            Parameter("theta_obs_3", 90.0, 110.0, "deg", description="orientation of bar 3"),
            Parameter("theta_obs_4", 90.0, 110.0, "deg", description="orientation of bar 4"),
            Parameter("f_t", 0.2, 0.4, "s", description="preview time of the controller"),
            Parameter("f_p", 0.15, 0.25, "1/s^2", description="gain on the lateral error"),
            Parameter("f_i", 0.002, 0.005, "1/s^3", description="gain on its integral"),
            Parameter("f_d", 0.6, 1.2, "1/s", description="gain on its rate"),
            Parameter("v_t_1", 0.1, 0.2, "s", description="first lag of the steering"),
            Parameter("v_t_2", 0.005, 0.015, "s", description="second lag of the steering"),
            Parameter("v_delay", 0.0, 0.1, "s", description="dead time of the steering"),
        )
    ),
    simulate=SumoSimulation(
        net="winding", scene=scene, duration=DURATION, step_length=0.05, ego=Ego("lane_keeping"),
    ),
    metrics=(*lateral_metrics(ROAD), LANE_LOST),
    requirement=Requirement("pos_lat_abs_err_max", low=3.0),
    roles=Roles(not_judged="ego steers: the reference drivers only brake, for others"),
)  # fmt: skip
