"""How much of the metric's variance inputs explain, how much the traffic that the seed draws, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import percent, plural
from sbt.metamodels.bootstrap import out_of_bag
from sbt.problem.arrays import Mask
from sbt.seeds import stream
from sbt.store.history import History
from sbt.store.records import optional

__all__ = ["ExplainedVariance", "explained_variance"]

_FEWEST, _FEWEST_JUDGED = 100, 30
"""Runs of drawn seeds from which on shares are stated: of fewer a forest explains too little. And those judged by."""

@dataclass(frozen=True)
class ExplainedVariance:
    """Shares of the metric's variance, by forests on runs that their trees had not seen (out of bag).

    Attributes:
        inputs: what the inputs alone explain.
        traffic: what the covariates explain beside them.
        rest: what is left: the drivers' imperfection during the run, and what the forests do not know.
        runs: of drawn seeds, which taught the forests.
        judged: those of them that no metamodel chose, of whose variance these are shares.
    """

    inputs: float
    traffic: float
    rest: float
    runs: int
    judged: int | None = optional()

    def sentence(self, metric: str) -> str:
        """Return the shares in words."""
        of = "" if self.judged in (None, self.runs) else f" over the {self.judged} runs that no metamodel chose"
        rest = f"what drivers do during the run and to what {plural(self.runs, 'run')} do not teach"
        traffic = f"the drawn traffic {percent(self.traffic)} more"
        said = f"Of the variance of {metric}{of}, inputs explain {percent(self.inputs)} and {traffic}"
        return f"{said}; {percent(self.rest)} is left to {rest}."


def explained_variance(settings: Settings, history: History, even: Mask | None = None) -> ExplainedVariance | None:
    """Return the shares; None where seeds are not looked at, or too few runs of drawn seeds have a finite metric.

    Args:
        settings: of the campaign.
        history: all runs, which teach the forests.
        even: (n,) those that no metamodel chose, whose variance is meant; None: all. Runs beside a boundary differ less.
    """
    covariates, requirement, space = settings.covariates, settings.scenario.requirement, settings.scenario.space
    if covariates is None or requirement.combined:
        return None
    known = history.ok & history.drawn
    known[known] = np.isfinite(requirement.told(history.where(known)))
    runs = history.where(known)
    judged = np.full(len(runs), True) if even is None else even[known]
    y = requirement.told(runs)
    if len(runs) < _FEWEST or judged.sum() < _FEWEST_JUDGED or np.ptp(y[judged]) == 0.0:
        return None
    inputs = space.metamodel_inputs_at(runs.x)
    both = covariates.beside_inputs(runs.x, runs.seed.tolist())
    alone = out_of_bag(inputs, y, stream(settings.seed, "explained", len(y)), judged)
    whole = max(out_of_bag(both, y, stream(settings.seed, "explained", len(y)), judged), alone)
    return ExplainedVariance(alone, whole - alone, 1.0 - whole, len(runs), int(judged.sum()))
