"""Whole numbers in a correlation: their probabilities are those of the draws, so that densities can be divided."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import sbt
from sbt.problem.cells import log_cell_mass
from sbt.problem.sensitivity import space_parameters
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream


def joined(whole: int, continuous: int, rho: float, mean: float = 1.5, top: int = 3) -> ParameterSpace:
    """Return inputs, all correlated by rho."""
    inputs = [sbt.Parameter(f"k{k}", 0, top, kind="integer", distribution=sbt.Normal(mean, 1.0)) for k in range(whole)]
    inputs += [sbt.Parameter(f"x{k}", -6, 6, distribution=sbt.Normal(0.0, 1.0)) for k in range(continuous)]
    matrix = np.full((len(inputs),) * 2, rho) + (1.0 - rho) * np.eye(len(inputs))
    return ParameterSpace(tuple(inputs), tuple(map(tuple, matrix.tolist())))


@pytest.mark.parametrize(("whole", "rho"), [(2, 0.5), (2, 0.95), (2, 0.9999), (3, 0.6), (3, 0.9)])
def test_the_probabilities_of_all_combinations_are_those_of_the_draws(whole, rho):
    space = joined(whole, 0, rho)
    x = np.array([*product(range(4), repeat=whole)], dtype=float)
    p = np.exp(space.log_density(x))
    assert p.sum() == pytest.approx(1.0, abs=1e-4 if rho > 0.99 else 1e-6)
    drawn = space.sample(20_000, stream(1))
    counts = np.array([(drawn == cell).all(axis=1).sum() for cell in x])
    assert (np.abs(counts - 20_000 * p) <= 5.0 * np.sqrt(20_000 * p) + 3.0).all()
    outside = x.copy()
    outside[::2, 0], outside[1::2, 1] = -1.0, 0.5
    assert (space.log_density(outside) == -np.inf).all()


def test_cells_are_rectangles_of_the_normal_distribution():
    matrix = np.array([[1.0, 0.7, -0.4], [0.7, 2.0, 0.1], [-0.4, 0.1, 0.5]])
    lower = np.array([[-1.0, 0.5, -0.2], [-np.inf, 1.0, 0.0], [2.0, 1.0, -3.0]])
    upper = np.array([[0.5, np.inf, 0.3], [0.0, 2.0, np.inf], [np.inf, 4.0, -0.5]])
    law = multivariate_normal(np.zeros(3), matrix, maxpts=500_000, abseps=1e-9, releps=1e-9)
    truth = [law.cdf(b, lower_limit=a, rng=np.random.default_rng(0)) for a, b in zip(lower, upper, strict=True)]
    np.testing.assert_allclose(np.exp(log_cell_mass(lower, upper, matrix)), truth, rtol=1e-4)


@pytest.mark.parametrize(("whole", "continuous", "rho"), [(2, 0, 0.9), (1, 1, 0.9), (2, 1, 0.7), (1, 2, -0.3)])
def test_ratios_of_densities_have_mean_one_and_scores_mean_zero(whole, continuous, rho):
    old, n = joined(whole, continuous, rho), 8000
    x = old.sample(n, stream(2))
    for new in (joined(whole, continuous, rho, mean=1.2), joined(whole, continuous, 0.8 * rho)):
        ratio = np.exp(new.log_density(x) - old.log_density(x))
        assert ratio.mean() == pytest.approx(1.0, abs=4.5 * ratio.std() / n**0.5)
    for each in space_parameters(old):
        score = each.score(x)
        assert score.mean() == pytest.approx(0.0, abs=4.5 * score.std() / n**0.5)


def asked_of(inputs: int = 2, rho: float = 0.9) -> sbt.Scenario:
    return sbt.Scenario(
        "whole", list(joined(inputs, 0, rho).parameters), sbt.Requirement("m", high=-1.0),
        evaluate=lambda v, _: {"m": v["k0"] - v["k1"]},
    )  # fmt: skip


def estimated(tmp_path, inputs: int = 2, rho: float = 0.9) -> sbt.Result:
    pairs = [{"inputs": [f"k{i}", f"k{j}"], "value": rho} for i in range(inputs) for j in range(i)]
    return sbt.run(
        campaign="estimation", scenario=asked_of(inputs), correlation=pairs, budget=400, acquisition="monte_carlo", seed=4,
        stop={"cov": None}, executor="serial", store=tmp_path / "store", report=False,
    )  # fmt: skip


def probability(mean: float = 1.5, rho: float = 0.9) -> float:
    """Return P(k0 < k1) with this mean of k0, exactly."""
    inputs = (joined(1, 0, rho, mean).parameters[0], joined(2, 0, rho).parameters[1])
    space, x = ParameterSpace(inputs, joined(2, 0, rho).correlation), np.array([*product(range(4), repeat=2)], dtype=float)
    return float(np.exp(space.log_density(x))[x[:, 0] < x[:, 1]].sum())


def test_correlated_whole_numbers_are_asked_again(tmp_path, monkeypatch):
    """The answer was 4 times that, as it still would be by the densities of stores of before."""
    with monkeypatch.context() as before:
        before.setattr(ParameterSpace, "log_density", ParameterSpace._log_density)
        found = estimated(tmp_path)
    told = found.estimate({"k0": sbt.Normal(1.0, 1.0)})
    assert told.low <= probability(1.0) <= told.high < 2.0 * told.probability
    rows = found.sensitivity()
    mean = rows[(rows["input"] == "k0") & (rows["parameter"] == "mean")].iloc[0]
    slope = (probability(1.51) - probability(1.49)) / 0.02
    assert mean["derivative"] == pytest.approx(slope, abs=4.0 * mean["std_error"])
    rho = rows[rows["parameter"] == "correlation"].iloc[0]
    slope = (probability(rho=0.901) - probability(rho=0.899)) / 0.002
    assert rho["derivative"] == pytest.approx(slope, abs=4.0 * rho["std_error"])


def test_more_correlated_whole_numbers_than_are_counted_are_refused(tmp_path):
    found = estimated(tmp_path, inputs=5, rho=0.5)
    assert found.conclusion.probability > 0.0
    assert found.estimate(critical=(-np.inf, -2.0)).probability < found.conclusion.probability
    assert found.sensitivity().empty
    with pytest.raises(sbt.InputError, match=r"at most 3 correlated whole numbers \(2 where .*\), but k0, k1, k2, k3, k4 are 5"):
        found.estimate({"k0": sbt.Normal(1.0, 1.0)})
