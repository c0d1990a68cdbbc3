"""Searches where noise hides which inputs fail: 0.6 % of the runs are critical, one in ten at the worst inputs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import qmc

import sbt
from sbt.campaigns.failures import search_runs
from sbt.campaigns.modes import modes_of
from sbt.campaigns.records import CONFIRM
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers import portfolio
from sbt.samplers.noise import hidden_by_noise, more_repeats, scores
from sbt.samplers.search import Search
from sbt.seeds import stream
from sbt.testbeds import values

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


def test_a_noisy_search_runs_where_the_failure_rate_is_believed_to_be_largest():
    """The hollow's P(critical) is .16 at most, and .006 on the whole."""
    rng, u = stream(1, "noisy"), qmc.Sobol(D, rng=np.random.default_rng(1)).random(256)
    u = np.vstack([u, u[:40]])
    y = mean(u) + 0.7 * rng.standard_normal(len(u))
    picks = portfolio.propose(Search(LOW, GP), u, y, 11, rng, None, repeats=True)
    believed = picks.u[[why == "rate" for why in picks.why]]
    assert len(believed) == round(0.3 * len(picks.u))
    assert set(picks.why) == {"rate", "drawn"}
    assert float(ndtr(-mean(believed) / 0.7).min()) > 0.08


@pytest.mark.parametrize("seed", [6, 17, 24])
def test_a_failure_rate_is_of_repetitions_that_chose_nothing(seed: int, tmp_path: Path):
    """The rate of a mode is that of its confirmations, all of which come after the search and the race and decide nothing."""
    result = sbt.run(
        campaign="falsification", scenario="testbed:two_hollows_noisy", seed=seed, budget=40, executor="serial",
        store=tmp_path / "store", report=False,
    )  # fmt: skip
    history, modes = result.history, result.conclusion.failure_modes
    critical = result.scenario.requirement.critical_runs(history)
    again = history.stage == CONFIRM
    raced = again & (np.cumsum(again) <= (result.conclusion.raced or 0))
    assert modes
    assert len(search_runs(history)) == 40
    assert history.index[again].min() > history.index[~again].max()
    for mode in modes:
        rate, mine = mode.failure_rate, again & ~raced & (history.x == np.array(list(mode.inputs.values()))).all(axis=1)
        assert rate is not None
        assert (rate.runs, rate.estimate) == (mine.sum(), critical[mine].mean())
        exact = float(ndtr(-values("two_hollows_noisy", np.array([list(mode.inputs.values())]))[0] / 0.35))
        assert rate.low <= exact <= rate.high  # in 18 of 18 modes, see benchmarks/noise.py


def test_modes_of_a_noisy_simulator_are_ordered_by_their_failure_rate(tmp_path: Path):
    result = sbt.run(
        campaign="coverage", scenario="testbed:himmelblau_partx", seed=1, budget=30, executor="serial",
        store=tmp_path / "store", report=False,
    )  # fmt: skip
    history, scenario = result.history, result.scenario
    hits = np.flatnonzero(scenario.requirement.critical_runs(history))
    rates = {tuple(scenario.space.to_unit(history.x[k : k + 1])[0]): 0.01 * (1 + n) for n, k in enumerate(hits)}

    def log_probability(v: Points) -> Vector:  # no two runs are joined
        return np.log([rates.get(tuple(row), 1e-9) for row in v])

    fitted: Any = SimpleNamespace(log_probability=log_probability, probability=lambda v: np.exp(log_probability(v)))
    known = np.array([rates.get(tuple(row), np.nan) for row in scenario.space.to_unit(history.x)])
    ordered = [mode.representative for mode in modes_of(fitted, history, scenario, rates=known)]
    assert ordered == hits[::-1].tolist()
    deepest = np.argsort(scenario.requirement.margins(history)[hits])
    assert [mode.representative for mode in modes_of(fitted, history, scenario)] == hits[deepest].tolist()
