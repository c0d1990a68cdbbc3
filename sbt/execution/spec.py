"""What crosses a process border in place of a scenario: its name and the user's choices, as plain data.

A worker resolves the specification itself, once; nothing that holds SUMO is pickled. A scenario that has no
name elsewhere, as it was defined in a script or a notebook, is carried as bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from sbt.errors import InputError, PluginError
from sbt.execution.carrying import delivered
from sbt.execution.exchange import with_drivers
from sbt.metrics.conflict_types import conflict_type
from sbt.metrics.pairwise import in_traffic, without_overtaking
from sbt.plugins import kept, load
from sbt.problem.isolation import Isolation, Warmable
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Metric

__all__ = ["ScenarioSpec"]

Attempt = Callable[[tuple[str | int, ...], Callable[[], LogicalScenario]], LogicalScenario | None]


@dataclass(frozen=True)
class ScenarioSpec:
    """A scenario by name, with the choices that change how it runs (not what is evaluated).

    Args:
        name: an installed scenario, or `file.py:NAME`; where the scenario is carried only for people.
        folder: where a relative file is looked up; make it absolute before it goes to another process.
        ego: the AV under test; None: the scenario's own.
        isolation: auto, fresh, reuse, replicas or snapshot; scenarios without SUMO ignore it.
        isolated: the isolation that was decided for a campaign; None: as `isolation` says and the scenario's conditions are.
        step_length: simulation step (s); None: the scenario's own.
        formulas: further formulas, the metric that measures each and its text; they change no requirement.
        friction: smallest and largest coefficient of friction of the roads, an input where they differ; None: the scenario's own.
        formula: of signal temporal logic, measured as the metric `stl` and required; None: the scenario's own requirement.
        conflict_type: measure how ego and the nearest other met as well, where runs have a trace.
        metrics: measured as well, in place of the scenario's of the same name: installed ones (of ego and each
            other in turn, the worst counts), or `file.py:NAME`, a `Metric` or a function of the trace.
        drivers: egos (kind and settings) that are exchanged for the scenario's own from run to run, as `sbt.execution.exchange`
            says; none: the ego is not exchanged.
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
    drivers: tuple[Mapping[str, Any], ...] = ()
    friction: tuple[float, float] | None = None
    formulas: tuple[tuple[str, str], ...] = ()
    isolated: Isolation | None = None

    def resolve(self) -> LogicalScenario:
        """Return the scenario; loaded once per process and specification.

        Raises:
            PluginError: there is no such scenario or metric, or its code raises when it is imported.
            InputError: the scenario does not offer one of the choices, or was carried and cannot be loaded here.
        """
        ego = None if self.ego is None else json.dumps(dict(self.ego), sort_keys=True)
        plain = replace(self, ego=None, drivers=(), folder=str(Path(self.folder).resolve()))
        scenario = _resolved(plain, ego)
        return with_drivers(scenario, self.drivers) if self.drivers else scenario

    def resolve_at(self, attempt: Attempt) -> LogicalScenario | None:
        """Return the scenario, one choice after the other.

        Args:
            attempt: (key of the configuration, what makes the scenario with this choice) -> the scenario, or None where the
                choice is impossible; the other choices are then tried without it.

        Returns:
            The scenario with every choice that is possible; None where there is none at all.
        """
        scenario = attempt(("scenario",), partial(_loaded, self.name, Path(self.folder), self.carried))
        if scenario is None:
            return None
        for key, change in self._choices():
            scenario = attempt(key, partial(change, scenario)) or scenario
        return scenario

    def _choices(self) -> Iterator[tuple[tuple[str | int, ...], Callable[[LogicalScenario], LogicalScenario]]]:
        """Yield each choice by its key in the configuration, as a change of the scenario."""
        for k, name in enumerate(self.metrics):
            yield ("metrics", k), partial(_with_metric, name, Path(self.folder))
        if self.formula is not None:
            yield ("requirement", "stl"), partial(_requiring, formula=self.formula)
        for metric, formula in self.formulas:
            yield ("requirement",), partial(_with_formula, metric, formula)
        if self.conflict_type:
            yield ("campaign",), _with_conflict_type
        if self.ego is not None:
            yield ("ego",), partial(LogicalScenario.configured, ego=self.ego)
        if self.step_length is not None:
            yield ("simulation", "step_length"), partial(LogicalScenario.configured, step_length=self.step_length)
        if self.friction is not None:
            low, high = self.friction
            yield ("simulation", "friction"), partial(LogicalScenario.with_friction, low=low, high=high)
        yield ("executor", "isolation"), partial(LogicalScenario.configured, isolation=self.isolation)  # may depend on the ego
        if self.isolated is not None:
            yield ("executor", "isolation"), partial(_isolated, isolation=self.isolated)


def _loaded(name: str, folder: Path, carried: bytes) -> LogicalScenario:
    """Return the scenario itself, without any choice."""
    scenario = delivered(carried, name) if carried else load("scenarios", name, folder)
    if not isinstance(scenario, LogicalScenario):
        hint = "; a TraCI loop goes into a scenario.yaml: simulate: file.py:NAME" if callable(scenario) else ""
        raise PluginError(f"a scenario must be a LogicalScenario, but '{name}' is a {type(scenario).__name__}{hint}")
    return scenario


def _isolated(scenario: LogicalScenario, isolation: Isolation) -> LogicalScenario:
    """Return the scenario at this isolation level, where its traffic can be warmed up at all."""
    simulate = scenario.simulate
    return replace(scenario, simulate=simulate.isolated(isolation)) if isinstance(simulate, Warmable) else scenario


@kept
def _resolved(spec: ScenarioSpec, ego: str | None) -> LogicalScenario:
    found = replace(spec, ego=None if ego is None else json.loads(ego)).resolve_at(lambda _, make: make())
    if found is None:
        raise PluginError(f"scenario {spec.name} cannot be loaded")
    return found


def _with_metric(name: str, folder: Path, scenario: LogicalScenario) -> LogicalScenario:
    """Return the scenario with a metric of this name."""
    return _measuring(scenario, _metric(name, folder, scenario))


def _with_conflict_type(scenario: LogicalScenario) -> LogicalScenario:
    """Return the scenario with the type of conflict as a metric, where runs have a trace."""
    return scenario if scenario.simulate is None else _measuring(scenario, conflict_type(scenario.roles.ego))


def _metric(name: str, folder: Path, scenario: LogicalScenario) -> Metric:
    """Return a metric by name, as one of this scenario's traces.

    Raises:
        InputError: there is none of this name, or the scenario has no traces.
    """
    if scenario.simulate is None:
        raise InputError(f"metric {name} needs the trace of a run, but scenario {scenario.name} gives its metrics directly")
    found = load("metrics", name, folder)
    if isinstance(found, Metric):
        return found if ".py:" in name else in_traffic(without_overtaking(found), scenario.roles.ego)
    if ".py:" in name and callable(found) and not isinstance(found, type):
        return Metric(getattr(found, "__name__", name.rpartition(":")[2]), found)
    raise InputError(
        f"a metric must be a Metric, or a function of the trace in a file.py, but '{name}' is a {type(found).__name__}"
    )


def _requiring(scenario: LogicalScenario, formula: str) -> LogicalScenario:
    """Return the scenario with the robustness of a formula as a further metric, and <= 0 critical."""
    return replace(_with_formula("stl", formula, scenario), requirement=Requirement("stl", high=0.0))


def _with_formula(name: str, formula: str, scenario: LogicalScenario) -> LogicalScenario:
    """Return the scenario with the robustness of a formula as a further metric of this name."""
    from sbt.metrics.stl import stl

    if scenario.simulate is None:
        raise InputError(f"a formula needs the trace of a run, but scenario {scenario.name} gives its metrics directly")
    roles = scenario.roles
    return _measuring(scenario, stl(formula, name, roles.ego, roles.other, roles.margin))


def _measuring(scenario: LogicalScenario, metric: Metric) -> LogicalScenario:
    """Return the scenario with one more metric, in place of one of the same name."""
    return replace(scenario, metrics=(*(m for m in scenario.metrics if m.name != metric.name), metric))
