"""Metrics at an end of their scale, and spaces with few combinations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import sbt
from sbt.metamodels.saturation import on_side
from sbt.problem.requirement import CriticalInterval, within_scale, without_placeholders
from sbt.problem.scenario import LogicalScenario
from tests.measured_runs import Runs


@pytest.mark.parametrize("critical", [CriticalInterval(high=2.0), CriticalInterval(low=9.0), CriticalInterval(-1.0, 1.0)])
def test_infinities_lie_beyond_all_values_and_keep_their_verdict(critical: CriticalInterval):
    y = np.array([3.0, math.inf, 0.5, -math.inf, math.nan, 5.0])
    found = within_scale(y, critical)
    assert found[1] > 9.0 if critical.low == 9.0 else found[1] > 5.0
    assert found[3] < found[2]
    assert math.isnan(found[4])
    assert (critical.contains(found) == critical.contains(y)).all()
    assert within_scale(found, critical) is found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_value_that_stands_for_none_is_an_infinity(sign: float):
    critical = CriticalInterval(high=1.5) if sign > 0 else CriticalInterval(low=-1.5)
    y = sign * np.array([0.4, 2.0, math.nan, 3.1, 999.0, 999.0])
    assert without_placeholders(y, critical)[4:].tolist() == [sign * math.inf] * 2
    need = sbt.Requirement("y", low=critical.low, high=critical.high)
    found = need.values(Runs(y=y))
    assert np.abs(found[4:]).max() < 4.0
    assert need.told(Runs(y=y))[4] == 999.0 * sign, "it is told as it is"
    assert (critical.contains(found) == critical.contains(y)).all()


@pytest.mark.parametrize(
    ("y", "critical"),
    [
        ([0.4, 2.0, 3.1, 999.0], CriticalInterval(high=1.5)),  # one may be a value
        ([0.4, 2.0, 3.1, 5.0, 5.0], CriticalInterval(high=1.5)),  # near: a cap
        ([0.0, 0.0, 1.0, 1.0], CriticalInterval(low=0.2)),  # a flag
        ([0.4, 2.0, 3.1, 999.0, 999.0], CriticalInterval(900.0, 1200.0)),  # M_c lies there
    ],
)
def test_other_values_are_what_they_are(y: list[float], critical: CriticalInterval):
    values = np.array(y)
    assert without_placeholders(values, critical) is values


def test_what_every_collision_counts_is_a_value_of_the_metric():
    """-5 where nothing else is critical, beside distances from 1 to 2.3; -999 is one that stands for none."""
    safe = np.linspace(1.0, 2.3, 12)
    counted = np.r_[safe, np.full(5, -5.0)]
    assert without_placeholders(counted, CriticalInterval(high=0.0)) is counted
    assert np.isneginf(without_placeholders(np.r_[safe, np.full(5, -999.0)], CriticalInterval(high=0.0))[-5:]).all()
    assert np.isneginf(without_placeholders(np.r_[counted, -0.5], CriticalInterval(high=0.0))[12:17]).all()


@pytest.mark.parametrize("kind", ["boundary", "estimation"])
@pytest.mark.parametrize("none", [-1.0, 999.0])
def test_times_to_collision_are_learned_whatever_stands_for_none(none: float, kind: str, tmp_path: Path):
    """Critical from 0 to 1.5 s; before, -1 lay next to a collision, and F1 was .1 to .8."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        time = max(1.5 + 10.0 * (values["a"] + 0.7 * values["b"] - 0.5 * values["c"] - 0.3), 0.0)
        return {"ttc": none if time > 3.0 else time}

    box = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = LogicalScenario("none", box, sbt.Requirement("ttc", 0.0, 1.5), evaluate=evaluate)
    result = campaign(tmp_path, scenario, kind, 70)
    at = np.random.default_rng(0).random((20_000, 3))
    inside = at @ np.array([1.0, 0.7, -0.5]) <= 0.3
    if kind == "estimation":
        assert result.conclusion.probability == pytest.approx(inside.mean(), rel=0.1)
        return
    assert result.conclusion.critical_fraction == pytest.approx(inside.mean(), rel=0.06)
    held_out = result.history.held_out
    assert result.conclusion.validation.n_critical == (held_out.y("ttc") <= 1.5).sum() - (held_out.y("ttc") < 0.0).sum()
    said = result.predict(dict(zip("abc", at[:3000].T, strict=True)))["p_critical"].to_numpy() > 0.5
    assert (said == inside[:3000]).mean() > 0.98


def lane(x: np.ndarray) -> np.ndarray:
    """A time of 0 in collisions, -1 wherever another lane is taken: next to any time."""
    return np.where(x[:, 0] > 0.75, -1.0, np.maximum(8.0 * x[:, 1] / (0.2 + x[:, 2]) - 2.0, 0.0))


@pytest.mark.parametrize(
    ("low", "metric", "least", "most"),
    [
        (0.0, lane, 6, 6),
        (0.1, lane, 4, 6),  # collisions are uncritical, too
        (0.1, lambda x: 15.0 * np.sqrt(np.maximum(0.6 - x.sum(axis=1) / 2.0, 0.0)), 0, 0),  # a speed of impact
        (1e-3, lambda x: np.maximum(5.0 * (x.sum(axis=1) - 1.2), 0.0), 0, 0),  # a distance
    ],
)
def test_a_value_that_stands_for_none_is_told_from_one_that_is_in_its_place(low, metric, least, most):
    moved = 0
    for seed in range(6):
        u = np.random.default_rng(seed).random((100, 3))
        y, critical = metric(u), CriticalInterval(low, 1.5)
        found = on_side(u, y, critical)
        moved += found is not y
        assert (critical.contains(found) == critical.contains(y)).all()
        assert (found[y != y.min()] == y[y != y.min()]).all()
        assert found is y or (found[y == y.min()] > 1.5).all()
    assert least <= moved <= most


def test_where_no_run_was_critical_a_value_that_stands_for_none_makes_none_likely(tmp_path: Path):
    """10 s, or none: beside the jump a process went below 1.5, and said so with P = .95."""
    scenario = LogicalScenario(
        "never", [sbt.Parameter(name, 0.0, 1.0) for name in "ab"], sbt.Requirement("ttc", high=1.5),
        evaluate=lambda values, _: {"ttc": 999.0 if values["a"] < 0.5 else 10.0},
    )  # fmt: skip
    result = campaign(tmp_path, scenario, "boundary", 60)
    assert result.conclusion.critical_fraction < 0.005
    at = np.random.default_rng(0).random((3000, 2))
    assert result.predict(dict(zip("ab", at.T, strict=True)))["p_critical"].max() < 0.1


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


def test_runs_are_told_by_what_they_gave(tmp_path: Path):
    """The nearest safe run of a failure has a time of inf: the number that was learned in its place was told."""

    def evaluate(values: dict[str, float], seed: int) -> dict[str, float]:
        return {"ttc": 3.0 * values["a"] + values["b"] if values["a"] < 0.3 else math.inf}

    box = [sbt.Parameter(name, 0.0, 1.0) for name in "ab"]
    for high, found in ((1.2, True), (-1.0, False)):
        scenario = LogicalScenario("inf", box, sbt.Requirement("ttc", high=high), evaluate=evaluate)
        result = campaign(tmp_path / str(found), scenario, "falsification", 60)
        told = result.conclusion
        points = [point for mode in told.failure_modes for point in (mode, mode.nearest_safe)] if found else [told.closest]
        rows = {int(index): y for index, y in zip(result.history.index, result.history.y("ttc"), strict=True)}
        for point in points:
            y = rows[getattr(point, "run", getattr(point, "representative", None))]
            assert point.metric == (y if math.isfinite(y) else None)
        assert not found or any(mode.nearest_safe.metric is None for mode in told.failure_modes)
        frame = result.frame
        assert (frame["margin"] == frame["y.ttc"] - high).all()
