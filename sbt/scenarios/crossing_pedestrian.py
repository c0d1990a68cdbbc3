"""Crossing pedestrian: a pedestrian uses a zebra crossing of a real town as the ego approaches, among other road users.

The streets are those around Wagner-Regeny-Strasse in Berlin-Adlershof, imported from OpenStreetMap data (c) OpenStreetMap
contributors, ODbL (`sumo_nets/town`); the zebra crossing has been added.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sbt.metrics.traffic import any_collision, any_impact_speed, nearest_distance, ttc_path_min
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Roles
from sbt.problem.space import ParameterSpace
from sbt.sumo.actors import Actor, Scene, State, VehicleType
from sbt.sumo.ego import Ego
from sbt.sumo.projecting import arrivals_at, driver_value, gaps
from sbt.sumo.simulation import SumoSimulation
from sbt.sumo.traffic import TrafficStream, ego_type

__all__ = ["SCENARIO"]

LIMIT = 50 / 3.6
"""Speed limit of the street (m/s)."""
BEFORE, GAP, BLOCK = 167.09, 15.4, 60.96
"""Lengths of the ego's street before the junction, across it, and from it to the crossing (m), in `town`."""
DISTANCE = 90.0
"""Initial distance from the ego's front to the crossing (m)."""
STREET = ("15", "14#0", "14#1", "13")
BACK = ("-13", "-14#1", "-14#0", "-15")
OVER = ("14#0", "-14#0", "-15")
"""Route of the pedestrian: along the ego's side of the street, over the crossing, and back along the other side."""
PACE = 0.05
"""Standard deviation of the pedestrian's speed relative to `v_ped`: the speed of a person varies."""
WALKER = VehicleType(0.5, 0.5, (("vClass", "pedestrian"), ("minGap", "0.25")))
ONCOMING = TrafficStream("oncoming", BACK, 1, LIMIT, spread=0.05)
NEAREST = 60.0
"""Foremost initial position of an oncoming car, on the 95 m before the junction behind the crossing (m), so that none
leaves the network during a run."""
PAVEMENTS = (("14#1", "13"), ("-14#0", "-15"))
WALKERS = 3.0
"""Mean number of other pedestrians."""
APART = 1.5
"""Smallest initial distance of two of them on a pavement (m)."""
WIDTH = "3"
"""Of pavements and crossing in `town` (m), and of the stripes in which SUMO's pedestrians walk: one stripe, so that they walk
along its centre line. With several, SUMO moves them to another stripe wherever one way ends and another begins, at once."""
STRIPES = ("--pedestrian.striping.stripe-width", WIDTH, "--pedestrian.striping.walkingarea-detail", "40")
PASSED = 10.0
"""Distance behind the crossing at which the ego has passed it (m)."""
CROSSING = (297.46, 285.96)
"""x, y of the centre of the crossing (m)."""
ONCOMING_WAY = 110.0
"""From the beginning of the oncoming cars' street to the crossing (m)."""
DURATION = 23.0
"""Longest simulated time (s)."""
EGO = Ego.of("sumo", jmCrossingGap={"min": 0.0, "max": 10.0}, decel={"min": 2.5, "max": 5.0})


def scene(values: Mapping[str, float], ego: Ego, rng: np.random.Generator) -> Scene:
    """Return the ego, the pedestrian, who reaches the kerb `t_ped` after the ego would reach the crossing, and the others."""
    speed, walk = values["v_ego"] / 3.6, values["v_ped"]
    pace = walk * (1.0 + PACE * float(np.clip(rng.standard_normal(), -2.0, 2.0)))
    driver = ego.driver(rng, speed)
    start = BEFORE + GAP + BLOCK - DISTANCE
    way = walk * (DISTANCE / speed + values["t_ped"])
    cars = ONCOMING.draw(rng, values["flow_co"], LIMIT, NEAREST, 0.0)
    actors = (
        Actor("ego", STREET, 1, start, speed, driver, ego_type(ego, speed, LIMIT)),
        Actor("ped", OVER, 0, BLOCK - way, pace, type=WALKER, person=True),
    )
    return Scene((*actors, *cars, *walkers(rng)), end_condition)


def walkers(rng: np.random.Generator) -> tuple[Actor, ...]:
    """Draw the other pedestrians, who stay on the pavements of the block, with some distance between them at the start."""
    drawn: list[Actor] = []
    for k in range(int(rng.poisson(WALKERS))):
        way, pace = PAVEMENTS[int(rng.integers(2))], float(rng.uniform(0.8, 1.6))
        at = float(rng.uniform(1.0, 30.0))
        while any(other.route == way and abs(other.position - at) < APART for other in drawn):
            at = float(rng.uniform(1.0, 30.0))
        drawn.append(Actor(f"walker_{k}", way, 0, at, pace, type=WALKER, person=True))
    return tuple(drawn)


def end_condition(t: float, states: Mapping[str, State]) -> str | None:
    """End the run when the ego has passed the crossing."""
    ego = states["ego"]
    ahead = (CROSSING[0] - ego.x) * ego.cos + (CROSSING[1] - ego.y) * ego.sin
    return "passed" if ahead < -PASSED else None


def covariates(values: Mapping[str, float], scene: Scene) -> dict[str, float]:
    """Return when the pedestrian, as fast as drawn, gets to kerb and lane relative to the ego, and who else comes there."""
    ego, walker = scene.actors[0], next(a for a in scene.actors if a.name == "ped")
    speed, way = values["v_ego"] / 3.6, BLOCK - walker.position
    arrives, kerb = DISTANCE / speed, way / walker.speed
    braking = 0.5 * speed**2 / driver_value(ego, "decel", 4.5)
    found = {
        "pace": walker.speed, "relative_pace": walker.speed / values["v_ped"], "kerb": kerb - arrives,
        "lane": (way + 3.0) / walker.speed - arrives, "across": (way + 6.0) / walker.speed - arrives,
        "ahead_at_kerb": DISTANCE - speed * kerb, "to_stop": braking, "left_to_stop": DISTANCE - speed * kerb - braking,
    }  # fmt: skip
    cars = [a for a in scene.actors if a.name.startswith(ONCOMING.name)]
    found |= {f"oncoming_{name}": value for name, value in gaps(arrivals_at(ONCOMING_WAY, cars, LIMIT), kerb, (4.0,), 2).items()}
    beyond = [abs(a.position + a.speed * (kerb + 4.0)) for a in scene.actors if a.person and a.route == PAVEMENTS[1]]
    return found | {"walkers_beyond": float(len(beyond)), "nearest_beyond": min(beyond, default=BLOCK)}


SCENARIO = LogicalScenario(
    name="crossing_pedestrian",
    description=(
        "Pedestrian on a zebra crossing of a real town.\n"
        "A street in Berlin-Adlershof at 50 km/h, from OpenStreetMap data. Ego comes at v_ego; a pedestrian walks along the "
        "pavement at v_ped, turns onto the zebra crossing t_ped after ego would reach it, and trusts in the right of way."
    ),
    space=ParameterSpace(
        (
            Parameter("v_ego", 30.0, 60.0, "km/h", description="speed of ego at the start and desired"),
            Parameter("v_ped", 0.8, 3.0, "m/s", description="mean speed of the pedestrian, from slow walking to running"),
            Parameter("t_ped", -4.0, 2.0, "s", description="the pedestrian at the kerb after ego, at constant speed, there"),
            Parameter("flow_co", 100.0, 600.0, "1/h", description="oncoming cars an hour"),
            *EGO.inputs,
        )
    ),
    simulate=SumoSimulation(
        net="town", scene=scene, duration=DURATION, step_length=0.05, ego=EGO, isolations=("fresh",), options=STRIPES,
        covariates=covariates,
    ),
    metrics=(ttc_path_min(), nearest_distance(), any_collision(), any_impact_speed()),
    requirement=Requirement("ttc_path_min", high=0.5),
    roles=Roles(other=None, not_judged="the other is a pedestrian: the models are of vehicles"),
)
