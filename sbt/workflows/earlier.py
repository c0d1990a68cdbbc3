"""Runs of an earlier campaign of the same scenario, as another one may learn from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sbt.errors import InputError
from sbt.problem.scenario import LogicalScenario
from sbt.store.history import History

__all__ = ["usable_runs"]


def usable_runs(scenario: LogicalScenario, folder: Path, names: Sequence[str], history: History) -> History:
    """Return the runs of an earlier campaign that are feasible here, their choices coded as here.

    Args:
        scenario: as it is now.
        folder: of the earlier campaign, for messages.
        names: its inputs.
        history: its runs.

    Raises:
        InputError: it had other inputs, or did not measure what is required now.
    """
    space = scenario.space
    if tuple(names) != space.names:
        raise InputError(
            f"warm_start.store must have the same inputs, but {folder} has others ({', '.join(names)} there, "
            f"{', '.join(space.names)} here)"
        )
    if set(space.choices) != set(history.choices):
        named = (", ".join(found) or "none" for found in (history.choices, space.choices))
        raise InputError("warm_start.store must have choices of the same inputs, but {} there, {} here".format(*named))
    history = history.recoded(space.choices)
    runs = history.where(space.feasible(history.x)) if len(history) else history
    for metric in (part.metric for part in scenario.requirement.parts):
        if len(runs) and metric not in runs.metrics and runs.ok.any():
            raise InputError(f"warm_start.store must have measured {metric}, but {folder} did not")
    return runs
