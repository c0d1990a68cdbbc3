"""The events whose probabilities an estimation states: critical, each requirement of a combination, both readings of failed runs.

A metamodel of the metric says nothing of runs without one. Of P(fail | x) and P(critical | x, the run gives a metric) = pi both
readings are made: failed runs are safe, (1 - P(fail)) pi, or critical, P(fail) + (1 - P(fail)) pi.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sbt.estimators.surrogate import JointLogProbability, LogProbability, sketch_of
from sbt.metamodels.joint import LogPair, joined_log_probability
from sbt.metamodels.success import failure_probability
from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["Event", "FailingLogProbability", "events", "given_a_metric", "with_failed_runs"]


@dataclass(frozen=True)
class FailingLogProbability:
    """P(critical) of runs that may fail; a failed run is safe.

    Args:
        given: P(critical) of a run that gives a metric.
        fails: P(a run gives none) at the same points.
    """

    given: LogProbability
    fails: Callable[[Points], Vector]

    def __call__(self, points: Points) -> LogPair:
        """Return (n,) log P(critical) and (n,) log P(uncritical)."""
        return _failing(self.given(points), self.fails(points)).safe

    def sketch(self, rows: int) -> FailingLogProbability:
        """Return about the same, learned from fewer runs."""
        return replace(self, given=sketch_of(self.given, rows))


@dataclass(frozen=True, eq=False)
class Event:
    """What a metamodel says of an event at n points: (n,) log P and (n,) log of the rest.

    Attributes:
        safe: where a failed run is none of it.
        critical: where every failed run is one; None: no run has failed.
    """

    safe: LogPair
    critical: LogPair | None = None


def with_failed_runs(
    given: LogProbability, coordinates: Callable[[Points], Points], points: Points, ok: Mask, rng: np.random.Generator
) -> LogProbability:
    """Return P(critical) of runs that may fail, a failed one as safe; `given` itself where all runs gave a metric.

    Args:
        given: P(critical) of a run that gives a metric.
        coordinates: points to the inputs of metamodels.
        points: (n, d) of all runs.
        ok: (n,) the run gave a metric.
        rng: the only source of randomness.
    """
    if ok.all():
        return given
    fails = failure_probability(coordinates(points), ok, rng)
    return FailingLogProbability(given, lambda at: fails(coordinates(at)))


def given_a_metric(log_probability: LogProbability) -> LogProbability:
    """Return P(critical) of runs that give a metric."""
    return log_probability.given if isinstance(log_probability, FailingLogProbability) else log_probability


def events(log_probability: LogProbability, points: Points) -> tuple[Event, tuple[Event, ...]]:
    """Return what is said of critical runs, and of each requirement of a combination (none without one), at points (n, d)."""
    given = given_a_metric(log_probability)
    joint = given if isinstance(given, JointLogProbability) else None
    parts = () if joint is None else tuple(part(points) for part in joint.parts)
    whole = given(points) if joint is None else joined_log_probability(joint.critical, parts)
    if not isinstance(log_probability, FailingLogProbability):
        return Event(whole), tuple(map(Event, parts))
    fails = log_probability.fails(points)
    return _failing(whole, fails), tuple(_failing(part, fails) for part in parts)


def _failing(given: LogPair, fails: Vector) -> Event:
    """Return both readings of an event of which `given` is said of runs that give a metric."""
    log_fails, log_ok = np.log(fails), np.log1p(-fails)
    log_pi, log_not = given[0] + log_ok, given[1] + log_ok
    return Event((log_pi, np.logaddexp(log_not, log_fails)), (np.logaddexp(log_pi, log_fails), log_not))
