"""Runs a configured campaign from its first run to its report, or resumes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sbt import plugins
from sbt.campaigns.parts import Settings
from sbt.errors import InputError
from sbt.execution.dask import DaskExecutor
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import Executor, SerialExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job, versions
from sbt.files import write_atomically
from sbt.loop.learner import Learner
from sbt.loop.stages import Campaign, Progress, Shard, check_shard, run_shard, run_stages
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.store.history import History, Record

if TYPE_CHECKING:
    from sbt.config.assemble import Assembly
    from sbt.config.load import Loaded
    from sbt.config.model import Configuration

__all__ = [
    "RESOLVED", "assembly_of", "earlier_runs", "keep_configuration", "kept_of", "loaded_from", "rebuild_report", "replay",
    "result_of", "run_campaign", "scenario_of_run", "settings_of", "whole_budget",
]  # fmt: skip

RESOLVED = "config.resolved.yaml"
"""The configuration with its defaults, in a store's folder."""
_UNLEARNED = ("monte_carlo", "subset")
"""Ways to draw that look at no metamodel."""
_MAY_CHANGE = {"budget", "folder", "yaml"}


def run_campaign(
    loaded: Loaded, *, progress: Callable[[Progress], None] | None = None, report: bool = True, shard: Shard | None = None
) -> dict[str, Any]:
    """Run a campaign to its end, or go on where the store stopped.

    Args:
        loaded: a checked configuration.
        progress: called after every run.
        report: write `report.html` in the end.
        shard: run only its share of the runs, into a store that `sbt.workflows.merging` joins with the others'; no report.

    Returns:
        What `run --json` prints: campaign, scenario, store, runs, ok, failed, critical, iterations,
        stopped, seconds, conclusion.

    Raises:
        InputError: the configuration does not fit the scenario, the store belongs to another one, or the
            campaign cannot be run in shards.
        StoreError: the store cannot be written.
    """
    from sbt.config.load import resumed

    folder = Path(loaded.config.store)
    loaded = replace(loaded, config=resumed(loaded.config, _stored(folder)))
    config = loaded.config
    parts = assembly_of(loaded)
    settings = settings_of(loaded, parts)
    campaign: Campaign = plugins.load("campaigns", config.campaign)(settings)
    kept = kept_of(loaded, settings, shard)
    executor = _executor(config, parts.spec)
    common: dict[str, Any] = {
        "seed": config.seed, "requirement": settings.scenario.requirement, "versions": versions(),
        "listener": progress or (lambda _: None),
    }  # fmt: skip
    if shard is not None:
        check_shard(campaign)
    with Store.open(folder, kept) as store:
        _check_same(store, kept)
        keep_configuration(store, config, kept)
        with executor:
            if shard is None:
                found = run_stages(campaign, store, executor, budget=whole_budget(config), **common)
            else:
                found = run_shard(campaign, shard, store, executor, **common)
        result = result_of(store, settings, config, *found)
        store.conclude(result)
        if report and shard is None:
            _report(store, settings)
    return result


def whole_budget(config: Configuration) -> int:
    """Return the number of runs, those included that only score."""
    return config.budget + config.validation.reference


def keep_configuration(store: Store, config: Configuration, kept: Mapping[str, Any]) -> None:
    """Write what a store remembers of its configuration, and the YAML beside it."""
    from sbt.config.load import dump

    store.update_configuration(kept)
    write_atomically(store.folder / RESOLVED, dump(config))


def assembly_of(loaded: Loaded) -> Assembly:
    """Return the objects that a configuration names."""
    from sbt.config.assemble import assemble

    return assemble(loaded)


def scenario_of_run(loaded: Loaded) -> LogicalScenario:
    """Return the scenario as a configuration asks for it."""
    return assembly_of(loaded).scenario


def _stored(folder: Path) -> dict[str, Any]:
    """Return the configuration of the store that is there, empty without one."""
    if not Store.begun(folder):
        return {}
    with Store.read(folder) as store:
        return store.configuration


def kept_of(loaded: Loaded, settings: Settings, shard: Shard | None = None) -> dict[str, Any]:
    """Return what the store remembers of a configuration: plain JSON, and the YAML to read back."""
    from sbt.config.load import dump, fingerprint

    return {
        **fingerprint(loaded.config), "budget": loaded.config.budget, "names": list(settings.scenario.space.names),
        "folder": str(Path(loaded.folder).resolve()), "yaml": dump(loaded.config),
        **({} if shard is None else {"shard": {"number": shard.number, "of": shard.of}}),
    }  # fmt: skip


def settings_of(loaded: Loaded, parts: Assembly) -> Settings:
    """Return what the campaigns are built from."""
    from sbt.config.campaigns import CAMPAIGNS

    config, recorded = loaded.config, parts.scenario.pool is not None
    blind = config.campaign == "estimation" and config.acquisition.kind in _UNLEARNED
    learner = None
    if parts.metamodel is not None and not blind:
        learner = Learner(parts.scenario, parts.metamodel, config.seed, CAMPAIGNS[config.campaign].adaptive)
    return Settings(
        parts.scenario, config.seed, config.budget, config.initial, config.batch,
        config.validation.share if learner is not None and not recorded else 0.0,
        0 if recorded else config.validation.reference, learner,
        parts.acquisition, config.acquisition.kind, config.stop.model_dump(),
        None if config.gate is None else config.gate.model_dump(), earlier_runs(loaded, parts.scenario),
    )  # fmt: skip


def earlier_runs(loaded: Loaded, scenario: LogicalScenario) -> History | None:
    """Return the runs of the campaign that `from` names, to learn from; None where it names none.

    Raises:
        InputError: there is no finished campaign, or it ran another scenario, ego, step or other inputs, or
            did not measure the metric.
    """
    config = loaded.config
    if config.earlier is None:
        return None
    folder = loaded.folder / Path(config.earlier).expanduser()
    with Store.read(folder) as store:
        before, history, finished = loaded_from(store), store.history(), store.conclusion is not None
    if not finished:
        raise InputError(f"from must name a finished campaign, but the one in {folder} has not concluded")
    if _what_runs(before) != _what_runs(loaded):
        told = f"{before.config.scenario} there, {config.scenario} here"
        raise InputError(f"from must name a campaign of the same scenario, ego and step, but {folder} has another ({told})")
    space = assembly_of(before).scenario.space
    if space.names != scenario.space.names:
        told = f"{', '.join(space.names)} there, {', '.join(scenario.space.names)} here"
        raise InputError(f"from must name a campaign of the same inputs, but {folder} has others ({told})")
    kept = history.where(scenario.space.feasible(history.x)) if len(history) else history
    if len(kept) and scenario.requirement.metric not in kept.metrics and kept.ok.any():
        raise InputError(f"from must name a campaign that measured {scenario.requirement.metric}, but {folder} did not")
    return kept


def _what_runs(loaded: Loaded) -> tuple[Any, ...]:
    """Return what decides the outcome of a concrete scenario: its code, the ego and the step."""
    config = loaded.config
    own = ".py:" in config.scenario or Path(config.scenario).suffix == ".yaml"
    name = str((loaded.folder / config.scenario).resolve()) if own else config.scenario
    ego = None if config.ego is None else config.ego.model_dump()
    return name, ego, config.simulation.step_length


def rebuild_report(folder: Path) -> Path:
    """Write the report of a store again, also while its campaign runs.

    Raises:
        StoreError: the folder holds no campaign.
    """
    with Store.read(folder) as store:
        loaded = loaded_from(store)
        return _report(store, settings_of(loaded, assembly_of(loaded)))


def loaded_from(store: Store) -> Loaded:
    """Return the configuration that a store was made with."""
    from sbt.config.load import parse

    kept = store.configuration
    return parse(kept["yaml"], name=str(store.folder / RESOLVED), folder=Path(kept["folder"]))


def replay(folder: Path, index: int) -> tuple[Record, Outcome, Trace | None, LogicalScenario]:
    """Execute a stored run again, as the campaign did.

    Returns:
        The stored row, the outcome now, the trace (none where the scenario has none or the run fails),
        and the scenario as it was configured.

    Raises:
        InputError: the store has no finished run of this index.
    """
    with Store.read(folder) as store:
        loaded, records = loaded_from(store), store.history().records
    found = [r for r in records if r.index == index]
    if not found:
        have = f"{records[0].index} to {records[-1].index}" if records else "none yet"
        raise InputError(f"a run must be a finished one of {folder} ({have}), but got {index}")
    record = found[0]
    parts = assembly_of(loaded)
    scenario = replace(parts.spec.resolve(), requirement=parts.scenario.requirement)
    outcome = run_job(scenario, Job(index, record.inputs, record.seed))
    again = scenario.simulate is not None and outcome.status == Status.OK
    return record, outcome, scenario.simulate(record.inputs, record.seed) if again and scenario.simulate else None, scenario


def _report(store: Store, settings: Settings) -> Path:
    from sbt.report.html import write_report

    belief = settings.learner.fit(store.history()) if settings.learner is not None else None
    return write_report(store, settings.scenario, None if belief is None else belief.predict)


def _executor(config: Configuration, spec: ScenarioSpec) -> Executor:
    choice = config.executor
    limit = None if choice.timeout == float("inf") else choice.timeout
    if choice.kind == "serial":
        return SerialExecutor(spec, limit)
    if choice.kind == "dask":
        return DaskExecutor(spec, choice.address, choice.workers, limit)
    return LocalExecutor(spec, choice.workers, limit)


def _check_same(store: Store, kept: Mapping[str, Any]) -> None:
    """Refuse to go on with a store that another configuration made.

    Only the budget may change (a shard's must not: its share was planned with it), and where runs are executed.
    """
    from sbt.config.load import differences

    before = store.configuration
    fixed = {*kept, *before} - (_MAY_CHANGE - {"budget"} if "shard" in kept else _MAY_CHANGE)
    if told := differences(before, kept, fixed):
        raise InputError(f"a store belongs to one configuration, but {store.folder} was made with another ({told})")


def result_of(
    store: Store, settings: Settings, config: Configuration, stopped: str, conclusion: Mapping[str, Any],
    seconds: Mapping[str, float],
) -> dict[str, Any]:  # fmt: skip
    """Return what `run --json` prints."""
    history = store.history()
    ok = int(history.ok.sum())
    critical = settings.scenario.requirement.critical.contains(history.y(settings.scenario.requirement.metric))
    return {
        "campaign": config.campaign, "scenario": config.scenario, "store": str(Path(config.store)), "runs": len(history),
        "ok": ok, "failed": len(history) - ok, "critical": int(critical.sum()), "iterations": len(store.iterations()),
        "stopped": stopped, "seconds": {k: round(v, 4) for k, v in seconds.items()}, "conclusion": dict(conclusion),
    }  # fmt: skip
