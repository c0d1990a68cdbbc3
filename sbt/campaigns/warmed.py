"""What warmed traffic means for a conclusion: runs of one warm-up are a cluster, and the result holds for the warm-ups."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbt.campaigns.counting import DRAWN, counted_batches, counted_iterations
from sbt.campaigns.crude import NOMINAL
from sbt.campaigns.gate import Limits
from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import plural
from sbt.estimators.clusters import clustered_error, reach
from sbt.loop.stages import Log
from sbt.problem.arrays import Vector
from sbt.store.history import History

__all__ = ["WarmTraffic", "conditional_on", "warmed_limits", "warmed_traffic"]


@dataclass(frozen=True)
class WarmTraffic:
    """The warmed traffic that an estimate rests on.

    Attributes:
        warm_ups: number of those that counted runs began with.
        std_error: of the estimate, from the spread between warm-ups; None: it is not known from one, or from repeats.
    """

    warm_ups: int
    std_error: float | None

    def sentence(self) -> str:
        """Return what the result is conditional on."""
        known = self.std_error is not None
        spread = "the interval has the spread between them" if known else "how others would change it is not in the interval"
        return f"The result is conditional on the traffic of {plural(self.warm_ups, 'warm-up')}; {spread}."


def warmed_traffic(log: Log, settings: Settings) -> WarmTraffic | None:
    """Return the warm-ups behind an estimate; None where runs simulate their traffic from the beginning."""
    counted = _counted_terms(log, settings)
    terms, rows = counted if counted is not None else (np.empty(0), np.arange(len(log.history)))
    cluster = log.history.columns["warm_up"][rows]
    if not (cluster >= 0).any():
        return None
    error = clustered_error(terms, cluster) if counted is not None else None
    return WarmTraffic(len(np.unique(cluster)), error)


def warmed_limits(limits: Limits, value: float | None, traffic: WarmTraffic) -> Limits:
    """Return limits that are at least as far from the estimate as the spread between warm-ups says."""
    error, k = traffic.std_error, traffic.warm_ups
    if error is None or value is None:
        return limits
    return Limits(
        lambda c: max(min(limits.lower(c), value - reach(error, k, c)), 0.0),
        lambda c: min(max(limits.upper(c), value + reach(error, k, c)), 1.0),
    )


def conditional_on(history: History) -> list[str]:
    """Return the sentence on the warm-ups of a campaign that searches; none where runs simulate their traffic."""
    numbers = history.columns["warm_up"]
    found = len(np.unique(numbers[numbers >= 0]))
    return [f"Runs began with the traffic of {plural(found, 'warm-up')}: the result is conditional on it."] if found else []


def _counted_terms(log: Log, settings: Settings) -> tuple[Vector, NDArray[np.intp]] | None:
    """Return what each counted run adds to the estimate, less the mean, and its row; None where repeats are counted."""
    history = log.history
    batches = counted_batches(log, settings)
    if batches:
        drawn = history.stage == DRAWN
        rows = [np.flatnonzero(drawn & (history.iteration == number)) for number in counted_iterations(log)][: len(batches)]
        weights = np.array([np.sqrt(t + 1.0) * len(b.critical) for t, b in enumerate(batches)])
        weights /= weights.sum()  # as `combine_estimates` has them
        return np.concatenate([w * b.errors for w, b in zip(weights, batches, strict=True)]), np.concatenate(rows)
    nominal = np.flatnonzero(history.stage == NOMINAL)
    if not len(nominal):
        return None
    critical = settings.scenario.requirement.critical_runs(history)[nominal].astype(np.float64)
    return (critical - critical.mean()) / len(nominal), nominal
