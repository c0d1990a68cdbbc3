"""Runs, in whatever process: everything that can go wrong becomes an `Outcome`."""

from __future__ import annotations

import math
import os
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby

import numpy as np

from sbt import interruption
from sbt.errors import InputError, PluginError, RunError, SbtError, described
from sbt.metrics.physics import beyond_tyres, drove_on, stopped_dead
from sbt.problem.outcome import DROVE_ON, IMPOSSIBLE, STOPPED, Job, Outcome, Status
from sbt.problem.scenario import Batched, LogicalScenario
from sbt.problem.trace import Trace

__all__ = ["prepare", "run_at_levels", "run_job", "run_jobs", "run_traced", "versions"]

_simulating = threading.RLock()
"""SUMO has one simulation a process: threads take turns, run by run."""
if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=lambda: _simulating._at_fork_reinit())  # type: ignore[attr-defined]
_Measured = tuple[dict[str, float], str, str]
"""Metrics, SUMO's own collision list, and what differs between it and the contacts."""


def prepare(scenario: LogicalScenario) -> None:
    """Let a scenario load what is slow to load, before its first run.

    Raises:
        InputError: a file is not as required.
        PluginError: its code raises.
    """
    try:
        scenario.prepare()
    except SbtError:
        raise
    except BaseException as error:  # a user's code must not end the driver
        if interruption.is_interruption(error):
            raise
        raise PluginError(f"scenario {scenario.name} must be prepared without an error, but raised {described(error)}") from None


def run_job(scenario: LogicalScenario, job: Job) -> Outcome:
    """Run one concrete scenario; never raises because of it.

    Returns:
        The outcome: OK with finite metrics, or the status and the reason why there are none.

    Raises:
        KeyboardInterrupt: a signal asked for it; one that the scenario's code raises is a failed run.
    """
    return run_traced(scenario, job)[0]


def run_traced(scenario: LogicalScenario, job: Job) -> tuple[Outcome, Trace | None]:
    """Run one concrete scenario, once, and keep its trace.

    Returns:
        The outcome as of `run_job`, and the trace; None where the scenario has none or could not be simulated. A run
        that was simulated and not measured has one.
    """
    simulate = scenario.simulate
    if simulate is None:
        return _outcome(job, lambda: (scenario.run(job.inputs, job.seed), "", "")), None
    traces: list[Trace] = []

    def measured() -> _Measured:
        with _simulating:
            trace = simulate(job.inputs, job.seed)
        if isinstance(trace, Trace):
            traces.append(trace)
        return _measured(scenario, trace)

    return _outcome(job, measured), traces[0] if traces else None


def run_jobs(scenario: LogicalScenario, jobs: Sequence[Job], at_work: Callable[[Sequence[int]], None]) -> list[Outcome]:
    """Run several concrete scenarios, at once where the scenario can.

    Args:
        scenario: what to run.
        jobs: its inputs and seeds.
        at_work: called repeatedly with the indices of the runs in progress, with none in the end.

    Returns:
        The outcomes, which do not depend on how jobs are grouped; `seconds` is the mean of jobs that ran at once.

    Raises:
        KeyboardInterrupt: a signal asked for it.
    """
    start = time.perf_counter()
    traces = _together(scenario, jobs, at_work)
    share = (time.perf_counter() - start) / len(jobs) if jobs else 0.0
    outcomes: list[Outcome] = []
    for k, job in enumerate(jobs):
        at_work((job.index,))
        outcomes.append(
            run_job(scenario, job) if traces is None else _outcome(job, partial(_measured, scenario, traces[k]), share)
        )
    at_work(())
    return outcomes


def run_at_levels(
    scenario: Callable[[int], LogicalScenario], jobs: Sequence[Job], at_work: Callable[[Sequence[int]], None]
) -> list[Outcome]:
    """Run several concrete scenarios as `run_jobs` does, each at its level of fidelity: `scenario` gives that of a level."""
    return [o for level, some in groupby(jobs, lambda job: job.level) for o in run_jobs(scenario(level), list(some), at_work)]


def _together(
    scenario: LogicalScenario, jobs: Sequence[Job], at_work: Callable[[Sequence[int]], None]
) -> list[Trace | BaseException] | None:
    """Return the traces, or errors, of jobs that are run at once; None where they have to be run one by one."""
    simulate = scenario.simulate
    if len(jobs) < 2 or not isinstance(simulate, Batched):
        return None
    try:
        if not simulate.batched:
            return None
        with _simulating:
            asked = [(j.inputs, j.seed) for j in jobs]
            found = simulate.simulate_many(asked, lambda busy: at_work([jobs[k].index for k in busy]))
    except BaseException as error:  # whose it is, the runs show when they are run alone
        if interruption.is_interruption(error):
            raise KeyboardInterrupt from None
        return None
    return list(found) if len(found) == len(jobs) else None


def _outcome(job: Job, measured: Callable[[], _Measured], seconds: float = 0.0) -> Outcome:
    """Return the outcome of a job: its metrics, or the status and reason of what was raised."""
    start, process = time.perf_counter() - seconds, os.getpid()
    try:
        try:
            metrics, reported, unconfirmed = measured()
        finally:
            if os.getpid() != process:  # a child that the run forked: going on, it would be a second driver or worker
                os._exit(0)
        interruption.check()  # the code of the run may have caught the KeyboardInterrupt of a signal
        return Outcome(job.index, Status.OK, metrics, "", time.perf_counter() - start, reported, unconfirmed, job.level)
    except BaseException as error:  # a user's scenario may raise anything, SystemExit too; the campaign goes on
        if interruption.is_interruption(error):
            raise KeyboardInterrupt from None
        status, reason = _verdict(error)
    return Outcome(job.index, status, {}, reason, time.perf_counter() - start, level=job.level)


def _verdict(error: BaseException) -> tuple[Status, str]:
    """Return the status of a run that raised, and the reason."""
    if isinstance(error, RunError) and error.status in set(Status) - {Status.OK}:
        return Status(error.status), str(error.reason)
    if os.environ.get("SBT_DEBUG"):
        traceback.print_exception(error)
    if isinstance(error, InputError):
        return Status.FAILED, str(error)
    return Status.FAILED, described(error)


def _measured(scenario: LogicalScenario, trace: Trace | BaseException) -> _Measured:
    """Return the metrics of a run, SUMO's own collision list and what differs, or raise its error."""
    if isinstance(trace, BaseException):
        raise trace
    if not isinstance(trace, Trace):
        raise RunError(Status.FAILED, f"simulate must return a Trace, but returned a {type(trace).__name__}")
    _check_trace(trace)
    ego = scenario.roles.ego
    doubts = [*trace.unconfirmed, *(f"{IMPOSSIBLE}{a:.3g} m/s^2 of {ego} at {t:.3f} s" for a, t in beyond_tyres(trace, ego))]
    doubts += [f"{STOPPED}'{name}' at {t:.3f} s, by {a:.3g} m/s^2" for name, a, t in stopped_dead(trace, ego)]
    doubts += [f"{DROVE_ON}'{a}' and '{b}' at {t:.3f} s" for a, b, t in drove_on(trace, ego)]
    return scenario.measure(trace), " ".join(trace.reported), " | ".join(doubts)


def _check_trace(trace: Trace) -> None:
    """Refuse states that are not finite; NaN in all of them says that an actor is absent, which the first one must not be."""
    for name in ("x", "y", "heading", "speed"):
        values = getattr(trace, name)
        if math.isfinite(float(values.sum())):
            continue
        wrong = ~np.isfinite(values) & trace.present
        if wrong.any() or not trace.present[:, 0].all():
            raise RunError(Status.FAILED, f"every state must be finite, but trace.{name} is not")


def versions() -> str:
    """Return the versions of what runs a concrete scenario, for the store; scenarios of Python alone run without libsumo."""
    try:
        sumo = version("libsumo")
    except PackageNotFoundError:
        sumo = "none"
    return f"sbt {version('sumo-sbt')}, libsumo {sumo}"
