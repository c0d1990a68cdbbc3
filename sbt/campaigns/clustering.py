"""The spread between warm-ups of what is estimated: runs that begin with the same warmed traffic are a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.counting import DRAWN, counted_iterations
from sbt.campaigns.gate import Limits
from sbt.campaigns.wording import plural
from sbt.estimators import binomial
from sbt.estimators.clusters import clustered_error, effective_runs, reach
from sbt.estimators.intervals import CountedBatch
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Vector
from sbt.store.history import History

__all__ = ["Spread", "clustered_interval", "spread_of_batches", "spread_of_draws", "spread_of_share"]


@dataclass(frozen=True)
class Spread:
    """How an estimate differs between warm-ups.

    Attributes:
        warm_ups: number of those that counted runs began with.
        std_error: of the estimate, from the spread between warm-ups; None: it is not known from one, or from repeats.
    """

    warm_ups: int
    std_error: float | None

    def widened(self, limits: Limits, value: float | None) -> Limits:
        """Return limits that are at least as far from the estimate as the spread says."""
        error, k = self.std_error, self.warm_ups
        if error is None or value is None:
            return limits
        return Limits(
            lambda c: max(min(limits.lower(c), value - reach(error, k, c)), 0.0),
            lambda c: min(max(limits.upper(c), value + reach(error, k, c)), 1.0),
        )

    def sentence(self) -> str:
        """Return what the result is conditional on."""
        known = self.std_error is not None
        spread = "the interval has the spread between them" if known else "how others would change it is not in the interval"
        return f"The result is conditional on the traffic of {plural(self.warm_ups, 'warm-up')}; {spread}."

    def decides(self, cov: float | None, value: float | None) -> bool:
        """Return whether the coefficient of variation of an estimate is that by the spread, as the draws' own is smaller."""
        return cov is not None and self.std_error is not None and bool(value and self.std_error / value >= cov)

    def exceeds(self, cov: float, value: float) -> bool:
        """Return whether the coefficient of variation is above a limit by the spread alone."""
        return self.std_error is not None and self.std_error > cov * value


def spread_of_draws(log: Log, batches: Sequence[CountedBatch]) -> Spread | None:
    """Return the spread of an estimate from weighted batches; None where runs simulate their traffic from the beginning."""
    history = log.history
    drawn = history.stage == DRAWN
    rows = [np.flatnonzero(drawn & (history.iteration == number)) for number in counted_iterations(log)][: len(batches)]
    return spread_of_batches(history.columns["warm_up"][np.concatenate(rows)], batches)


def spread_of_batches(warm_up: Vector, batches: Sequence[CountedBatch]) -> Spread | None:
    """Return the spread of an estimate from weighted batches, of which each draw began with a warm-up (n,), -1 without one."""
    weights = np.array([np.sqrt(t + 1.0) * len(b.critical) for t, b in enumerate(batches)])
    weights /= weights.sum()  # as `combine_estimates` has them
    return _spread(warm_up, np.concatenate([w * b.errors for w, b in zip(weights, batches, strict=True)]))


def spread_of_share(history: History, among: Mask, critical: Mask) -> Spread | None:
    """Return the spread of the critical share among some runs; None where runs simulate their traffic from the beginning."""
    rows = np.flatnonzero(among)
    hits = critical[rows].astype(np.float64)
    return _spread(history.columns["warm_up"][rows], (hits - hits.mean()) / len(rows)) if len(rows) else None


def clustered_interval(hits: Mask, warm_up: Vector | None = None, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of the share of hits (n,), that of fewer runs where they share warm-ups.

    Args:
        hits: of the runs.
        warm_up: (n,) that each began with, -1 without one; None: there are none.
        confidence: of the two-sided interval.

    Source:
        Korn and Graubard (1998), see `sbt.estimators.clusters`.
    """
    n, independent = len(hits), 1.0
    if n and warm_up is not None and (warm_up >= 0).all():
        independent = effective_runs(hits.astype(np.float64), warm_up, confidence) / n
    low, high = binomial.interval(float(hits.sum()) * independent, n * independent, confidence)
    return float(low), float(high)


def _spread(cluster: Vector, terms: Vector) -> Spread | None:
    if not (cluster >= 0).any():
        return None
    return Spread(len(np.unique(cluster)), clustered_error(terms, cluster))
