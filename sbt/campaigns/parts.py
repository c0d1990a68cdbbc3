"""Parts that campaigns are put together from: the batch stage, held-out runs, intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from sbt.campaigns.choices import Choice, evenly
from sbt.campaigns.settings import Settings
from sbt.estimators.binomial import interval
from sbt.loop.learner import FittedMetamodel, changed_share
from sbt.loop.stages import Batch, Fit, Log
from sbt.problem.arrays import Points, Vector
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.database import PlannedRun
from sbt.store.history import VALIDATION, History

__all__ = [
    "BatchStage", "Settings", "critical_share", "fit_of", "held_out_runs", "named_inputs",
]  # fmt: skip


@dataclass(frozen=True)
class BatchStage:
    """Batches chosen by one rule, the first one evenly distributed.

    A share of each batch is drawn at random instead and only scores the metamodel.

    Args:
        name: what its iterations are called in the store.
        settings: of the campaign.
        choose: the rule.
    """

    name: str
    settings: Settings
    choose: Choice

    def stop(self, log: Log) -> str | None:
        """Return why the stage is over: `budget`, `no rows left`, `stable` or `misclassified`; None: go on."""
        s = self.settings
        if log.iterations and len(log.history) - s.reference >= s.budget:
            return "budget"
        if s.scenario.pool is not None and len(log.history) >= len(s.scenario.pool.x):
            return "no rows left"
        chose = [fit for fit in log.fits if fit["iteration"] < log.iteration]  # a concluding fit chose no batch
        stable = s.stop.get("stable")
        if stable is not None and len(chose) >= 3:
            sides = [fit["sides"] for fit in chose[-3:]]
            moved = [changed_share(a, b) for a, b in pairwise(sides)]
            if max(moved) < stable:
                return "stable"
        return "misclassified" if chose and self._sure(chose[-1]) else None

    def _sure(self, fit: Mapping[str, Any]) -> bool:
        """Say whether so little of the space is expected on the wrong side, and held-out runs do not deny it."""
        target = self.settings.stop.get("misclassified")
        if target is None or fit["expected_misclassified"] > target or not fit.get("n"):
            return False
        wrong = round(fit["error_rate"] * fit["n"])
        return bool(interval(wrong, fit["n"])[0] <= target)

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        s, first = self.settings, log.iteration == 0
        spent = len(log.history) - (0 if first else s.reference)
        size = min(s.initial if first else s.batch, s.budget - spent)
        held_out = math.floor(s.share * (spent + size)) - math.floor(s.share * spent)
        held_out = min(held_out, size - 1) if size > 1 else 0
        belief = s.learner.fit(log.history) if s.learner is not None and not first else None
        found = (evenly if first else self.choose)(s, belief, log, size - held_out)
        stage = "initial" if first else self.name
        chosen = [PlannedRun(stage, named_inputs(s.scenario, row)) for row in found.x]
        random = held_out_runs(s, log.iteration, held_out + (s.reference if first else 0))
        return Batch((*chosen, *random), {**found.how, "held_out": len(random)}, fit_of(belief))


def held_out_runs(settings: Settings, iteration: int, n: int) -> list[PlannedRun]:
    """Return n uniform random runs of the box, with their log density, for the batch of this iteration."""
    space = settings.scenario.space
    rng = stream(settings.seed, VALIDATION, iteration)
    u, log_q = _uniform(space, n, rng)
    return [PlannedRun(VALIDATION, named_inputs(settings.scenario, row), log_q) for row in space.from_unit(u)]


def _uniform(space: ParameterSpace, n: int, rng: np.random.Generator) -> tuple[Points, float | None]:
    """Return (n, d) uniform points of the feasible box and their log density in physical values.

    The density is None where constraints cut the box (its volume is not known exactly).
    """
    kept: list[Points] = [np.empty((0, space.dimension))]
    missing = n
    while missing > 0:
        u = rng.random((max(missing, 16), space.dimension))
        u = u[space.feasible(space.from_unit(u))][:missing]
        kept.append(u)
        missing -= len(u)
    if space.constraints:
        return np.vstack(kept), None
    ends = [p.bounds for p in space.parameters]
    whole = [p.kind == "integer" for p in space.parameters]
    return np.vstack(kept), -float(sum(math.log(b - a + w) for (a, b), w in zip(ends, whole, strict=True)))


def named_inputs(scenario: LogicalScenario, row: Vector) -> dict[str, float]:
    """Return the (d,) values of a concrete scenario by name."""
    return {name: float(value) for name, value in zip(scenario.space.names, row, strict=True)}


def fit_of(belief: FittedMetamodel | None) -> Fit | None:
    """Return what the store keeps of a belief."""
    return None if belief is None else Fit({**belief.scores, "learned": belief.runs}, belief.seconds)


def critical_share(history: History, scenario: LogicalScenario) -> dict[str, Any]:
    """Return the share of critical runs of an even or random design with its 95 % interval.

    Failed runs count both ways: as uncritical for the low end, as critical for the high end. For
    Sobol points the interval is that of random ones, which is wider than it needs to be.
    """
    y = history.y(scenario.requirement.metric)
    hits, n, failed = int(scenario.requirement.critical.contains(y).sum()), len(history), int((~history.ok).sum())
    ok = n - failed
    low, high = float(interval(hits, n)[0]), float(interval(hits + failed, n)[1])
    return {"critical_fraction": hits / ok if ok else None, "low": low, "high": high, "confidence": 0.95, "counted": n}
