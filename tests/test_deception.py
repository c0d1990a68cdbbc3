"""Searches that are led astray: by a broad trap beside a narrow well, and by the luck of a seed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import qmc

from sbt.campaigns.linking import connected
from sbt.campaigns.modes import FailureRate, representative_of
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.requirement import CriticalInterval
from sbt.samplers import portfolio
from sbt.samplers.regions import niches, regions
from sbt.samplers.room import spread_out
from sbt.samplers.search import Search, search_data
from sbt.seeds import stream
from sbt.testbeds import values

LOW = CriticalInterval(high=0.0)
GP = GaussianProcess(nu=2.5, input_noise=False)


def test_a_narrow_well_beside_a_broad_trap_is_found():
    """0.1 % of the square is critical, and seen from 1 % of it; everything else leads into the other corner."""
    rng, u = stream(3, "trap"), qmc.Sobol(2, rng=np.random.default_rng(3)).random(16)[:10]
    batch, filling, y = np.zeros(10), np.ones(10, dtype=bool), values("deceptive_d2", u)
    while not (y <= 0).any():
        assert len(y) < 400
        new = np.vstack([portfolio.propose(Search(LOW, GP), u, y, 9, rng, batch, filling).u, rng.random((1, 2))])
        u, y = np.vstack([u, new]), np.append(y, values("deceptive_d2", new))
        batch, filling = np.append(batch, np.full(10, batch[-1] + 1)), np.append(filling, np.arange(10) == 9)


def test_the_flank_of_a_basin_is_no_region_but_what_surprises_is_one():
    u = np.array([[0.1, 0.1], [0.3, 0.1], [0.4, 0.1], [0.9, 0.9], [0.5, 0.6]])
    margin = np.array([0.1, 0.2, 0.3, 0.8, 1.0])
    batch = np.arange(5.0)
    filling = np.array([False, False, False, True, True])  # their median is not that of the guided runs
    assert [r.centre.tolist() for r in regions(u, margin, batch, filling=filling)] == [[0.1, 0.1], [0.9, 0.9]]
    assert len(regions(u, margin, batch)) == 1
    found = niches(np.array([0.0, 0.0, 0.0, 3.0, 2.0]), u, margin, batch, [])
    assert [r.centre.tolist() for r in found] == [[0.9, 0.9]]


def test_rows_left_out_are_predicted_from_the_others():
    rng = stream(1, "left out")
    u = rng.random((40, 2))
    y = np.sin(6.0 * u[:, 0]) + u[:, 1] ** 2
    fitted = GP.fit(u, y, rng)
    covariance = fitted.factor @ fitted.factor.T
    z = (y - fitted.shift) / fitted.scale - fitted.centre
    for rows, (residual, std) in zip([[3], [5, 8, 20]], fitted.left_out([[3], [5, 8, 20]]), strict=True):
        rest = np.setdiff1d(np.arange(40), rows)
        weights = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[np.ix_(rest, rows)])
        np.testing.assert_allclose(residual, fitted.scale * (z[rows] - weights.T @ z[rest]), rtol=1e-5, atol=1e-9)
        variance = np.diag(covariance[np.ix_(rows, rows)] - covariance[np.ix_(rows, rest)] @ weights)
        np.testing.assert_allclose(std, fitted.scale * np.sqrt(variance), rtol=1e-5)


def test_filling_leaves_smaller_gaps_than_chance_and_does_not_prefer_corners():
    rng = stream(2, "spread")
    u = spread_out(lambda v: np.ones(len(v), dtype=bool), rng.random((10, 4)), 150, rng)
    probe = rng.random((1000, 4))

    def gap(points: np.ndarray) -> float:
        apart = np.abs(probe[:, None] - points[None])
        return float((np.minimum(apart, 1 - apart) ** 2).sum(axis=2).min(axis=1).max())

    assert gap(u) < np.median([gap(rng.random((150, 4))) for _ in range(9)])
    assert np.abs(u - 0.5).mean() == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(("again", "deflated"), [(0, False), (1, True)])
def test_a_noisy_hit_deflates_its_basin_only_where_most_seeds_fail(again: int, deflated: bool):
    """At (0.5, 0.5) one run was critical; two more with other seeds were not, or both were, and all about it."""
    rng = stream(5, "noisy")
    u = np.vstack([rng.random((60, 2)), np.full((3, 2), 0.5)])
    y = 1.0 + 0.4 * rng.standard_normal(len(u))
    y[-3:] = [-0.1, 1.3, 0.9] if not again else [-1.1, -1.2, -1.0]
    if again:
        near = np.abs(u - 0.5).max(axis=1) < 0.2
        y[near] = -1.0 + 0.1 * rng.standard_normal(near.sum())
    seen = search_data(Search(LOW, GP), u, y, None, stream(5, "data"))
    assert seen.noisy
    assert (len(u) - 3 not in seen.rows.tolist()) == deflated
    assert bool(seen.admissible(np.array([[0.52, 0.5]]))[0]) != deflated
    exact = search_data(Search(LOW, GP), u[:-2], y[:-2], None, stream(5, "data"))
    assert not exact.noisy
    assert not exact.admissible(np.array([[0.52, 0.5]]))[0]  # without noise one hit says all


def test_modes_of_a_noisy_simulator_are_joined_relative_to_their_ends():
    u = np.array([[0.1, 0.5], [0.3, 0.5], [0.9, 0.5]])
    fitted = cast(Any, SimpleNamespace(probability=lambda v: np.where(np.abs(v[:, 0] - 0.6) < 0.1, 0.01, 0.15)))
    assert len(set(connected(fitted, u, np.zeros(3)).tolist())) == 3
    first, second, third = connected(fitted, u, np.zeros(3), noisy=True).tolist()
    assert first == second != third


def test_a_mode_is_represented_by_the_run_likeliest_to_fail_again_however_small_the_rates():
    log_rate, depth, same = np.log([0.04, 0.14, 0.139, 0.06]), np.array([-0.5, -0.1, -0.2, -0.4]), np.zeros(4)
    assert representative_of(log_rate, depth, same) == 2  # of two that are alike the deeper one
    assert representative_of(same, depth, same) == 0
    assert representative_of(same, same, np.array([0.0, 3.0, 1.0, 2.0])) == 1


def test_the_interval_of_a_failure_rate_is_exact_and_counts_failed_runs_both_ways():
    flags = np.array([True] * 2 + [False] * 8)
    rate = FailureRate.of(flags, np.zeros(10, dtype=bool))
    assert (rate.estimate, rate.runs) == (0.2, 10)
    assert (rate.low, rate.high) == pytest.approx((0.02521, 0.55610), abs=1e-4)
    lost = FailureRate.of(flags, np.array([False] * 8 + [True] * 2))
    assert lost.estimate == 0.25
    assert lost.low == rate.low
    assert lost.high > rate.high
