"""What every campaign is built from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from sbt.loop.learner import Learner
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval
from sbt.problem.scenario import LogicalScenario
from sbt.store.history import History

__all__ = ["Acquisition", "Settings"]

Acquisition = Callable[[Prediction, CriticalInterval, Vector], Vector]


@dataclass(frozen=True)
class Settings:
    """What every campaign is built from.

    Args:
        scenario: with the campaign's own space and requirement.
        seed: of the campaign.
        budget: runs, the held-out share included.
        initial, batch: runs of the first and of each further iteration.
        share: of every batch that is drawn at random and held out.
        reference: further held-out runs beyond the budget.
        learner: fits and scores the metamodel; None: no metamodel.
        acquisition: log score of candidates; None where the campaign chooses by a method of its own.
        method: name of the acquisition or method, as configured.
        stop: rules by name, None where one is off.
        gate: `probability` and `confidence` of the verdict of an estimation; None: no verdict.
        earlier: runs of another campaign to learn from, never to count.
    """

    scenario: LogicalScenario
    seed: int
    budget: int
    initial: int
    batch: int
    share: float
    reference: int
    learner: Learner | None
    acquisition: Acquisition | None
    method: str = ""
    stop: Mapping[str, Any] = field(default_factory=dict)
    gate: Mapping[str, float] | None = None
    earlier: History | None = None
