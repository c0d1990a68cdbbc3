"""Runs that fail: the campaigns learn where, and neither go there nor count it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt import testbeds
from sbt.metamodels.success import failure_probability, learned_success
from sbt.seeds import stream

AWAY = 0.25
"""Largest share of the guided runs that may fail."""


def campaign(kind: str, testbed: str, folder: Path, budget: int, seed: int = 1) -> sbt.Result:
    return sbt.run(
        campaign=kind, scenario=f"testbed:{testbed}", seed=seed, budget=budget, executor="serial", store=folder / "s",
        report=False,
    )


SHARES = {"needle_half_fails": 0.5, "hartmann6_third_fails": 0.379, "wavy_half_fails": 0.4987}


@pytest.mark.parametrize(("name", "share"), SHARES.items())
def test_the_testbeds_fail_where_they_say(name: str, share: float):
    problem = testbeds.find(name)
    y = problem.function(stream(1, name).random((100_000, len(problem.parameters))))
    assert np.isnan(y).mean() == pytest.approx(share, abs=0.006)


@pytest.mark.parametrize("testbed", ["needle_half_fails", "hartmann6_third_fails"])
def test_a_search_stays_where_runs_give_a_metric(testbed: str, tmp_path: Path):
    frame = campaign("falsification", testbed, tmp_path, 70, seed=2).frame
    guided = frame[frame.stage == "search"]
    assert len(guided) > 50
    assert (guided.status != "ok").mean() <= AWAY
    assert frame.critical.fillna(False).any()


@pytest.mark.slow
def test_a_boundary_stays_there_and_states_shares_of_what_gives_a_metric(tmp_path: Path):
    result = campaign("boundary", "wavy_half_fails", tmp_path, 150)
    guided = result.frame[result.frame.stage == "boundary"]
    assert len(guided) > 100
    assert (guided.status != "ok").mean() <= AWAY
    critical, failing = testbeds.truth("wavy_half_fails").probability, SHARES["wavy_half_fails"]
    assert result.conclusion.failing_fraction == pytest.approx(failing, abs=0.06)
    assert result.conclusion.critical_fraction == pytest.approx(critical / (1 - failing), rel=0.1)
    assert "of the parameter space gives no metric" in result._repr_html_()


@pytest.mark.parametrize(
    ("method", "seed"), [("log_expected_improvement", 2), ("lower_confidence_bound", 2), ("thompson", 2), ("u", 1)]
)
def test_every_method_stays_there(method: str, seed: int, tmp_path: Path):
    """Of `u`, which has no margin to go by, on one seed where it meets the needle: without it .4 of its runs fail."""
    result = sbt.run(
        campaign="falsification", scenario="testbed:needle_half_fails", seed=seed, budget=40, acquisition=method,
        executor="serial", store=tmp_path / "s", report=False, stop={"failures": None},
    )  # fmt: skip
    guided = result.frame[result.frame.stage == "search"]
    assert (guided.status != "ok").mean() <= AWAY


def test_p_of_success_is_a_probability_and_never_learned_from_success_alone():
    rng = stream(3, "success")
    u = rng.random((60, 2))
    assert learned_success(u, np.ones(60, bool), rng) is None
    assert learned_success(u, np.zeros(60, bool), rng) is None
    score = learned_success(u, u[:, 0] < 0.5, rng)
    assert score is not None
    inside, outside = np.array([[0.1, 0.5]]), np.array([[0.9, 0.5]])
    assert np.exp(score(inside)) > 0.9
    assert score(outside) == -np.inf
    at_random = learned_success(u, rng.random(60) < 0.8, rng)  # failures that no input explains
    assert at_random is not None
    assert np.exp(at_random(rng.random((500, 2)))).mean() == pytest.approx(0.8, abs=0.12)


def test_p_of_failure_is_never_certain():
    rng = stream(4, "failure")
    u = rng.random((60, 2))
    p = failure_probability(u, u[:, 0] < 0.5, rng)(np.array([[0.1, 0.5], [0.9, 0.5]]))
    assert p.tolist() == pytest.approx([1 / 62, 61 / 62])


def test_an_estimation_states_both_readings(tmp_path: Path):
    """Half of the space fails, and most of the critical region: x1 + x2 > 3 sqrt(2) where x1 - 0.5 x2 > 0."""
    scenario = sbt.Scenario(
        "half", inputs=[sbt.Parameter(name, -np.inf, np.inf, "", sbt.Normal(0.0, 1.0)) for name in ("a", "b")],
        evaluate=lambda v, _: {"y": np.nan if v["a"] > 0.5 * v["b"] else 3.0 - (v["a"] + v["b"]) / np.sqrt(2.0)},
        requirement=sbt.Requirement("y", high=0.0),
    )  # fmt: skip
    z = stream(5, "truth").standard_normal((2_000_000, 2))
    fails, critical = z[:, 0] > 0.5 * z[:, 1], z.sum(axis=1) > 3.0 * np.sqrt(2.0)
    safe, worst = (critical & ~fails).mean(), (critical | fails).mean()
    result = sbt.run(
        campaign="estimation", scenario=scenario, seed=1, budget=90, executor="serial", store=tmp_path / "s", report=False,
        stop={"cov": None},
    )  # fmt: skip
    for found in (result.conclusion, result.estimate()):
        assert found.low <= safe <= found.failed_as_safe + found.failed_as_critical
        assert found.failed_as_safe == pytest.approx(safe, rel=0.5)
        assert found.failed_as_critical == pytest.approx(worst, rel=0.25)
        assert found.low > 0.0
        assert worst <= found.high < 1.0


def test_runs_that_fail_for_no_reason_do_not_stop_the_search(tmp_path: Path):
    problem = testbeds.find("needle_d4_1e-3")

    def flaky(values: dict[str, float], seed: int) -> dict[str, float]:
        y = float(problem.function(np.array([list(values.values())]))[0])
        return {"y": np.nan if stream(seed, "flaky").random() < 0.3 else y}

    scenario = sbt.Scenario("flaky", inputs=problem.parameters, evaluate=flaky, requirement=sbt.Requirement("y", high=0.0))
    result = sbt.run(
        campaign="falsification", scenario=scenario, seed=3, budget=80, executor="serial", store=tmp_path / "s", report=False
    )
    assert result.frame.critical.fillna(False).any()
    assert 0.15 < (result.frame.status != "ok").mean() < 0.45


def test_a_boundary_says_what_failing_leaves_open(tmp_path: Path):
    """Runs fail right beyond contact, so that what is critical ends where nobody looks: .167 of what gives a metric."""

    def crash(inputs: dict[str, float], seed: int) -> dict[str, float]:
        y = inputs["a"] + inputs["b"] - inputs["c"]
        if y < 0.1:
            raise sbt.RunError("failed", "no metric beyond a contact")
        return {"y": y}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = sbt.Scenario("crash", inputs, sbt.Requirement("y", high=0.3), evaluate=crash)
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=80, seed=1, executor="serial", store=tmp_path / "s", report=False,
    )  # fmt: skip
    least, most = result.conclusion.critical_range
    assert least < 0.167 < most
    assert any(told.endswith("may be critical.") for told in result.sentences())


def test_one_run_is_too_few_and_none_failed(tmp_path: Path):
    result = sbt.run(
        campaign="boundary", scenario="testbed:gayton_hat", budget=1, executor="serial", store=tmp_path / "s", report=False
    )
    assert not any("failed" in told for told in result.sentences())
