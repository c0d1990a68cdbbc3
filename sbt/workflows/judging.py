"""Would a reference driver have avoided it: failures are run again with each of them in the place of the ego.

Judging runs are no runs of the campaign: rows stay as they are, and what was found is kept beside them in the store, so that
reading a store needs no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.preventable import DRIVERS, describe_judgements
from sbt.errors import InputError, must_be
from sbt.execution.exchange import DRIVER
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_traced
from sbt.loop.stages import Conclusion
from sbt.metrics.preventability import METRIC_NAME, why_not
from sbt.plugins import Objects
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.plain import JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.store.database import Store
from sbt.store.history import History, Record
from sbt.store.records import Judgement
from sbt.workflows.study import Study

if TYPE_CHECKING:
    from sbt.workflows.running import Replay

__all__ = [
    "MOST_JUDGED",
    "in_words",
    "judge_campaign",
    "judge_run",
    "judge_runs",
    "judgement_line",
    "stored_judgements",
    "with_driver",
]  # fmt: skip

MOST_JUDGED = 10
"""Runs of a campaign that are judged: one a failure mode, or the deepest critical ones."""
_COLLISION = "collision"


@dataclass(frozen=True)
class _Panel:
    """The drivers that can stand in for the ego, and why the others cannot.

    Args:
        kinds: as they are named.
        egos: kind and settings of those that can, in the order of `names`.
        names: of those that can.
        refused: driver to reason.
    """

    kinds: tuple[str, ...]
    egos: tuple[JsonMapping, ...]
    names: tuple[str, ...]
    refused: dict[str, str]


def judge_campaign(
    study: Study, store: Store, conclusion: Conclusion, *, tell: Callable[[str], None] = lambda _: None
) -> Conclusion:
    """Judge the failures of a campaign that has ended, as configured; what the store has is not judged again.

    Args:
        study: as configured.
        store: open for writing; it keeps what is found.
        conclusion: of the campaign.
        tell: told what is done, before it takes time.

    Returns:
        The conclusion, in which every judged failure mode says who would have avoided it.
    """
    modes = conclusion.failure_modes if isinstance(conclusion, FalsificationConclusion) else None
    drivers = study.config.judges
    if drivers is None:
        drivers = DRIVERS if modes is not None and study.runnable.simulate is not None else ()
    history = store.history()
    runs = [mode.representative for mode in modes[:MOST_JUDGED]] if modes is not None else _deepest(study, history)
    known = [each for each in store.judgements if each.driver in drivers]
    if drivers and runs:
        tell("judging failures")
        judged = judge_runs(study, history, runs, drivers, known=known)
        if judged != store.judgements:
            store.judge(judged)
        known = judged
    if modes is None or not known or not isinstance(conclusion, FalsificationConclusion):
        return conclusion
    told = tuple(
        replace(mode, preventable=tuple(j for j in known if j.run == mode.representative) or None) for mode in modes
    )
    return replace(conclusion, failure_modes=told)


def judge_run(
    folder: Path, run: int, drivers: Sequence[str] | None = None, *, objects: Objects | None = None
) -> tuple[Judgement, ...]:
    """Judge one run of a store, whatever its verdict, at its level of fidelity; the store is not changed.

    Args:
        folder: of the store.
        run: its index.
        drivers: kinds of ego; None: those that the campaign was configured with, or the four.
        objects: what was given in Python when the store was made.

    Returns:
        One judgement a driver; those that are in the store are not made again.

    Raises:
        InputError: the store has no such run, or there is no such driver.
    """
    with Store.read(folder) as store:
        study, history, known = Study.from_store(store, objects=objects), store.history(level=None), store.judgements
    chosen = tuple(drivers) if drivers is not None else study.config.judges or DRIVERS
    with nullcontext() if drivers is not None else study.loaded.scope.naming():
        judged = judge_runs(study, history, [run], chosen, known=known, workers=1)
    return tuple(each for driver in chosen for each in judged if (each.run, each.driver) == (run, driver))


def stored_judgements(folder: Path, run: int) -> tuple[Judgement, ...]:
    """Return what the store keeps of the judgements of a run; empty where it was not judged."""
    with Store.read(folder) as store:
        return tuple(each for each in store.judgements if each.run == run)


def judgement_line(judgement: Judgement) -> str:
    """Return what one driver made of the run."""
    if judgement.avoided is None:
        verdict = f"not applicable: {judgement.reason}"
    else:
        how = "" if judgement.avoided or not judgement.collision else ", collision"
        verdict = f"{'avoided' if judgement.avoided else 'not avoided'}{how} ({judgement.metric:.6g})"
    return f"  {judgement.driver:<23} {verdict}"


def with_driver(again: Replay, driver: str) -> Replay:
    """Return a run that was executed again, executed once more with a driver in the place of the ego, to be shown.

    Raises:
        InputError: the scenario does not take the driver.
    """
    scenario, record = again.scenario.configured(ego={"kind": driver}), again.record
    inputs = {name: record.inputs[name] for name in scenario.space.names}
    outcome, trace = run_traced(scenario, Job(record.index, inputs, record.seed))
    return replace(again, outcome=outcome, trace=trace, scenario=scenario)


def in_words(judgements: Iterable[JsonMapping]) -> str:
    """Return in words which drivers avoided a run, from the JSON of a conclusion."""
    return describe_judgements(Judgement(**each) for each in judgements)


def judge_runs(
    study: Study, history: History, runs: Sequence[int], drivers: Sequence[str], *, known: Iterable[Judgement] = (),
    workers: int | None = None,
) -> list[Judgement]:  # fmt: skip
    """Run concrete scenarios again with each driver in the place of the ego, in worker processes.

    Args:
        study: the campaign.
        history: its runs.
        runs: indices of those to judge.
        drivers: kinds of ego.
        known: judgements that need not be made again.
        workers: processes; None: as configured.

    Returns:
        The known judgements and the new ones, by run and driver.

    Raises:
        InputError: a run is not in the history, or there is no such driver.
    """
    found = {(each.run, each.driver): each for each in known}
    missing = [run for run in dict.fromkeys(runs) if any((run, driver) not in found for driver in drivers)]
    records = [_record(history, run) for run in missing]
    for level in sorted({record.level for record in records}):
        for each in _judged(study, [record for record in records if record.level == level], drivers, workers):
            found.setdefault((each.run, each.driver), each)
    order = {driver: k for k, driver in enumerate(drivers)}
    return sorted(found.values(), key=lambda each: (each.run, order.get(each.driver, len(order)), each.driver))


def _judged(study: Study, records: Sequence[Record], drivers: Sequence[str], workers: int | None) -> list[Judgement]:
    """Return what every driver makes of these runs, all of one level of fidelity."""
    runnable, spec = study.runnable, replace(study.spec.at_level(records[0].level), only=None)
    scenario = spec.resolve() if records[0].level else runnable
    panel, roles = _panel(scenario, study.loaded.folder, drivers), scenario.roles
    reason = roles.not_judged or ("" if panel.egos else next(iter(panel.refused.values())))
    if reason:
        return [Judgement(r.index, driver, None, reason=reason) for r in records for driver in drivers]
    spec = _exchanging(spec, scenario, panel)
    jobs = {(k, d): Job(k * (len(panel.names) + 1) + d, {**r.inputs, DRIVER: float(d)}, r.seed)
            for k, r in enumerate(records) for d in range(len(panel.names) + 1)}  # fmt: skip
    with study.executor(spec, workers=workers) as executor:
        first = {o.index: o for o in executor.run([jobs[k, 0] for k in range(len(records))])}
        reasons = [_why_not(first[jobs[k, 0].index], record) for k, record in enumerate(records)]
        rest = [job for (k, d), job in jobs.items() if d > 0 and not reasons[k]]
        outcomes = {o.index: o for o in executor.run(rest)} if rest else {}
    judged = []
    for k, record in enumerate(records):
        for driver in panel.kinds:
            why = panel.refused.get(driver) or reasons[k]
            if why:
                judged.append(Judgement(record.index, driver, None, reason=why))
            else:
                outcome = outcomes[jobs[k, panel.names.index(driver) + 1].index]
                judged.append(_judgement(study, record.index, driver, outcome))
    return judged


def _panel(scenario: LogicalScenario, folder: Path, drivers: Sequence[str]) -> _Panel:
    """Return who can stand in for the ego; files of drivers are looked up in the folder."""
    egos: list[JsonMapping] = []
    names: list[str] = []
    refused: dict[str, str] = {}
    for driver in drivers:
        ego = {"kind": str(folder.resolve() / Path(driver).expanduser()) if ".py:" in driver else driver}
        try:
            scenario.configured(ego=ego)
        except InputError as error:
            refused[driver] = str(error)
            continue
        egos.append(ego)
        names.append(driver)
    return _Panel(tuple(drivers), tuple(egos), tuple(names), refused)


def _exchanging(spec: ScenarioSpec, scenario: LogicalScenario, panel: _Panel) -> ScenarioSpec:
    """Return the scenario in which the ego can be exchanged, with what a judgement needs measured."""
    further = () if _COLLISION in scenario.measured else (_COLLISION,)
    return replace(spec, drivers=panel.egos, metrics=(*spec.metrics, *further))


def _why_not(again: Outcome, record: Record) -> str:
    """Return why a run cannot be judged; "" where it can."""
    if again.status != Status.OK:
        return f"the run itself gives no metric: {again.reason}"
    changed = [name for name, value in record.metrics.items() if again.metrics.get(name) != value and not np.isnan(value)]
    if changed:
        return f"the run is not the same when it is executed again ({changed[0]})"
    return why_not(again.metrics[METRIC_NAME])


def _judgement(study: Study, run: int, driver: str, outcome: Outcome) -> Judgement:
    """Return the judgement that follows from the run with a driver."""
    if outcome.status != Status.OK:
        return Judgement(run, driver, None, reason=f"the run with it failed: {outcome.reason}")
    need = study.scenario.requirement
    avoided, collision = not need.is_critical(outcome.metrics), outcome.metrics[_COLLISION] > 0.0
    return Judgement(run, driver, bool(avoided), bool(collision), float(need.told_of(outcome.metrics)))


def _deepest(study: Study, history: History) -> list[int]:
    """Return the indices of the critical runs deepest in the critical interval."""
    margins = study.scenario.requirement.depths(history)
    critical = np.flatnonzero(margins <= 0)
    return [int(history.index[k]) for k in critical[np.argsort(margins[critical], kind="stable")][:MOST_JUDGED]]


def _record(history: History, run: int) -> Record:
    must_be("a run must be its index", run, Integral)
    rows = np.flatnonzero(history.index == run)
    if len(rows) == 0:
        raise InputError(f"a run must be a finished one of the store, but got {run}")
    return history.record(int(rows[0]))
