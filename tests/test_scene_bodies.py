"""Scenes of actors know the levels of the roads and the bodies of long vehicles, as the user's own simulations do."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_evidence import SOUTH_NORTH, WEST_EAST, net

from sbt.metrics.fcd import catalogue
from sbt.sumo.actors import KEEP, Action, Actor, Scene, State, VehicleType
from sbt.sumo.simulation import SumoSimulation

pytestmark = pytest.mark.sumo

CAR = VehicleType(attributes=(("maxSpeed", "10"),))


class Looking:
    """Keeps its speed, and notes whom it sees."""

    def __init__(self, seen: set[str]):
        self.seen = seen

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        self.seen.update(f"{own.name}>{other.name}" for other in others)
        return KEEP


def crossing(folder: Path, z: float | None) -> Path:
    """Two roads that cross without a junction, one of them so high above the other (m); None: without heights."""
    heights = (0.0, z)
    roads = {
        name: [p if z is None else (*p, heights[k]) for p in shape]
        for k, (name, shape) in enumerate((("we", WEST_EAST), ("sn", SOUTH_NORTH)))
    }
    path = folder / f"{z}.net.xml"
    path.write_text(net(roads, z=z is not None))
    return path


def meeting(path: Path, seen: set[str] | None, **settings: Any) -> SumoSimulation:
    """The ego and others on both roads; `seen` of controllers, else SUMO drives."""

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        driver = None if seen is None else Looking(seen)
        return Scene((
            Actor("ego", ("we",), 0, 50.0, 10.0, driver, CAR), Actor("lead", ("we",), 0, 75.0, 10.0, driver, CAR),
            Actor("co", ("sn",), 0, 50.0 + values["p"], 10.0, driver, CAR),
        ))  # fmt: skip

    return SumoSimulation(str(path), scene, 9.0, 0.1, isolations=("fresh", "reuse", "replicas"), **settings)


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("z", [None, 6.0, 0.5])
def test_only_who_is_on_the_egos_level_is_hit_seen_or_measured(tmp_path: Path, z: float | None, driven: bool) -> None:
    seen: set[str] = set()
    one = meeting(crossing(tmp_path, z), seen if driven else None, isolation="fresh")
    trace = one({"p": 0.0}, 1)
    apart = z != 0.5
    assert (trace.ended == "collision") is not apart
    assert trace.present[:, trace.actors.index("co")].any() is not np.bool_(apart)
    assert trace.present[:, :2].all()
    if driven:
        assert ("ego>co" in seen, "co>ego" in seen, "lead>ego" in seen) == (not apart, not apart, True)
    values = {metric.name: metric(trace) for metric in catalogue()}
    assert values["collision"] == float(not apart)
    assert not any(math.isnan(value) for value in values.values())
    guessed = [text for text in trace.unconfirmed if text.startswith("on another level: 'co' at")]
    assert bool(guessed) is (z is None), "a contact that rests on a guess is told"
    assert any("cross without a junction" in text for text in one.warnings()) is (z != 6.0)


@pytest.mark.parametrize("z", [None, 6.0])
def test_levels_are_the_same_in_every_isolation(tmp_path: Path, z: float | None) -> None:
    path = crossing(tmp_path, z)
    work = [({"p": float(p)}, 1) for p in (0, 5, 10)]
    fresh = [meeting(path, set(), isolation="fresh")(*one) for one in work]
    for isolation in ("reuse", "replicas"):
        for a, b in zip(fresh, meeting(path, set(), isolation=isolation).simulate_many(work), strict=True):
            assert a.identical(b)


def test_who_begins_by_a_pose_is_on_the_level_of_its_lane(tmp_path: Path) -> None:
    class Standing:
        def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
            return Action(speed=0.0, pose=(own.x, own.y, own.heading))

    def scene(values: Any, ego: Any, rng: Any) -> Scene:
        beside = (4.5, -1.6, 0.5 * math.pi)
        return Scene((
            Actor("ego", ("we",), 0, 50.0, 10.0, Looking(set())),
            Actor("co", ("sn",), 0, 90.0, 0.0, Standing(), pose=beside),
        ))  # fmt: skip

    for z, ended in ((6.0, "duration"), (0.5, "collision")):
        assert SumoSimulation(str(crossing(tmp_path, z)), scene, 9.0, 0.1)({}, 1).ended == ended
