"""Which failure mode of a noisy simulator fails most often: labels near it and a race, never depth, never what is told."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

import sbt
from sbt.campaigns.confirming import shares
from sbt.campaigns.failures import batches_by, search_runs
from sbt.campaigns.modes import FailureRate
from sbt.campaigns.rates import LocalRates, local_rates, next_repetitions
from sbt.campaigns.records import CONFIRM, LINK, RACE
from sbt.loop.stages import Facts, Log
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.search import Search
from sbt.seeds import stream
from sbt.store.database import Store

DISCS = runpy.run_path(str(Path(__file__).resolve().parents[1] / "benchmarks" / "two_discs.py"))
SEARCH = Search(CriticalInterval(high=0.0), GaussianProcess(nu=2.5, input_noise=False))
NONE: Any = (np.empty((0, 2)), np.empty(0, dtype=bool))


def ran(u: Points, rng: np.random.Generator) -> Vector:
    evaluate: Callable[..., dict[str, float]] = DISCS["SCENARIO"].evaluate
    return np.array([evaluate({"x1": a, "x2": b}, int(rng.integers(2**31)))["y"] for a, b in u])


@pytest.fixture(scope="module", params=[0, 1])
def discs(request: pytest.FixtureRequest) -> tuple[Points, Vector]:
    """Runs as a search leaves them: spread out, and gathered in both discs."""
    rng = stream(request.param, "discs")
    u = np.vstack([rng.random((40, 2)), *(c + 0.05 * rng.standard_normal((12, 2)) for c in ((0.25, 0.3), (0.75, 0.7)))])
    u[-1] = u[-2]
    return u, ran(u, rng)


def test_what_fails_often_comes_before_what_fails_deeply(discs: tuple[Points, Vector]):
    u, y = discs
    rates = local_rates(SEARCH, u, y, np.ones(len(u), dtype=bool), *NONE, stream(0, "rates"))
    hits, exact = np.flatnonzero(y <= 0), DISCS["rates"](u)
    assert exact[np.argmin(y)] == 0.2
    often, rarely = (rates.mean[hits][exact[hits] == rate].max() for rate in (0.9, 0.2))
    assert often > rarely + 0.3
    assert ((rates.mean >= 0.0) & (rates.mean <= 1.0) & (rates.std >= 0.0)).all()


def test_repetitions_raise_and_lower_a_rate(discs: tuple[Points, Vector]):
    u, y = discs
    every, hit = np.ones(len(u), dtype=bool), int(np.argmin(y))
    before = local_rates(SEARCH, u, y, every, *NONE, stream(0, "rates")).mean[hit]
    again = np.repeat(u[[hit]], 20, axis=0)
    up, down = (local_rates(SEARCH, u, y, every, again, np.full(20, k), stream(0, "rates")).mean[hit] for k in (True, False))
    assert down < before < up
    assert down < 0.15


def test_only_runs_whose_seed_was_drawn_are_counted(discs: tuple[Points, Vector]):
    """Without the critical runs of a disc among those that are counted, few failures are expected there."""
    u, y = discs
    every, exact = np.ones(len(u), dtype=bool), DISCS["rates"](u)
    often = (exact == 0.9) & (y <= 0)
    some, none = (local_rates(SEARCH, u, y, mask, *NONE, stream(0, "rates")).mean for mask in (every, ~often))
    assert (none[often] < some[often]).all()


def test_where_the_metric_tells_the_rate_few_labels_do_not_spoil_its_order():
    """A rate that grows along one input, to one in seven: the best of some ten hits is known by the metric alone."""
    found = []
    for seed in range(6):
        rng = stream(seed, "slope")
        u = rng.random((200, 2))
        mean = 1.3 - 0.9 * u[:, 0]
        y = mean + 0.35 * rng.standard_normal(200)
        rates, hits = local_rates(SEARCH, u, y, np.ones(200, dtype=bool), *NONE, rng).mean, np.flatnonzero(y <= 0)
        found.append(ndtr(-mean[hits[np.argmax(rates[hits])]] / 0.35) / ndtr(-mean[hits].min() / 0.35))
    assert np.mean(found) > 0.85


def test_a_race_repeats_the_leader_and_who_may_exceed_it():
    mean, std = np.array([0.5, 0.49, 0.48, 0.3, 0.2, 0.45]), np.array([0.1, 0.01, 0.1, 0.3, 0.1, 0.0])
    rates = LocalRates(mean, std)
    assert next_repetitions(rates, [[0, 1, 2], [4, 5, 3]], 3) == [0, 1, 0]  # two of a mode: 2 does not run
    assert next_repetitions(rates, [[0], [4, 3]], 4) == [0, 3, 0, 3]
    assert next_repetitions(LocalRates(mean, 0.0 * std), [[4], [0]], 2) == [0, 4]


@pytest.mark.parametrize("modes", range(1, 11))
def test_a_race_takes_repetitions_from_those_that_are_told_and_costs_none(modes: int):
    racing, told = shares(modes)
    assert racing + sum(told) == modes * min(max(30 // modes, 3), 10)
    assert len(told) == modes
    assert told == sorted(told, reverse=True)
    assert (min(told), max(told)) >= (3, min(10, 30 // modes))
    assert racing == 0 or modes > 1


@pytest.mark.parametrize("modes", [2, 3, 5])
def test_the_interval_of_the_winner_of_a_race_covers(modes: int):
    """400 races between candidates of like rates: the repetitions that are told are not those that chose."""
    rng, covered, off = np.random.default_rng(modes), [], []
    racing, told = shares(modes)
    for _ in range(400):
        exact = rng.beta(1.0, 4.0, 2 * modes)
        runs, hits = np.full(2 * modes, 5.0), rng.binomial(4, exact) + 0.5
        mine = [[2 * k, 2 * k + 1] for k in range(modes)]
        for _ in range(3):
            mean = hits / runs
            rows = next_repetitions(LocalRates(mean, np.sqrt(mean * (1.0 - mean) / (runs + 1.0))), mine, racing // 3)
            np.add.at(runs, rows, 1.0)
            np.add.at(hits, rows, rng.random(len(rows)) < exact[rows])
        winner = int(np.argmax(hits / runs))
        rate = FailureRate.of(rng.random(told[0]) < exact[winner], np.zeros(told[0], dtype=bool))
        covered.append(rate.low <= exact[winner] <= rate.high)
        off.append((rate.estimate or 0.0) - exact[winner])
    assert np.mean(covered) >= 0.95
    assert abs(np.mean(off)) < 3.0 * np.std(off) / 20.0


def test_a_campaign_races_then_tells_and_each_batch_follows_from_the_log(tmp_path: Path):
    scenario = DISCS["SCENARIO"]
    result = sbt.run(
        campaign="falsification", scenario=scenario, seed=17, budget=60, executor="serial", store=tmp_path / "store", report=False
    )
    with Store.read(tmp_path / "store") as store:
        log = Log(store.history(), tuple(store.iterations()), tuple(store.fits()))
    history, modes, stage = log.history, result.conclusion.failure_modes, result.study.campaign.stages[-1]
    racing, told = shares(len(modes))
    raced = np.isin(history.iteration, batches_by(log, RACE))
    assert len(modes) > 1
    assert DISCS["rates"](np.array([list(modes[0].inputs.values())]))[0] == 0.9
    assert modes[0].metric > min(mode.metric for mode in modes)  # the deepest is not the first
    assert int(raced.sum()) == racing == result.conclusion.raced
    assert [mode.failure_rate.runs for mode in modes] == told == [mode.confirmation_runs for mode in modes]
    links = np.isin(history.iteration, batches_by(log, LINK))
    assert len(history) == len(search_runs(history)) + racing + sum(told) + links.sum()
    assert history.index[raced].max() < history.index[(history.stage == CONFIRM) & ~raced & ~links].min()
    said = " ".join(result.conclusion.sentences(Facts(history, scenario.requirement)))
    assert "not of how deep they are" in said
    assert f"{racing} repetitions that count in no rate" in said
    for batch in log.iterations:
        if batch.stage == CONFIRM:
            known = Log(history.where(history.iteration < batch.number), log.iterations[: batch.number], ())
            rows = history.where(history.iteration == batch.number)
            assert [dict(run.inputs) for run in stage.propose(known).runs] == [dict(rows.inputs(k)) for k in range(len(rows))]
    assert stage.stop(log) == "budget"
