"""Runs of one warm-up are not independent of each other: what intervals make of that."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import sbt
from sbt.campaigns.again import reused
from sbt.campaigns.asking import answer
from sbt.campaigns.clustering import clustered_interval, spread_of_batches
from sbt.campaigns.gate import Limits
from sbt.estimators.binomial import interval
from sbt.estimators.clusters import clustered_error, deviations, effective_runs, reach
from sbt.estimators.importance import draw_systematic, plan_batch
from sbt.estimators.intervals import CountedBatch, combine_estimates
from sbt.estimators.two_level import TwoPhases, drawn, inclusion
from sbt.loop.stages import Log
from sbt.store.database import Store
from sbt.workflows.asking import _settings
from sbt.workflows.paired import Pairs
from sbt.workflows.study import Study


def test_the_spread_between_clusters_is_covered_where_that_of_runs_alone_is_not():
    rng, share, covered, naive = np.random.default_rng(1), 0.2, 0, 0
    cluster = np.repeat(np.arange(20), 15)
    for _ in range(400):
        of_cluster = rng.beta(share * 8, (1 - share) * 8, 20)  # warm-ups differ: standard deviation .13
        critical = (rng.random(300) < of_cluster[cluster]).astype(float)
        hits, n = critical.sum(), 300.0
        part = effective_runs(critical, cluster) / n
        low, high = interval(hits * part, n * part)
        covered += low <= share <= high
        low, high = interval(hits, n)
        naive += low <= share <= high
    assert covered >= 0.93 * 400
    assert naive < 0.85 * 400


def test_independent_runs_in_clusters_lose_little():
    rng = np.random.default_rng(2)
    parts = [effective_runs((rng.random(400) < 0.3).astype(float), np.arange(400) % 20) / 400 for _ in range(50)]
    assert 0.7 < np.median(parts) <= 1.0


def test_a_single_cluster_tells_nothing_of_others():
    assert clustered_error(np.array([0.1, -0.1]), np.array([3, 3])) is None
    assert effective_runs(np.array([1.0, 0.0, 0.0]), np.zeros(3)) == 3.0


def test_failed_runs_of_one_cluster_are_no_independent_ones():
    """All 23 failed runs began with one of four warm-ups: the upper end counts them as critical, and as a cluster."""
    hits, warm_up = np.zeros(120, dtype=bool), np.arange(120) % 4
    failed = (warm_up == 3) & (np.arange(120) < 92)
    assert failed.sum() == 23
    alone, clustered = clustered_interval(failed), clustered_interval(failed, warm_up.astype(float))
    assert alone == pytest.approx(tuple(float(end) for end in interval(23, 120)))
    assert clustered[1] > 0.6 > alone[1]
    none = np.zeros(120, dtype=bool)
    apart, together = (Pairs(hits, failed, none, none, cluster).difference() for cluster in (None, warm_up.astype(float)))
    assert together[0] < apart[0]
    assert together[1] > apart[1]


def test_the_error_of_sums_is_that_of_their_clusters():
    terms, cluster = np.array([0.3, 0.1, -0.2, -0.2]), np.array([0, 0, 1, 1])
    assert clustered_error(terms, cluster) == pytest.approx(np.sqrt(2 * (0.4**2 + 0.4**2)))
    assert reach(1.0, 2, 0.975) == pytest.approx(12.706, abs=1e-3)


@pytest.mark.parametrize("method", [pytest.param("difference", marks=pytest.mark.slow), "monte_carlo"])
def test_an_estimate_on_warm_ups_has_their_spread(tmp_path, method):
    """A campaign whose store says that seeds are those of 20 warm-ups, which decide everything."""

    def evaluate(values, seed):
        return {"y": values["x"] + (1.5 if seed % 20 < 5 else 0.0)}

    inputs = [sbt.Parameter("x", -4, 4, "", sbt.Normal(0, 1))]
    scenario = sbt.Scenario("warm", inputs=inputs, evaluate=evaluate, requirement=sbt.Requirement("y", low=1.8))
    common = {"campaign": "estimation", "scenario": scenario, "budget": 150, "seed": 1, "stop": {"cov": None}}
    plain = sbt.run(**common, acquisition=method, store=tmp_path / "plain", executor={"kind": "serial"}).conclusion
    assert plain.warmed_traffic is None
    with Store.read(tmp_path / "plain") as store:
        history = store.history()
        history.columns["warm_up"][:] = history.columns["seed"] % 20
        study = Study.from_store(store, objects={("scenarios", "object:warm"): scenario}, live=True)
        log = Log(history, tuple(store.iterations()), ())
        found, _ = study.campaign.conclude(log)
    again = answer(reused(log, _settings(study, scenario.requirement), study.scenario.space, scenario.requirement))
    assert again.warmed_traffic.warm_ups == 20
    assert again.high - again.low > 0.8 * (found.high - found.low)
    assert again.low < plain.low
    traffic = found.warmed_traffic
    assert traffic.warm_ups == 20
    assert found.low < plain.low
    assert found.high > plain.high
    assert "conditional on the traffic of 20 warm-ups; the interval has the spread" in traffic.sentence()
    assert dataclasses.replace(found, warmed_traffic=None).probability == plain.probability


def test_requirements_and_the_rule_of_precision_know_of_the_spread_between_warm_ups(tmp_path):
    def evaluate(values, seed):
        warm = 1.5 if seed % 20 < 5 else 0.0
        return {"y": values["x"] + warm, "z": values["x"] - warm}

    inputs = [sbt.Parameter("x", -4, 4, "", sbt.Normal(0, 1))]
    requirement = sbt.any_of(sbt.Requirement("y", low=1.0), sbt.Requirement("z", high=-1.0))
    scenario = sbt.Scenario("warm", inputs=inputs, evaluate=evaluate, requirement=requirement)
    store = tmp_path / "store"
    common = {"campaign": "estimation", "acquisition": "monte_carlo", "executor": {"kind": "serial"}, "seed": 1, "initial": 100}
    plain = sbt.run(scenario=scenario, budget=2000, batch=100, stop={"cov": 0.1}, store=store, **common)
    with Store.read(store) as opened:
        history, iterations = opened.history(), tuple(opened.iterations())
        study = Study.from_store(opened, objects={("scenarios", "object:warm"): scenario}, live=True)
        (stage,) = study.campaign.stages
        assert stage.stop(Log(history, iterations, ())) == "cov"
        history.columns["warm_up"][:] = history.columns["seed"] % 20
        assert stage.stop(Log(history, iterations, ())) is None
        found, _ = study.campaign.conclude(Log(history, iterations, ()))
    for before, after in zip(plain.conclusion.requirements, found.requirements, strict=True):
        assert after.probability == before.probability
        assert after.high - after.low > 1.2 * (before.high - before.low)


def test_traffic_is_said_to_differ_only_where_it_does_beyond_chance():
    """Runs that do not depend on their warm-ups: at most 1 % of the campaigns say so, and nearly all where traffic decides."""
    rng, told = np.random.default_rng(0), {0.0: 0, 0.3: 0}
    warm_up = np.arange(200) % 20
    for spread in told:
        for _ in range(200):
            share = 0.4 + spread * rng.choice([-1.0, 1.0], 20)
            critical = (rng.random(200) < share[warm_up]).astype(float)
            found = spread_of_batches(warm_up, [CountedBatch(0.0, 0.0, 0.0, np.ones(200), np.zeros(200), critical)])
            told[spread] += found.differs
            assert found.differs or not found.decides(found.std_error_apart / 0.4, 0.4)
    assert told[0.0] <= 8
    assert told[0.3] >= 190


def test_the_upper_end_has_the_spread_of_failed_runs_too():
    """Five critical draws in as many warm-ups, and four that fail in one: failed as critical that one stands out."""
    n, warm_up = 160, np.arange(160) % 20
    critical, failed = np.isin(np.arange(n), [0, 1, 2, 3, 4]), np.isin(np.arange(n), [7, 27, 47, 67])
    even = [CountedBatch(0.0, 0.0, 0.0, np.ones(n), np.zeros(n), hits.astype(float)) for hits in (critical, critical | failed)]
    found = spread_of_batches(warm_up, [even[0]], [even[1]])
    sums = np.bincount(warm_up, weights=(critical | failed) - (critical | failed).mean()) / n
    assert found.std_error_failed == pytest.approx(math.sqrt(20 / 19 * (sums**2).sum()), rel=0.01)
    assert found.std_error_failed > 2.0 * found.std_error
    none = Limits(lambda _: 0.03, lambda _: 0.03)
    assert found.widened(none, 5 / n, 9 / n).upper(0.975) == pytest.approx(9 / n + reach(found.std_error_failed, 20, 0.975))
    assert found.widened(none, 5 / n, 9 / n).lower(0.975) == max(5 / n - reach(found.std_error, 20, 0.975), 0.0)
    assert spread_of_batches(warm_up, [even[0]], [even[0]]).std_error_failed is None
    nothing = CountedBatch(0.0, 0.0, 0.0, np.ones(n), np.zeros(n), np.zeros(n))
    assert "is not in the interval" in spread_of_batches(warm_up, [nothing]).sentence()


@pytest.mark.parametrize("known", ["coarse runs", "traffic of the pairs"])
def test_what_is_known_of_pairs_before_their_runs_takes_no_spread_between_warm_ups_away(known):
    """Six warm-ups of which each decides its runs: the error of the estimate is that of six draws, however sharp the belief."""
    rng, k, values, errors = np.random.default_rng(3), 6, [], []
    for _ in range(300):
        share = rng.choice([0.02, 0.95], k)
        batches, warm_up = [], []
        for _ in range(3):
            seeds = rng.integers(0, 10**6, 300)
            hits, g = (rng.random(300) < share[seeds % k]).astype(float), share[seeds % k]
            if known == "coarse runs":
                first, second = np.ones(300), inclusion(np.sqrt(g * (1 - g)), np.ones(300), 60, fine=True)
                rows = drawn(second, g, rng)
                phases = TwoPhases(300, 0.0, 0.0, np.zeros(300), first, g, second)
                batch = CountedBatch(
                    phases.prior, phases.anticipated(len(rows)), phases.pool_variance, phases.coefficient(rows), g[rows],
                    hits[rows], weight=len(rows) + 30.0, by_warm_up=phases.by_warm_up(seeds, k),
                )  # fmt: skip
            else:
                flat = np.zeros(300)
                plan = plan_batch(np.log(g), np.log1p(-g), flat, flat, flat, (0.8, 0.2, 0.0, 0.0), "difference")
                draws = draw_systematic(plan, 60, np.log(g) - np.log1p(-g), rng)
                plan, rows = draws.plan, draws.rows
                batch = CountedBatch(
                    plan.prior, plan.anticipated, plan.pool_variance, draws.coefficient, draws.control_variate, hits[rows],
                    by_warm_up=deviations(plan.weight * g, plan.weight, seeds, k),
                )  # fmt: skip
            batches.append(batch)
            warm_up.append(seeds[rows] % k)
        values.append(combine_estimates(batches).value)
        found = spread_of_batches(np.concatenate(warm_up), batches)
        errors.append(found.std_error)
        assert found.warm_ups == k
    between = math.sqrt(0.93**2 / 4 / k)  # standard error of the mean of six warm-ups
    assert np.std(values) == pytest.approx(between, rel=0.15)
    assert np.mean(np.square(errors)) == pytest.approx(np.var(values), rel=0.2)
