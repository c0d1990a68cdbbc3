"""No run twice, unless the simulator is noisy: of few combinations of whole numbers and choices each is run once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from sbt.campaigns.repeats import repeats_wanted, simulator_noise
from sbt.campaigns.wording import percent
from sbt.loop.stages import Facts
from sbt.problem.arrays import Points
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.samplers.sobol import SobolSequence
from sbt.store.history import History

__all__ = ["ALL_RUN", "EveryCombination", "all_run", "combinations_left", "every_combination", "few", "none_left",
           "without_repetition"]  # fmt: skip

ALL_RUN = "all combinations"
"""Why a campaign stops that has run every combination of its inputs."""
_CANDIDATES = 1024  # points of which the farthest from all runs takes the place of a repetition


def combinations_left(scenario: LogicalScenario, history: History) -> Points | None:
    """Return the feasible combinations (m, d) that were not run yet, in the inputs' units.

    None where repetitions are worth a run: an input is continuous, there are more than 4,096 of them, equal inputs gave
    different metrics, or all were run and noise would hardly show (`SimulatorNoise.silent`); also for recorded tables, whose
    rows are never repeated.
    """
    space = scenario.space
    points = space.combinations
    noise = simulator_noise(history, scenario.requirement)
    if points is None or scenario.pool is not None or noise.noisy:
        return None
    x = space.from_unit(points)
    gone = {tuple(row) for row in _cells(space, history.x)}
    left = x[[tuple(row) not in gone for row in _cells(space, x)]]
    return None if noise.silent and not len(left) else left


def few(scenario: LogicalScenario, history: History, budget: int) -> bool:
    """Return whether the budget is enough to run every combination: then what is held out would be what is learned."""
    left = combinations_left(scenario, history)
    return left is not None and len(left) + len(history) <= budget


def all_run(scenario: LogicalScenario, history: History) -> bool:
    """Return whether every combination was run, and repeats have told that running them again tells nothing new."""
    left = combinations_left(scenario, history)
    return left is not None and len(left) == 0 and not repeats_wanted(history, scenario, 1)


@dataclass(frozen=True)
class EveryCombination:
    """What is known where every combination of the inputs was run, and gave the same metric whenever it was repeated.

    Attributes:
        combinations: that can be run.
        critical: those whose run was critical.
    """

    combinations: int
    critical: int

    @property
    def share(self) -> float:
        """The critical share of the parameter space: every combination is as large a part of it."""
        return self.critical / self.combinations

    def sentences(self, scenario: str, condition: str) -> list[str]:
        """Return the share, what it does not tell, and what to do next."""
        are = "is" if self.critical == 1 else "are"
        return [
            f"{self.critical:,} of all {self.combinations:,} combinations of the inputs of {scenario} {are} critical"
            f" ({condition}), {percent(self.share)}: every one was run, and metrics did not change where runs were repeated.",
            "This does not tell how probable critical runs are in traffic, since every combination counts the same.",
            "Next: campaign: estimation weighs the combinations by their probability; result.frame and export list them.",
        ]


def every_combination(scenario: LogicalScenario, history: History) -> EveryCombination | None:
    """Return what is known where every combination was run and gave a metric; None elsewhere."""
    if not all_run(scenario, history) or not history.ok.all():
        return None
    first = np.unique(history.x, axis=0, return_index=True)[1]
    return EveryCombination(len(first), int(scenario.requirement.critical_runs(history)[first].sum()))


def none_left(facts: Facts) -> bool:
    """Return whether every combination was run and gave a metric, the same wherever it was repeated."""
    history, n = facts.history, facts.combinations
    if n is None or len(history) < n or len(np.unique(history.x, axis=0)) < n or not history.ok.all():
        return False
    noise = simulator_noise(history, facts.requirement)
    return noise.noisy is False and not noise.silent


def without_repetition(scenario: LogicalScenario, history: History, x: Points, *, continuous: bool = True) -> Points:
    """Return the runs x (n, d) in the inputs' units without repetitions of each other and of earlier runs.

    Of combinations of whole numbers and choices the nearest ones left take their place, fewer where no more are left; elsewhere
    points of an even design far from all runs (`continuous`: there, too). x itself where repetitions are worth a run: the
    simulator is noisy.
    """
    left = combinations_left(scenario, history)
    if left is None:
        kept = not continuous or scenario.pool is not None or simulator_noise(history, scenario.requirement).noisy
        return x if kept else _apart(scenario.space, history.x, x)
    space = scenario.space
    chosen: list[Points] = []
    for row in x[: len(left)]:
        at = [space.cube.embedded(space.to_unit(points)) for points in (row[None], left)]
        nearest = int(cdist(*at)[0].argmin())
        chosen.append(left[nearest])
        left = np.delete(left, nearest, axis=0)
    return np.array(chosen).reshape(-1, space.dimension)


def _apart(space: ParameterSpace, known: Points, x: Points) -> Points:
    """Return runs x (n, d), those that equal a known (m, d) or an earlier one replaced by points far from all."""
    first = np.unique(np.concatenate([known, x]), axis=0, return_index=True)[1]
    new = np.isin(np.arange(len(known), len(known) + len(x)), first)
    if new.all():
        return x
    even = space.from_unit(SobolSequence(space.dimension, len(known)).points(0, _CANDIDATES))
    even = even[space.feasible(even)]
    at = [space.cube.embedded(space.to_unit(points)) for points in (even, np.concatenate([known, x[new]]))]
    if not len(even):
        return x
    distance, found = cdist(*at).min(axis=1), x.copy()
    for row in np.flatnonzero(~new):
        farthest = int(distance.argmax())
        found[row] = even[farthest]
        distance = np.minimum(distance, cdist(at[0], at[0][[farthest]])[:, 0])
    return found


def _cells(space: ParameterSpace, x: Points) -> Points:
    return space.cube.cells(space.to_unit(x)) if len(x) else np.empty((0, 1))
