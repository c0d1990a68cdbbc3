"""How much of the metric's variance inputs explain, how much the traffic that the seed draws, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import percent, plural
from sbt.problem.arrays import Points, Vector
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["ExplainedVariance", "explained_variance"]

_FEWEST = 100
"""Runs of drawn seeds from which on shares are stated: of fewer a forest explains too little."""
_TREES = 200


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
            f"Of the variance of {metric}, inputs explain {percent(self.inputs)} and the drawn traffic {percent(self.traffic)} more;"
            f" {percent(self.rest)} is left to what drivers do during the run and to what {plural(self.runs, 'run')} do not teach."
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
    inputs = space.metamodel_inputs(np.clip(space.to_unit(runs.x), 0.0, 1.0))
    both = np.column_stack([inputs, covariates.at(runs.x, runs.seed.tolist())])
    alone = _out_of_bag(inputs, y, settings.seed)
    whole = max(_out_of_bag(both, y, settings.seed), alone)
    return ExplainedVariance(alone, whole - alone, 1.0 - whole, len(runs))


def _out_of_bag(u: Points, y: Vector, seed: int) -> float:
    """Return the share of the variance of y (n,) that a forest on u (n, d) explains of rows its trees did not learn, at least 0."""
    from sklearn.ensemble import ExtraTreesRegressor

    state = int(stream(seed, "explained", len(y)).integers(2**31))
    forest = ExtraTreesRegressor(_TREES, min_samples_split=4, bootstrap=True, oob_score=True, random_state=state, n_jobs=1)
    return max(float(forest.fit(u, y).oob_score_), 0.0)
