"""What of a log counts: complete batches with known densities, and what all runs met."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.records import CountedDraws, EstimationProposal, PoolSummary
from sbt.campaigns.settings import Settings
from sbt.errors import InputError
from sbt.estimators.intervals import CountedBatch
from sbt.loop.stages import Log
from sbt.problem.arrays import Vector

__all__ = ["DRAWN", "Seen", "counted_batches", "counted_iterations", "drawn_shares"]

DRAWN = "estimation"
"""Stage of runs that were drawn with a known density."""
_DENIED = 0.01
"""P(critical) below which a critical draw is a surprise to the metamodel."""


def counted_batches(log: Log, settings: Settings, *, failed_critical: bool = False) -> list[CountedBatch]:
    """Return the batches that count, with their outcomes; failed runs count as stated.

    Raises:
        InputError: a counted run has no proposal density.
    """
    history = log.history
    critical = settings.scenario.requirement.critical_runs(history) | (failed_critical & ~history.ok)
    found, drawn = [], history.stage == DRAWN
    for iteration, pool, draws in _counted(log):
        rows = np.flatnonzero(drawn & (history.iteration == iteration))
        if len(rows) < len(draws.coefficient):
            continue  # a batch counts only when it is complete
        if np.isnan(history.log_q[rows]).any():
            raise InputError("an estimate needs runs with a known proposal density, but a counted run has none")
        found.append(CountedBatch(
            pool.probability, pool.anticipated, draws.pool_variance, np.array(draws.coefficient), np.array(draws.control_variate),
            critical[rows].astype(np.float64),
        ))  # fmt: skip
    return found


def _counted(log: Log) -> Iterator[tuple[int, PoolSummary, CountedDraws]]:
    """Yield number, pool and draws of the batches that count."""
    for batch in log.iterations:
        proposal = batch.read(EstimationProposal)
        if proposal.counted is not None and proposal.pool is not None:
            yield batch.number, proposal.pool, proposal.counted


def drawn_shares(log: Log) -> Vector:
    """Return the share in proportion to the inputs' distribution of every counted draw, in their order."""
    shares = [np.full(len(draws.coefficient), draws.nominal) for _, _, draws in _counted(log)]
    return np.concatenate(shares) if shares else np.empty(0)


def counted_iterations(log: Log) -> list[int]:
    """Return the numbers of the batches that count."""
    return [number for number, _, _ in _counted(log)]


@dataclass(frozen=True)
class Seen:
    """What all runs met: critical and safe ones, failed draws, and draws that surprised the metamodel."""

    critical: int
    safe: int
    failed_draws: int
    surprises: int

    @classmethod
    def of(cls, log: Log, settings: Settings) -> Seen:
        """Count the runs of a log."""
        history = log.history
        critical = settings.scenario.requirement.critical_runs(history)
        surprises = 0
        for iteration, _, draws in _counted(log):
            rows = (history.stage == DRAWN) & (history.iteration == iteration)
            surprises += int((critical[rows] & (np.array(draws.pi) < _DENIED)).sum())
        failed = int((~history.ok & (history.stage == DRAWN)).sum())
        return cls(int(critical.sum()), int((history.ok & ~critical).sum()), failed, surprises)
