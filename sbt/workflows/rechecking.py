"""Whether a store's runs would come again from the user's code and files: some are tried before a campaign goes on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.execution.protocol import Executor
from sbt.plugins import OBJECT
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import History, Record
from sbt.workflows.changes import changed_since, package_print
from sbt.workflows.study import Study

__all__ = ["check_code", "check_earlier", "not_repeated", "own_code"]

_TRIED = 20
"""Runs that are tried again, spread over those that are there, before a campaign goes on whose files or code, the package's and
SUMO's too, were changed."""


def check_code(store: Store, study: Study, executor: Executor, *, changed: bool, package: bool) -> None:
    """Refuse to go on with a store whose runs would not come again, by code and files as they are now.

    Of each level of fidelity the first and the last with metrics are tried where there is code of the user's; where files or
    code were `changed` since, or this `package` or SUMO, as many as `_TRIED` of all, and the first that could not be run: code
    may change just what is invalid. Where files and code are as they were, and SUMO does not repeat every run of such files, most
    of as many are enough.
    """
    if not (changed or package or own_code(study)):
        return
    history = store.history(level=None)
    for level in np.unique(history.columns["level"]):
        scenario = study.runnable if level == 0 else study.spec.at_level(int(level)).resolve()
        unsure = "" if changed else not_repeated(scenario)
        _check_runs(store, history.at_level(int(level)), executor, changed=changed or package, unsure=unsure)


def _check_runs(store: Store, history: History, executor: Executor, *, changed: bool, unsure: str) -> None:
    """Refuse to go on where some of these runs, of one level of fidelity, do not come again.

    Args:
        store: named in the refusal.
        history: the runs.
        executor: runs them.
        changed: files or code were, or the package.
        unsure: why a run may differ all the same; "" for no reason.
    """
    ok, invalid = np.flatnonzero(history.ok), np.flatnonzero(history.status == str(Status.INVALID))
    tried = _spread(ok, _TRIED if changed or unsure else 2)
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

    Where this package or SUMO was another one then, as many as `_TRIED` are; of files that SUMO does not repeat most of these are
    enough. With warmed traffic none is tried, since another number of warm-ups is another beginning.
    """
    choice = study.config.warm_start
    if choice is None or choice.transfer or (study.isolation is not None and study.isolation.warm):
        return
    earlier = study.earlier_campaign()
    same_package = earlier.package == package_print()
    if same_package and not own_code(study):
        return
    history = earlier.same_runs(study.scenario)
    ok = np.flatnonzero(history.ok & history.drawn & (history.columns["level"] == 0))
    unsure, differing = "" if same_package else not_repeated(study.runnable), 0
    tried = _spread(ok, 2 if same_package else _TRIED)
    with study.executor() as executor:
        for record, outcome in _again(history, tried, executor):
            stored = {name: value for name, value in record.metrics.items() if name in outcome.metrics or not outcome.metrics}
            now = {name: outcome.metrics[name] for name in stored if outcome.metrics} or outcome.reason
            differing += now != stored
            if now != stored and (not unsure or 2 * differing > len(tried)):
                rule = f"warm_start.store must be of what is run now, but its run {record.index} now gives {now}, not {stored}"
                rule += "" if same_package else " (this package or SUMO was another one then)"
                raise InputError(f"{rule}: transfer: true takes it as another setup")


def own_code(study: Study) -> bool:
    """Return whether runs depend on files or objects of the user's."""
    config = study.config
    coarse = None if config.fidelity is None else config.fidelity.scenario
    code = [config.scenario, *([] if coarse is None else [coarse]), *config.metrics]
    code += [] if config.ego is None else [config.ego.kind]
    return any(name.startswith((OBJECT, "table:")) or ".py:" in name or name.endswith((".yaml", ".yml")) for name in code)


def _spread(rows: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Return n of the rows, the first and the last among them, or all where there are fewer."""
    return rows[np.linspace(0, len(rows) - 1, min(n, len(rows))).round().astype(np.intp)]


def _again(history: History, rows: Iterable[np.intp], executor: Executor) -> Iterator[tuple[Record, Outcome]]:
    """Yield the runs in these rows, and how they go now."""
    records = {record.index: record for record in (history.record(int(row)) for row in dict.fromkeys(rows))}
    for outcome in executor.run([Job(r.index, r.inputs, r.seed, r.level) for r in records.values()]):
        yield records[outcome.index], outcome
