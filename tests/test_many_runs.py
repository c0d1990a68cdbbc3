"""The default metamodel where many runs crowd at the edge, and what a conclusion says where runs deny it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt import testbeds
from sbt.campaigns.boundary import BoundaryConclusion
from sbt.campaigns.parts import CriticalShare
from sbt.loop.learner import Learner
from sbt.loop.stages import Facts
from sbt.metamodels.automatic import Auto
from sbt.metamodels.base import build, with_target
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.stacking import cell_shares
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.history import Rows
from sbt.store.records import Validation


def crowded(name: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """A fifth of the rows uniform, the others where the metric is nearest to critical, as a boundary campaign leaves them."""
    rng, scenario = np.random.default_rng(5), testbeds.find(name).scenario()
    u = rng.random((20_000, scenario.space.dimension))
    margin = np.abs(scenario.requirement.critical.margin(testbeds.values(name, u)))
    near = rng.choice(np.argsort(margin)[:3000], n - n // 5, replace=False)
    chosen = np.concatenate([rng.choice(20_000, n // 5, replace=False), near])
    return u[chosen], testbeds.values(name, u[chosen])


@pytest.mark.slow
def test_auto_states_the_share_of_the_space_where_rows_crowd_at_the_edge():
    name = "hartmann6_1e-3"
    u, y = crowded(name, 700)
    critical = Requirement("y", high=-1.1).critical
    predictor = with_target(build(Auto, "quick"), critical).fit(u, y, np.random.default_rng(0))
    probe = np.random.default_rng(1).random((4000, 6))
    true = critical.contains(testbeds.values(name, probe)).mean()
    assert abs(predictor(probe).probability(critical).mean() / true - 1.0) < 0.08


def test_leaving_out_a_row_in_closed_form_is_leaving_it_out():
    u, y = crowded("wavy_level_d3", 40)
    full = GaussianProcess(nu=2.5, input_noise=False).fit(u, y, np.random.default_rng(0))
    left = full.leave_one_out(u, y)
    covariance = full.hyper.covariance(u, u) + full.hyper.noise * np.eye(40)
    z = (y - full.shift) / full.scale - full.centre
    for row in (0, 7, 39):
        rest = np.arange(40) != row
        weight = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[rest, row])
        mean, variance = weight @ z[rest], covariance[row, row] - weight @ covariance[rest, row]
        assert np.isclose(left.mu[row], full.shift + full.scale * (full.centre + mean), rtol=1e-4)
        assert np.isclose(left.sigma[row], full.scale * np.sqrt(variance), rtol=1e-4)


def test_leaving_out_rows_that_were_not_all_learned():
    """Repetitions of a deterministic metric are learned once; the paper's preset holds the first fifth of the rows out."""
    u, y = crowded("wavy_level_d3", 40)
    process = GaussianProcess(nu=2.5, input_noise=False)
    once = process.fit(u, y, np.random.default_rng(0)).leave_one_out(u, y)
    rows = np.array([3, *range(40), 3, 39])
    again = process.fit(u[rows], y[rows], np.random.default_rng(0)).leave_one_out(u[rows], y[rows])
    assert np.allclose(again.mu[0], again.mu[4])
    assert np.isclose(again.mu, once.mu[rows], rtol=0.2, atol=0.1).mean() > 0.9  # another order, about the same process
    part = GaussianProcess(nu=0.5, input_noise=False, priors=False, max_epochs=20).fit(u, y, np.random.default_rng(0))
    left, plain = part.leave_one_out(u, y), part(u)
    held_out = 40 - len(part.u)
    assert held_out > 0
    assert np.allclose(left.mu[:held_out], plain.mu[:held_out])
    assert (np.abs(left.mu - y)[held_out:] > np.abs(plain.mu - y)[held_out:]).all()


def test_shares_of_the_space_sum_to_one_and_crowds_share_theirs():
    rng = np.random.default_rng(2)
    u = np.concatenate([rng.random((20, 2)), 0.5 + 0.001 * rng.random((80, 2))])
    shares = cell_shares(u, rng)
    assert np.isclose(shares.sum(), 1.0)
    assert shares[20:].sum() < 0.2


def test_a_conclusion_says_where_held_out_runs_deny_it():
    facts = Facts(Rows(("a",), {}).history(), Requirement("y", high=0.0))
    share = CriticalShare(0.3, 0.25, 0.35, counted=300)

    def said(fraction: float, misclassified: float, error_rate: float) -> str:
        validation = Validation(error_rate=error_rate, n=300)
        return " ".join(
            BoundaryConclusion(fraction, misclassified, 0.1, validation, held_out_fraction=share).sentences(facts)
        )

    assert "deny" not in said(0.31, 0.02, 0.02)
    assert "too sure" not in said(0.31, 0.02, 0.02)
    assert "outside of their interval" in said(0.2, 0.02, 0.02)
    assert "too sure" in said(0.31, 0.001, 0.05)


def test_shares_are_measured_at_many_points_where_constraints_leave_a_thousandth():
    space = ParameterSpace(
        tuple(Parameter(k, 0.0, 1.0) for k in "ab"), constraints=(("a - b near 0", lambda v: np.abs(v["a"] - v["b"]) < 0.001),)
    )
    scenario = LogicalScenario("narrow", space, Requirement("y", high=0.5), evaluate=lambda values, seed: {"y": values["a"]})
    probe = Learner(scenario, GaussianProcess(), 0).probe
    assert len(probe) >= 1024
    assert space.feasible(space.from_unit(probe)).all()
    assert abs((probe[:, 0] < 0.5).mean() - 0.5) < 0.05


def test_a_small_share_is_stated_from_many_points(tmp_path: Path):
    result = sbt.run(
        campaign="boundary", scenario="testbed:interval_ring_d3:box", seed=1, budget=120, store=tmp_path / "s", executor="serial",
        metamodel={"kind": "gp", "nu": 2.5, "input_noise": False}, report=False,
    )  # fmt: skip
    assert result.conclusion.critical_fraction == pytest.approx(testbeds.truth("interval_ring_d3").box_fraction, rel=0.15)
