"""Testbeds: agreement with the reference file where it is available, and consistency of their reference values."""

from __future__ import annotations

import importlib.util
import math
import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.special import ndtr
from scipy.stats import chi2

from sbt import testbeds
from sbt.config.load import parse
from sbt.errors import InputError, RunError
from sbt.execution.spec import ScenarioSpec
from sbt.plugins import load
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.seeds import stream
from sbt.store.database import Store
from sbt.workflows.checking import check_scenario
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

ORACLE = Path(__file__).resolve().parents[2] / "shared" / "data" / "reference_problems.py"
NAMES = testbeds.names()
FAILING = {"needle_half_fails", "hartmann6_third_fails", "wavy_half_fails"}
OWN = FAILING | {"ellipsoids_d8", "ellipsoids_d10", "hills_d8", "waves_d12", "linear_d30", "linear_d80"}
OWN |= {"two_hollows_noisy", "slope_noisy", "ramp_uneven_d4", "steep_bowl_d4", "sentinel_d3"}
OWN |= {"ring_d2", "shell_d3", "banana_d2", "corner_d2"}
OWN |= {"deceptive_d3", "deceptive_d4", "deceptive_d6", "deceptive_d2_1e-5", "deceptive_d4_1e-5"}
REFERENCED = [name for name in NAMES if name not in OWN]
SAMPLED = [name for name in NAMES if testbeds.truth(name).probability >= 8e-4]
"""probable enough for a short Monte Carlo"""


@pytest.fixture(scope="module")
def oracle() -> ModuleType:
    if not ORACLE.is_file():
        pytest.skip(f"the reference problems are not beside the checkout ({ORACLE})")
    spec = importlib.util.spec_from_file_location("reference_problems", ORACLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


def cube(name: str, n: int, rng: np.random.Generator) -> Any:
    """Points uniform in the box of a testbed."""
    return testbeds.find(f"{name}:box").scenario().space.sample(n, rng)


# Against the reference file


def test_names_are_those_of_the_reference(oracle: ModuleType) -> None:
    assert set(REFERENCED) == set(oracle.names())
    assert len(NAMES) == len(set(NAMES))


@pytest.mark.parametrize("name", REFERENCED)
def test_values_and_verdicts_equal_the_reference(oracle: ModuleType, name: str) -> None:
    reference, mine = oracle.get(name), testbeds.find(name)
    for x in (reference.sample(2000, 1), reference.sample_box(2000, 2)):
        expected, y = reference(x), testbeds.values(name, x)
        np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-12)
        assert np.array_equal(mine.critical.contains(y), reference.critical(expected))
    assert (mine.critical.low, mine.critical.high) == (reference.lo, reference.hi)
    assert mine.noise == reference.noise_sd


@pytest.mark.parametrize("name", REFERENCED)
def test_truths_equal_the_reference(oracle: ModuleType, name: str) -> None:
    reference, truth = oracle.get(name), testbeds.truth(name)
    assert truth.probability == pytest.approx(reference.pf, rel=3e-8)
    assert truth.std_error == pytest.approx(reference.pf_se, rel=1e-9)
    if not math.isnan(reference.box_fraction):  # a Monte Carlo of some 1e5 points there
        assert truth.box_fraction == pytest.approx(reference.box_fraction, rel=0.01)


@pytest.mark.parametrize("name", REFERENCED)
def test_distributions_equal_the_reference(oracle: ModuleType, name: str) -> None:
    reference, space = oracle.get(name), testbeds.find(name).scenario().space
    z = np.vstack([stream(3, name).standard_normal((500, space.dimension)), np.full((2, space.dimension), [[-5.0], [5.0]])])
    x = space.from_normal(z)
    np.testing.assert_allclose(x, reference.inputs.from_u(z), rtol=1e-9, atol=1e-12)  # quantiles
    np.testing.assert_allclose(space.to_normal(x)[:500], z[:500], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(space.log_density(x), reference.inputs.logpdf(x), rtol=1e-9, atol=1e-9)
    box = np.array([p.bounds for p in testbeds.find(f"{name}:box").parameters])
    np.testing.assert_allclose(box, reference.bounds, rtol=1e-9)


# Laws that need no reference


@pytest.mark.parametrize("name", SAMPLED)
def test_monte_carlo_agrees_with_the_truth(name: str) -> None:
    problem, rng = testbeds.find(name), stream(0, "truth", name)
    n = 200_000 if problem.truth.probability > 5e-3 else 800_000
    n = min(n, 2_000_000 // len(problem.parameters))
    hits = problem.critical.contains(testbeds.values(name, problem.scenario().space.sample(n, rng), rng))
    assert_share(hits, problem.truth.probability, problem.truth.std_error)


@pytest.mark.parametrize("name", NAMES)
def test_the_critical_share_of_the_box_agrees_with_the_truth(name: str) -> None:
    problem, rng = testbeds.find(name), stream(0, "box", name)
    n = min(100_000, 500_000 // len(problem.parameters))
    hits = problem.critical.contains(testbeds.values(name, cube(name, n, rng), rng))
    assert_share(hits, problem.truth.box_fraction, problem.truth.box_std_error)
    boxed = testbeds.truth(f"{name}:box")
    assert (boxed.probability, boxed.std_error) == (problem.truth.box_fraction, problem.truth.box_std_error)


def assert_share(hits: Any, truth: float, std_error: float) -> None:
    error = math.hypot(math.sqrt(truth * (1 - truth) / len(hits)), std_error)
    assert abs(hits.mean() - truth) < 4 * error, f"{hits.mean():.6g} against {truth:.6g}: {(hits.mean() - truth) / error:.1f}"


def inside_along_rays(name: str, r: Any, angles: int) -> Any:
    """(angles, radii) booleans: critical at these polar coordinates of the plane."""
    angle = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)
    x = np.stack([np.multiply.outer(np.cos(angle), r), np.multiply.outer(np.sin(angle), r)], axis=-1)
    return testbeds.find(name).critical.contains(testbeds.values(name, x.reshape(-1, 2))).reshape(angles, len(r))


@pytest.mark.parametrize("name", ["four_branch_7", "rp110", "gayton_hat", "metaball", "linear_d2", "chi2_d2"])
def test_truths_in_the_plane_by_integration_along_rays(name: str) -> None:
    r, angles = np.linspace(2.0, 9.0, 1401), 720
    inside = inside_along_rays(name, r, angles)
    mass = (inside * r * np.exp(-0.5 * r**2)).sum() * (r[1] - r[0]) / angles
    assert mass == pytest.approx(testbeds.truth(name).probability, rel=0.02)


def test_truths_in_ten_dimensions_are_those_of_sum_and_length() -> None:
    assert testbeds.truth("linear_d10").probability == pytest.approx(ndtr(-3.5), rel=1e-12)
    assert testbeds.values("linear_d10", np.full((1, 10), 3.5 / math.sqrt(10)))[0] == pytest.approx(0.0, abs=1e-12)
    assert testbeds.truth("chi2_d10").probability == pytest.approx(chi2(10).sf(6.2**2), rel=1e-12)
    assert testbeds.values("chi2_d10", np.full((1, 10), 6.2 / math.sqrt(10)))[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("name", "cells"), [("himmelblau_partx", 500), ("goldstein_price_partx", 500), ("deceptive_d2", 400),
                                             ("needle_d2_1e-3", 400), ("wavy_level_d3", 80)])  # fmt: skip
def test_modes_of_uniform_inputs_are_the_connected_critical_regions(name: str, cells: int) -> None:
    problem = testbeds.find(name)
    d = len(problem.parameters)
    axis = (np.arange(cells) + 0.5) / cells
    x = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    inside = problem.critical.contains(testbeds.values(name, x)).reshape((cells,) * d)
    assert label(inside, np.ones((3,) * d))[1] == problem.truth.modes


@pytest.mark.parametrize(
    ("name", "nearest"), [("four_branch_6", 4), ("four_branch_7", 4), ("metaball", 4), ("rp110", 2), ("gayton_hat", 1)]
)
def test_modes_of_normal_inputs_are_the_nearest_critical_points(name: str, nearest: int) -> None:
    r = np.linspace(0.01, 12.0, 2400)
    inside = inside_along_rays(name, r, 720)
    distance = np.where(inside.any(axis=1), r[inside.argmax(axis=1)], 99.0)
    around = np.min([np.roll(distance, k) for k in range(-10, 11) if k], axis=0)
    minima = (distance < 12.0) & ((distance < around) | ((distance == around) & (np.roll(distance, 1) > distance)))
    assert minima.sum() == nearest == testbeds.truth(name).modes


@pytest.mark.parametrize("name", NAMES)
def test_a_testbed_is_a_scenario_whose_runs_are_the_vectorised_values(name: str) -> None:
    for written in (name, f"{name}:box"):
        scenario = load("scenarios", f"testbed:{written}")
        problem = testbeds.find(written)
        assert scenario.name == f"testbed:{written}"
        assert "Source:" in scenario.description
        x = scenario.space.sample(40, stream(4, written))
        fails = np.isnan(testbeds.values(written, x))
        assert fails.any() == (name in FAILING)
        for row in x[fails]:
            with pytest.raises(RunError, match="metric y must be finite"):
                scenario.run(dict(zip(scenario.space.names, row.tolist(), strict=True)), seed=5)
        x = x[~fails]
        y = [scenario.run(dict(zip(scenario.space.names, row.tolist(), strict=True)), seed=5)["y"] for row in x]
        if not problem.noise:
            np.testing.assert_allclose(y, testbeds.values(written, x), rtol=1e-12, atol=1e-12)
        again, point = pickle.loads(pickle.dumps(scenario.evaluate)), dict(zip(scenario.space.names, x[0].tolist(), strict=True))
        assert again(point, 5) == {"y": y[0]}


@pytest.mark.parametrize("name", NAMES)
def test_each_value_depends_on_its_own_row_alone(name: str) -> None:
    x = cube(name, 50, stream(5, name))
    order = stream(6, name).permutation(50)
    np.testing.assert_allclose(testbeds.values(name, x[order]), testbeds.values(name, x)[order], rtol=1e-12, atol=1e-12)
    assert testbeds.values(name, x[:0]).shape == (0,)


def test_the_seed_of_the_run_decides_the_noise() -> None:
    scenario = load("scenarios", "testbed:four_branch_noisy")
    point = {"x1": 1.0, "x2": 0.5}
    clean = float(testbeds.values("four_branch_noisy", np.array([[1.0, 0.5]]))[0])
    noise = np.array([scenario.run(point, seed)["y"] - clean for seed in range(2000)])
    assert scenario.run(point, 3) == scenario.run(point, 3) != scenario.run(point, 4)
    assert abs(noise.mean()) < 4 * 0.3 / math.sqrt(2000)
    assert noise.std() == pytest.approx(0.3, rel=4 / math.sqrt(2 * 2000))
    y = testbeds.values("four_branch_noisy", np.tile([1.0, 0.5], (2000, 1)), stream(7, "noise"))
    assert y.std() == pytest.approx(0.3, rel=4 / math.sqrt(2 * 2000))


def test_a_borehole_without_a_radius_has_no_flow() -> None:
    x = cube("borehole_1e-3", 5, stream(8, "borehole"))
    x[:, 0] = [-0.01, 0.0, 1e-12, -5.0, 0.1]
    y = testbeds.values("borehole_1e-3", x)
    assert np.all(np.abs(y[:4]) < 1e-9)
    assert y[4] > 1.0


@pytest.mark.parametrize("written", ["four_branch7", "hartman6_1e-3", "needle", "", "four_branch_7:bx", "cutin_crash:box"])
def test_wrong_names_are_refused_with_a_hint(written: str) -> None:
    with pytest.raises(InputError, match="a testbed must be one of four_branch_6") as caught:
        testbeds.truth(written)
    if written not in ("needle", ""):
        assert "did you mean" in str(caught.value)


def test_the_hint_reaches_the_configuration() -> None:
    with pytest.raises(InputError, match="did you mean 'four_branch_7'"):
        load("scenarios", "testbed:four_branch7")


def test_values_refuse_another_number_of_inputs() -> None:
    with pytest.raises(ValueError, match="2 columns"):
        testbeds.values("four_branch_7", np.zeros((3, 3)))


# Campaigns, and functions of one's own


def test_a_testbed_keeps_the_contract_of_scenarios() -> None:
    findings = check_scenario(ScenarioSpec("testbed:four_branch_noisy"))
    assert [f.rule for f in findings if not f.ok] == []


@pytest.mark.parametrize("scenario", ["testbed:four_branch_7", "testbed:four_branch_7:box"])
def test_a_coverage_campaign_runs(tmp_path: Path, scenario: str) -> None:
    config = f"campaign: coverage\nscenario: {scenario}\nbudget: 64\nexecutor: {{kind: serial}}\nstore: {tmp_path / 's'}\n"
    summary = run_study(Study(parse(config)), report=False)
    assert (summary.runs, summary.ok, summary.failed) == (64, 64, 0)
    with Store.read(tmp_path / "s") as store:
        history = store.history()
    np.testing.assert_allclose(history.y("y"), testbeds.values("four_branch_7", history.x), rtol=1e-12)
    edge = 6.0 if scenario.endswith(":box") else 4.7535
    assert 0.9 * edge < np.abs(history.x).max() <= edge


def test_analytic_makes_a_scenario_of_a_function() -> None:
    def height(x: Any) -> Any:
        """A saddle."""
        return x[:, 0] * x[:, 1] + x[:, 2]

    scenario = testbeds.analytic(
        height, name="saddle", critical=(0.0, math.inf), correlation=((1.0, 0.5, 0.0), (0.5, 1.0, 0.0), (0.0, 0.0, 1.0)),
        inputs={
            "a": (-1.0, 1.0), "b": Distribution.of(kind="lognormal", mean=1.0, std=0.5), "c": Parameter("height", 0.0, 9.0, "m"),
        },
    )  # fmt: skip
    assert scenario.space.names == ("a", "b", "c")
    assert scenario.description == "A saddle."
    assert scenario.run({"a": 0.5, "b": 2.0, "c": 3.0}, seed=0) == {"y": 4.0}
    x = scenario.space.sample(4000, stream(9, "saddle"))
    assert np.all(x[:, 1] > 0)
    assert np.corrcoef(scenario.space._scores(x)[:, 0], scenario.space._scores(x)[:, 1])[0, 1] == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"noise": -1.0}, "noise must be a finite standard deviation >= 0, but got -1.0"),
        ({"noise": math.nan}, "noise must be a finite standard deviation >= 0, but got nan"),
        ({"critical": (1.0, 0.0)}, "needs low <= high"),
        ({"inputs": {"a": (1.0, 0.0)}}, "input a: low < high must hold"),
        ({"inputs": {}}, "at least one input"),
        ({"correlation": ((1.0,), (0.0,))}, r"symmetric \(1, 1\) matrix"),
    ],
)
def test_analytic_refuses_what_cannot_be(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        testbeds.analytic(
            **({"function": lambda x: x[:, 0], "inputs": {"a": (0.0, 1.0)}, "critical": (0.0, 1.0), "name": "f"} | wrong)
        )


def test_a_function_of_the_wrong_shape_is_an_error() -> None:
    scenario = testbeds.analytic(lambda x: x, inputs={"a": (0.0, 1.0)}, critical=(0.0, 1.0), name="wrong")
    with pytest.raises(ValueError, match=r"shape \(n,\)"):
        scenario.run({"a": 0.5}, seed=0)
