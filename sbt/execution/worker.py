"""One run, in whatever process: everything that can go wrong becomes an `Outcome`."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Mapping

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace

__all__ = ["place_of", "run_job"]


def run_job(scenario: LogicalScenario, job: Job) -> Outcome:
    """Run one concrete scenario; never raises because of it.

    Returns:
        The outcome: OK with finite metrics, or the status and the reason why there are none.
    """
    start = time.perf_counter()
    try:
        metrics, reported = _measured(scenario, job.inputs, job.seed)
        return Outcome(job.index, Status.OK, metrics, "", time.perf_counter() - start, reported)
    except RunError as error:
        status, reason = Status(error.status), error.reason
    except InputError as error:
        status, reason = Status.FAILED, str(error)
    except Exception as error:  # a user's scenario may raise anything; the night goes on
        status, reason = Status.FAILED, f"{type(error).__name__}: {error} ({place_of(error)})"
    return Outcome(job.index, status, {}, reason, time.perf_counter() - start)


def _measured(scenario: LogicalScenario, inputs: Mapping[str, float], seed: int) -> tuple[dict[str, float], str]:
    """Return the metrics of a run and SUMO's own collision list."""
    if scenario.simulate is None:
        return scenario.run(inputs, seed), ""
    trace = scenario.simulate(inputs, seed)
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


def place_of(error: BaseException) -> str:
    """Return file:line where the error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "no place"
