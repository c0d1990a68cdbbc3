"""From a checked configuration to the objects of a campaign: scenario, metamodel, acquisition.

Here the rules are checked that need the scenario or a plug-in; all problems are collected and
raised together, each at the place of the key that is responsible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from sbt.acquisitions import Acquisition, even
from sbt.config.fidelity import check_levels, coarse_level
from sbt.config.load import Loaded
from sbt.config.model import Choice
from sbt.config.several import combined_requirement
from sbt.config.source import Problems, must_be_measured, must_be_one_of
from sbt.config.space import configured_space
from sbt.errors import InputError
from sbt.execution.carrying import carry, keep_here
from sbt.execution.spec import ScenarioSpec
from sbt.metamodels.base import Metamodel, build, call
from sbt.metamodels.recalibrated import Recalibrated
from sbt.plugins import OBJECT, names
from sbt.problem.metric import metric_from
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario

__all__ = ["Assembly", "assemble", "check", "metamodel_of", "scenario_of", "spec_of"]

T = TypeVar("T")


@dataclass(frozen=True)
class Assembly:
    """What a configuration asks for, ready to run.

    Attributes:
        scenario: with the configured inputs and requirement.
        spec: the same scenario for other processes, as plain data.
        metamodel: settings, not fitted; None where the campaign learns nothing.
        acquisition: how much a candidate is worth; None where the campaign has its own way (`methods`).
    """

    scenario: LogicalScenario
    spec: ScenarioSpec
    metamodel: Metamodel | None
    acquisition: Acquisition | None


def assemble(loaded: Loaded) -> Assembly:
    """Return everything a campaign needs.

    Raises:
        ConfigError: all problems of the scenario, metamodel and acquisition at once.
    """
    metamodel, acquisition, scenario = check(loaded)
    if not _states_metamodel(loaded):
        metamodel = metamodel_of(loaded)
    return Assembly(scenario, spec_of(loaded), metamodel, acquisition)


def check(loaded: Loaded) -> tuple[Metamodel | None, Acquisition | None, LogicalScenario]:
    """Return metamodel, acquisition and scenario; a metamodel that the user does not state is right, and is not loaded for it.

    Libraries of metamodels take a second to load, which a message about a slip of the pen shall not wait for.

    Raises:
        ConfigError: all problems of the scenario, metamodel and acquisition at once.
    """
    problems = Problems(loaded.source)
    with loaded.scope.naming():
        metamodel = _metamodel(loaded, problems) if _states_metamodel(loaded) else None
        acquisition = _acquisition(loaded, problems)
        scenario = _scenario(loaded, problems)
        for k, driver in enumerate(loaded.config.judges or ()):
            problems.attempt(("judges", k), partial(loaded.scope.load, "controllers", driver))
    problems.check()
    return metamodel, acquisition, scenario


def _states_metamodel(loaded: Loaded) -> bool:
    return "metamodel" in loaded.config.model_fields_set


def scenario_of(loaded: Loaded) -> LogicalScenario:
    """Return the scenario with the configured inputs, requirement, ego, step and isolation.

    Raises:
        ConfigError: all problems of the scenario at once.
    """
    return _without_problems(loaded, _scenario)


def metamodel_of(loaded: Loaded) -> Metamodel | None:
    """Return the metamodel's settings, None where the campaign learns nothing.

    Raises:
        ConfigError: unknown metamodel, preset or setting, or a value it refuses.
    """
    return _without_problems(loaded, _metamodel)


def _without_problems(loaded: Loaded, make: Callable[[Loaded, Problems], T]) -> T:
    problems = Problems(loaded.source)
    with loaded.scope.naming():
        made = make(loaded, problems)
    problems.check()
    return made


def spec_of(loaded: Loaded) -> ScenarioSpec:
    """Return the scenario as plain data for other processes; files are absolute, objects given in Python are carried by value."""
    config, scope = loaded.config, loaded.scope
    ego = None if config.ego is None else _plain_ego(config.ego, loaded.folder)
    types = config.requirement.decisive if config.campaign == "falsification" else None  # failure modes are told apart by them
    named = tuple(name for name in config.metrics if not name.startswith(OBJECT))
    own = tuple(metric_from(scope.load("metrics", name)) for name in config.metrics if name.startswith(OBJECT))
    carried = b""
    if own or config.scenario.startswith(OBJECT):
        scenario = scope.load("scenarios", config.scenario)
        if not isinstance(scenario, LogicalScenario):
            raise InputError(f"a scenario must be a Scenario or the name of one, but got {scenario!r}")
        further = tuple(metric for metric in own if metric not in scenario.metrics)
        whole = replace(scenario, metrics=(*scenario.metrics, *further)) if further else scenario
        carried = keep_here(whole) if config.executor.kind == "serial" else carry(whole)
    return ScenarioSpec(
        config.scenario, str(loaded.folder.resolve()), ego, config.executor.isolation, config.simulation.step_length,
        config.requirement.stl, types, named, carried,
        friction=None if config.simulation.friction is None else (config.simulation.friction.min, config.simulation.friction.max),
        formulas=config.requirement.formulas, coarse=coarse_level(config, loaded.folder),
    )  # fmt: skip


def _plain_ego(ego: Choice, folder: Path) -> Json:
    kind = str(folder.resolve() / Path(ego.kind).expanduser()) if ".py:" in ego.kind else ego.kind
    return {"kind": kind, **ego.settings}


def _scenario(loaded: Loaded, problems: Problems) -> LogicalScenario:
    """Return the configured scenario, as far as the problems allow; raise them where there is none at all."""
    config, spec = loaded.config, problems.attempt(("scenario",), partial(spec_of, loaded))
    if spec is None:
        raise problems.error()
    scenario = spec.resolve_at(problems.attempt)
    if scenario is None:
        raise problems.error()
    space = configured_space(config, scenario.space, problems, loaded.folder)
    requirement = _requirement(loaded, scenario, problems)
    if (choice := config.fidelity) is not None:
        problems.attempt(("fidelity",), partial(check_levels, choice, spec, replace(scenario, requirement=requirement)))
    pool = scenario.pool
    if pool is not None and space is not scenario.space:
        pool = problems.attempt(("scenario",), partial(pool.within, scenario.space, space)) or pool
    return replace(scenario, space=space, requirement=requirement, pool=pool)


def _requirement(loaded: Loaded, scenario: LogicalScenario, problems: Problems) -> Requirement:
    """Return the scenario's requirement with the configured metric and interval, or the configured combination."""
    change, own = loaded.config.requirement, scenario.requirement
    if change.combined is not None:
        made = combined_requirement(change, scenario.measured, own, problems)
        return own if made is None else made
    if change.stl is not None:
        return own if change.critical is None else Requirement(own.metric, *change.critical)
    if own.combined and change.metric is None:
        if change.critical is not None:
            problems.add(("requirement", "critical"), f"it needs a metric: the scenario's own requirement is {own.metric}")
        return own
    metric = own.metric if change.metric is None else change.metric
    if change.critical is None and metric == own.metric:
        return own
    if metric not in scenario.measured:
        problems.add(("requirement", "metric"), must_be_measured(metric, scenario.measured))
        return own
    if change.critical is None:
        problems.add(("requirement",), f"critical: [low, high] is required with the metric {metric}")
        return own
    return Requirement(metric, *change.critical)


def _metamodel(loaded: Loaded, problems: Problems) -> Metamodel | None:
    choice = loaded.config.metamodel
    if choice is None:
        return None
    kind = problems.attempt(("metamodel", "kind"), lambda: loaded.scope.load("metamodels", choice.kind))
    if kind is None:
        return None
    if not callable(getattr(kind, "fit", None)):
        problems.add(
            ("metamodel", "kind"),
            f"a metamodel must be a class (or an object) with fit(u, y, rng), but '{choice.kind}' is not",
        )
        return None
    settings = choice.settings
    recalibrate = settings.pop("recalibrate", False)
    if not isinstance(recalibrate, bool):
        problems.add(("metamodel", "recalibrate"), f"must be true or false, but got {recalibrate!r}")
    made: Metamodel | None = problems.attempt(("metamodel",), lambda: build(kind, choice.preset, settings))
    if made is not None:
        call(made, choice.kind)
    return Recalibrated(made) if recalibrate is True and made is not None else made


def _acquisition(loaded: Loaded, problems: Problems) -> Acquisition | None:
    kind, installed = loaded.config.acquisition.kind, names("acquisitions")
    if kind in loaded.kind.methods:
        return None
    if kind.isidentifier() and kind not in installed and ("acquisitions", kind) not in loaded.scope.objects:
        known = must_be_one_of("acquisitions", kind, [*loaded.kind.methods, *installed])
        problems.add(("acquisition", "kind"), known.replace(", but got", ", or file.py:NAME, but got", 1))
        return even
    found = problems.attempt(("acquisition", "kind"), lambda: loaded.scope.load("acquisitions", kind))
    if found is not None and not callable(found):
        problems.add(("acquisition", "kind"), f"an acquisition must be a function, but '{kind}' is not")
    return even if found is None else found  # `even` only stands in until the problems are raised
