"""How much a campaign of another setup, from which one was warm-started, told about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import number, plural
from sbt.loop.stages import Log

__all__ = ["TRANSFERRED", "EarlierTold", "earlier_told"]

TRANSFERRED = "transfer"
"""Stage of runs that were critical in an earlier campaign of another setup."""
_FEWEST = 5
"""Runs from which on a correlation is stated."""


@dataclass(frozen=True)
class EarlierTold:
    """What an earlier campaign of another setup told about this one.

    Attributes:
        runs: of this campaign, with a finite metric, by which it is judged.
        correlations: of each metric of the requirement, between the ranks of what the earlier campaign lets expect and of what
            runs gave here; left out where fewer than five runs tell it, or all gave the same.
        again: critical runs of the earlier campaign that were run again.
        critical: of these, here.
        learned: what it lets expect is used where it helps; otherwise its critical runs alone are.
    """

    runs: int
    correlations: Mapping[str, float] = field(default_factory=dict)
    again: int = 0
    critical: int = 0
    learned: bool = True

    def sentences(self) -> list[str]:
        """Return in words how like the two setups are."""
        said = []
        if self.correlations:
            each = ", ".join(f"{number(value, 2)} ({name})" for name, value in self.correlations.items())
            here = plural(self.runs, "run")
            used = "it is used as far as it predicts them better" if self.learned else "a search takes its critical runs alone"
            alike = f"What the earlier campaign lets expect has a rank correlation of {each} with {here} of this one"
            said.append(f"{alike}; {used}.")
        if self.again:
            were = "was" if self.critical == 1 else "were"
            again = plural(self.again, "critical run")
            said.append(f"Of {again} of the earlier campaign that began this one, {self.critical} {were} critical here.")
        return said


def earlier_told(log: Log, settings: Settings, *, learned: bool = True) -> EarlierTold | None:
    """Return how well the earlier campaign predicts this one's runs, from which it learned or not; None: of the same setup."""
    if settings.transfer is None:
        return None
    from scipy.stats import spearmanr

    requirement = settings.scenario.requirement
    runs = log.history.where(log.history.columns["level"] == 0)
    again = runs.where(runs.stage == TRANSFERRED)
    gave = runs.where(runs.ok)
    z, counted, correlations = settings.scenario.space.to_normal(gave.x), 0, {}
    for part, trend in zip(requirement.parts, settings.transfer.trends, strict=True):
        y = part.values(gave)
        finite = np.isfinite(y)
        if finite.sum() < _FEWEST or np.ptp(y[finite]) == 0.0:
            continue
        expected = trend.mean(z[finite])
        if np.ptp(expected) > 0.0:
            correlations[part.told_as] = float(spearmanr(expected, trend.warp.values(y[finite])).statistic)
            counted = max(counted, int(finite.sum()))
    return EarlierTold(counted, correlations, len(again), int(requirement.critical_runs(again).sum()), learned)
