"""Metrics of few values: repeats that agree by chance prove no determinism, and what tells of nothing is not followed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sbt
from sbt.campaigns.counting import crude_rows
from sbt.seeds import stream
from sbt.store.history import History, Record

INPUTS = [sbt.Parameter("n", 1, 5, kind="integer"), sbt.Parameter("k", choices={"x": 0.7, "y": 0.3})]


def coin(rate: float, where=lambda values: True):
    """Fails with this share of the seeds."""
    return lambda values, seed: {"y": float(where(values) and stream(seed, "coin").random() < rate)}


def campaign(kind: str, evaluate: Any, store: Path, *, inputs=INPUTS, budget=100, seed=0, **keys: Any) -> sbt.Result:
    scenario = sbt.Scenario("few", inputs, sbt.Requirement("y", low=0.5), evaluate=evaluate)
    return sbt.run(
        campaign=kind, scenario=scenario, budget=budget, seed=seed, store=store, executor="serial", report=False, **keys
    )


def test_an_estimation_of_rare_flags_does_not_end_as_exact(tmp_path: Path):
    """Ten combinations, 5 % of the seeds fail: after a run of each half of the campaigns said that P is 0, and gates passed."""
    covered, passed = [], []
    for seed in range(6):
        found = campaign("estimation", coin(0.05), tmp_path / str(seed), seed=seed, gate={"probability": 0.01}).conclusion
        covered.append(found.low <= 0.05 <= found.high)
        passed.append(found.gate.verdict == "pass")
        assert found.low < found.high
    assert sum(covered) >= 5
    assert not any(passed)


@pytest.mark.parametrize("evaluate", [coin(0.05), coin(0.3, lambda v: v["n"] == 5 and v["k"] == "y")], ids=["any", "one"])
def test_a_search_goes_on_while_noise_would_hardly_show(evaluate: Any, tmp_path: Path):
    result = campaign("falsification", evaluate, tmp_path / "s")
    assert len(result.history) >= 100
    assert result.conclusion.critical_runs > 0


def test_where_nothing_differs_the_conclusion_does_not_rule_noise_out(tmp_path: Path):
    result = campaign("falsification", coin(0.0), tmp_path / "s", budget=40)
    said = " ".join(result.sentences())
    assert "None of all" not in said
    assert "noise would hardly show" in said


def test_a_flag_that_many_repeats_confirm_is_exact(tmp_path: Path):
    """The interval has what so many repeats may have missed, no more."""
    found = campaign("estimation", coin(1.0, lambda v: v["n"] >= 4), tmp_path / "s").conclusion
    assert found.probability == pytest.approx(0.4)
    assert 0.32 < found.low < 0.4 < found.high < 0.48
    assert found.counted < 100


def test_where_all_runs_have_one_metric_draws_count(tmp_path: Path):
    """A speed of impact in two normal inputs: two thirds of the budget searched where there is nothing to follow."""
    inputs = [sbt.Parameter(name, -6, 6, "", sbt.Normal(0, 1)) for name in "ab"]
    counted = []
    for seed in range(4):

        def speed(values, _):
            return {"y": max(0.0, 5.0 * (0.5 - np.hypot(values["a"] - 0.8, values["b"] - 0.4)))}

        result = campaign("estimation", speed, tmp_path / str(seed), inputs=inputs, budget=100, seed=seed, stop={"cov": None})
        first = result.history.iteration < 2
        if not (result.history.y("y")[first] > 0.0).any():
            counted.append(result.conclusion.counted)
    assert counted
    assert min(counted) >= 70


@pytest.mark.slow
def test_draws_that_count_end_where_values_come_that_can_be_followed(tmp_path: Path):
    """A metric with a cap that nothing comes below in the first fifth of the budget: 1 of 240 draws was critical."""
    centre, exact = np.array([1.2, -0.8, 0.6]), 0.003305
    inputs = [sbt.Parameter(name, -6, 6, "", sbt.Normal(0, 1)) for name in "abc"]

    def near(values, _):
        return {"y": min(float(np.linalg.norm(np.array(list(values.values())) - centre)) - 0.35, 0.25)}

    scenario = sbt.Scenario("well", inputs, sbt.Requirement("y", high=0.0), evaluate=near)
    result = sbt.run(
        campaign="estimation", scenario=scenario, budget=300, seed=7, store=tmp_path / "s", executor="serial", report=False,
        stop={"cov": None},
    )  # fmt: skip
    stages = set(result.history.stage)
    assert {"monte_carlo", "estimation"} <= stages
    assert result.conclusion.probability == pytest.approx(exact, rel=0.1)
    assert result.conclusion.low <= exact <= result.conclusion.high
    assert result.estimate().probability == pytest.approx(result.conclusion.probability, rel=0.1)  # not by the draws before


@pytest.mark.slow
def test_whether_draws_were_critical_does_not_decide_if_they_count(tmp_path: Path):
    """Those that had met none were left out, and those that had met one counted: 1.3 times P (90 campaigns)."""

    def drawn(told: dict[int, float]) -> int:
        """Return the number of random draws of a campaign where all runs but these have the metric 0."""
        calls = iter(range(1000))
        scenario = sbt.Scenario(
            "levels", [sbt.Parameter("a", -6, 6, "", sbt.Normal(0, 1))], sbt.Requirement("m", low=1.5),
            evaluate=lambda values, seed: {"m": told.get(next(calls), 0.0)},
        )  # fmt: skip
        result = sbt.run(
            campaign="estimation", scenario=scenario, budget=90, stop={"cov": None}, executor="serial", report=False,
            store=tmp_path / str(len(list(tmp_path.iterdir()))),
        )  # fmt: skip
        return int((result.history.stage == "monte_carlo").sum())

    stays = drawn({32: 2.0})
    assert drawn({32: 1.0}) == drawn({32: 1.0, 33: 2.0}) == 15  # one batch: then a metamodel draws
    assert drawn({60: 1.0}) == stays == 65  # half of the budget is gone


def test_draws_before_a_metamodel_drew_count_for_no_crude_monte_carlo_after_it():
    """As they do not where it goes on to draw."""

    def met(*stages: str) -> list[bool]:
        records = [Record(k, stage, k, {"a": 0.0}, 0, "ok", {"m": 0.0}) for k, stage in enumerate(stages)]
        return crude_rows(History.of(["a"], records)).tolist()

    assert met("hunt", "monte_carlo", "monte_carlo") == [False, True, True]
    assert met("monte_carlo", "learn", "hunt") == [True, False, False]
    assert met("monte_carlo", "learn", "monte_carlo", "monte_carlo") == [False, False, True, True]
