"""What a sensitivity states is the derivative of the probability, or it states nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from typer.testing import CliRunner

import sbt
from sbt.cli import app
from sbt.problem.distribution import Distribution
from sbt.problem.sensitivity import SpaceParameter, space_parameters
from sbt.problem.space import ParameterSpace

INPUTS = {
    "a": (sbt.SciPy("uniform", loc=2.0, scale=4.0), 5.0), "b": (sbt.SciPy("expon", loc=1.0, scale=1.0), 2.0),
    "c": (sbt.Triangular(1.0, 3.0, 9.0), 6.0), "d": (sbt.SciPy("gamma", a=3.0, loc=1.0), 6.0),
}  # fmt: skip
"""Distributions, each with the edge of what is critical."""
MOVING = {("a", "loc"), ("a", "scale"), ("b", "loc")}


def parameters(distribution: Distribution, low: float = 0.0, high: float = 10.0, **keys: object) -> dict[str, SpaceParameter]:
    space = ParameterSpace((sbt.Parameter("x", low, high, "", distribution, **keys),))
    return {each.name: each for each in space_parameters(space)}


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> sbt.Result:
    """Crude draws, critical where each input is below its edge."""
    scenario = sbt.Scenario(
        "below", [sbt.Parameter(name, 0, 30, "", made) for name, (made, _) in INPUTS.items()], sbt.Requirement("y", high=0.0),
        evaluate=lambda x, _: {"y": max(x[name] - edge for name, (_, edge) in INPUTS.items())},
    )  # fmt: skip
    return sbt.run(
        campaign="estimation", scenario=scenario, acquisition="monte_carlo", budget=2000, batch=2000, stop={"cov": None}, seed=3,
        executor="serial", report=False, store=tmp_path_factory.mktemp("counted") / "store",
    )  # fmt: skip


def probability(name: str, parameter: str, value: float) -> float:
    """Return P(all inputs are below their edges) with a parameter changed, exactly."""
    made = {n: dict(d.parameters) for n, (d, _) in INPUTS.items()}
    made[name][parameter] = value
    below = (Distribution.of(d.kind, **made[n]).truncated(0.0, 30.0).cdf(np.array(edge)) for n, (d, edge) in INPUTS.items())
    return math.prod(map(float, below))


def test_a_stated_derivative_is_that_of_the_probability(counted):
    """An end at which there is a density moves with `loc`: the derivative of a's was stated as 0 +- 0 for -.1."""
    rows = counted.sensitivity()
    assert set(zip(rows["input"], rows["parameter"], strict=True)) >= MOVING
    for _, row in rows.iterrows():
        which = row["input"], row["parameter"]
        assert np.isnan(row["derivative"]) == np.isnan(row["std_error"]) == (which in MOVING)
        ends = [probability(*which, row["value"] + side * 1e-5) for side in (1.0, -1.0)]
        if which not in MOVING:
            assert row["derivative"] == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=4.0 * row["std_error"]), which
        for side, key in ((1.0, "raised"), (-1.0, "lowered")):
            if not np.isnan(row[key]):
                assert row[key] == pytest.approx(probability(*which, row["value"] + side * row["change"]), rel=0.15), which


@pytest.mark.slow
def test_no_draw_that_is_critical_tells_no_sensitivity(counted):
    rows = counted.sensitivity(critical=(-1000.0, -900.0))
    assert rows[["derivative", "std_error", "raised", "lowered"]].isna().all(axis=None)
    printed = CliRunner().invoke(app, ["estimate-again", str(counted.store)]).output
    assert "not known" in printed
    assert "nan" not in printed


@pytest.mark.parametrize(
    ("distribution", "low", "high", "unknown"),
    [
        (sbt.SciPy("uniform", loc=-5.0, scale=30.0), 0, 10, set()),  # its ends lie beyond the range
        (sbt.SciPy("uniform", loc=-5.0, scale=10.0), 0, 10, {"loc", "scale"}),
        (sbt.SciPy("expon", loc=-3.0, scale=1.0), 0, 10, set()),
        (sbt.SciPy("truncexpon", b=8.0), 0, 30, {"b"}),  # the density there is 3e-4
        (sbt.SciPy("pareto", b=3.0, scale=1.0), 0, 30, {"scale"}),
        (sbt.SciPy("weibull_min", c=0.7, loc=1.0), 0, 30, {"loc"}),
        (sbt.Triangular(1.0, 1.0, 9.0), 0, 10, {"low", "mode"}),
        (sbt.Triangular(1000.1, 1000.5, 1000.9), 1000, 1001, set()),
        (sbt.Normal(-4.0, 1.0), 3, 10, set()),
        (sbt.LogNormal(5.0, 5.0), 0, 1e9, set()),
        (sbt.Weibull(0.5, 2.0), 0, 10, set()),
        (sbt.Beta(0.5, 0.5), 0, 10, set()),
    ],
)
def test_scores_count_where_they_tell_how_the_distribution_moves(distribution, low, high, unknown):
    assert {name for name, each in parameters(distribution, low, high).items() if not each.smooth} == unknown


@pytest.mark.parametrize(("loc", "smooth"), [(2.2, True), (2.5, False)])
def test_whole_numbers_count_while_none_gets_its_first_mass(loc, smooth):
    assert parameters(sbt.SciPy("uniform", loc=loc, scale=4.0), kind="integer")["loc"].smooth is smooth


@pytest.mark.parametrize("constraints", [(), (("x <= 8", lambda x: x["x"] <= 8.0),)])
def test_no_probability_is_told_of_a_distribution_that_reaches_further(constraints):
    """Triangular: 1.5 % lie beyond, where all that is critical may lie; with constraints, a share of any size was passed over."""
    for made, name in ((sbt.Triangular(0.0, 3.0, 6.0), "high"), (sbt.SciPy("uniform", loc=2.0, scale=4.0), "loc")):
        space = ParameterSpace((sbt.Parameter("x", 0, 10, "", made),), constraints=constraints)
        (each,) = (each for each in space_parameters(space) if each.name == name)
        assert each.ratio(np.array([[3.0]]), each.value + each.tenth) is None
