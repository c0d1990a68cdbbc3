"""An earlier campaign, as another one may learn from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sbt.campaigns.transferring import earlier_runs, transfer_of
from sbt.config.model import Configuration, WarmStart
from sbt.errors import InputError
from sbt.estimators.transfer import Transfer
from sbt.loop.earlier import EarlierRuns
from sbt.loop.learner import Learner
from sbt.metamodels.base import simplest
from sbt.problem.plain import unit_of
from sbt.problem.scenario import LogicalScenario
from sbt.store.history import History

__all__ = ["EarlierCampaign"]


@dataclass(frozen=True, eq=False)
class EarlierCampaign:
    """A finished campaign.

    Attributes:
        folder: of its store, for messages.
        scenario: with its own inputs.
        history: its runs.
        choice: how another campaign learns from it.
        package: print of the package that it was run with; "" where its store remembers none.
    """

    folder: Path
    scenario: LogicalScenario
    history: History
    choice: WarmStart
    package: str = ""

    def pooled(self, learner: Learner, config: Configuration) -> EarlierRuns:
        """Return its runs, without the held-out ones, for a metamodel that learns from them beside those of its own campaign.

        Both campaigns may have the same held-out inputs: whoever learned from the ones would be scored too well by the others.

        Args:
            learner: of the new campaign.
            config: of the new campaign.

        Raises:
            InputError: see `same_runs` and `earlier_runs`; or it has an input or a required metric in another unit.
        """
        choice, scenario = self.choice, learner.scenario
        self._check_units(scenario)
        runs = self.history if choice.transfer else self.same_runs(scenario)
        learn = simplest(learner.metamodel)
        return earlier_runs(
            self.scenario, runs.training, scenario, learn, config.seed, other=choice.transfer, fixed=choice.fixed
        )  # fmt: skip

    def trend(self, learner: Learner, config: Configuration) -> Transfer:
        """Return what it tells as a trend; arguments as of `pooled`.

        Raises:
            InputError: see `transfer_of`; or it has an input or a required metric in another unit.
        """
        self._check_units(learner.scenario)
        learn, fixed = learner.metamodel, self.choice.fixed
        return transfer_of(self.scenario, self.history.training, learner.scenario, learn, config.seed, fixed)

    def _check_units(self, scenario: LogicalScenario) -> None:
        """Refuse runs with an input or a required metric in another unit: numbers would be compared that mean other things."""
        old, new, metrics = self.scenario.units, scenario.units, [part.metric for part in scenario.requirement.parts]
        units = {name: (old.get(name, ""), new.get(name, "")) for name in scenario.space.names}
        units |= {name: (unit_of(old, name), unit_of(new, name)) for name in metrics if name not in units}
        others = [f"{name} in {a} there, in {b} here" for name, (a, b) in units.items() if a and b and a != b]
        if others:
            raise InputError(f"warm_start.store must have the same units, but {self.folder} has {'; '.join(others)}")

    def same_runs(self, scenario: LogicalScenario) -> History:
        """Return its runs that are feasible in the scenario as it is now, their choices coded as there.

        Raises:
            InputError: it had other inputs, or other units of them, or did not measure what is required now.
        """
        self._check_units(scenario)
        space, history = scenario.space, self.history
        if history.names != space.names:
            raise InputError(
                f"warm_start.store must have the same inputs, but {self.folder} has others ({', '.join(history.names)} there, "
                f"{', '.join(space.names)} here)"
            )
        if set(space.choices) != set(history.choices):
            named = (", ".join(found) or "none" for found in (history.choices, space.choices))
            raise InputError("warm_start.store must have choices of the same inputs, but {} there, {} here".format(*named))
        history = history.recoded(space.choices)
        runs = history.where(space.feasible(history.x)) if len(history) else history
        for metric in (part.metric for part in scenario.requirement.parts):
            if len(runs) and metric not in runs.metrics and runs.ok.any():
                raise InputError(f"warm_start.store must have measured {metric}, but {self.folder} did not")
        return runs
