"""Metrics that end at the critical edge, such as a distance that is 0 in every collision, and metrics that come in steps."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

import sbt
from sbt.estimators.surrogate import fit_log_probability
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.saturation import Opened, centred, opened, scored
from sbt.problem.requirement import CriticalInterval
from sbt.samplers.search import Search, fit_warped
from tests.measured_runs import Runs

CRITICAL = CriticalInterval(high=0.0)


def test_runs_at_the_edge_go_into_it_and_others_stay():
    rng = np.random.default_rng(1)
    u = rng.random((200, 3))
    distance = np.linalg.norm(u - 0.5, axis=1) - 0.45
    y = np.maximum(distance, 0.0)
    found = opened(u, y, CRITICAL, np.random.default_rng(0))
    assert np.array_equal(found[y > 0], y[y > 0])
    assert (found[y == 0] < 0).all()
    assert np.corrcoef(found, distance)[0, 1] > 0.9
    other = opened(u, -y, CriticalInterval(low=0.0), np.random.default_rng(0))
    assert np.array_equal(other, -found), "the other direction likewise"


@pytest.mark.parametrize(
    ("y", "critical"),
    [
        ([0.0, 0.0, 1.0, -0.1], CRITICAL),  # one lies beyond: the metric goes on
        ([0.0, 0.5, 1.0, 2.0], CRITICAL),  # one at the edge may be there by chance
        ([0.0, 0.0, 1.0, 0.5], CriticalInterval(0.0, 0.2)),
    ],
)
def test_a_metric_that_goes_on_is_left_alone(y, critical):
    values = np.array(y)
    assert opened(np.linspace(0, 1, 4)[:, None], values, critical, np.random.default_rng(0)) is values


@pytest.mark.parametrize(
    ("shape", "two_ends", "one_end"),
    [
        (lambda d: np.maximum(6.0 * d + 1.5, 0.0), CriticalInterval(0.0, 1.5), CriticalInterval(high=1.5)),  # a TTC
        (lambda d: 1.0 * (d <= 0.0), CriticalInterval(1.0, 1.0), CriticalInterval(low=1.0)),  # a flag
    ],
)
def test_an_end_that_the_metric_ends_at_makes_no_difference(shape, two_ends, one_end):
    """To boundaries, estimations and searches; before, P(critical) was about a half wherever the metric is 0, and 0 of a flag."""
    rng = np.random.default_rng(2)
    u, at = rng.random((50, 2)), rng.random((200, 2))
    y = shape(np.linalg.norm(u - 0.5, axis=1) - 0.4)

    def answers(critical):
        learned = Opened(GaussianProcess(nu=2.5), critical).fit(u, y, np.random.default_rng(0))
        search, _ = Search(critical, GaussianProcess(nu=2.5)).reached(u, y)
        search = fit_warped(search, u, y, np.random.default_rng(0))
        belief = fit_log_probability(GaussianProcess(nu=2.5), lambda z: z, critical, u, y, np.random.default_rng(0))
        return learned(at).probability(critical), np.exp(search.log_probability(at)), np.exp(belief(at)[0])

    for found, expected in zip(answers(two_ends), answers(one_end), strict=True):
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)
        assert found.max() > 0.9 > 0.1 > found.min()


def test_an_end_that_no_run_lies_beyond_does_not_rank_them_nor_hide_a_jump():
    """Of speeds of impact in [.1, 100] the fastest is the worst; what is learned is what [.1, null] gives."""
    need, runs = sbt.Requirement("impact", 0.1, 100.0), Runs(impact=np.array([0.0, 0.0, 7.0, 60.0, 90.0]))
    assert need.depths(runs).argsort()[:2].tolist() == [4, 3]
    assert need.depths(Runs(impact=np.array([0.0, 7.0, 60.0, 120.0]))).argsort()[0] == 2
    rng = np.random.default_rng(2)
    u, at = rng.random((60, 2)), rng.random((300, 2))
    y = 15.0 * np.sqrt(np.maximum(0.4 - np.linalg.norm(u - 0.5, axis=1), 0.0))
    found, expected = (
        Opened(GaussianProcess(nu=2.5), critical).fit(u, y, np.random.default_rng(0))(at).probability(need.critical)
        for critical in (need.critical, CriticalInterval(low=0.1))
    )
    assert found == pytest.approx(expected, abs=1e-12)


def test_an_end_that_the_metric_ends_at_does_not_rank_runs():
    """Of times to collision in [0, 1.5] the collision is the worst, not the run in the middle."""
    need, runs = sbt.Requirement("ttc", 0.0, 1.5), Runs(ttc=np.array([0.7, 0.0, 0.0, 1.4, 3.0]))
    assert need.margins(runs).tolist() == pytest.approx([-0.7, 0.0, 0.0, -0.1, 1.5])
    assert need.depths(runs).tolist() == pytest.approx([-0.8, -1.5, -1.5, -0.1, 1.5])
    assert sbt.Requirement("ttc", 0.5, 1.5).depths(runs).tolist() == pytest.approx([-0.2, 0.5, 0.5, -0.1, 1.5])


def test_of_a_metric_that_ends_its_values_are_scored():
    y, mu, critical = np.array([0.0, 0.0, 1.0, 3.0]), np.array([-0.7, 0.2, 0.9, 2.8]), CriticalInterval(0.0, 1.5)
    assert scored(y, mu, critical).tolist() == [-0.7, 0.0, 1.0, 3.0]
    assert scored(y, mu, CriticalInterval(0.5, 1.5)).tolist() == y.tolist()


def test_where_all_runs_are_at_the_edge_all_is_critical():
    assert (opened(np.random.default_rng(0).random((5, 2)), np.zeros(5), CRITICAL, np.random.default_rng(0)) < 0).all()


def test_of_a_run_at_the_edge_its_side_is_scored():
    y, mu = np.array([0.0, 0.0, 1.0]), np.array([-0.4, 0.2, 0.9])
    assert scored(y, mu, CRITICAL).tolist() == [-0.4, 0.0, 1.0]
    assert scored(np.array([0.0, -1.0]), mu[:2], CRITICAL).tolist() == [0.0, -1.0]


@pytest.mark.parametrize("edge", [-1e-9, -0.02])
@pytest.mark.parametrize("critical_runs", [18, 1])
def test_runs_that_nothing_happens_in_go_away_from_the_edge(edge: float, critical_runs: int):
    """A speed of impact is 0 in all of them; those farther from a critical run go farther, also where one alone is known."""
    rng = np.random.default_rng(1)
    u = rng.random((300, 3))
    distance = np.linalg.norm(u - 0.5, axis=1) - 0.3
    order = np.argsort(distance)
    left_out = order[critical_runs : (distance < 0.0).sum()]
    u, distance = np.delete(u, left_out, axis=0), np.delete(distance, left_out)
    y, critical = np.minimum(distance, 0.0), CriticalInterval(high=edge)
    found = opened(u, y, critical, np.random.default_rng(0))
    nothing = y == 0.0
    assert np.array_equal(found[~nothing], y[~nothing])
    assert (found[nothing] > 0.0).all()
    assert np.corrcoef(found[nothing], distance[nothing])[0, 1] > 0.6
    other = opened(u, -y, CriticalInterval(low=-edge), np.random.default_rng(0))
    assert np.array_equal(other, -found), "the other direction likewise"
    two_ends = opened(u, y, CriticalInterval(-0.2, edge), np.random.default_rng(0))
    assert np.array_equal(two_ends, found), "the other end does not matter"
    held_out = scored(y, np.where(nothing, 0.2, y - 0.1), critical)
    assert held_out.tolist() == np.where(nothing, 0.2, y).tolist()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_metric_that_ends_deep_in_the_critical_region_goes_on(sign: float):
    """A time to collision is 0 in every collision, and critical up to 1.5 s."""
    rng = np.random.default_rng(3)
    u, at = rng.random((100, 3)), rng.random((2000, 3))

    def time(x):
        return 10.0 * (np.linalg.norm(x - 0.5, axis=1) - 0.3)

    critical = CriticalInterval(high=1.5) if sign > 0 else CriticalInterval(low=-1.5)
    y = sign * np.maximum(time(u), 0.0)
    found, ended = opened(u, y, critical, np.random.default_rng(0)), y == 0.0
    assert np.array_equal(found[~ended], y[~ended])
    assert np.corrcoef(sign * found[ended], time(u[ended]))[0, 1] > 0.7
    p = Opened(GaussianProcess(nu=2.5, input_noise=False), critical).fit(u, y, rng)(at).probability(critical)
    inside = time(at) <= 1.5
    assert ((p > 0.5) != inside).mean() < 0.01
    assert scored(y, np.where(ended, sign * -2.0, y), critical).tolist() == np.where(ended, sign * -2.0, y).tolist()


@pytest.mark.parametrize("low", [0.0, -0.5, -5.0])
def test_what_goes_on_is_critical_however_far_an_end_is_that_no_run_lies_beyond(low: float):
    """Times of 0 in collisions, in [-0.5, 1]: what is learned of them lies below -0.5, and is no less critical."""
    rng = np.random.default_rng(4)
    u, at = rng.random((80, 2)), rng.random((2000, 2))
    critical = CriticalInterval(low, 1.0)
    y = np.maximum(3.0 * (u[:, 0] - 0.4), 0.0)
    p = Opened(GaussianProcess(nu=2.5, input_noise=False), critical).fit(u, y, rng)(at).probability(critical)
    assert ((p > 0.5) == (3.0 * (at[:, 0] - 0.4) <= 1.0)).mean() > 0.99


def test_repetitions_of_the_deepest_run_are_no_end_of_the_metric():
    u = np.append(np.linspace(0, 1, 12), [0.0, 0.0])[:, None]
    y = np.append(np.linspace(-1, 4, 12), [-1.0, -1.0])
    assert opened(u, y, CriticalInterval(high=0.0), np.random.default_rng(0)).tolist() == y.tolist()


@pytest.mark.parametrize(
    ("y", "critical"),
    [
        ([-5.0, -5.0, 0.4, 0.5, 0.6, 0.9, 1.2, 2.0, 3.0, 4.0], CriticalInterval(high=0.5)),  # a collision counts -5: a jump
        ([0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], CriticalInterval(high=0.5)),  # a flag
        ([0.0, 0.2, 0.3, 0.4, 0.5, 0.9, 1.2, 2.0, 3.0, 4.0], CriticalInterval(high=0.5)),  # it goes on
    ],
)
def test_a_metric_that_jumps_to_its_last_value_is_left_alone(y, critical):
    found = opened(np.linspace(0, 1, 10)[:, None], np.array(y), critical, np.random.default_rng(0))
    assert found.tolist() == y


@pytest.mark.parametrize(
    ("y", "critical"),
    [
        ([0.0, 0.0, 0.0, -1.0, -1.0], CriticalInterval(high=-0.5)),  # a flag has no depth
        ([0.0, 0.0, 0.0, -1.0, -2.0], CriticalInterval(high=-0.9)),  # it ends far from the edge
        ([0.0, 0.1, 0.2, 0.3, -2.0], CriticalInterval(high=-0.1)),  # it goes on
        ([0.0, 0.0, 0.0, 0.0, 0.0], CriticalInterval(high=-0.1)),  # nothing is critical
    ],
)
def test_a_metric_that_does_not_end_near_the_edge_is_left_alone(y, critical):
    values = np.array(y)
    found = opened(np.linspace(0, 1, 5)[:, None], values, critical, np.random.default_rng(0))
    assert found.tolist() == y


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_edge_of_a_metric_in_steps_lies_midway_between_two_of_them(sign):
    u = np.arange(7.0)[:, None]
    y = np.array([-2.0, -1.0, 0.0, 0.0, 1.0, 1.0, 2.0])
    for edge in (0.0, 0.3):  # what lies between two steps makes no difference
        critical = CriticalInterval(high=edge) if sign > 0 else CriticalInterval(low=-edge)
        found = centred(u, sign * y, critical)
        assert np.array_equal(critical.contains(found), critical.contains(sign * y))
        assert (sign * found).tolist() == [-2.0, -1.0, edge - 0.5, edge - 0.5, edge + 0.5, edge + 0.5, 2.0]
        assert opened(u, sign * y, critical, np.random.default_rng(0)).tolist() == found.tolist()


@pytest.mark.parametrize(
    ("u", "y", "critical"),
    [
        ([0, 1, 2, 3, 4], [-1.0, 0.0, 0.0, 1.0, 2.0], CRITICAL),  # one value next to the edge may be there by chance
        ([0, 1, 1, 3, 3], [-1.0, 0.0, 0.0, 1.0, 1.0], CRITICAL),  # repetitions of the same inputs are no step
        ([0, 1, 2, 3, 4], [-1.0, 0.0, 0.0, 1.0, 1.0], CriticalInterval(-0.5, 0.5)),
        ([0, 1, 2, 3, 4], [1.0, 1.0, 2.0, 2.0, 2.0], CRITICAL),  # nothing is critical
    ],
)
def test_a_metric_without_steps_is_left_alone(u, y, critical):
    values = np.array(y)
    assert centred(np.array(u, dtype=float)[:, None], values, critical) is values


@pytest.mark.parametrize("campaign", ["boundary", "coverage"])
def test_of_a_count_the_stated_share_is_right(tmp_path, campaign):
    """Conflicts are counted: 0 to 9 on the square, two or fewer are critical where 2.5 would be."""
    scenario = sbt.Scenario(
        "count", inputs=[sbt.Parameter(name, 0.0, 1.0) for name in "ab"],
        evaluate=lambda v, _: {"conflicts": float(round(9.0 * math.hypot(v["a"], v["b"]) / math.sqrt(2.0)))},
        requirement=sbt.Requirement("conflicts", high=2.0),
    )  # fmt: skip
    found = sbt.run(
        campaign=campaign, scenario=scenario, budget=60, seed=0, executor="serial", store=tmp_path / "s", report=False,
        metamodel={"kind": "gp", "nu": 2.5, "input_noise": False},
    )  # fmt: skip
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101)), axis=-1).reshape(-1, 2)
    critical = 9.0 * np.hypot(*grid.T) / math.sqrt(2.0) < 2.5
    p = found.predict(pd.DataFrame(grid, columns=["a", "b"]))["p_critical"].to_numpy()
    assert ((p > 0.5) == critical).mean() > 0.98
    assert p.mean() == pytest.approx(critical.mean(), abs=0.01)


def disc(values, seed):
    """A distance, 0 in the disc."""
    return {"gap": max(math.hypot(values["a"] - 0.6, values["b"] - 0.4) - 0.25, 0.0)}


def corner(values, seed):
    """Normal inputs; 0 beyond two standard deviations."""
    return {"gap": max(2.0 - (values["a"] + values["b"]) / math.sqrt(2.0), 0.0)}


@pytest.mark.slow
def test_a_boundary_is_where_a_metric_ends(tmp_path):
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]
    scenario = sbt.Scenario("disc", inputs, sbt.Requirement("gap", high=0.0), evaluate=disc, metrics=["gap"])
    result = sbt.run(campaign="boundary", scenario=scenario, budget=60, seed=0, store=tmp_path / "s", executor="serial")
    a, b = np.random.default_rng(0).random((2, 2000))
    critical, found = np.hypot(a - 0.6, b - 0.4) <= 0.25, result.predict({"a": a, "b": b})["p_critical"].to_numpy() > 0.5
    assert result.conclusion.critical_fraction == pytest.approx(math.pi * 0.25**2, rel=0.1)
    assert 2 * (critical & found).sum() / (critical.sum() + found.sum()) > 0.93


@pytest.mark.slow
def test_an_estimate_of_a_metric_that_ends_covers(tmp_path):
    inputs = [sbt.Parameter(name, -6, 6, "", sbt.Normal(0.0, 1.0)) for name in "ab"]
    scenario = sbt.Scenario("corner", inputs, sbt.Requirement("gap", high=0.0), evaluate=corner, metrics=["gap"])
    result = sbt.run(
        campaign="estimation", scenario=scenario, budget=120, seed=0, store=tmp_path / "s", executor="serial", report=False,
        stop={"cov": None},
    )  # fmt: skip
    truth = 0.02275
    assert result.conclusion.low <= truth <= result.conclusion.high
    assert result.conclusion.probability == pytest.approx(truth, rel=0.15)


def test_what_all_runs_are_alike_in_is_called_no_lead(tmp_path):
    """No run is the closest, or the worst, of a metric that is 0 or 1."""
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]

    def said(size, seed):
        def bump(values, seed):
            return {"bump": float(math.hypot(values["a"] - 0.5, values["b"] - 0.5) < size)}

        scenario = sbt.Scenario("bump", inputs, sbt.Requirement("bump", low=1.0), evaluate=bump, metrics=["bump"])
        store = tmp_path / f"{size}"
        keys = {"campaign": "falsification", "budget": 30, "seed": seed, "executor": "serial", "report": False}
        return sbt.run(scenario=scenario, store=store, **keys).sentences()

    found = said(0.2, 1)[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "one of the worst" in found
    assert "in 1 failure mode" in found or "1 distinct failure mode" in found
    assert "runs at 28 inputs came equally close" in said(0.0, 1)[2].replace("\N{NO-BREAK SPACE}", " ")


@pytest.mark.slow
def test_hits_of_a_metric_of_few_values_are_repeated_until_a_seed_disagrees(tmp_path):
    """Two repeats of 0 or 1 agree by chance: taken for deterministic, the search would leave a place that often fails."""
    inputs = [sbt.Parameter("a", 0, 1), sbt.Parameter("b", 0, 1)]

    def hit(values, seed):
        rate = 0.8 * math.exp(-((values["a"] - 0.6) ** 2 + (values["b"] - 0.4) ** 2) / (2 * 0.12**2))
        return {"hit": float(np.random.default_rng(seed).random() < rate)}

    scenario = sbt.Scenario("hit", inputs, sbt.Requirement("hit", low=1.0), evaluate=hit, metrics=["hit"])
    found = []
    for seed in (1, 2, 3):
        keys = {"campaign": "falsification", "budget": 60, "seed": seed, "executor": "serial", "report": False}
        result = sbt.run(scenario=scenario, store=tmp_path / f"{seed}", **keys)
        found.append(result.conclusion.critical_runs)
        assert result.conclusion.simulator_noise.noisy
    assert np.median(found) > 60 * 0.8 * 2 * math.pi * 0.12**2, "as many random runs"
