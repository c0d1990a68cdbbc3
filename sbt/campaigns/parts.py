"""Parts that campaigns are put together from: the batch stage, held-out runs, intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import betaincinv

from sbt.acquisition import boundary
from sbt.arrays import Points, Vector
from sbt.campaign import Batch, Fit, Log
from sbt.history import VALIDATION, History
from sbt.learner import Belief, Learner, changed_share
from sbt.metamodels.prediction import Prediction
from sbt.problem.requirement import CriticalInterval
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.samplers.pool import PoolSequence
from sbt.samplers.roi import RoiDraw, rejection
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store import PlannedRun

__all__ = ["Acquisition", "BatchStage", "Settings", "clopper_pearson", "critical_share", "fit_of"]

Acquisition = Callable[[Prediction, CriticalInterval, Vector], Vector]

_POSITION = "next_position"


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


@dataclass(frozen=True)
class BatchStage:
    """Batches from the region of interest, the first one evenly distributed.

    Each batch is drawn by rejection from one Sobol sequence that is continued from batch to batch; a
    share of it is drawn at random instead and only scores the metamodel.

    Source:
        Winkelmann et al. (2022), section V.
    """

    name: str
    settings: Settings
    adaptive: bool

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `stable` where the boundary no longer moves."""
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
        return None

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        s, first = self.settings, log.iteration == 0
        spent = len(log.history) - (0 if first else s.reference)
        size = min(s.initial if first else s.batch, s.budget - spent)
        held_out = math.floor(s.share * (spent + size)) - math.floor(s.share * spent)
        held_out = min(held_out, size - 1) if size > 1 else 0
        belief = s.learner.fit(log.history) if s.learner is not None and not first else None
        draw = self._draw(belief, log, size - held_out)
        stage = "initial" if first else self.name
        chosen = [PlannedRun(stage, _inputs(s.scenario, row)) for row in self._values(draw, log)]
        random = self._held_out(log.iteration, held_out + (s.reference if first else 0))
        how = {
            "method": draw.method, "candidates": draw.candidates, "acceptance": draw.acceptance,
            _POSITION: draw.next_position, "held_out": len(random),
        }  # fmt: skip
        return Batch((*chosen, *random), how, fit_of(belief))

    def _draw(self, belief: Belief | None, log: Log, n: int) -> RoiDraw:
        """Draw from the region of interest; evenly where there is no metamodel to ask."""
        s, space = self.settings, self.settings.scenario.space
        critical = s.scenario.requirement.critical

        def score(u: Points) -> Vector:
            if belief is None or s.acquisition is None or not self.adaptive:
                return np.zeros(len(u))
            return s.acquisition(belief.predict(u), critical, space.log_density(space.from_unit(u)))

        admissible = (lambda u: space.feasible(space.from_unit(u))) if space.constraints else None
        pool = self._pool(log)
        if pool is not None:
            n = min(n, len(pool))
            return rejection(
                score, pool, n, start=0, seed=s.seed, label=log.iteration, max_candidates=len(pool), accept_filter=admissible
            )
        start = int(log.iterations[-1][_POSITION]) if log.iterations else 0
        sobol = SobolSequence(space.dimension, s.seed)
        bound = belief.log_ambiguity_bound if belief is not None and s.acquisition is boundary and self.adaptive else None
        return rejection(score, sobol, n, start=start, seed=s.seed, label=log.iteration, accept_filter=admissible, bound=bound)

    def _pool(self, log: Log) -> PoolSequence | None:
        """Return the recorded rows that are left to choose from; None where runs are simulated."""
        scenario = self.settings.scenario
        if scenario.pool is None:
            return None
        u = np.clip(scenario.space.to_unit(scenario.pool.x), 0.0, 1.0)
        return PoolSequence(u, scenario.pool.taken(log.history.x), self.settings.seed)

    def _values(self, draw: RoiDraw, log: Log) -> Points:
        """Return the drawn points in the inputs' units, exactly as recorded where they are."""
        scenario, pool = self.settings.scenario, self._pool(log)
        if scenario.pool is None or pool is None:
            return scenario.space.from_unit(draw.u)
        return scenario.pool.x[pool.rows[draw.positions]]

    def _held_out(self, iteration: int, n: int) -> list[PlannedRun]:
        """Return n uniform random runs of the box, with their log density."""
        space = self.settings.scenario.space
        rng = stream(self.settings.seed, VALIDATION, iteration)
        u, log_q = _uniform(space, n, rng)
        return [PlannedRun(VALIDATION, _inputs(self.settings.scenario, row), log_q) for row in space.from_unit(u)]


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


def _inputs(scenario: LogicalScenario, row: Vector) -> dict[str, float]:
    return {name: float(value) for name, value in zip(scenario.space.names, row, strict=True)}


def fit_of(belief: Belief | None) -> Fit | None:
    """Return what the store keeps of a belief."""
    return None if belief is None else Fit({**belief.scores, "learned": belief.runs}, belief.seconds)


def clopper_pearson(hits: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact binomial interval of a share.

    Source:
        Clopper and Pearson (1934), doi 10.1093/biomet/26.4.404.
    """
    if n == 0:
        return 0.0, 1.0
    tail = (1 - confidence) / 2
    low = 0.0 if hits == 0 else float(betaincinv(hits, n - hits + 1, tail))
    high = 1.0 if hits == n else float(betaincinv(hits + 1, n - hits, 1 - tail))
    return low, high


def critical_share(history: History, scenario: LogicalScenario) -> dict[str, Any]:
    """Return the share of critical runs of an even or random design with its 95 % interval.

    Failed runs count both ways: as uncritical for the low end, as critical for the high end. For
    Sobol points the interval is that of random ones, which is wider than it needs to be.
    """
    y = history.y(scenario.requirement.metric)
    hits, n, failed = int(scenario.requirement.critical.contains(y).sum()), len(history), int((~history.ok).sum())
    ok = n - failed
    low, _ = clopper_pearson(hits, n)
    _, high = clopper_pearson(hits + failed, n)
    return {"critical_fraction": hits / ok if ok else None, "low": low, "high": high, "confidence": 0.95, "counted": n}
