"""Critical regions of a boundary: as many as there are, as large as they are, where they are."""

from __future__ import annotations

import numpy as np
import pytest

import sbt
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.parts import CriticalShare
from sbt.campaigns.place import BoundaryPlace, Cut, Stretch
from sbt.campaigns.regions import CriticalRegion, critical_regions
from sbt.campaigns.telling import tell_boundary
from sbt.loop.stages import Facts
from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.seeds import stream
from sbt.testbeds import analytic, find, truth, values
from tests.sided_runs import sided_runs

COUNTED = {
    "himmelblau_partx": 3, "ring_d2": 1, "shell_d3": 1, "banana_d2": 1, "corner_d2": 1, "wavy_level_d3": 1, "hartmann6_1e-3": 2,
    "four_branch_7:box": 4, "linear_d10:box": 1,
}  # fmt: skip


@pytest.mark.parametrize("name", COUNTED)
def test_regions_of_known_problems_are_counted(name: str):
    """By the function itself in the place of a metamodel; shares of the box add up to the exact one."""
    problem = find(name)
    scenario = problem.scenario()

    def log_odds(u: Points) -> Vector:
        return np.where(problem.critical.contains(values(name, scenario.space.from_unit(u))), 1.0, -1.0)

    even = scenario.space.cube.snapped(stream(7, name).random((40_000, scenario.space.dimension)))
    met = even[log_odds(even) > 0.0]
    found = critical_regions(log_odds, scenario, 0, met)
    assert critical_regions(log_odds, scenario, 0, met[:0]) == (), "no run says that it is one"
    shares = [region.share for region in found]
    assert len(found) == COUNTED[name]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(truth(name).box_fraction, rel=0.1, abs=1e-3)


def test_where_runs_fail_is_in_no_region_and_separates_none():
    scenario = analytic(lambda x: x[:, 0], inputs={"a": (0.0, 1.0), "b": (0.0, 1.0)}, critical=(-np.inf, 0.0), name="f")
    met = np.array([[0.2, 0.1], [0.2, 0.9]])

    def log_success(u: Points) -> Vector:
        return np.where(np.abs(u[:, 1] - 0.5) < 0.2, -5.0, 0.0)

    (region,) = critical_regions(lambda u: 0.5 - u[:, 0], scenario, 0, met, log_success)
    assert region.share == pytest.approx(0.3, abs=0.01)


def test_what_only_a_choice_or_a_whole_number_divides_is_one_region():
    inputs = {"a": (0.0, 1.0), "n": Parameter("n", 1, 6, kind="integer"), "c": Parameter("c", choices=("x", "y", "z"))}
    scenario = analytic(lambda x: x[:, 0], inputs=inputs, critical=(-np.inf, 0.0), name="m")
    choice = 1.0 / 3.0

    def apart(u: Points) -> Vector:
        """Below 0.4 with the first choice, above 0.6 with the last one."""
        first, last = (u[:, 2] < choice) & (u[:, 0] < 0.4), (u[:, 2] > 2 * choice) & (u[:, 0] > 0.6)
        return np.where(first | last, 1.0, -1.0)

    met = scenario.space.cube.snapped(stream(8, "met").random((300, 3)))
    assert [round(r.share, 1) for r in critical_regions(lambda u: 0.5 - u[:, 0], scenario, 0, met[met[:, 0] < 0.5])] == [0.5]
    assert [round(r.share, 2) for r in critical_regions(apart, scenario, 0, met[apart(met) > 0.0])] == [0.13, 0.13]
    assert critical_regions(lambda u: -u[:, 0], scenario, 0, met) == ()


def test_a_boundary_names_its_regions(tmp_path):
    result = sbt.run(
        campaign="boundary", scenario="testbed:himmelblau_partx", seed=1, budget=150, executor="serial", metamodel="gp",
        store=tmp_path / "store", report=False,
    )  # fmt: skip
    found = result.conclusion
    assert len(found.regions) == 3
    first, *_ = sentences = found.sentences(Facts.of(result.history, result.scenario))
    assert "a run is critical (y \N{LESS-THAN OR EQUAL TO} 0) where it lies in one of 3 separate regions: " in first
    assert any(sentence.startswith("On lines across the boundary") for sentence in sentences)
    critical = result.scenario.requirement.critical_runs(result.history)
    inside = [
        np.all([(e.low <= x) & (x <= e.high) for e, x in zip(r.extent.values(), result.history.x.T, strict=True)], axis=0)
        for r in found.regions
    ]
    assert all(critical[rows].mean() > 0.5 for rows in inside)


def test_regions_are_counted_where_the_edges_are_known():
    regions = tuple(CriticalRegion(share, {"a": Stretch(low, low + 0.1)}) for share, low in ((0.2, 0), (0.1, 0.5), (0.001, 0.9)))
    facts = Facts(sided_runs(5, 5), Requirement("y", high=0.0), "m", "s")
    for unsure, told in ((0.01, 2), (0.5, 0)):
        place = BoundaryPlace(("a",), 0.0, 1.0, (Cut(None, (Stretch(0.0, 0.3),), unsure),), {}, {"a": 1.0})
        found = BoundaryConclusion(0.3, 0.0, 0.0, None, place=place, regions=regions)
        first = tell_boundary(found, CriticalShare(None, 0.0, 1.0), facts)[0]
        assert (f"{told} separate regions (1 smaller one aside): 20" in first) == bool(told)
        assert ("separate regions" in first) == bool(told)
