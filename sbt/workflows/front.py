"""What `import sbt` offers: run, open, simulate, list, check; the command line calls the same."""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, overload

import numpy as np

from sbt import plugins
from sbt.config.load import load
from sbt.config.scenario_file import is_scenario
from sbt.errors import InputError, PluginError, did_you_mean
from sbt.execution.carrying import carry
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_traced
from sbt.loop.stages import Progress
from sbt.plugins import OBJECT, Scope
from sbt.problem.description import scenario_differences
from sbt.problem.distribution import Distribution
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario, Metric, metric_from
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.workflows.checking import Finding, check_scenario
from sbt.workflows.result import Result
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

if TYPE_CHECKING:
    from typing import Unpack

    import pandas as pd

    from sbt.campaigns.boundary import BoundaryConclusion
    from sbt.campaigns.coverage import CoverageConclusion
    from sbt.campaigns.estimation import EstimationConclusion
    from sbt.campaigns.failures import FalsificationConclusion

__all__ = ["CampaignKeys", "Checked", "Run", "check_target", "installed", "open_result", "run_campaign", "simulate_scenario"]

Setting = str | Mapping[str, Any]


class CampaignKeys(TypedDict, total=False):
    """Keys of a configuration (but `campaign`), as `run` takes them; see docs/configuration.md."""

    scenario: LogicalScenario | str
    requirement: Requirement | Mapping[str, Any]
    inputs: Mapping[str, Any]
    correlation: Sequence[Any]
    constraints: Sequence[str]
    features: Mapping[str, str]
    metrics: Sequence[Metric | str | Callable[[Trace], float]]
    ego: Setting | None
    simulation: Mapping[str, Any]
    seed: int
    budget: int
    initial: int
    batch: int
    validation: Mapping[str, Any]
    metamodel: object
    acquisition: object
    stop: Mapping[str, Any]
    gate: Mapping[str, float] | None
    warm_start: Mapping[str, Any] | str | Path | None
    executor: Setting
    store: str | Path
    workers: int
    report: bool
    progress: Callable[[Progress], None] | None


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
    known = (*CampaignKeys.__annotations__, "campaign")
    for name in keys:
        if name not in known:
            raise InputError(f"run takes the keys of a configuration, but got '{name}'{did_you_mean(name, known)}")
    progress, report, workers = keys.pop("progress", None), keys.pop("report", True), keys.pop("workers", None)
    data, objects = _as_data(keys)
    if config is not None:
        overrides = [] if workers is None else [f"executor.workers={int(workers)}"]
        study = Study.from_file(config, overrides, changes=data, objects=objects)
    else:
        if workers is not None:
            data["executor"] = {**data.get("executor", {}), "workers": workers}
        study = Study.from_mapping(data, name="sbt.run", scope=Scope(Path.cwd(), objects))
    summary = run_study(study, progress=progress, report=report)
    return Result(Path(summary.store), objects)


def _as_data(keys: Mapping[str, Any]) -> tuple[dict[str, Any], dict[tuple[str, str], Any]]:
    """Return keywords as a configuration's plain data, and the objects among them by kind and name."""
    objects: dict[tuple[str, str], Any] = {}

    def named(kind: str, thing: Any) -> str:
        """Return the name that stands for an object in the configuration."""
        name = OBJECT + str(getattr(thing, "name", None) or getattr(thing, "__name__", None) or type(thing).__name__)
        objects[kind, name] = thing
        return name

    def choice(kind: str, given: Any) -> Any:
        if given is None:
            return None
        if isinstance(given, Mapping):
            return {k: named(kind, v) if k == "kind" and not isinstance(v, str) else _plain(v) for k, v in given.items()}
        return {"kind": str(given) if isinstance(given, str | Path) else named(kind, given)}

    data: dict[str, Any] = {}
    for key, given in keys.items():
        if key in ("metamodel", "acquisition"):
            data[key] = choice(f"{key}s", given)
        elif key in ("scenario", "campaign"):
            data[key] = str(given) if isinstance(given, str | Path) else named(f"{key}s", given)
        elif key == "metrics":
            data[key] = [m if isinstance(m, str) else named("metrics", metric_from(m)) for m in given]
        elif key in ("ego", "executor") and isinstance(given, str):
            data[key] = {"kind": given}
        elif key == "warm_start" and isinstance(given, str | Path):
            data[key] = {"store": str(given)}
        elif key == "requirement" and isinstance(given, Requirement):
            data[key] = {"metric": given.metric, "critical": [given.low, given.high]}
        elif key == "inputs" and isinstance(given, Mapping):
            data[key] = {name: _input(change) for name, change in given.items()}
        else:
            data[key] = _plain(given)
    return data, objects


def _input(change: Any) -> Any:
    """Return the change of an input as plain data: of a range, a distribution, or a whole parameter."""
    if isinstance(change, Parameter):
        law = {} if change.distribution is None else {"distribution": change.distribution}
        change = {"min": change.low, "max": change.high, **law}
    if isinstance(change, Distribution):
        change = {"distribution": change}
    if isinstance(change, Mapping):
        return {k: {"kind": v.kind, **dict(v.parameters)} if isinstance(v, Distribution) else _plain(v) for k, v in change.items()}
    return _plain(change)


def _plain(value: Any) -> Any:
    """Return plain data: scalars and arrays of NumPy and paths become Python's own."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, builtins.list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def open_result(
    store: str | Path, *, scenario: LogicalScenario | None = None, metamodel: object = None, acquisition: object = None,
    metrics: Sequence[Metric | Callable[[Trace], float]] = (), campaign: object = None,
) -> Result[Any]:  # fmt: skip
    """Return the result in a store, also while its campaign runs.

    Args:
        store: the folder.
        scenario, metamodel, acquisition, metrics, campaign: objects that the store was made with, where something needs
            them: to run is to need the scenario, to predict the metamodel.

    Raises:
        StoreError: the folder holds no campaign.
        InputError: an object is not the one that the store was made with.
    """
    folder = Path(store)
    given = {"scenario": scenario, "metamodel": metamodel, "acquisition": acquisition, "campaign": campaign}
    _, objects = _as_data({key: value for key, value in given.items() if value is not None} | {"metrics": metrics})
    with Store.read(folder) as opened:
        study = Study.from_store(opened, objects=objects)
        _check_objects(study, objects, folder)
        if scenario is not None and not study.config.metrics:
            changed = scenario_differences(study.kept["described"], Study(study.loaded).snapshot()["described"])
            if changed:
                raise InputError(f"scenario {scenario.name} must be the one that {folder} was made with, but {changed}")
    return Result(folder, objects)


def _check_objects(study: Study, objects: Mapping[tuple[str, str], Any], folder: Path) -> None:
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


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """One concrete scenario that was run.

    Attributes:
        scenario: what was run.
        inputs: all of them, in their units.
        seed: of the run.
        outcome: status, metrics, or the reason why there are none.
        states: the trace; None where the scenario has none or the run failed.
    """

    scenario: LogicalScenario
    inputs: Mapping[str, float]
    seed: int
    outcome: Outcome
    states: Trace | None = None

    @property
    def status(self) -> Status:
        """How the run ended."""
        return self.outcome.status

    @property
    def metrics(self) -> Mapping[str, float]:
        """Every metric by name; empty where the run failed."""
        return self.outcome.metrics

    @property
    def reason(self) -> str:
        """Why there are no metrics."""
        return self.outcome.reason

    @property
    def critical(self) -> bool | None:
        """Whether the requirement is violated; None where the run has no metric."""
        return self.scenario.requirement.is_critical(self.metrics) if self.status == Status.OK else None

    @property
    def margin(self) -> float | None:
        """Signed distance of the metric to the critical interval, <= 0 where critical; None where the run has no metric."""
        need = self.scenario.requirement
        return float(need.critical.margin(np.array(self.metrics[need.metric]))) if self.status == Status.OK else None

    @cached_property
    def trace(self) -> pd.DataFrame:
        """The states of every road user over time.

        Raises:
            InputError: the run has no trace.
        """
        import pandas as pd

        if self.states is None:
            reason = self.reason or f"scenario {self.scenario.name} gives its metrics directly"
            raise InputError(f"only a run with a trace can be shown, but this one has none: {reason}")
        return pd.DataFrame(self.states.rows())

    def to_dict(self) -> dict[str, Any]:
        """Return what `simulate --json` prints."""
        return {
            "scenario": self.scenario.name, "seed": self.seed, "inputs": dict(self.inputs), "status": str(self.status),
            "metrics": dict(self.metrics), "critical": self.critical, "reason": self.reason, "seconds": self.outcome.seconds,
        }  # fmt: skip

    def __repr__(self) -> str:
        """Return status, metrics and verdict."""
        metrics = ", ".join(f"{name} {value:g}" for name, value in self.metrics.items())
        verdict = {True: "critical", False: "not critical", None: self.reason}[self.critical]
        return f"<Run of {self.scenario.name}, seed {self.seed}: {self.status}, {metrics or 'no metrics'}; {verdict}>"


def simulate_scenario(
    scenario: LogicalScenario | str | Path, inputs: Mapping[str, float] | None = None, *, seed: int = 0,
    ego: Setting | None = None, step_length: float | None = None, isolation: str = "auto",
    metrics: Sequence[Metric | str | Callable[[Trace], float]] = (),
) -> Run:  # fmt: skip
    """Run one concrete scenario.

    Args:
        scenario: an object, an installed name, `file.py:NAME`, `scenario.yaml`, `testbed:NAME` or `table:FOLDER`.
        inputs: values by name; the others are at the centre of their range.
        seed: of the run, >= 0.
        ego: the AV under test: a kind, or kind and settings.
        step_length: simulation step (s).
        isolation: how SUMO is kept between runs.
        metrics: further ones to measure.

    Returns:
        The run; one that fails says why in `status` and `reason`.

    Raises:
        InputError: there is no such scenario, or it does not take these inputs or choices.
    """
    spec = _spec(scenario, isolation)
    choice = {"kind": ego} if isinstance(ego, str) else ego
    own = [metric_from(m) for m in metrics if not isinstance(m, str)]
    spec = ScenarioSpec(
        spec.name, spec.folder, choice, isolation, step_length, metrics=tuple(m for m in metrics if isinstance(m, str)),
        carried=spec.carried,
    )  # fmt: skip
    found = spec.resolve()
    if own:
        found = replace(found, metrics=(*found.metrics, *own))
    values = found.space.values({name: _number(name, value) for name, value in (inputs or {}).items()})
    outcome, states = run_traced(found, Job(0, values, seed))
    return Run(found, values, seed, outcome, states)


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"input {name} must be a number, but got {value!r}")
    return float(value)


def _spec(scenario: LogicalScenario | str | Path, isolation: str) -> ScenarioSpec:
    """Return a scenario as its specification."""
    if isinstance(scenario, LogicalScenario):
        return ScenarioSpec(OBJECT + scenario.name, str(Path.cwd()), isolation=isolation, carried=carry(scenario))
    if not isinstance(scenario, str | Path):
        raise InputError(f"a scenario must be a Scenario or its name, but got {type(scenario).__name__}")
    return ScenarioSpec(str(scenario), str(Path.cwd()), isolation=isolation)


@dataclass(frozen=True, repr=False)
class Checked:
    """What the check of a scenario found: one finding a rule."""

    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether every rule holds."""
        return all(finding.ok for finding in self.findings)

    def __repr__(self) -> str:
        """Return a line a rule."""
        return "\n".join(f"{'ok  ' if f.ok else 'FAIL'}  {f.rule}: {f.detail}" for f in self.findings)


def check_target(target: LogicalScenario | str | Path, *, seed: int = 0, isolation: str = "auto") -> Checked:
    """Try out the contract of a scenario: corners run, same seed same trace, also in another process and reused.

    Args:
        target: a scenario as for `simulate`, or a configuration file (its scenario, with its ranges).
        seed: of the runs.
        isolation: how SUMO is kept between runs.

    Raises:
        InputError: it cannot be loaded.
    """
    if not isinstance(target, LogicalScenario) and Path(target).suffix in (".yaml", ".yml") and not is_scenario(Path(target)):
        study = Study(load(target))
        return Checked(check_scenario(study.spec, seed, study.scenario))
    return Checked(check_scenario(_spec(target, isolation), seed))


_KINDS = ("scenarios", "sources", "metamodels", "acquisitions", "metrics", "controllers", "campaigns")
_WRITTEN = {"table": "table:FOLDER", "testbed": "testbed:NAME", "yaml": "FOLDER/scenario.yaml"}
"""How the sources of this package are asked for a scenario; others as PREFIX:REST."""


def installed(kind: str = "scenarios") -> dict[str, str]:
    """Return what is installed of a kind: a line on each, by name; what cannot be loaded says so.

    Args:
        kind: scenarios, sources, metamodels, acquisitions, metrics, controllers or campaigns.

    Raises:
        InputError: there is no such kind.
    """
    if kind not in _KINDS:
        raise InputError(f"KIND must be one of {', '.join(_KINDS)}, but got '{kind}'{did_you_mean(kind, _KINDS)}")
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
    """Return the first line of a description or docstring."""
    text = getattr(thing, "description", "") or inspect.getdoc(thing) or ""
    unit = f" ({thing.unit})" if getattr(thing, "unit", "") else ""
    return (text.strip().splitlines() or [""])[0] + unit
