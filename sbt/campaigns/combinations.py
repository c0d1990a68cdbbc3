"""Spaces of whole numbers and choices only, with few combinations: each is run once, unless the simulator is noisy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from sbt.campaigns.repeats import repeats_wanted, simulator_noise
from sbt.problem.arrays import Points
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.history import History

__all__ = ["ALL_RUN", "all_run", "combinations_left", "few", "without_repetition"]

ALL_RUN = "all combinations"
"""Why a campaign stops that has run every combination of its inputs."""
_MOST = 4096  # combinations that are kept account of


def combinations_left(scenario: LogicalScenario, history: History) -> Points | None:
    """Return the feasible combinations (m, d) that were not run yet, in the inputs' units.

    None where repetitions are worth a run: an input is continuous, there are more than 4,096 combinations, or equal inputs
    gave different metrics; also for recorded tables, whose rows are never repeated.
    """
    space = scenario.space
    points = space.cube.combinations(space.dimension, _MOST)
    if points is None or scenario.pool is not None or simulator_noise(history, scenario.requirement).noisy:
        return None
    x = space.from_unit(points)
    x = x[space.feasible(x)]
    gone = {tuple(row) for row in _cells(space, history.x)}
    return x[[tuple(row) not in gone for row in _cells(space, x)]]


def few(scenario: LogicalScenario, history: History, budget: int) -> bool:
    """Return whether the budget is enough to run every combination: then what is held out would be what is learned."""
    left = combinations_left(scenario, history)
    return left is not None and len(left) + len(history) <= budget


def all_run(scenario: LogicalScenario, history: History) -> bool:
    """Return whether every combination was run, and repeats have told that running them again tells nothing new."""
    left = combinations_left(scenario, history)
    return left is not None and len(left) == 0 and not repeats_wanted(history, scenario, 1)


def without_repetition(scenario: LogicalScenario, history: History, x: Points) -> Points:
    """Return the runs x (n, d) in the inputs' units, repeated ones replaced by the nearest combinations left.

    Fewer where no more are left; x itself where repetitions are worth a run.
    """
    left = combinations_left(scenario, history)
    if left is None:
        return x
    space = scenario.space
    chosen: list[Points] = []
    for row in x[: len(left)]:
        at = [space.cube.embedded(space.to_unit(points)) for points in (row[None], left)]
        nearest = int(cdist(*at)[0].argmin())
        chosen.append(left[nearest])
        left = np.delete(left, nearest, axis=0)
    return np.array(chosen).reshape(-1, space.dimension)


def _cells(space: ParameterSpace, x: Points) -> Points:
    return space.cube.cells(space.to_unit(x)) if len(x) else np.empty((0, 1))
