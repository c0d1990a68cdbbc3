"""Whether a run is critical: what of it the inputs decide, what the traffic that the seed draws, and what stays open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import percent
from sbt.metamodels.risk import fit_risk
from sbt.problem.arrays import Points
from sbt.samplers.noise import scores
from sbt.samplers.search import fill_uniformly
from sbt.seeds import SEED_END, stream
from sbt.store.history import VALIDATION, History

__all__ = ["TrafficDoubt", "traffic_doubt"]

_FEWEST, _EITHER = 100, 10
"""Runs, and critical and safe ones among them, from which on shares are stated."""
_POINTS, _SEEDS = 256, 8
"""Points of the space, and fresh seeds at each."""


@dataclass(frozen=True)
class TrafficDoubt:
    """P(critical | inputs) as the mean over the traffic that seeds draw, and the variance of "critical" in three parts.

    Attributes:
        critical_fraction: mean P(critical) over the space and over drawn traffic.
        inputs: share of the variance that is between inputs, whatever the traffic: beyond it a boundary tells nothing.
        traffic: share between the traffics of the same inputs.
        rest: share that is left when both are known: the drivers' imperfection during the run, and what the runs did not teach.
        pairs: of inputs and fresh seeds, over which it was taken.
    """

    critical_fraction: float
    inputs: float
    traffic: float
    rest: float
    pairs: int

    def sentence(self) -> str:
        """Return the shares in words."""
        return (
            f"Whether a run is critical is decided to {percent(self.inputs)} by the inputs and to {percent(self.traffic)} by the"
            f" drawn traffic; {percent(self.rest)} stay open: drivers during the run, and what the runs do not teach. Over"
            f" {self.pairs:,} pairs of inputs and fresh seeds, {percent(self.critical_fraction)} are critical in the mean."
        )


def traffic_doubt(settings: Settings, history: History) -> TrafficDoubt | None:
    """Return the shares; None where seeds are not looked at, or there are fewer than 100 runs, or 10 critical or safe ones."""
    covariates, scenario = settings.covariates, settings.scenario
    runs = history.where((history.stage != VALIDATION) & history.drawn & (history.columns["level"] == 0))
    critical = scenario.requirement.critical_runs(runs)
    if covariates is None or len(runs) < _FEWEST or min(critical.sum(), (~critical).sum()) < _EITHER:
        return None
    space, rng = scenario.space, stream(settings.seed, "doubt", len(runs))

    def inputs(x: Points, told: Points) -> Points:
        return np.column_stack([space.metamodel_inputs_at(x), told])

    margin = np.where(runs.ok, np.nan_to_num(scenario.requirement.margins(runs), nan=np.inf, posinf=np.inf), np.inf)
    u = fill_uniformly(lambda v: space.feasible(space.from_unit(v)), _POINTS, space.dimension, rng)
    x, seeds = np.repeat(space.from_unit(u), _SEEDS, axis=0), rng.integers(0, SEED_END, _POINTS * _SEEDS).tolist()
    with threadpool_limits(1):
        risk = fit_risk(inputs(runs.x, covariates.at(runs.x, runs.seed.tolist())), scores(margin), margin, critical, rng)
        p = np.exp(risk(inputs(x, covariates.at(x, seeds, keep=False)))[0]).reshape(_POINTS, _SEEDS)
    traffic, rest = float(p.var(axis=1, ddof=1).mean()), float((p * (1.0 - p)).mean())
    between = max(float(p.mean(axis=1).var(ddof=1)) - traffic / _SEEDS, 0.0)
    whole = max(between + traffic + rest, 1e-300)
    return TrafficDoubt(float(p.mean()), between / whole, traffic / whole, rest / whole, _POINTS * _SEEDS)
