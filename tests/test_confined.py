"""Of critical regions that choices or whole numbers confine, these are named."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.parts import CriticalShare
from sbt.campaigns.place import BoundaryPlace, boundary_place
from sbt.campaigns.regions import CriticalRegion, critical_regions
from sbt.campaigns.telling import tell_boundary
from sbt.loop.stages import Facts
from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.records import from_json, to_json
from tests.sided_runs import sided_runs
from tests.test_lines_across import scenario_of


def told(space: ParameterSpace, log_odds: Callable[[Points], Vector]) -> tuple[str, tuple[CriticalRegion, ...]]:
    """Return the first sentence of a boundary that a metamodel sees so, and its regions."""
    scenario, u = scenario_of(space), space.cube.snapped(stream(0, "met").random((500, space.dimension)))
    place = boundary_place(log_odds, scenario, 1)
    regions = critical_regions(log_odds, scenario, 1, u[log_odds(u) > 0.0])
    assert from_json(BoundaryPlace, to_json(place)) == place
    assert [from_json(CriticalRegion, to_json(region)) for region in regions] == list(regions)
    assert from_json(CriticalRegion, {"share": 0.5, "extent": {}}).only is None, "of a store that was written before"
    found = BoundaryConclusion(0.3, 0.0, 0.0, None, place=place, regions=regions)
    facts = Facts(sided_runs(5, 5), Requirement("y", high=0.0), "m", "s")
    return tell_boundary(found, CriticalShare(None, 0.0, 1.0), facts)[0], regions


KIND, LANES = Parameter("k", choices=["a", "b", "c", "d"]), Parameter("n", 0, 3, kind="integer")


@pytest.mark.parametrize("single", [KIND, LANES])
def test_the_choices_and_whole_numbers_that_decide_are_named(single: Parameter):
    space = ParameterSpace((single, Parameter("c", 0, 1), Parameter("e", 0, 1)))
    value = ["k a", "k b", "k c", "k d"] if single is KIND else ["n 0", "n 1", "n 2", "n 3"]

    def at(u: Points, *cells: int) -> Vector:
        return np.isin(np.floor(4 * u[:, 0]).astype(int), cells)

    def sides(u: Points) -> Vector:
        """Below 0.2 at the first value, above 0.8 at the last, else nowhere."""
        return 500.0 * np.where(at(u, 0), 0.2 - u[:, 1], np.where(at(u, 3), u[:, 1] - 0.8, -0.5))

    said, regions = told(space, sides)
    assert [list(region.only.values()) for region in regions] in ([[(v,)] for v in order] for order in two(single, 0, 3))
    assert "one of 2 separate regions" in said
    for k, ends in ((0, "c 0.0"), (3, "c 0.8")):
        assert f"nine tenths of it with {value[k]} and {ends}" in said
    assert " e " not in said.split(";  the")[0].split("the metamodel learned")[0], "which decides nothing"

    said, regions = told(space, lambda u: 500.0 * np.where(at(u, 2, 3), 0.4 - u[:, 1] - 0.2 * u[:, 2], -0.5))
    assert len(regions) == 1
    assert f"and only with {'k c or d' if single is KIND else 'n 2 to 3'}; " in said

    said, _ = told(space, lambda u: np.where(at(u, 1), 5.0, -5.0) + 0.1 * u[:, 1])
    assert f"a run is critical (y ≤ 0 m) where it has {value[1]} (by the metamodel); " in said

    said, regions = told(space, lambda u: 500.0 * (0.4 - u[:, 1] - 0.2 * u[:, 2] + 0.05 * u[:, 0]))
    assert regions[0].only is None
    assert "only with" not in said


def two(single: Parameter, one: int, other: int) -> list[list[object]]:
    """Return two values of an input in either order."""
    pair = [single.value(float(one)), single.value(float(other))]
    return [pair, pair[::-1]]
