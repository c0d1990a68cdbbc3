"""How much of the metric's variance inputs explain, how much the traffic that the seed draws, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import percent, plural
from sbt.metamodels.bootstrap import out_of_bag
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["ExplainedVariance", "explained_variance"]

_FEWEST = 100
"""Runs of drawn seeds from which on shares are stated: of fewer a forest explains too little."""

@dataclass(frozen=True)
class ExplainedVariance:
    """Shares of the metric's variance, by forests on runs that their trees had not seen (out of bag).

    Attributes:
        inputs: what the inputs alone explain.
        traffic: what the covariates explain beside them.
        rest: what is left: the drivers' imperfection during the run, and what the forests do not know.
        runs: of drawn seeds, from which it was taken.
    """

    inputs: float
    traffic: float
    rest: float
    runs: int

    def sentence(self, metric: str) -> str:
        """Return the shares in words."""
        return (
            f"Of the variance of {metric}, inputs explain {percent(self.inputs)} and the drawn traffic {percent(self.traffic)}"
            f" more; {percent(self.rest)} is left to what drivers do during the run and to what {plural(self.runs, 'run')} do not"
            " teach."
        )


def explained_variance(settings: Settings, history: History) -> ExplainedVariance | None:
    """Return the shares; None where seeds are not looked at, or fewer than 100 runs of drawn seeds have a finite metric."""
    covariates, requirement, space = settings.covariates, settings.scenario.requirement, settings.scenario.space
    if covariates is None or requirement.combined:
        return None
    runs = history.where(history.ok & history.drawn)
    runs = runs.where(np.isfinite(requirement.told(runs)))
    y = requirement.told(runs)
    if len(runs) < _FEWEST or np.ptp(y) == 0.0:
        return None
    inputs = space.metamodel_inputs_at(runs.x)
    both = np.column_stack([inputs, covariates.at(runs.x, runs.seed.tolist())])
    alone = out_of_bag(inputs, y, stream(settings.seed, "explained", len(y)))
    whole = max(out_of_bag(both, y, stream(settings.seed, "explained", len(y))), alone)
    return ExplainedVariance(alone, whole - alone, 1.0 - whole, len(runs))
