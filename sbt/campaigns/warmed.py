"""What warmed traffic means for a conclusion: runs of one warm-up are a cluster, and the result holds for the warm-ups."""

from __future__ import annotations

import numpy as np

from sbt.campaigns.clustering import Spread, spread_of_draws, spread_of_share
from sbt.campaigns.counting import NOMINAL, counted_batches
from sbt.campaigns.crude import nominal_rows
from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import plural
from sbt.loop.stages import Log
from sbt.store.history import History

__all__ = ["conditional_on", "warmed_traffic"]


def conditional_on(history: History) -> list[str]:
    """Return the sentence on the warm-ups of a campaign that searches; none where runs simulate their traffic."""
    numbers = history.columns["warm_up"]
    found = len(np.unique(numbers[numbers >= 0]))
    said = f"Runs began with the traffic of {plural(found, 'warm-up')}: the result is conditional on it"
    return [f"{said}{', and other traffic (warm_up.seeds) may give another' if found == 1 else ''}."] if found else []


def warmed_traffic(log: Log, settings: Settings) -> Spread | None:
    """Return the spread between the warm-ups behind an estimate; None where runs simulate their traffic from the beginning.

    Its error is not known where repeats are counted.
    """
    history = log.history
    batches = counted_batches(log, settings)
    if batches:
        return spread_of_draws(log, batches, counted_batches(log, settings, failed_critical=True))
    if (history.stage == NOMINAL).any():
        return spread_of_share(history, nominal_rows(log), settings.scenario.requirement.critical_runs(history))
    numbers = history.columns["warm_up"]
    return Spread(len(np.unique(numbers)), None) if (numbers >= 0).any() else None
