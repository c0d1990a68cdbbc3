"""Lines across a boundary cross it: of regions with straight faces what is told is true and sharp."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sbt.campaigns.place import BoundaryPlace, boundary_place
from sbt.problem.arrays import Points, Vector
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.records import from_json, to_json

A, B, C = 0, 1, 2
FACED: dict[str, Callable[[Points], Vector]] = {
    "and": lambda u: np.minimum(u[:, A], u[:, B]) - 0.6,
    "or": lambda u: np.maximum(u[:, A], u[:, B]) - 0.8,
    "box": lambda u: np.min([0.3 - np.abs(u[:, A] - 0.5), 0.25 - np.abs(u[:, B] - 0.4), u[:, C] - 0.35], axis=0),
    "checker": lambda u: np.where(
        (u[:, A] < 0.5) == (u[:, B] < 0.5), -1.0, 1.0
    ) * np.minimum(np.abs(u[:, A] - 0.5), np.abs(u[:, B] - 0.5)),
    "three": lambda u: np.min([u[:, A] - 0.2, u[:, B] - 0.3, u[:, C] - 0.4], axis=0),
}  # fmt: skip
"""Positive where critical, by how far inside."""
LOG = Distribution.of(kind="scipy", name="loguniform", a=1e-4, b=1.0)
SPACES = {
    "even": ParameterSpace(tuple(Parameter(name, 0, 1) for name in "abc")),
    "decades": ParameterSpace((Parameter("a", 1e-4, 1.0, "", LOG), Parameter("b", 3600, 3610), Parameter("c", -1, 0))),
}


def scenario_of(space: ParameterSpace) -> LogicalScenario:
    return LogicalScenario("s", space, Requirement("y", high=0.0), evaluate=lambda v, s: {"y": 0.0})


@pytest.mark.parametrize("name", FACED)
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lines_do_not_run_along_faces(name: str, space: str, seed: int):
    """A metamodel's faces are rough: on one, P crosses 0.5 again and again, and nowhere is sure."""
    inside, scenario = FACED[name], scenario_of(SPACES[space])

    def log_odds(u: Points) -> Vector:
        rough = np.sin(37 * u[:, A]) * np.sin(41 * u[:, B] + 1.0) + np.sin(53 * u[:, A] + 29 * u[:, B])
        return 2000.0 * (inside(u) + 0.0004 * rough)

    found = boundary_place(log_odds, scenario, seed)
    assert not found.vague
    assert found.across is not None, "a face that no line along the first input meets"
    assert found.across.inputs == found.inputs[::-1]
    for place in (found, found.across):
        assert_true(place, found, inside, scenario.space)
    assert from_json(BoundaryPlace, to_json(found)) == found


def assert_true(place: BoundaryPlace, of: BoundaryPlace, inside: Callable[[Points], Vector], space: ParameterSpace) -> None:
    """Compare the critical stretches of each line with what is critical on it; edges are known to half a cell."""
    along, at = (space.names.index(name) for name in place.inputs)
    t = np.linspace(0.0, 1.0, 801)
    for cut in place.cuts:
        row = np.array([p.number(of.fixed[p.name]) if p.name in of.fixed else 0.0 for p in space.parameters])
        row[at] = cut.at
        points = np.repeat(space.to_unit(row[None]), len(t), axis=0)
        points[:, along] = t
        ends = [(space.parameters[along].to_unit(np.array([s.low, s.high]))) for s in cut.critical]
        said = np.any([(low - 0.004 <= t) & (t <= high + 0.004) for low, high in ends], axis=0)
        surely = np.any([(low + 0.004 <= t) & (t <= high - 0.004) for low, high in ends], axis=0)
        assert (inside(points)[surely] > 0.0).all()
        assert (inside(points)[~said] < 0.0).all()


def test_a_slanted_boundary_has_no_face_and_a_doubtful_one_stays_vague():
    scenario = scenario_of(SPACES["even"])
    slanted = boundary_place(lambda u: 300.0 * (u[:, A] + 0.8 * u[:, B] - 0.7), scenario, 1)
    assert len(slanted.cuts) == 3
    assert slanted.across is None
    assert not slanted.vague
    for steep in (1.0, 4.0):
        assert boundary_place(lambda u, k=steep: k * (u[:, A] + 0.8 * u[:, B] - 0.7), scenario, 1).vague
        assert boundary_place(lambda u, k=steep: k * FACED["and"](u), scenario, 1).vague
