"""What crosses a process border in place of a scenario: its name and the user's choices, as plain data.

A worker resolves the specification itself, once; nothing that holds SUMO or a function is pickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from sbt.errors import InputError, PluginError
from sbt.metrics.conflict_types import conflict_type
from sbt.plugins import load
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Metric

__all__ = ["ScenarioSpec"]


@dataclass(frozen=True)
class ScenarioSpec:
    """A scenario by name, with the choices that change how it runs (not what is asked about it).

    Args:
        name: an installed scenario, or `file.py:NAME`.
        folder: where a relative file is looked up; make it absolute before it goes to another process.
        ego: the AV under test; None: the scenario's own.
        isolation: auto, fresh, reuse or replicas; scenarios without SUMO ignore it.
        step_length: simulation step (s); None: the scenario's own.
        formula: of signal temporal logic, measured as the metric `stl` and required; None: the scenario's own requirement.
        conflict_type: measure how ego and the nearest other met as well, where runs have a trace.
    """

    name: str
    folder: str = "."
    ego: Mapping[str, Any] | None = None
    isolation: str = "auto"
    step_length: float | None = None
    formula: str | None = None
    conflict_type: bool = False

    def resolve(self) -> LogicalScenario:
        """Return the scenario; loaded once per process and specification.

        Raises:
            PluginError: there is no such scenario, or its code raises when it is imported.
            InputError: the scenario does not offer one of the choices.
        """
        ego = None if self.ego is None else json.dumps(dict(self.ego), sort_keys=True)
        folder = str(Path(self.folder).resolve())
        return _resolve(self.name, folder, ego, self.isolation, self.step_length, self.formula, self.conflict_type)


@cache
def _resolve(
    name: str, folder: str, ego: str | None, isolation: str, step_length: float | None, formula: str | None, conflict: bool
) -> LogicalScenario:
    scenario = load("scenarios", name, Path(folder))
    if not isinstance(scenario, LogicalScenario):
        hint = "; a TraCI loop goes into a scenario.yaml: simulate: file.py:NAME" if callable(scenario) else ""
        raise PluginError(f"a scenario must be a LogicalScenario, but '{name}' is a {type(scenario).__name__}{hint}")
    if formula is not None:
        scenario = _requiring(scenario, formula)
    if conflict and scenario.simulate is not None:
        scenario = _measuring(scenario, conflict_type(scenario.roles.ego))
    chosen = scenario.configured(None if ego is None else json.loads(ego), None, step_length)
    return chosen.configured(isolation=isolation)  # afterwards: what is allowed may depend on the ego


def _requiring(scenario: LogicalScenario, formula: str) -> LogicalScenario:
    """Return the scenario with the robustness of a formula as a further metric, and <= 0 critical."""
    from sbt.metrics.stl import stl

    if scenario.simulate is None:
        raise InputError(f"a formula needs the trace of a run, but scenario {scenario.name} gives its metrics directly")
    roles = scenario.roles
    metric = stl(formula, "stl", roles.ego, roles.other, roles.margin)
    return replace(_measuring(scenario, metric), requirement=Requirement(metric.name, high=0.0))


def _measuring(scenario: LogicalScenario, metric: Metric) -> LogicalScenario:
    """Return the scenario with one more metric, in place of one of the same name."""
    return replace(scenario, metrics=(*(m for m in scenario.metrics if m.name != metric.name), metric))
