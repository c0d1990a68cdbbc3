"""What chance decides: where runs are critical most often is told, and not that a run is critical there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import logit

import sbt
from sbt.campaigns.chance import chance_place
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream


def inside(u: np.ndarray) -> np.ndarray:
    return (u[:, 0] > 0.5) & (u[:, 1] > 0.4)


def test_a_place_is_told_where_runs_are_critical_most_often():
    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    scenario = sbt.Scenario("place", inputs, sbt.Requirement("y", high=0.0), evaluate=lambda values, seed: {"y": 1.0})
    u = SobolSequence(2, 3).points(0, 100)
    hit = inside(u) & (stream(3, "hit").random(100) < 0.3)

    def odds(v: np.ndarray, rate: float = 0.3) -> np.ndarray:
        return logit(0.01 + (rate - 0.01) / (1.0 + np.exp(-40.0 * np.minimum(v[:, 0] - 0.5, v[:, 1] - 0.4))))

    found = chance_place(odds, scenario, 0, u, hit)
    assert found is not None
    assert found.hits / found.runs == pytest.approx(0.3, abs=0.15)
    words = found.words("In place", "y at most 0", {})
    assert "chance decides which runs are critical (y at most 0); most often they are where" in words
    assert f"{found.hits} of the {found.runs} runs there" in words
    assert "edges" not in words
    denied = chance_place(lambda v: odds(v, 0.9), scenario, 0, u, hit)
    assert denied is not None, "P is said to be .9 where three runs in ten are critical"
    assert chance_place(lambda v: odds(v, 0.9), scenario, 0, u, inside(u)) is None
    assert chance_place(lambda v: np.full(len(v), -1.0), scenario, 0, u, hit) is None


@pytest.mark.slow
def test_a_conflict_of_some_seeds_is_not_told_as_one_of_all(tmp_path: Path):
    """It was said where "a run is critical", without a hedge, of inputs that change nothing and a P of .3 at most."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        rng = np.random.default_rng(seed)
        some = values["a"] > 0.5 and values["b"] > 0.4 and rng.random() < 0.3
        return {"y": 0.9 * rng.random() if some else 10.0}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abcd"]
    scenario = sbt.Scenario("some", inputs, sbt.Requirement("y", high=1.0), evaluate=evaluate)
    result = sbt.run(
        campaign="boundary", scenario=scenario, budget=100, seed=1, executor="serial", store=tmp_path / "s", report=False,
    )  # fmt: skip
    first = result.sentences()[0]
    assert "a run is critical (y ≤ 1) where" not in first
    assert result.conclusion.critical_fraction == pytest.approx(0.09, abs=0.05)


def test_no_place_is_told_by_runs_that_chance_would_put_there_as_well():
    """Three critical runs of a coin, all in the half of the space where a metamodel expects them, which has learned from them."""
    inputs = [sbt.Parameter("a", 0.0, 1.0), sbt.Parameter("b", 0.0, 1.0)]
    scenario = sbt.Scenario("coin", inputs, sbt.Requirement("y", high=0.0), evaluate=lambda values, seed: {"y": 1.0})
    u = SobolSequence(2, 3).points(0, 50)
    hit = np.zeros(50, dtype=bool)
    hit[np.flatnonzero(inside(u))[:3]] = True
    assert chance_place(lambda v: np.where(inside(v), -1.5, -6.0), scenario, 0, u, hit) is None
    hit[np.flatnonzero(inside(u))[:10]] = True
    assert chance_place(lambda v: np.where(inside(v), -1.5, -6.0), scenario, 0, u, hit) is not None
