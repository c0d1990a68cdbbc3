"""What crosses a process border in place of a scenario: its name and the user's choices, as plain data.

A worker resolves the specification itself, once; nothing that holds SUMO is pickled. A scenario that has no
name elsewhere, as it was defined in a script or a notebook, is carried as bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from sbt.errors import InputError, PluginError
from sbt.execution.carrying import delivered
from sbt.metrics.encounter import conflict_type
from sbt.metrics.others import in_traffic, without_verdict
from sbt.plugins import load
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario, Metric

__all__ = ["ScenarioSpec"]


@dataclass(frozen=True)
class ScenarioSpec:
    """A scenario by name, with the choices that change how it runs (not what is evaluated).

    Args:
        name: an installed scenario, or `file.py:NAME`; where the scenario is carried only for people.
        folder: where a relative file is looked up; make it absolute before it goes to another process.
        ego: the AV under test; None: the scenario's own.
        isolation: auto, fresh, reuse or replicas; scenarios without SUMO ignore it.
        step_length: simulation step (s); None: the scenario's own.
        formula: of signal temporal logic, measured as the metric `stl` and required; None: the scenario's own requirement.
        conflict_type: measure how ego and the nearest other met as well, where runs have a trace.
        metrics: measured as well, in place of the scenario's of the same name: installed ones (of ego and each
            other in turn, the worst counts), or `file.py:NAME`, a `Metric` or a function of the trace.
        carried: the scenario itself, as `sbt.execution.carrying.carry` gives it; empty where the name says which it is.
    """

    name: str
    folder: str = "."
    ego: Mapping[str, Any] | None = None
    isolation: str = "auto"
    step_length: float | None = None
    formula: str | None = None
    conflict_type: bool = False
    metrics: tuple[str, ...] = ()
    carried: bytes = field(default=b"", repr=False)

    def resolve(self) -> LogicalScenario:
        """Return the scenario; loaded once per process and specification.

        Raises:
            PluginError: there is no such scenario or metric, or its code raises when it is imported.
            InputError: the scenario does not offer one of the choices, or was carried and cannot be loaded here.
        """
        ego = None if self.ego is None else json.dumps(dict(self.ego), sort_keys=True)
        folder = str(Path(self.folder).resolve())
        choices = (ego, self.isolation, self.step_length, self.formula, self.conflict_type, self.metrics)
        return _resolve(self.name, folder, self.carried, *choices)


@cache
def _resolve(
    name: str, folder: str, carried: bytes, ego: str | None, isolation: str, step_length: float | None, formula: str | None,
    conflict: bool, metrics: tuple[str, ...],
) -> LogicalScenario:  # fmt: skip
    scenario = delivered(carried, name) if carried else load("scenarios", name, Path(folder))
    if not isinstance(scenario, LogicalScenario):
        hint = "; a TraCI loop goes into a scenario.yaml: simulate: file.py:NAME" if callable(scenario) else ""
        raise PluginError(f"a scenario must be a LogicalScenario, but '{name}' is a {type(scenario).__name__}{hint}")
    for metric in metrics:
        scenario = _measuring(scenario, _metric(metric, Path(folder), scenario))
    if formula is not None:
        scenario = _requiring(scenario, formula)
    if conflict and scenario.simulate is not None:
        scenario = _measuring(scenario, conflict_type(scenario.roles.ego))
    chosen = scenario.configured(None if ego is None else json.loads(ego), None, step_length)
    return chosen.configured(isolation=isolation)  # afterwards: what is allowed may depend on the ego


def _metric(name: str, folder: Path, scenario: LogicalScenario) -> Metric:
    """Return a metric by name, as one of this scenario's traces.

    Raises:
        InputError: there is none of this name, or the scenario has no traces.
    """
    if scenario.simulate is None:
        raise InputError(f"metric {name} needs the trace of a run, but scenario {scenario.name} gives its metrics directly")
    found = load("metrics", name, folder)
    if isinstance(found, Metric):
        return found if ".py:" in name else in_traffic(without_verdict(found), scenario.roles.ego)
    if ".py:" in name and callable(found) and not isinstance(found, type):
        return Metric(getattr(found, "__name__", name.rpartition(":")[2]), found)
    raise InputError(
        f"a metric must be a Metric, or a function of the trace in a file.py, but '{name}' is a {type(found).__name__}"
    )


def _requiring(scenario: LogicalScenario, formula: str) -> LogicalScenario:
    """Return the scenario with the robustness of a formula as a further metric, and <= 0 critical."""
    from sbt.metrics.stl import stl

    if scenario.simulate is None:
        raise InputError(f"a formula needs the trace of a run, but scenario {scenario.name} gives its metrics directly")
    roles = scenario.roles
    metric = stl(formula, "stl", roles.ego, roles.other, roles.margin)
    return replace(_measuring(scenario, metric), requirement=Requirement(metric.name, CriticalInterval(high=0.0)))


def _measuring(scenario: LogicalScenario, metric: Metric) -> LogicalScenario:
    """Return the scenario with one more metric, in place of one of the same name."""
    return replace(scenario, metrics=(*(m for m in scenario.metrics if m.name != metric.name), metric))
