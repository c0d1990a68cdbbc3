"""Jaywalking: a child steps onto a suburban street from behind a vending machine.

Inputs, ranges, metric and critical interval are those of the scenario `Jaywalking` of the Driving
Scenario Input Output Dataset (Winkelmann et al. 2022, doi 10.1109/ITSC55140.2022.9922091), whose
runs were simulated in CARLA with the agent Pylot. The effect of the weather on visibility and friction is
modelled explicitly here, with named constants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sbt.errors import InputError
from sbt.metrics.cache import per_trace
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace
from sbt.sumo.actors import Actor, EndCondition, Obstacle, Scene, State, VehicleType
from sbt.sumo.drivers import Walk
from sbt.sumo.dynamics import Gust
from sbt.sumo.ego import Ego
from sbt.sumo.emergency import GRAVITY
from sbt.sumo.simulation import SumoSimulation

__all__ = ["SCENARIO", "friction", "sight"]

LANE = -1.625
"""y of the centre of the ego's lane (m), in the network `street`."""
START = 60.0
"""Initial position of the ego's front (m)."""
BESIDE = 4.0
"""Lateral distance of the child from the ego's centre line (m), as in Euro NCAP's Car-to-Pedestrian Nearside Child."""
CAR = VehicleType(length=5.0, width=1.8)
CHILD = VehicleType(length=0.5, width=0.5, attributes=(("vClass", "pedestrian"),))
"""A circle of 0.5 m, which reproduces the largest min_dist beside a passing car in the data set (2.845 m)."""
MACHINE = (0.8, 1.0)
"""Size of the vending machine along and across the street (m)."""
BEHIND = 0.25
"""Initial clearance between the machine and the child (m)."""
MACHINE_BESIDE = 3.6
"""Lateral distance of the centre of the machine from the ego's centre line (m)."""
FRICTION_DRY, FRICTION_WET = 0.9, 0.5
"""Tyre-road friction without rain and in the heaviest rain, linear in between: usual values of asphalt, the wet one with
a film of standing water (review: Wallman and Astrom 2001, VTI meddelande 911A)."""
RANGE_DAY, RANGE_NIGHT = 80.0, 40.0
"""Detection range of the camera for a child in clear air (m): limited by its resolution by day, by the low beam at night."""
VISIBILITY_CLEAR, VISIBILITY_FOG = 2000.0, 40.0
"""Meteorological visibility without fog and in the densest fog (m); its logarithm is linear in between."""
CONTRAST_NEEDED, CONTRAST_NIGHT, CONTRAST_RAIN = 0.2, 0.5, 0.7
"""Contrast that the detector needs; factors on the contrast at night, and through the windscreen in the heaviest rain."""
LATITUDE = math.radians(50.0)
"""Of the location (rad), for the elevation of the sun at the equinox."""
GUST = 0.2
"""Standard deviation of the child's speed in the strongest wind, along and across (m/s); gusts take about 2 s."""
DURATION = 30.0
"""Longest simulated time (s)."""
FAR_SIDE = 1.0
"""Lateral clearance to the ego at which the child has crossed (m)."""
RADIUS = 0.5 * CHILD.width
"""Of the child (m)."""


def friction(rain: float) -> float:
    """Return the tyre-road friction for an intensity of rain in [0, 1]."""
    return FRICTION_DRY + (FRICTION_WET - FRICTION_DRY) * rain


def daylight(hour: float) -> float:
    """Return the daylight, 0 at night and 1 by day, smooth in between (sun 6 degrees below to 6 above the horizon)."""
    elevation = math.asin(math.cos(LATITUDE) * math.cos(math.pi * (hour - 12.0) / 12.0))
    share = min(max(0.5 + math.degrees(elevation) / 12.0, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


def sight(rain: float, fog: float, hour: float) -> float:
    """Return the distance at which the camera detects the child (m).

    The contrast decreases with the distance by Koschmieder's law, with an extinction coefficient of 3 / visibility.

    >>> sight(0.0, 0.0, 12.0), sight(0.0, 0.0, 0.0)
    (80.0, 40.0)
    >>> sight(0.0, 1.0, 12.0) > sight(1.0, 1.0, 12.0) > sight(1.0, 1.0, 0.0) > 5.0
    True
    """
    light = daylight(hour)
    contrast = (CONTRAST_NIGHT + (1.0 - CONTRAST_NIGHT) * light) * (1.0 + (CONTRAST_RAIN - 1.0) * rain)
    visibility = VISIBILITY_CLEAR * (VISIBILITY_FOG / VISIBILITY_CLEAR) ** fog
    return min(math.log(contrast / CONTRAST_NEEDED) * visibility / 3.0, RANGE_NIGHT + (RANGE_DAY - RANGE_NIGHT) * light)


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego at v_av, the child d_0 ahead of its front and 4 m to the right, and the machine between them."""
    speed, x = values["v_av"], START + values["d_0"]
    depth, across = MACHINE
    machine = Obstacle("machine", (x - RADIUS - BEHIND - 0.5 * depth, LANE - MACHINE_BESIDE, 0.0), depth, across)
    wind = GUST * values["wind_rel"]
    start = (x, LANE - BESIDE, 0.5 * math.pi)
    child = Walk(start, values["v_ped"], Gust(rng, wind), Gust(rng, wind))
    grip = friction(values["rain_rel"])
    driver = ego.driver(
        rng, speed, friction=grip, obstacles=(machine,),
        sight=sight(values["rain_rel"], values["fog_rel"], values["time_of_day"]),
    )  # fmt: skip
    if driver is None:
        raise InputError("ego.kind must be a controller in jaywalking: SUMO's own models do not look for children")
    return Scene(
        (
            Actor("ego", ("road",), 1, START, speed, driver, CAR),
            Actor("child", ("road",), 0, x, values["v_ped"], child, CHILD, start, person=True),
        ),
        end_condition(),
        (machine,),
        {"friction": lambda: grip},
    )


def end_condition() -> EndCondition:
    """Return the end condition: the ego touches the child, has passed it, or the child has crossed."""

    def over(t: float, states: Mapping[str, State]) -> str | None:
        ego, child = states["ego"], states["child"]
        ahead, left = child.x - ego.x, child.y - ego.y
        if math.hypot(max(abs(ahead) - 0.5 * ego.length, 0.0), max(abs(left) - 0.5 * ego.width, 0.0)) <= RADIUS:
            return "collision"
        if ahead < -0.5 * ego.length - RADIUS and ego.speed > abs(child.speed):
            return "passed"
        if left > 0.5 * ego.width + RADIUS + FAR_SIDE:
            return "crossed"
        return None

    return over


@per_trace
def distances(trace: Trace) -> tuple[float, float | None]:
    """Return the smallest distance of the ego's rectangle and the child's circle, and the ego's speed at the contact.

    Accounts for the motion between two instants: within a step both move on straight lines, and the distance from
    a rectangle is convex along a line, so that a ternary search finds its minimum.

    Returns:
        (distance > 0 (m), None), or (0, speed at the first contact (m/s)).
    """
    ego, child = trace.actor("ego"), trace.actor("child")
    cos, sin = np.cos(ego.heading), np.sin(ego.heading)
    dx, dy = child.x - ego.x, child.y - ego.y
    place = np.stack([dx * cos + dy * sin, dy * cos - dx * sin], axis=1)  # (t, 2) in ego's frame
    half = 0.5 * np.array([ego.length, ego.width])

    def clearance(point: np.ndarray) -> np.ndarray:
        return np.asarray(np.hypot(*np.maximum(np.abs(point) - half, 0.0).T) - RADIUS)

    start, step = place[:-1], np.diff(place, axis=0)
    low, high = np.zeros(len(step)), np.ones(len(step))
    for _ in range(60):  # ternary search in all steps simultaneously
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        nearer = clearance(start + a[:, None] * step) <= clearance(start + b[:, None] * step)
        low, high = np.where(nearer, low, a), np.where(nearer, b, high)
    best = 0.5 * (low + high)
    smallest = np.minimum(clearance(start + best[:, None] * step), np.minimum(clearance(start), clearance(place[1:])))
    hits = np.flatnonzero(smallest <= 0.0)
    if hits.size == 0:
        return float(smallest.min(initial=float(clearance(place[:1])[0]))), None
    k = int(hits[0])
    first, last = 0.0, float(best[k]) if clearance((start + best[:, None] * step)[k : k + 1])[0] <= 0.0 else 1.0
    for _ in range(50):  # bisection of the fraction of the step after which they touch
        middle = 0.5 * (first + last)
        if clearance((start[k] + middle * step[k])[None])[0] <= 0.0:
            last = middle
        else:
            first = middle
    return 0.0, float(ego.speed[k] + last * (ego.speed[k + 1] - ego.speed[k]))


def _min_dist(trace: Trace) -> float:
    distance, speed = distances(trace)
    return distance if speed is None else -(speed**2) / (2.0 * float(trace.signal("friction")[0]) * GRAVITY)


MIN_DIST = Metric(
    "min_dist", _min_dist, "m", "low", math.inf,
    "smallest distance between ego and the child; in a collision minus the braking distance still left",
    "Winkelmann et al. (2022), doi 10.1109/ITSC55140.2022.9922091",
)  # fmt: skip
COLLISION = Metric(
    "collision", lambda trace: float(distances(trace)[1] is not None), "", "high", 0.0, "ego and the child touched"
)
IMPACT_SPEED = Metric(
    "impact_speed", lambda trace: distances(trace)[1] or 0.0, "m/s", "high", 0.0, "speed of ego at the first contact"
)

SCENARIO = LogicalScenario(
    name="jaywalking",
    description=(
        "Jaywalking: a child steps out behind a vending machine.\n"
        "Suburban street. Ego drives at v_av when a child, hidden by a vending machine, walks towards the road at v_ped, "
        "d_0 ahead of ego's front and 4 m beside its centre line. Rain lowers friction and, like fog and darkness, sight."
    ),
    space=ParameterSpace(
        (
            Parameter("v_av", 4.5, 7.5, "m/s", description="speed of ego"),
            Parameter("v_ped", 0.4, 2.0, "m/s", description="speed of the child"),
            Parameter("d_0", 0.0, 50.0, "m", description="distance from ego's front to the child along the road at the start"),
            Parameter("rain_rel", 0.0, 1.0, "", description="intensity of rain: friction and contrast"),
            Parameter("fog_rel", 0.0, 1.0, "", description="intensity of fog: sight"),
            Parameter("wind_rel", 0.0, 1.0, "", description="intensity of wind: gusts that push the child"),
            Parameter("time_of_day", 0.0, 24.0, "h", description="hour: daylight"),
        )
    ),
    simulate=SumoSimulation(
        net="street",
        scene=scene,
        duration=DURATION,
        step_length=0.05,
        ego=Ego("pedestrian_braking"),
    ),
    metrics=(MIN_DIST, COLLISION, IMPACT_SPEED),
    roles=Roles(other="child", not_judged="the other is a pedestrian: the models are of vehicles"),
    requirement=Requirement("min_dist", high=-1e-6),
)
