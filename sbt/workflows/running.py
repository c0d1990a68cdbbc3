"""Runs a study from its first run to its report, or resumes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Integral
from pathlib import Path

import numpy as np

from sbt.config.load import differences, dump
from sbt.errors import InputError, PluginError, must_be
from sbt.execution.code_print import code_print
from sbt.execution.warming import warm_up
from sbt.execution.worker import run_traced, versions
from sbt.files import write_atomically
from sbt.loop.learner import FittedMetamodel
from sbt.loop.running import Finished, check_shard, run_shard, run_stages
from sbt.loop.stages import Conclusion, Facts, Log, Progress, Shard, sentences_of
from sbt.plugins import Objects, forget_files
from sbt.plugins.approval import is_trusted
from sbt.problem.description import scenario_differences
from sbt.problem.outcome import Doubt, Job, Outcome, Status
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.store.database import Store
from sbt.store.history import Record
from sbt.store.planning import storable
from sbt.workflows.asking import sensitivities_in
from sbt.workflows.changes import CONTENTS, changed_files, changed_since, contents_in, package_changed, package_print
from sbt.workflows.fidelity import COARSE_COST
from sbt.workflows.filming import film_runs
from sbt.workflows.judging import judge_campaign
from sbt.workflows.portable import write_bundle
from sbt.workflows.rechecking import check_code, check_earlier
from sbt.workflows.study import PACKAGE, RESOLVED, Study

__all__ = [
    "Replay", "Summary", "bundle_store", "keep_configuration", "rebuild_report", "replay_run", "run_study", "summarise",
]  # fmt: skip

CODE = "code"
"""Key under which a store remembers a print of the code of the user's own that its runs depend on."""
_MAY_CHANGE = {
    CODE, PACKAGE, CONTENTS, COARSE_COST, "budget", "described", "folder", "judges", "kind", "place", "sources", "yaml",
}  # fmt: skip
"""What may differ when a campaign is resumed; `described` is compared by `scenario_differences`."""


@dataclass(frozen=True)
class Summary:
    """How a campaign ended.

    Attributes:
        campaign, scenario, store: as configured.
        runs, ok, failed, critical: counts.
        unconfirmed: critical runs with a contact that SUMO's own list does not confirm.
        struck: critical runs in which a recorded road user, who does not react, hit the ego from behind.
        other_level: runs with a contact that is not counted, as roads that cross without a junction are taken for bridges.
        iterations: batches.
        stopped: why it ended.
        seconds: of `simulate`, `fit` and `propose`; `work` and `idle` of the workers, summed over them, from the first run
            to the last since the campaign was started, where their number is known.
        conclusion: what was found.
        sentences: the same in plain words.
        metric: that of the requirement, or what stands for it in a formula or a combination.
        units: of inputs and metrics, by name; of a metric with the name of an input as `y.NAME`.
        look_at: the run to look at first, as the sentences say; None: they name none.
    """

    campaign: str
    scenario: str
    store: str
    runs: int
    ok: int
    failed: int
    critical: int
    iterations: int
    stopped: str
    seconds: Mapping[str, float]
    conclusion: Conclusion
    unconfirmed: int = 0
    struck: int = 0
    other_level: int = 0
    sentences: tuple[str, ...] = ()
    metric: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    look_at: int | None = None

    def to_dict(self) -> Json:
        """Return what `run --json` prints."""
        plain = {"seconds": dict(self.seconds), "units": dict(self.units), "sentences": list(self.sentences)}
        found = {**vars(self), **plain, "conclusion": self.conclusion.to_dict()}
        return {key: value for key, value in found.items() if value is not None}


def run_study(
    study: Study, *, progress: Callable[[Progress], None] | None = None, report: bool = True, shard: Shard | None = None
) -> Summary:
    """Run a campaign to its end, or go on where its store stopped.

    Args:
        study: as configured.
        progress: called after every run.
        report: write `report.html` in the end.
        shard: run only its share of the runs, into a store that `merge` joins with the others'; no report.

    Raises:
        InputError: the configuration does not fit the scenario, the store belongs to another one, or the
            campaign cannot be run in shards.
        StoreError: the store cannot be written.
    """
    executor = study.executor()
    if not Store.begun(Path(study.config.store)):  # what can be wrong is found before there is a folder
        campaign = study.campaign
        if shard is not None:
            check_shard(campaign)
        check_earlier(study)
        if study.scenario.pool is not None and study.config.validation.reference:
            raise InputError("validation.reference: recorded rows have no runs beside them; those that are left over score")
    with Store.open(Path(study.config.store)) as store:
        study = study.stored_in(store)
        campaign, snapshot = study.campaign, study.snapshot(shard) | _code_of(study)
        snapshot |= {CONTENTS: contents_in(study.loaded.folder)}
        if shard is not None:
            check_shard(campaign)
        store.begin(snapshot)
        _check_same(store, snapshot)
        before = store.configuration
        begun, same_code = (store.folder / RESOLVED).is_file(), before.get(CODE, snapshot[CODE]) == snapshot[CODE]
        changed = begun and not (same_code and not changed_files(store.folder, before))
        package = begun and before.get(PACKAGE) != snapshot[PACKAGE]
        if not (changed or package):  # else what is written is newer, so that the runs are tried before
            keep_configuration(store, study, snapshot)
        common: Json = {
            "seed": study.config.seed, "requirement": study.scenario.requirement, "versions": versions(),
            "listener": progress or (lambda _: None),
        }  # fmt: skip
        executor = study.executor()  # at the isolation level that the store remembers
        warm_up(study.spec, study.config.executor.workers, partial(_tell, store, study, common["listener"]))
        with executor:
            check_code(store, study, executor, changed=changed, package=package)
            if changed or package:
                keep_configuration(store, study, snapshot)
            if shard is None:
                finished = run_stages(campaign, store, executor, budget=study.budget, workers=study.workers, **common)
            else:
                finished = run_shard(campaign, shard, store, executor, **common)
        if shard is None:
            tell = partial(_tell, store, study, common["listener"])
            finished = replace(finished, conclusion=judge_campaign(study, store, finished.conclusion, tell=tell))
        summary = summarise(store, study, finished)
        store.conclude(summary.to_dict())
        if report and shard is None:
            _report(store, study, finished.conclusion, finished.fitted)
    return summary


def _tell(store: Store, study: Study, listener: Callable[[Progress], None], activity: str) -> None:
    """Tell the listener what is done after the last run."""
    history = store.history()
    critical = int(np.count_nonzero(study.scenario.requirement.critical_runs(history)))
    counts = len(history), study.budget, int((~history.ok).sum()), critical, len(store.iterations())
    listener(Progress(*counts, activity))


def _code_of(study: Study) -> Json:
    """Return what a store remembers of the code that its runs depend on, and which inputs are spread in their logarithm."""
    logarithmic = [p.name for p in study.scenario.space.parameters if p.logarithmic]
    return {CODE: code_print(study.scenario), PACKAGE: package_print(), "logarithmic": logarithmic or None}


def keep_configuration(store: Store, study: Study, snapshot: JsonMapping) -> None:
    """Write what a store remembers of its configuration, and the YAML beside it."""
    store.update_configuration(snapshot)
    write_atomically(store.folder / RESOLVED, dump(study.config))


def summarise(store: Store, study: Study, finished: Finished) -> Summary:
    """Return how a campaign ended."""
    history, config, scenario = store.history(), study.config, study.scenario
    seconds, before = {k: round(v, 4) for k, v in finished.seconds.items()}, store.conclusion
    if before is not None and before["runs"] == len(history):  # nothing was run: what it took is known from then
        seconds = before["seconds"]
    ok, critical = int(history.ok.sum()), scenario.requirement.critical_runs(history)
    return Summary(
        config.campaign, config.scenario, str(Path(config.store)), len(history), ok, len(history) - ok,
        int(np.count_nonzero(critical)), len(store.iterations()), finished.stopped,
        seconds, finished.conclusion,
        int(np.count_nonzero(critical & history.unconfirmed)), int(np.count_nonzero(critical & history.doubtful(Doubt.STRUCK))),
        int(np.count_nonzero(history.doubtful(Doubt.OTHER_LEVEL))),
        tuple(sentences_of(finished.conclusion, Facts.of(history, scenario))),
        scenario.requirement.told_as, scenario.units, getattr(finished.conclusion, "look_at", None),
    )  # fmt: skip


def rebuild_report(
    folder: Path, *, objects: Objects | None = None, target: Path | None = None, told: Callable[[str], None] | None = None
) -> Path:  # fmt: skip
    """Write the report of a store again, also while its campaign runs; without a metamodel whose code is not at hand.

    Args:
        folder: of the store.
        objects: what was given in Python when it was made.
        target: folder to write to; None: the store's.
        told: called with what the report leaves out, and why, if it does; it says so itself, too.

    Raises:
        StoreError: the folder holds no campaign.
        InputError: it is one shard of a campaign.
    """
    with Store.read(folder) as store:
        study, ended = Study.from_store(store, objects=objects), store.conclusion
        if "shard" in store.configuration:
            raise InputError(f"a report is of a whole campaign, but {folder} is one shard of it: merge joins them")
        conclusion = None if ended is None else study.conclusion(ended["conclusion"])
        note = _left_out(study)
        if note and told is not None:
            told(note)
        return _report(store, study, conclusion, study.fit(store.history()) if study.learns else None, target, note)


def _left_out(study: Study) -> str:
    """Return why a report has nothing of the metamodel; "" where it has, or there is none."""
    choice = study.config.metamodel
    if choice is None or study.learns:
        return ""
    try:
        study.loaded.scope.load("metamodels", choice.kind)
    except PluginError as error:
        return f"The figures of the metamodel are left out: {error}"
    return ""


def _report(
    store: Store, study: Study, conclusion: Conclusion | None, fitted: FittedMetamodel | None, target: Path | None = None,
    note: str = "",
) -> Path:  # fmt: skip
    from sbt.report.html import write_report

    log = Log(store.history(), tuple(store.iterations()), ())
    scenario = replace(study.scenario, requirement=study.scenario.requirement.in_units_of(log.history))
    told = sensitivities_in(study, log) if getattr(conclusion, "probability", None) else ()
    learner = None if fitted is None else study.learner
    predict = None if fitted is None or learner is None else learner.told(fitted.predict, log.history, log.history.training)
    film = partial(film_runs, study, store.history())
    return write_report(store, scenario, predict, conclusion, folder=target, sensitivity=told, film=film, note=note)


@dataclass(frozen=True, eq=False)
class Replay:
    """A stored run, executed again.

    Attributes:
        record: the stored row.
        outcome: now.
        trace: None where the scenario has none or the run fails.
        scenario: as it was configured.
        executed: False: there is nothing to show, and the user's code was not run for it; the outcome is the stored one.
        changed: files that were changed since the campaign last began.
    """

    record: Record
    outcome: Outcome
    trace: Trace | None
    scenario: LogicalScenario
    executed: bool = True
    changed: tuple[Path, ...] = ()

    @property
    def differing(self) -> str:
        """What differs from the store in status, metrics (to the last bit), contacts and doubts, in words; "" for nothing.

        The text of a reason may name temporary files, and is not compared.
        """
        now, record = self.outcome, self.record
        if str(now.status) != record.status or dict(now.metrics) != dict(record.metrics):
            return f"{now.status} {dict(now.metrics)}, not {record.status} {dict(record.metrics)}"
        contacts = storable(now.collisions), storable(now.unconfirmed)
        stored = contacts if not self.executed else (record.collisions, record.unconfirmed)
        return "" if contacts == stored else f"contacts and doubts {contacts}, not {stored}"

    @property
    def as_stored(self) -> bool:
        """Whether nothing of it is `differing` from the store."""
        return not self.differing

    @property
    def identical(self) -> bool:
        """Whether it is the stored run: `as_stored`, from files that were not changed since; a metric at its cap tells little."""
        return self.as_stored and not self.changed


def replay_run(folder: Path, index: int, *, objects: Objects | None = None, execute: bool = False) -> Replay:
    """Execute a stored run again, as the campaign did.

    Where a file of Python gives metrics without a trace, there is nothing to show: its code runs only where that is asked for,
    by `execute` or by trusting the store.

    Raises:
        InputError: the store has no finished run of this index, or its code is needed and not approved.
    """
    again = _replayed(folder, index, objects, execute=execute)
    if again.changed:  # or files of another campaign that this process has read: what is read from now on is of this one
        forget_files()
        again = _replayed(folder, index, objects, execute=execute)
    return again


def _replayed(folder: Path, index: int, objects: Objects | None, *, execute: bool) -> Replay:
    """Return what `replay_run` does, with all files that were changed of those that this process has read."""
    must_be("a run must be its index", index, Integral)
    with Store.read(folder) as store:
        study, history = Study.from_store(store, objects=objects), store.history(level=None)
    rows = np.flatnonzero(history.index == index)
    if len(rows) == 0:
        have = f"{history.index[0]} to {history.index[-1]}" if len(history) else "none yet"
        raise InputError(f"a run must be a finished one of {folder} ({have}), but got {index}")
    record = history.record(int(rows[0]))
    if study.own_code and not study.kept["described"]["traced"] and not (execute or is_trusted(folder)):
        stored = Outcome(index, Status(record.status), record.metrics, record.reason, record.seconds)
        return Replay(record, stored, None, study.scenario, executed=False)
    with study.loaded.scope.naming():
        scenario, runs = study.runnable, study.spec.at_level(record.level).resolve()
        outcome, trace = run_traced(runs, Job(index, record.inputs, record.seed, record.level))
        if record.level:
            scenario = replace(scenario, simulate=runs.simulate, metrics=runs.metrics)
    return Replay(record, outcome, trace, scenario, changed=tuple(changed_files(folder, study.kept)))


def bundle_store(folder: Path, target: Path) -> list[Path]:
    """Write a zip with a store and the files of its scenario, which replays wherever it is unpacked; return these files.

    The first run that went well is executed again, so that all files are known that a run reads.

    Raises:
        InputError: the code is not approved, does not give the run again, or names files absolutely; no folder for the target.
        StoreError: the folder holds no campaign.
    """
    if not target.absolute().parent.is_dir():
        raise InputError(f"a bundle must be written into a folder that is there, but got '{target}'")
    forget_files()
    with Store.read(folder) as store:
        study, history = Study.from_store(store), store.history()
    with study.loaded.scope.naming():
        _, scenario = study.runnable, study.spec.resolve()  # the first one says what is wrong
        for row in np.flatnonzero(history.ok)[:1]:
            record = history.record(int(row))
            outcome, _ = run_traced(scenario, Job(record.index, record.inputs, record.seed))
            if dict(outcome.metrics) != dict(record.metrics):
                rule = f"a bundle must give the runs again, but run {record.index} now gives {dict(outcome.metrics)}"
                raise InputError(f"{rule}, not {dict(record.metrics)}{changed_since(folder, study.kept)}")
    return write_bundle(folder, study.loaded.folder, target)


def _check_same(store: Store, snapshot: JsonMapping) -> None:
    """Refuse to go on with a store that another configuration or scenario made.

    Only the budget may change (a shard's must not: its share was planned with it), and where runs are executed.
    """
    before = store.configuration
    fixed = {*snapshot, *before} - (_MAY_CHANGE - {"budget"} if "shard" in snapshot else _MAY_CHANGE)
    changed = differences(before, snapshot, fixed) or scenario_differences(before.get("described", {}), snapshot["described"])
    if changed:
        rule = f"a store belongs to one configuration, but {store.folder} was made with another ({changed})"
        raise InputError(f"{rule}{package_changed(before)}")
