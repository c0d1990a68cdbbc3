"""The spread between warm-ups of what is estimated: runs that begin with the same warmed traffic are a cluster."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, stdtrit

from sbt.campaigns.counting import DRAWN, counted_iterations
from sbt.campaigns.gate import Limits
from sbt.campaigns.wording import plural
from sbt.estimators import binomial
from sbt.estimators.clusters import clustered_error, effective_runs, reach
from sbt.estimators.intervals import CountedBatch, batch_weights
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Vector
from sbt.store.history import History
from sbt.store.records import optional

__all__ = ["Spread", "clustered_interval", "likelier", "spread_of_batches", "spread_of_draws", "spread_of_share"]

Batches = Sequence[CountedBatch]
_CHANCE = 0.01


@dataclass(frozen=True)
class Spread:
    """How an estimate differs between warm-ups.

    Attributes:
        warm_ups: number of those that counted runs began with.
        std_error: of the estimate, from the spread between warm-ups; None: it is not known from one, or from repeats.
        std_error_failed: of that with failed runs as critical; None: no run failed.
        std_error_apart: as if no two runs had a warm-up in common.
    """

    warm_ups: int
    std_error: float | None
    std_error_failed: float | None = optional()
    std_error_apart: float | None = optional()

    @property
    def differs(self) -> bool:
        """Whether the error between warm-ups is beyond what chance makes of runs that do not depend on them (F, at 1 %)."""
        if not self.std_error or self.std_error_apart is None:
            return False
        df = self.warm_ups - 1.0
        return self.std_error**2 > self.std_error_apart**2 * float(chdtri(df, _CHANCE)) / df

    def widened(self, limits: Limits, value: float | None, worst: float | None = None) -> Limits:
        """Return limits that are at least as far from the estimate as the spread says; `worst` has failed runs as critical."""
        error, k = self.std_error, self.warm_ups
        if error is None or value is None:
            return limits
        most, failed = max(value, worst or 0.0), max(error, self.std_error_failed or 0.0)
        return Limits(
            lambda c: max(min(limits.lower(c), value - reach(error, k, c)), 0.0),
            lambda c: min(max(limits.upper(c), most + reach(failed, k, c)), 1.0),
        )

    def sentence(self) -> str:
        """Return what the result is conditional on."""
        known = bool(self.std_error) or bool(self.std_error_failed)  # 0: nothing, or all, was critical
        spread = "the interval has the spread between them" if known else "how others would change it is not in the interval"
        return f"The result is conditional on the traffic of {plural(self.warm_ups, 'warm-up')}; {spread}."

    def decides(self, cov: float | None, value: float | None) -> bool:
        """Return whether the coefficient of variation of an estimate is that by the spread, as warm-ups differ."""
        return self.differs and cov is not None and bool(value and (self.std_error or 0.0) / value >= cov)

    def exceeds(self, cov: float, value: float) -> bool:
        """Return whether the coefficient of variation is above a limit by the spread alone."""
        return self.std_error is not None and self.std_error > cov * value


def spread_of_draws(log: Log, batches: Batches, worst: Batches | None = None) -> Spread | None:
    """Return the spread of an estimate from weighted batches; None where runs simulate their traffic from the beginning.

    Args:
        log: of the campaign.
        batches: failed runs as safe.
        worst: the same, failed runs as critical.
    """
    history = log.history
    drawn = history.stage == DRAWN
    rows = [np.flatnonzero(drawn & (history.iteration == number)) for number in counted_iterations(log)][: len(batches)]
    return spread_of_batches(history.columns["warm_up"][np.concatenate(rows)], batches, worst)


def spread_of_batches(warm_up: Vector, batches: Batches, worst: Batches | None = None) -> Spread | None:
    """Return the spread of an estimate from weighted batches, of which each draw began with a warm-up (n,), -1 without one.

    `worst` are the same batches with failed runs as critical. What is stated of a pool before its draws depends on warm-ups as
    much as they do, where the traffic of its pairs is known, or they were run coarse.
    """
    weights = batch_weights(batches)
    pools = [b.by_warm_up for b in batches if b.by_warm_up is not None]
    cluster = np.concatenate([warm_up, *(np.arange(len(pool)) for pool in pools)])

    def terms(those: Batches) -> Vector:
        stated = [w * b.by_warm_up for w, b in zip(weights, those, strict=True) if b.by_warm_up is not None]
        return np.concatenate([*(w * b.errors for w, b in zip(weights, those, strict=True)), *stated])

    differ = worst is not None and any((a.critical != b.critical).any() for a, b in zip(batches, worst, strict=True))
    known = float(weights**2 @ [0.0 if b.by_warm_up is None else b.pool_variance for b in batches])
    own = terms(batches)
    apart = math.sqrt(float((own[: len(warm_up)] ** 2).sum()) + known)
    return _spread(cluster, own, terms(worst) if worst is not None and differ else None, apart)


def spread_of_share(history: History, among: Mask, critical: Mask) -> Spread | None:
    """Return the spread of the critical share among some runs; None where runs simulate their traffic from the beginning."""
    rows = np.flatnonzero(among)
    if not len(rows):
        return None
    readings = (each[rows].astype(np.float64) for each in (critical, critical | ~history.ok))
    safe, worst = ((hits - hits.mean()) / len(rows) for hits in readings)
    apart = float(np.sqrt((safe**2).sum()))
    return _spread(history.columns["warm_up"][rows], safe, None if history.ok[rows].all() else worst, apart)


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


def likelier(one: Mask, other: Mask, warm_up: Vector | None = None, confidence: float = 0.975) -> bool:
    """Return whether the first of two events that exclude each other is likelier: by the exact test on the runs with either.

    Args:
        one: (n,) the run has the first event.
        other: (n,) the run has the second one.
        warm_up: (n,) that each began with, -1 without one; None: there are none. Runs count for fewer by the spread between them.
        confidence: of the one-sided test.

    Source:
        McNemar (1947), doi 10.1007/BF02295996, with exact binomial tails.
    """
    n, counts = len(one), np.array([one.sum(), other.sum()], dtype=np.float64)
    if n and warm_up is not None and (warm_up >= 0).all():
        terms = (one.astype(np.float64) - other) / n
        terms -= terms.mean()
        error = clustered_error(terms, warm_up)
        if error:
            few = float(stdtrit(n - 1.0, confidence)) / float(stdtrit(len(np.unique(warm_up)) - 1.0, confidence))
            counts *= min(float((terms**2).sum()) / error**2 * few**2, 1.0)
    return bool(binomial.lower(counts[0], counts.sum(), confidence) > 0.5) if counts[0] > 0.0 else False


def _spread(cluster: Vector, terms: Vector, failed: Vector | None, apart: float) -> Spread | None:
    if not (cluster >= 0).any():
        return None
    worst = None if failed is None else clustered_error(failed, cluster)
    return Spread(len(np.unique(cluster)), clustered_error(terms, cluster), worst, apart)
