"""What `import sbt` offers: run, open, simulate, list, check; the command line calls the same."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from sbt import plugins
from sbt.config.load import load
from sbt.config.scenario_file import is_scenario
from sbt.config.source import read_value
from sbt.errors import InputError, PluginError, SbtError, did_you_mean, must_be
from sbt.execution.carrying import carry
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_traced
from sbt.plugins import OBJECT, Objects, Scope
from sbt.plugins.approval import trust_store
from sbt.problem.description import describe_scenario, scenario_differences
from sbt.problem.metric import Metric, metric_from
from sbt.problem.outcome import Job
from sbt.problem.plain import Json, Value
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.workflows.checking import Finding, findings_of
from sbt.workflows.keywords import CampaignKeys, Setting, as_data, check_listener
from sbt.workflows.one_run import Run
from sbt.workflows.result import Result
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

if TYPE_CHECKING:
    from typing import Unpack

    from sbt.campaigns.boundary import BoundaryConclusion
    from sbt.campaigns.coverage import CoverageConclusion
    from sbt.campaigns.estimation import EstimationConclusion
    from sbt.campaigns.failures import FalsificationConclusion

__all__ = ["Checked", "Run", "check_target", "findings_in", "installed", "open_result", "run_campaign", "simulate_scenario"]


@overload
def run_campaign(*, campaign: Literal["boundary"], **keys: Unpack[CampaignKeys]) -> Result[BoundaryConclusion]: ...
@overload
def run_campaign(*, campaign: Literal["falsification"], **keys: Unpack[CampaignKeys]) -> Result[FalsificationConclusion]: ...
@overload
def run_campaign(*, campaign: Literal["estimation"], **keys: Unpack[CampaignKeys]) -> Result[EstimationConclusion]: ...
@overload
def run_campaign(*, campaign: Literal["coverage"], **keys: Unpack[CampaignKeys]) -> Result[CoverageConclusion]: ...
@overload
def run_campaign(*, campaign: object, **keys: Unpack[CampaignKeys]) -> Result[Any]: ...
@overload
def run_campaign(config: str | Path, **keys: Unpack[CampaignKeys]) -> Result[Any]: ...
def run_campaign(config: str | Path | None = None, **keys: Any) -> Result[Any]:
    """Run a campaign to its end, or go on where its store stopped.

    Args:
        config: a configuration file; None: the keywords are the whole configuration.
        **keys: every key of a configuration (docs/configuration.md), as plain data or as objects: a `Scenario`, a
            `Requirement`, a metamodel (class or settings), an acquisition function, metrics, a campaign. With a file they
            replace the keys of the file. Besides: `workers` (processes), `report` (write report.html; default True),
            `progress` (called after every run).

    Returns:
        The result; its `conclusion` has the type that belongs to the campaign.

    Raises:
        InputError: anything in the configuration breaks a rule, or the store belongs to another configuration or scenario.
        StoreError: the store cannot be written.
    """
    plugins.forget_changed()
    must_be("a configuration must be the path of a file", config, str, Path, type(None))
    known = (*CampaignKeys.__annotations__, "campaign")
    for name in keys:
        if name not in known:
            raise InputError(f"run takes the keys of a configuration, but got '{name}'{did_you_mean(name, known)}")
    progress, report, workers = keys.pop("progress", None), keys.pop("report", True), keys.pop("workers", None)
    check_listener(progress)
    data, objects = as_data(keys)
    if config is not None:
        overrides = [] if workers is None else [f"executor.workers={int(workers)}"]
        study = Study.from_file(config, overrides, changes=data, objects=objects)
    else:
        if workers is not None:
            data["executor"] = {**data.get("executor", {}), "workers": workers}
        study = Study.from_mapping(data, name="sbt.run", scope=Scope(Path.cwd(), objects))
    summary = run_study(study, progress=progress, report=report)
    trust_store(Path(summary.store))  # the caller has named its code, which has run
    return Result(Path(summary.store).absolute(), objects)


def open_result(
    store: str | Path, *, scenario: LogicalScenario | None = None, metamodel: object = None, acquisition: object = None,
    metrics: Sequence[Metric | Callable[[Trace], float]] = (), campaign: object = None, trust: bool = False,
) -> Result[Any]:  # fmt: skip
    """Return the result in a store, also while its campaign runs.

    Args:
        store: the folder.
        scenario: the object that the store was made with, where runs are to be executed again: trace, film, replay.
        metamodel: likewise, to predict and for figures of the metamodel.
        acquisition: likewise.
        metrics: likewise, beside the scenario.
        campaign: likewise, for the type of the conclusion.
        trust: approve the code that the store names (`file.py:NAME`), with the content that it has now.

    Raises:
        StoreError: the folder holds no campaign.
        InputError: an object is not the one that the store was made with.
    """
    must_be("a store must be the path of a folder", store, str, Path)
    folder = Path(store).expanduser()
    if trust:
        trust_store(folder)
    given = {"scenario": scenario, "metamodel": metamodel, "acquisition": acquisition, "campaign": campaign}
    for name, value in given.items():
        if isinstance(value, str | Path):
            raise InputError(f"{name} must be the object that the store was made with, but got '{value}'")
    _, objects = as_data({key: value for key, value in given.items() if value is not None} | {"metrics": metrics})
    with Store.read(folder) as opened:
        study = Study.from_store(opened, objects=objects)
        _check_objects(study, objects, folder)
        if scenario is not None and not study.config.metrics:
            changed = scenario_differences(study.kept["described"], describe_scenario(study.runnable))
            if changed:
                raise InputError(f"scenario {scenario.name} must be the one that {folder} was made with, but {changed}")
    return Result(folder.absolute(), objects)


def _check_objects(study: Study, objects: Objects, folder: Path) -> None:
    """Refuse objects that the store was not made with."""
    config = study.config
    expected = {
        "scenarios": [config.scenario], "metamodels": [config.metamodel.kind] if config.metamodel is not None else [],
        "acquisitions": [config.acquisition.kind], "metrics": list(config.metrics), "campaigns": [config.campaign],
    }  # fmt: skip
    for kind, name in objects:
        if name not in expected[kind]:
            stored = ", ".join(n.removeprefix(OBJECT) for n in expected[kind]) or "none"
            one, given = kind.removesuffix("s"), name.removeprefix(OBJECT)
            raise InputError(f"the store in {folder} was made with {one} {stored}, but got {given}")


def simulate_scenario(
    scenario: LogicalScenario | str | Path, inputs: Mapping[str, Value] | None = None, *, seed: int = 0,
    ego: Setting | None = None, step_length: float | None = None, isolation: str = "auto",
    metrics: Sequence[Metric | str | Callable[[Trace], float]] = (), traced: bool = False, as_text: bool = False,
) -> Run:  # fmt: skip
    """Run one concrete scenario.

    Args:
        scenario: an object, an installed name, `file.py:NAME`, `scenario.yaml`, `testbed:NAME` or `table:FOLDER`.
        inputs: values by name; the others are at the centre of their range, or their likeliest choice.
        seed: of the run, >= 0.
        ego: the AV under test: a kind, or kind and settings.
        step_length: simulation step (s).
        isolation: how SUMO is kept between runs.
        metrics: further ones to measure.
        traced: refuse a scenario that gives no trace, before it runs.
        as_text: values are texts of a command line; those of inputs with ranges are read as YAML.

    Returns:
        The run; one that fails says why in `status` and `reason`.

    Raises:
        InputError: there is no such scenario, or it does not take these inputs or choices.
    """
    plugins.forget_changed()
    choice = {"kind": ego} if isinstance(ego, str) else ego
    must_be("ego must be a kind, or a mapping of kind and settings", choice, Mapping, type(None))
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed must be a whole number >= 0, but got {seed!r}")
    if inputs is not None and not isinstance(inputs, Mapping):
        raise InputError(f"inputs must be values by name, such as {{'d_v': 110}}, but got {inputs!r}")
    if step_length is not None and not 0 < step_length < math.inf:
        raise InputError(f"step_length must be > 0 s, but got {step_length}")
    named = tuple(m for m in metrics if isinstance(m, str))
    own = tuple(metric_from(m) for m in metrics if not isinstance(m, str))
    if isinstance(scenario, LogicalScenario) and not named:  # it stays in this process: no need to carry it
        found = scenario.configured(choice, isolation, step_length)
    else:
        spec = _spec(scenario, isolation)
        found = replace(spec, ego=choice, step_length=step_length, metrics=named).resolve()
    if traced and found.simulate is None:
        raise InputError(f"a trace needs a scenario that is simulated, but {found.name} gives its metrics directly")
    if own:
        found = replace(found, metrics=(*found.metrics, *own))
    given = dict(inputs or {})
    if as_text:
        given = {k: v if k in found.space.choices else read_value(str(v), f"input {k}") for k, v in given.items()}
    values = found.space.values(given)
    outcome, states = run_traced(found, Job(0, values, int(seed)))
    return Run(found, values, int(seed), outcome, states, "" if isinstance(scenario, LogicalScenario) else str(scenario))


def _spec(scenario: LogicalScenario | str | Path, isolation: str) -> ScenarioSpec:
    """Return a scenario as its specification."""
    if isinstance(scenario, LogicalScenario):
        return ScenarioSpec(OBJECT + scenario.name, str(Path.cwd()), isolation=isolation, carried=carry(scenario))
    must_be("a scenario must be a Scenario or its name", scenario, str, Path)
    return ScenarioSpec(str(scenario), str(Path.cwd()), isolation=isolation)


@dataclass(frozen=True, repr=False)
class Checked:
    """What the check of a scenario found: one finding a rule."""

    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether every rule holds."""
        return all(finding.ok for finding in self.findings)

    def to_dict(self) -> Json:
        """Return what `check --json` prints, but the target."""
        return {"ok": self.ok, "findings": [vars(finding) for finding in self.findings]}

    def __repr__(self) -> str:
        """Return a line a rule."""
        return "\n".join(map(str, self.findings))


def check_target(target: LogicalScenario | str | Path, *, seed: int = 0, isolation: str = "auto") -> Checked:
    """Try out the contract of a scenario: corners run, same seed same trace, also in another process and reused.

    Args:
        target: a scenario as for `simulate`, or a configuration file (its scenario, with its ranges).
        seed: of the runs.
        isolation: how SUMO is kept between runs.

    Raises:
        InputError: it cannot be loaded.
    """
    return Checked(tuple(findings_in(target, seed=seed, isolation=isolation)))


def findings_in(target: LogicalScenario | str | Path, *, seed: int, isolation: str) -> Iterator[Finding]:
    """Yield what `check_target` finds, each finding as soon as it is known."""
    plugins.forget_changed()
    if isinstance(target, str | Path) and Path(target).suffix in (".yaml", ".yml") and not is_scenario(Path(target)):
        study = Study(load(target))
        return chain(_starts_warm(study), findings_of(study.spec, seed, study.scenario, lambda: study.covariates))
    return findings_of(_spec(target, isolation), seed)


def _starts_warm(study: Study) -> Iterator[Finding]:
    """Yield whether the campaign that `warm_start` names can teach this one; nothing where there is none."""
    if study.config.warm_start is None:
        return
    try:
        _ = study.settings
        problem = ""
    except SbtError as error:
        problem = str(error)
    yield Finding("the earlier campaign can teach this one", not problem, problem)


_WRITTEN = {"table": "table:FOLDER", "testbed": "testbed:NAME", "yaml": "FOLDER/scenario.yaml"}
"""How the sources of this package are asked for a scenario; others as PREFIX:REST."""


def installed(kind: str = "scenarios") -> dict[str, str]:
    """Return what is installed of a kind: a line on each, by name; what cannot be loaded says so.

    Args:
        kind: scenarios, sources, metamodels, acquisitions, metrics, controllers or campaigns.

    Raises:
        InputError: there is no such kind.
    """
    must_be("KIND must be text", kind, str)
    if kind not in plugins.KINDS:
        raise InputError(f"KIND must be one of {', '.join(plugins.KINDS)}, but got '{kind}'{did_you_mean(kind, plugins.KINDS)}")
    if kind == "sources":
        from sbt import testbeds

        found = {_WRITTEN.get(n, f"{n}:REST"): _line_on(plugins.load("sources", n)) for n in plugins.names("sources")}
        return found | {f"testbed:{n}": testbeds.find(n).title for n in testbeds.names()}
    entries = {}
    for name in plugins.names(kind):
        try:
            entries[name] = _line_on(plugins.load(kind, name))
        except PluginError as error:
            entries[name] = f"cannot be loaded: {error}"
    return entries


def _line_on(thing: Any) -> str:
    """Return the first line of a description or docstring; of a scenario without one its inputs."""
    own = f"inputs: {', '.join(thing.space.names)}" if isinstance(thing, LogicalScenario) else inspect.getdoc(thing)
    text = getattr(thing, "description", "") or own or ""
    unit = f" ({thing.unit})" if getattr(thing, "unit", "") else ""
    return (text.strip().splitlines() or [""])[0] + unit
