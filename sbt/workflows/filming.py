"""Executes runs of a store again for the films of its report."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path

from sbt.errors import SbtError
from sbt.execution.worker import run_traced
from sbt.plugins.approval import UntrustedError
from sbt.problem.metric import Metric
from sbt.problem.outcome import Job
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace
from sbt.report.reel import Film
from sbt.store.history import History, Record
from sbt.sumo.nets import Lane, lanes
from sbt.workflows.networks import net_of
from sbt.workflows.study import Study

__all__ = ["film_runs", "shown_requirement"]


_DIRECT = "The scenario gives its metrics directly: there is no trace to show."


@cache
def _lanes(net: Path, content: bytes) -> tuple[Lane, ...]:
    """Return the lanes of a network, which is read once as long as its file stays the same."""
    return lanes(str(net))


def film_runs(study: Study, history: History, chosen: Mapping[int, str]) -> tuple[list[Film], str]:
    """Execute runs again; return those that are as they were, to the last bit, and in words why others are missing.

    Args:
        study: as it was configured.
        history: its runs.
        chosen: indices of runs, each with the reason why it is shown.
    """
    if not chosen:
        return [], ""
    if not (study.kept.get("described") or {"traced": True})["traced"]:
        return [], _DIRECT
    rows = {int(index): row for row, index in enumerate(history.index)}
    films: list[Film] = []
    missing: dict[int, str] = {}
    try:
        with study.loaded.scope.naming():
            runnable, scenario = study.runnable, study.spec.resolve()
            if runnable.simulate is None:
                return [], _DIRECT
            for run, role in chosen.items():
                record = history.record(rows[run])
                film = _film(scenario, runnable, record, role)
                if isinstance(film, Film):
                    films.append(film)
                else:
                    missing[run] = film
    except UntrustedError:
        return films, "Films need the scenario's own code, which runs only where it was approved: report --trust."
    except (SbtError, OSError) as error:
        return films, f"Films are missing: {error}"
    note = "; ".join(f"no film of run {run}: {reason}" for run, reason in list(missing.items())[:3])
    return films, f"{note[:1].upper()}{note[1:]}." if note else ""


def _film(scenario: LogicalScenario, runnable: LogicalScenario, record: Record, role: str) -> Film | str:
    """Return the film of a run, or why there is none."""
    outcome, trace = run_traced(scenario, Job(record.index, record.inputs, record.seed))
    if trace is None:
        return outcome.reason or "it has no trace"
    if dict(outcome.metrics) != dict(record.metrics):
        return "executed again it is another one"
    need, metric = shown_requirement(runnable, trace)
    net = net_of(runnable, record.inputs, record.seed)
    return Film(record.index, role, trace, metric, need, () if net is None else _lanes(net, sha256(net.read_bytes()).digest()))


def shown_requirement(scenario: LogicalScenario, states: Trace) -> tuple[Requirement, Metric]:
    """Return the requirement that a film shows and its metric: the first that the run violates, or else the first."""
    own = {m.name: m for m in scenario.metrics}
    parts = scenario.requirement.parts
    need = next((part for part in parts if part.is_critical({part.metric: own[part.metric].value(states)})), parts[0])
    return need, own[need.metric]
