"""Runs, in whatever process: everything that can go wrong becomes an `Outcome`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version

import numpy as np

from sbt.errors import InputError, RunError, place_of
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import Batched, LogicalScenario
from sbt.problem.trace import Trace

__all__ = ["run_job", "run_jobs", "versions"]


def run_job(scenario: LogicalScenario, job: Job) -> Outcome:
    """Run one concrete scenario; never raises because of it.

    Returns:
        The outcome: OK with finite metrics, or the status and the reason why there are none.
    """
    simulate = scenario.simulate
    if simulate is None:
        return _outcome(job, lambda: (scenario.run(job.inputs, job.seed), ""))
    return _outcome(job, lambda: _measured(scenario, simulate(job.inputs, job.seed)))


def run_jobs(scenario: LogicalScenario, jobs: Sequence[Job], at_work: Callable[[Sequence[int]], None]) -> list[Outcome]:
    """Run several concrete scenarios, at once where the scenario can.

    Args:
        scenario: what to run.
        jobs: its inputs and seeds.
        at_work: told again and again the indices of the jobs that are being run, none in the end.

    Returns:
        The outcomes, which do not depend on what ran at once; of runs at once the mean time.
    """
    simulate = scenario.simulate
    outcomes: list[Outcome] = []
    if isinstance(simulate, Batched) and simulate.batched and len(jobs) > 1:
        start = time.perf_counter()
        found = simulate.simulate_many([(j.inputs, j.seed) for j in jobs], lambda busy: at_work([jobs[k].index for k in busy]))
        share = (time.perf_counter() - start) / len(jobs)
        for job, result in zip(jobs, found, strict=True):
            at_work((job.index,))
            outcomes.append(_outcome(job, partial(_measured, scenario, result), share))
    else:
        for job in jobs:
            at_work((job.index,))
            outcomes.append(run_job(scenario, job))
    at_work(())
    return outcomes


def _outcome(job: Job, measured: Callable[[], tuple[dict[str, float], str]], seconds: float = 0.0) -> Outcome:
    """Return what became of a job: the metrics, or the error that is raised instead."""
    start = time.perf_counter() - seconds
    try:
        metrics, reported = measured()
        return Outcome(job.index, Status.OK, metrics, "", time.perf_counter() - start, reported)
    except RunError as error:
        status, reason = Status(error.status), error.reason
    except InputError as error:
        status, reason = Status.FAILED, str(error)
    except Exception as error:  # a user's scenario may raise anything; the night goes on
        status, reason = Status.FAILED, f"{type(error).__name__}: {error} ({place_of(error)})"
    return Outcome(job.index, status, {}, reason, time.perf_counter() - start)


def _measured(scenario: LogicalScenario, trace: Trace | Exception) -> tuple[dict[str, float], str]:
    """Return the metrics of a run and SUMO's own collision list, or raise its error."""
    if isinstance(trace, Exception):
        raise trace
    _check_trace(trace)
    return scenario.measure(trace), " ".join(trace.reported)


def _check_trace(trace: Trace) -> None:
    """Refuse states that are not finite; NaN in all of them says that an actor is not there, which the first one must be."""
    for name in ("x", "y", "heading", "speed"):
        values = getattr(trace, name)
        if math.isfinite(float(values.sum())):
            continue
        wrong = ~np.isfinite(values) & trace.present
        if wrong.any() or not trace.present[:, 0].all():
            raise RunError(Status.FAILED, f"every state must be finite, but trace.{name} is not")


def versions() -> str:
    """Return the versions of what runs a concrete scenario, for the store."""
    return f"sbt {version('sumo-sbt')}, libsumo {version('libsumo')}"
