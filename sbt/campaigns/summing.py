"""Few combinations of whole numbers and choices: each is run, and the probabilities of the critical ones are summed.

Every combination is a stratum: it is run again as often as it is likely, whatever came back. With a noisy simulator the sum has
the limits of weighted Poisson counts. Where all runs of a combination agree, the sum is exact if the simulator is deterministic;
that it is, no repeat proves, so that the limits allow for what so many runs may have missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sbt.campaigns.combinations import ALL_RUN
from sbt.campaigns.records import COUNT, EstimationProposal
from sbt.campaigns.repeats import WANTED, repeats_wanted, stated_noise
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import Settings
from sbt.estimators.intervals import FEWEST_HITS
from sbt.estimators.reweighting import WeightedShare
from sbt.loop.stages import Batch, Log
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.store.database import PlannedRun

__all__ = ["Summed", "SummingStage", "counted_with", "summed", "sums", "took_sum"]

COMBINATION = "combination"
"""Stage of the first run of every combination."""
_REPLICATE = "replicate"
"""Stage of further runs of a combination, of a noisy simulator."""
_MOST = 4096
"""Combinations that are looked at."""
_NORMAL = 1.96
"""Half width of a 95 % interval over its standard error."""


@dataclass(frozen=True, eq=False)
class Summed:
    """The probability of a combination's being critical, from runs of every combination.

    Attributes:
        share: weighted runs, failed ones as safe; the weights of all combinations sum to their number.
        worst: the same with failed ones as critical.
        missing: probability of the combinations that were not run.
        combinations: number of all.
        noisy: equal inputs gave different metrics, or at times none, or it would hardly show if they did.
    """

    share: WeightedShare
    worst: WeightedShare
    missing: float
    combinations: int
    noisy: bool

    @property
    def hits(self) -> int:
        """Critical runs."""
        return int(self.share.critical.sum())

    @property
    def std_error(self) -> float:
        """Of the estimate: of Poisson counts, of critical or of other runs; where all agree, by what runs may have missed."""
        if not self.noisy:
            return 0.5 * (_missed(self.share, 0.975) + _missed(_rest(self.share), 0.975)) / _NORMAL
        if not len(self.share.weight):
            return 0.0
        squares, critical = (self.share.weight / len(self.share.weight)) ** 2, self.share.critical
        return float(np.sqrt(min(squares @ critical, squares @ (1.0 - critical))))

    def lower(self, confidence: float) -> float:
        """Return the one-sided lower limit, failed runs as safe."""
        if not len(self.share.weight):
            return 0.0
        if not self.noisy:
            return max(self.share.value - _missed(self.share, confidence), 0.0)
        return max(self.share.lower(confidence), 1.0 - _rest(self.share).upper(confidence) - self.missing, 0.0)

    def upper(self, confidence: float) -> float:
        """Return the one-sided upper limit, failed runs as critical, and combinations that were not run."""
        if not len(self.worst.weight):
            return 1.0
        if not self.noisy:
            return min(self.worst.value + self.missing + _missed(_rest(self.worst), confidence), 1.0)
        return min(self.worst.upper(confidence), 1.0 - self.missing - _rest(self.worst).lower(confidence)) + self.missing


def _rest(share: WeightedShare) -> WeightedShare:
    return WeightedShare(share.weight, 1.0 - share.critical)


def _missed(share: WeightedShare, confidence: float) -> float:
    """Return the upper limit of the probability with which combinations that always gave this outcome give another one.

    The number of other outcomes is Poisson, and was 0: a sum of p_k q_k is at most that of n_k q_k times the largest p_k / n_k.
    """
    terms = share.weight * share.critical / max(len(share.weight), 1)
    return float(min(-np.log1p(-confidence) * terms.max(initial=0.0), terms.sum()))


@dataclass(frozen=True)
class SummingStage:
    """Runs every combination, the likeliest first; of a noisy simulator again, in proportion to their probabilities."""

    settings: Settings
    name: str = COMBINATION

    @cached_property
    def _points(self) -> tuple[Points, Vector]:
        space = self.settings.scenario.space
        return _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))

    def stop(self, log: Log) -> str | None:
        """Return `all combinations`, `budget`, or `cov` where noise leaves an error that is small enough."""
        s = self.settings
        if log.iterations and not took_sum(log):
            return SequentialStage(s).stop(log)
        if log.iterations and len(log.history) >= s.budget:
            return "budget"
        if not log.iterations or self._left(log) or repeats_wanted(log.history, s.scenario, s.budget - len(log.history)):
            return None
        found, target = summed(log, s), s.stop.get("cov")
        if target is None or found.std_error > target * found.share.value:
            return None
        return ALL_RUN if not found.noisy else "cov" if found.hits >= FEWEST_HITS else None

    def propose(self, log: Log) -> Batch:
        """Return the next combinations, the repeats that tell whether there is noise, then replicates."""
        s, space = self.settings, self.settings.scenario.space
        if log.iterations and not took_sum(log):
            return SequentialStage(s).propose(log)
        (x, p), done = self._points, int((log.history.stage == COMBINATION).sum())
        size = min(s.batch if log.iterations else s.initial, s.budget - len(log.history))
        kept = EstimationProposal(COUNT, "combinations")
        if done < len(x):
            log_q = -float(np.log(len(x)))
            rows = x[done : done + size]
            return Batch(tuple(PlannedRun(COMBINATION, space.named(row), log_q) for row in rows), kept)
        again = repeats_wanted(log.history, s.scenario, size)
        if again:
            return Batch(again, kept)
        rows = np.array(_next_replicates(p, np.bincount(_counted(log, space, x)[1], minlength=len(x)), size))
        return Batch(tuple(PlannedRun(_REPLICATE, space.named(row)) for row in x[rows]), kept)

    def _left(self, log: Log) -> bool:
        return int((log.history.stage == COMBINATION).sum()) < len(self._points[0])


def sums(settings: Settings) -> bool:
    """Return whether every combination of the inputs can be run within the budget, and repeats that tell of noise.

    Not with correlated inputs: the probabilities of their combinations have no closed form.
    """
    found = None if settings.scenario.space.correlation is not None else _combinations(settings.scenario.space)
    return found is not None and len(found[0]) + WANTED <= settings.budget


def took_sum(log: Log) -> bool:
    """Return whether combinations are summed: not where a smaller budget had begun with draws."""
    return bool(log.iterations) and log.iterations[0].proposal.get("method") == "combinations"


def summed(log: Log, settings: Settings, requirement: Requirement | None = None) -> Summed:
    """Return the sum over the combinations that were run, of the campaign's requirement or another one."""
    space, history = settings.scenario.space, log.history
    x, p = _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))
    rows, at = _counted(log, space, x)
    runs, times = history.where(np.isin(np.arange(len(history)), rows)), np.bincount(at, minlength=len(x))
    weight = len(at) * p[at] / np.maximum(times[at], 1)
    critical = (requirement or settings.scenario.requirement).critical_runs(runs)
    noise = stated_noise(history, settings.scenario)
    noisy = noise is not None and (noise.noisy is True or noise.silent is True or noise.lost is not None)
    return Summed(
        WeightedShare(weight, critical.astype(np.float64)), WeightedShare(weight, (critical | ~runs.ok).astype(np.float64)),
        float(p[times == 0].sum()), len(x), noisy,
    )  # fmt: skip


def _combinations(space: ParameterSpace) -> tuple[Points, Vector] | None:
    """Return the combinations (m, d) that have a probability, and those (m,), the likeliest first; None: not few."""
    cells = space.cube.combinations(space.dimension, _MOST)
    if cells is None:
        return None
    x = space.from_unit(cells)
    x = x[space.feasible(x)]
    p = np.exp(np.sum([each.log_density(x[:, k]) for k, each in enumerate(space.parameters)], axis=0))
    order = np.argsort(-p, kind="stable")
    order = order[p[order] > 0.0]
    return x[order], p[order] / p.sum()


def counted_with(log: Log, space: ParameterSpace) -> tuple[NDArray[np.intp], Vector]:
    """Return the rows (n,) of a log that count, and log densities of all rows with which their weighted mean is the sum.

    A combination has the share of these rows that are its own. Rows that do not count have no density.
    """
    x, _ = _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))
    rows, at = _counted(log, space, x)
    log_q = np.full(len(log.history), np.nan)
    log_q[rows] = np.log(np.bincount(at, minlength=len(x))[at] / max(len(at), 1))
    return rows, log_q


def _counted(log: Log, space: ParameterSpace, x: Points) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows (n,) of a log that count and their combinations (n,), rows of x (m, d); others have no probability."""
    rows = np.flatnonzero(np.isin(log.history.stage, (COMBINATION, _REPLICATE)))
    known = {cell: k for k, cell in enumerate(_cells(space, x))}
    at = np.array([known.get(cell, -1) for cell in _cells(space, log.history.x[rows])], dtype=np.intp)
    return rows[at >= 0], at[at >= 0]


def _cells(space: ParameterSpace, x: Points) -> list[tuple[float, ...]]:
    return [tuple(row) for row in space.cube.cells(space.to_unit(x))] if len(x) else []


def _next_replicates(p: Vector, times: NDArray[np.intp], n: int) -> list[int]:
    """Return the combinations of the next n runs: each where one more takes most from the sum of p^2 / times.

    It looks at no outcome: an allocation by what came back would be biased.
    """
    counts, chosen = times.astype(np.float64), []
    for _ in range(n):
        chosen.append(int(np.argmax(p**2 / (counts * (counts + 1.0)))))
        counts[chosen[-1]] += 1.0
    return chosen
