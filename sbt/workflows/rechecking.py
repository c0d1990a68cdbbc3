"""Whether a store's runs would come again from the user's code and files: some are tried before a campaign goes on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sbt.errors import InputError
from sbt.execution.protocol import Executor
from sbt.plugins import OBJECT
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import History, Record
from sbt.workflows.changes import changed_since
from sbt.workflows.study import Study

__all__ = ["check_code", "check_earlier", "not_repeated", "own_code"]

_TRIED = 20
"""Runs that are tried again, spread over those that are there, before a campaign goes on whose files or code were changed."""


def check_code(store: Store, study: Study, executor: Executor, *, changed: bool) -> None:
    """Refuse to go on with a store whose runs the user's code and files would not give again.

    Of each level of fidelity the first and the last with metrics are tried, where files or code were changed since as many as
    `_TRIED` of all, and the first that could not be run: code may change just what is invalid. Where nothing was changed, and
    SUMO does not repeat every run of such files, most of as many are enough.
    """
    if not own_code(study):
        return
    history = store.history(level=None)
    for level in np.unique(history.columns["level"]):
        scenario = study.runnable if level == 0 else study.spec.at_level(int(level)).resolve()
        unsure = "" if changed else not_repeated(scenario)
        _check_runs(store, history.at_level(int(level)), executor, changed=changed, unsure=unsure)


def _check_runs(store: Store, history: History, executor: Executor, *, changed: bool, unsure: str) -> None:
    """Refuse to go on where some of these runs, of one level of fidelity, do not come again.

    Args:
        store: named in the refusal.
        history: the runs.
        executor: runs them.
        changed: files or code were.
        unsure: why a run may differ all the same; "" for no reason.
    """
    ok, invalid = np.flatnonzero(history.ok), np.flatnonzero(history.status == str(Status.INVALID))
    tried = ok[np.linspace(0, len(ok) - 1, min(_TRIED if changed or unsure else 2, len(ok))).round().astype(np.intp)]
    again = list(_again(history, [*tried, *invalid[:1]], executor))
    differing = [(record, outcome) for record, outcome in again if dict(outcome.metrics) != dict(record.metrics)]
    if not unsure or 2 * len(differing) > len(again):
        for record, outcome in differing:
            now, stored = dict(outcome.metrics) or outcome.reason, dict(record.metrics) or record.reason
            run = f"run {record.index}" + (f" (a coarse one, at level {record.level})" if record.level else "")
            rule = f"code and files must give the runs of {store.folder} again to go on, but {run} now gives {now}"
            remedy = "choose another store for what has changed"
            raise InputError(f"{rule}, not {stored}{changed_since(store.folder, store.configuration) or unsure}; {remedy}")


def not_repeated(scenario: LogicalScenario) -> str:
    """Return in words why a run may differ although nothing was changed; "" where no reason is known."""
    from sbt.sumo.files import SumoFiles
    from sbt.sumo.repeating import unrepeatable

    files = getattr(scenario.simulate, "files", None)
    why = unrepeatable(files) if isinstance(files, SumoFiles) else ""
    return why and f"; {why}"


def check_earlier(study: Study) -> None:
    """Refuse to learn from an earlier campaign as from this one where code has changed: its first and last run are tried.

    With warmed traffic they are not, since another number of warm-ups is another beginning.
    """
    choice = study.config.warm_start
    if choice is None or choice.transfer or not own_code(study) or (study.isolation is not None and study.isolation.warm):
        return
    history = study.earlier_campaign().same_runs(study.scenario)
    ok = np.flatnonzero(history.ok & history.drawn & (history.columns["level"] == 0))
    with study.executor() as executor:
        for record, outcome in _again(history, [*ok[:1], *ok[-1:]], executor):
            stored = {name: value for name, value in record.metrics.items() if name in outcome.metrics or not outcome.metrics}
            now = {name: outcome.metrics[name] for name in stored if outcome.metrics} or outcome.reason
            if now != stored:
                rule = f"warm_start.store must be of what is run now, but its run {record.index} now gives {now}, not {stored}"
                raise InputError(f"{rule}: transfer: true takes it as another setup")


def own_code(study: Study) -> bool:
    """Return whether runs depend on files or objects of the user's."""
    config = study.config
    coarse = None if config.fidelity is None else config.fidelity.scenario
    code = [config.scenario, *([] if coarse is None else [coarse]), *config.metrics]
    code += [] if config.ego is None else [config.ego.kind]
    return any(name.startswith((OBJECT, "table:")) or ".py:" in name or name.endswith((".yaml", ".yml")) for name in code)


def _again(history: History, rows: Sequence[np.intp], executor: Executor) -> Iterator[tuple[Record, Outcome]]:
    """Yield the runs in these rows, and how they go now."""
    records = {record.index: record for record in (history.record(int(row)) for row in dict.fromkeys(rows))}
    for outcome in executor.run([Job(r.index, r.inputs, r.seed, r.level) for r in records.values()]):
        yield records[outcome.index], outcome
