"""Searches where noise hides which inputs fail: 0.6 % of the runs are critical, one in ten at the worst inputs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import qmc

from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers import portfolio
from sbt.samplers.noise import hidden_by_noise, more_repeats, scores
from sbt.samplers.search import Search
from sbt.seeds import stream

LOW = CriticalInterval(high=0.0)
GP = GaussianProcess(nu=2.5, input_noise=False)
D = 5


def mean(u: Points) -> Vector:
    """A hollow in two of five inputs; runs scatter about it by 0.7."""
    return 2.89 - 2.2 * np.exp(-((u[:, 0] - 0.85) ** 2 + (u[:, 1] - 0.15) ** 2) / 0.05)


def test_scores_keep_the_order_and_weigh_the_low_end_most():
    found = scores(np.array([3.0, 1.0, 2.0, 4.0, np.inf]))
    assert np.argsort(found).tolist() == [1, 2, 0, 3, 4]
    assert (np.diff(np.diff(np.sort(found))) < 0).all()


def test_noise_hides_where_repeats_scatter_as_much_as_other_inputs():
    u = np.vstack([np.linspace(0.0, 1.0, 20)[:, None], [[0.0], [0.0]]])
    y = np.append(np.linspace(0.0, 1.0, 20), [0.01, 0.02])
    assert not hidden_by_noise(u[:-2], y[:-2])  # nothing repeated
    assert not hidden_by_noise(u[:-2], np.append(y[:-3], y[0]))
    assert hidden_by_noise(u, np.append(y[:-2], [0.8, 0.9]))
    assert more_repeats(u, y) == (1, 2)  # four in all; those repeated already are not asked again
    assert len(more_repeats(np.vstack([u, u[1:3]]), np.append(y, [0.1, 0.2]))) == 0


def test_a_noisy_search_meets_several_times_as_many_failures_as_chance():
    """The sum of P(critical) over the distinct inputs of 120 runs: chance meets 0.7."""
    rng, u = stream(0, "noisy"), qmc.Sobol(D, rng=np.random.default_rng(0)).random(16)[:10]
    u = np.vstack([u, u[:2]])
    y = mean(u) + 0.7 * rng.standard_normal(12)
    batch, number = np.zeros(12), 0.0
    while len(y) < 120:
        number += 1.0
        picks = portfolio.propose(Search(LOW, GP), u, y, 11, rng, batch, repeats=True)
        new = np.vstack([picks.u, u[list(picks.repeat)], rng.random((1, D))])
        u, y = np.vstack([u, new]), np.append(y, mean(new) + 0.7 * rng.standard_normal(len(new)))
        batch = np.append(batch, np.full(len(new), number))
    distinct = np.unique(u, axis=0)
    assert len(u) - len(distinct) <= 12  # a tenth
    base = float(ndtr(-mean(stream(0, "base").random((20000, D))) / 0.7).mean())
    assert base == pytest.approx(0.006, abs=0.002)
    assert float(ndtr(-mean(distinct) / 0.7).sum()) >= 3.0 * 120 * base
