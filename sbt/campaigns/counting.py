"""What of a log counts: complete batches with known densities, and what all runs met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.campaigns.parts import Settings
from sbt.errors import InputError
from sbt.estimators.intervals import CountedBatch
from sbt.loop.stages import Log
from sbt.problem.arrays import Vector

__all__ = ["DRAWN", "Seen", "counted_batches", "drawn_shares"]

DRAWN = "estimation"
"""Stage of runs that were drawn with a known density."""
_DENIED = 0.01


def counted_batches(log: Log, settings: Settings, *, failed_critical: bool = False) -> list[CountedBatch]:
    """Return the batches that count, with their outcomes; failed runs count as stated.

    Raises:
        InputError: a counted run has no proposal density.
    """
    found, requirement = [], settings.scenario.requirement
    critical = requirement.critical.contains(log.history.y(requirement.metric))
    critical = critical | (failed_critical & ~log.history.ok)
    drawn = log.history.stage == DRAWN
    for how in log.iterations:
        if how.get("phase") != "count":
            continue
        rows = np.flatnonzero(drawn & (log.history.iteration == how["iteration"]))
        if len(rows) < how["draws"]:
            continue  # a batch counts only when it is complete
        if any(log.history.records[k].log_q is None for k in rows):
            raise InputError("an estimate needs runs with a known proposal density, but a counted run has none")
        found.append(CountedBatch(
            how["prior"], how["anticipated"], how["pool_variance"], np.array(how["coefficient"]), np.array(how["believed"]),
            critical[rows].astype(np.float64),
        ))  # fmt: skip
    return found


def drawn_shares(log: Log) -> Vector:
    """Return the share in proportion to the nominal law of every counted draw, in their order."""
    shares = [np.full(i["draws"], i["nominal"]) for i in log.iterations if i.get("phase") == "count"]
    return np.concatenate(shares) if shares else np.empty(0)


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
        history, requirement = log.history, settings.scenario.requirement
        critical = requirement.critical.contains(history.y(requirement.metric))
        surprises = 0
        for how in log.iterations:
            if how.get("phase") == "count":
                rows = (history.stage == DRAWN) & (history.iteration == how["iteration"])
                surprises += int((critical[rows] & (np.array(how["pi"]) < _DENIED)).sum())
        failed = int((~history.ok & (history.stage == DRAWN)).sum())
        return cls(int(critical.sum()), int((history.ok & ~critical).sum()), failed, surprises)
