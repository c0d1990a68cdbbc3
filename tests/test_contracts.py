"""The public contracts, run over everything that is installed; and each contract finds the flaw it is there for."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sbt import plugins
from sbt.execution.spec import ScenarioSpec
from sbt.problem.metric import Metric
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.testing import ContractError, check_acquisition, check_metric, check_scenario


def traces() -> list[Trace]:
    """Following, a rear-end collision, a cut-in from beside, a crossing, and one state only."""
    t = np.arange(0.0, 6.0, 0.05)
    one, zero = np.ones_like(t), np.zeros_like(t)

    def both(ego: tuple[np.ndarray, ...], co: tuple[np.ndarray, ...], n: int = len(t)) -> Trace:
        x, y, heading, speed, acceleration = (np.column_stack([a, b])[:n] for a, b in zip(ego, co, strict=True))
        return Trace(t[:n], ("ego", "co"), x, y, heading, speed, acceleration, np.array([5.0, 4.5]), np.array([1.8, 1.7]))

    straight = (20 * t, zero, zero, 20 * one, zero)
    slower = (30 + 15 * t, zero, zero, 15 * one, zero)
    stopping = (20 * np.minimum(t, 4) - np.minimum(t, 4) ** 2 * 2.5, zero, zero, 20 - 5 * np.minimum(t, 4), -5.0 * (t < 4))
    lateral = np.clip(-3.5 + t, -3.5, 0)
    cutting = (3 + 16 * t, lateral, np.arctan2(np.gradient(lateral, t), 16), 16 * one, zero)
    crossing = (50 * one, 40 - 12 * t, -np.pi / 2 * one, 12 * one, zero)
    return [
        both(straight, slower, 60), both(straight, slower), both(stopping, slower), both(straight, cutting),
        both(straight, crossing), both(straight, slower, 1),
    ]  # fmt: skip


@pytest.mark.parametrize("name", plugins.names("acquisitions"))
def test_acquisitions(name):
    check_acquisition(plugins.load("acquisitions", name))


@pytest.mark.parametrize("name", plugins.names("metrics"))
def test_metrics(name):
    metric = plugins.load("metrics", name)
    assert isinstance(metric, Metric)
    assert (metric.name, bool(metric.description)) == (name, True)
    check_metric(metric, traces())


def _scenarios() -> list[object]:
    slow = {"lane_keeping"}  # 49 runs of a long drive, six times
    return [pytest.param(name, marks=pytest.mark.slow if name in slow else ()) for name in plugins.names("scenarios")]


@pytest.mark.sumo
@pytest.mark.parametrize("name", _scenarios())
def test_scenarios(name):
    start = time.process_time()
    scenario = ScenarioSpec(name).resolve()
    assert isinstance(scenario, LogicalScenario)
    assert (scenario.name, bool(scenario.description)) == (name, True)
    assert all(p.description for p in scenario.space.parameters)
    findings = check_scenario(ScenarioSpec(name), seed=2)
    assert [f"{f.rule}: {f.detail}" for f in findings if not f.ok] == []
    assert time.process_time() - start < (100 if name == "lane_keeping" else 10)


CHANGED = {
    "no number": (lambda trace: np.nan, "must be finite, inf or -inf"),
    "infinite alone": (lambda trace: np.inf, "where the two never meet"),
    "raises": (lambda trace: 1 / 0, "must measure every trace, but m raised ZeroDivisionError"),
    "clock": (lambda trace: float(trace.time[-1]), "must not depend on when the run began"),
    "without": (lambda trace: 3.0, "where the two never meet"),
    "memory": (lambda trace, seen=[]: float(seen.append(0) or len(seen)), "the same trace must give the same value"),
    "writes": (lambda trace: float(np.add(trace.x, 1.0, out=trace.x).shape[1]), "must not change the trace"),
}  # fmt: skip


@pytest.mark.parametrize("flaw", CHANGED)
def test_the_metric_contract_finds(flaw):
    function, message = CHANGED[flaw]
    with pytest.raises(ContractError, match=message):
        check_metric(Metric("m", function, without=1.0), traces())


def test_the_metric_contract_wants_a_value_without_interaction_and_a_direction():
    good = Metric("m", lambda trace: 2.0, without=2.0)
    check_metric(good, traces())
    check_metric(Metric("m", lambda trace: np.inf), traces())  # an end of the scale, as in docs/extending.md
    with pytest.raises(ContractError, match="must say its value without an interaction"):
        check_metric(replace(good, without=np.inf), [])
    with pytest.raises(ContractError, match="direction must be low or high, but got 'down'"):
        check_metric(replace(good, direction="down"), [])


def test_the_scenario_contract_finds_a_scenario_that_is_never_the_same(analytic):
    analytic.write_text(
        analytic.read_text() + "\n\ncalls = []\n\n\ndef drifting(values, seed):\n    calls.append(0)\n"
        "    return {'y': float(len(calls)), 'noise': 0.0}\n\n\nDRIFTING = scenario(drifting)\n"
    )
    good, bad = (check_scenario(ScenarioSpec(f"analytic.py:{n}", str(analytic.parent))) for n in ("SCENARIO", "DRIFTING"))
    assert all(finding.ok for finding in good)
    assert "same seed, same trace" in [finding.rule for finding in bad if not finding.ok]


_IDLE = """
import sbt

INPUTS = [*(sbt.Parameter(name, 0, 1) for name in ("a", "b", "late")), sbt.Parameter("kind", choices=["car", "van"])]

def evaluate(values, seed):
    return {"m": values["a"] + seed % 7 + (values["late"] if values["a"] > 0.99 else 0.0)}

SCENARIO = sbt.Scenario("s", INPUTS, sbt.Requirement("m", high=0.5), evaluate=evaluate, metrics=["m"])
"""


def test_inputs_that_change_nothing_are_told(tmp_path: Path):
    """Those that do somewhere are not among them, and a seed's noise hides none."""
    (tmp_path / "s.py").write_text(_IDLE)
    found = check_scenario(ScenarioSpec(f"{tmp_path / 's.py'}:SCENARIO"))
    (idle,) = (one for one in found if one.rule.endswith("inputs that change nothing"))
    assert idle.ok
    assert idle.detail.startswith("b, kind: 18 runs (random ones, centre, corners) are bit by bit the same")


_HANGS = """
import os
import time
import sbt

def evaluate(values, seed):
    while values["a"] > 0.7:
        LEAVES
    return {"m": values["a"]}

SCENARIO = sbt.Scenario("s", [sbt.Parameter("a", 0, 1)], sbt.Requirement("m", high=0.5), evaluate=evaluate, metrics=["m"])
"""


@pytest.mark.parametrize(
    ("how", "said"), [("time.sleep(0.1)", "within 3 s: a run must end"), ("os._exit(3)", "process died (exit code 3)")]
)
def test_a_run_that_hangs_or_kills_its_process_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str, said: str):
    if "sleep" in how:
        monkeypatch.setattr("sbt.workflows.checking._WORKER_DEADLINE", 3.0)
    (tmp_path / "s.py").write_text(_HANGS.replace("LEAVES", how))
    (finding,) = (found for found in check_scenario(ScenarioSpec(f"{tmp_path / 's.py'}:SCENARIO")) if not found.ok)
    assert finding.rule == "centre and corners run"
    assert said in finding.detail
