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
from sbt.metrics.conflict_types import Decisive, conflict_type
from sbt.metrics.pairwise import in_traffic, without_overtaking
from sbt.plugins import kept, load
from sbt.problem.isolation import Isolation, Warmable
from sbt.problem.metric import Metric
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario

__all__ = ["CoarseLevel", "ScenarioSpec"]

@dataclass(frozen=True)
class CoarseLevel:
    """A second, cheaper level of fidelity: other settings of the same scenario, which the same inputs and seeds are run at.

    Args:
        step_length: its step (s); None: that of its scenario.
        name: of its scenario, as of `ScenarioSpec`; None: the same.
        metrics: that it measures, beside those of its own requirement; None: all.
    """

    step_length: float | None = None
    name: str | None = None
    metrics: tuple[str, ...] | None = None


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
        conflict_type: measure also how ego met whom its failure is about, or the nearest other, where runs have a trace; by the
            metrics that decide ("": its own), each with its critical interval (None: its own); none: those of its requirement.
        metrics: measured as well, in place of the scenario's of the same name: installed ones (of ego and each
            other in turn, the worst counts), or `file.py:NAME`, a `Metric` or a function of the trace.
        drivers: egos (kind and settings) that are exchanged for the scenario's own from run to run, as `sbt.execution.exchange`
            says; none: the ego is not exchanged.
        carried: the scenario itself, as `sbt.execution.carrying.carry` gives it; empty where the name says which it is.
        only: measure nothing but these metrics and those of the requirement; None: all.
        coarse: a cheaper level of fidelity (`at_level`); None: there is none. It does not change the scenario itself.
    """

    name: str
    folder: str = "."
    ego: Mapping[str, Any] | None = None
    isolation: str = "auto"
    step_length: float | None = None
    formula: str | None = None
    conflict_type: tuple[tuple[str, tuple[float, float] | None], ...] | None = None
    metrics: tuple[str, ...] = ()
    carried: bytes = field(default=b"", repr=False)
    drivers: tuple[Mapping[str, Any], ...] = ()
    friction: tuple[float, float] | None = None
    formulas: tuple[tuple[str, str], ...] = ()
    isolated: Isolation | None = None
    only: tuple[str, ...] | None = None
    coarse: CoarseLevel | None = None

    def at_level(self, level: int) -> ScenarioSpec:
        """Return the scenario at a level of fidelity: 0 is itself, 1 the coarse one.

        Raises:
            InputError: it has no such level.
        """
        if level == 0:
            return self if self.coarse is None else replace(self, coarse=None)
        if self.coarse is None or level != 1:
            raise InputError(f"a run must be at a level of fidelity of its campaign, but {self.name} has no level {level}")
        coarse = self.coarse
        if coarse.name is None:
            return replace(self, step_length=coarse.step_length, only=coarse.metrics, coarse=None)
        return replace(self, name=coarse.name, step_length=coarse.step_length, carried=b"", only=coarse.metrics, coarse=None)

    @property
    def levels(self) -> tuple[ScenarioSpec, ...]:
        """The scenario at each of its levels of fidelity, its own first."""
        return tuple(self.at_level(k) for k in range(1 if self.coarse is None else 2))

    def resolve(self) -> LogicalScenario:
        """Return the scenario; loaded once per process and specification.

        Raises:
            PluginError: there is no such scenario or metric, or its code raises when it is imported.
            InputError: the scenario does not offer one of the choices, or was carried and cannot be loaded here.
        """
        ego = None if self.ego is None else json.dumps(dict(self.ego), sort_keys=True)
        plain = replace(self, ego=None, drivers=(), coarse=None, folder=str(Path(self.folder).resolve()))
        scenario = _resolved(plain, ego)
        return with_drivers(scenario, self.drivers, decisive(scenario, self.conflict_type or ())) if self.drivers else scenario

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
        if self.conflict_type is not None:
            yield ("campaign",), partial(_with_conflict_type, self.conflict_type)
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
        if self.only is not None:
            yield ("fidelity",), partial(_measuring_only, self.only)


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


def _with_conflict_type(
    deciding: tuple[tuple[str, tuple[float, float] | None], ...], scenario: LogicalScenario
) -> LogicalScenario:
    """Return the scenario with the type of conflict as a metric, where runs have a trace."""
    if scenario.simulate is None:
        return scenario
    return _measuring(scenario, conflict_type(scenario.roles.ego, decisive(scenario, deciding)))


def decisive(scenario: LogicalScenario, deciding: tuple[tuple[str, tuple[float, float] | None], ...]) -> tuple[Decisive, ...]:
    """Return the metrics that decide whether a run of the scenario is critical, those that runs do not give left out."""
    own = {part.metric: CriticalInterval(part.low, part.high) for part in scenario.requirement.parts}
    metrics = {metric.name: metric for metric in scenario.metrics}
    named = [(name or scenario.requirement.metric, ends) for name, ends in deciding]
    asked = {name: own.get(name) if ends is None else CriticalInterval(*ends) for name, ends in named} if named else own
    return tuple((metrics[name], critical) for name, critical in asked.items() if name in metrics and critical is not None)


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


def _measuring_only(names: tuple[str, ...], scenario: LogicalScenario) -> LogicalScenario:
    """Return the scenario with these metrics and those of its requirement, where they are measured on traces."""
    kept = {*names, *(part.metric for part in scenario.requirement.parts)}
    found = tuple(metric for metric in scenario.metrics if metric.name in kept)
    return scenario if scenario.simulate is None else replace(scenario, metrics=found)


def _measuring(scenario: LogicalScenario, metric: Metric) -> LogicalScenario:
    """Return the scenario with one more metric, in place of one of the same name."""
    return replace(scenario, metrics=(*(m for m in scenario.metrics if m.name != metric.name), metric))
