"""Metrics at an end of their scale, and spaces with few combinations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.problem.requirement import CriticalInterval, within_scale
from sbt.problem.scenario import LogicalScenario


@pytest.mark.parametrize("critical", [CriticalInterval(high=2.0), CriticalInterval(low=9.0), CriticalInterval(-1.0, 1.0)])
def test_infinities_lie_beyond_all_values_and_keep_their_verdict(critical: CriticalInterval):
    y = np.array([3.0, math.inf, 0.5, -math.inf, math.nan, 5.0])
    found = within_scale(y, critical)
    assert found[1] > 9.0 if critical.low == 9.0 else found[1] > 5.0
    assert found[3] < found[2]
    assert math.isnan(found[4])
    assert (critical.contains(found) == critical.contains(y)).all()
    assert within_scale(found, critical) is found


def _hole(values: dict[str, float], seed: int) -> dict[str, float]:
    a, b = values["a"], values["b"]
    return {"y": math.inf if a < 0.3 else (a - 0.6) ** 2 + (b - 0.5) ** 2 - 0.03}


def _grid(values: dict[str, float], seed: int) -> dict[str, float]:
    return {"y": abs(values["k"] - 2) + abs(values["m"] - 1) - 0.5}


def _jitter(values: dict[str, float], seed: int) -> dict[str, float]:
    return {"y": _grid(values, seed)["y"] + 0.3 * math.sin(seed)}


GRID = [sbt.Parameter("k", 0, 3, kind="integer"), sbt.Parameter("m", 0, 4, kind="integer")]


def campaign(folder: Path, scenario: LogicalScenario, kind: str, budget: int) -> sbt.Result:
    return sbt.run(
        campaign=kind, scenario=scenario, seed=0, budget=budget, store=folder / "store", executor="serial", report=False
    )


def test_runs_without_a_conflict_are_learned(tmp_path: Path):
    box = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    scenario = LogicalScenario("hole", box, sbt.Requirement("y", high=0.0), evaluate=_hole)
    result = campaign(tmp_path, scenario, "boundary", 36)
    y = result.history.y("y")
    assert result.history.ok.all()
    assert 0 < np.isposinf(y).sum() < 20  # stored as they are, and not searched again and again
    assert result.conclusion.critical_fraction == pytest.approx(0.03 * math.pi, rel=0.15)


@pytest.mark.parametrize("kind", ["falsification", "boundary"])
def test_few_combinations_are_run_once_each_unless_the_simulator_is_noisy(kind: str, tmp_path: Path):
    need = sbt.Requirement("y", high=0.0)
    runs = campaign(tmp_path / "a", LogicalScenario("grid", GRID, need, evaluate=_grid), kind, 60).history
    searched = runs.where((runs.stage != "repeat") & (runs.stage != "confirm"))
    assert len(searched) == len(np.unique(searched.x, axis=0)) == 20
    noisy = campaign(tmp_path / "b", LogicalScenario("jitter", GRID, need, evaluate=_jitter), kind, 30).history
    assert len(noisy) >= 30
