"""Few combinations of whole numbers and choices: each is run, and the probabilities of the critical ones are summed.

Every combination is a stratum: it is run again as often as it is likely, whatever came back. With a noisy simulator the sum has
the limits of weighted Poisson counts; where a run of each would leave too few for those that decide, the combinations not run
yet are one stratum together, of random draws. Where all runs of a combination agree, the sum is exact if the simulator is
deterministic; that it is, no repeat proves, so that the limits allow for what so many runs may have missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sbt.campaigns.combinations import ALL_RUN
from sbt.campaigns.records import COUNT, EstimationProposal
from sbt.campaigns.repeats import REPEAT, WANTED, repeats_wanted, simulator_noise, stated_noise
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import Settings
from sbt.estimators.intervals import FEWEST_HITS
from sbt.estimators.reweighting import WeightedShare
from sbt.loop.stages import Batch, Log
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.database import PlannedRun

__all__ = ["Summed", "SummingStage", "counted_with", "summed", "sums", "took_sum"]

COMBINATION = "combination"
"""Stage of the first run of every combination."""
_REPLICATE = "replicate"
"""Stage of further runs of a combination, of a noisy simulator."""
_REST = "rest"
"""Stage of random draws among the combinations that the noise left without a run of their own; log_q is that among them."""
_WORSE = 1.2
"""Variance over that of as many random draws, where noise decides every run, from which on not all combinations are run."""
_SELDOM, _FEWEST = 0.5, 5
"""Expected draws of a combination, with the whole budget, from which on it is run in any case; and number that is run anyway."""
_EARLY, _HIDES = 4, 0.1
"""Repeats of the likeliest combination by which that is decided, and their standard deviation over the mean deviation of the
metric between combinations: with less noise a run of each combination tells more than draws."""
_ROUNDING = 1e-9
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
        drawn: of the combinations, those that are one stratum of random draws.
    """

    share: WeightedShare
    worst: WeightedShare
    missing: float
    combinations: int
    noisy: bool
    drawn: int = 0

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
    """Runs every combination, the likeliest first; of a noisy simulator again, in proportion to their probabilities.

    Where noise decides much and a run of each would take what the likely ones need, the others are drawn at random.
    """

    settings: Settings
    name: str = COMBINATION

    @cached_property
    def _points(self) -> tuple[Points, Vector]:
        space = self.settings.scenario.space
        return _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))

    @cached_property
    def _crowded(self) -> bool:
        """Whether a run of each combination takes so much of the budget that the sum is worse than random draws, if noisy."""
        return _is_crowded(self._points[1], self.settings.budget)

    @cached_property
    def _likely(self) -> int:
        """How many combinations are so likely that each is run, whatever is known of noise."""
        return max(int((self._points[1] * self.settings.budget >= _SELDOM).sum()), _FEWEST)

    def stop(self, log: Log) -> str | None:
        """Return `all combinations`, `budget`, or `cov` where noise leaves an error that is small enough."""
        s = self.settings
        if log.iterations and not took_sum(log):
            return SequentialStage(s).stop(log)
        if log.iterations and len(log.history) >= s.budget:
            return "budget"
        if not log.iterations or self._left(log) or self._again(log, s.budget - len(log.history)):
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
        (x, p), done = self._points, _done(log)
        size = min(s.batch if log.iterations else s.initial, s.budget - len(log.history))
        kept, left = EstimationProposal(COUNT, "combinations"), self._left(log)
        again = self._early(log) if left else self._again(log, size)
        if again:
            return Batch(again, kept)
        if left:
            log_q = -float(np.log(len(x)))
            first = size if log.iterations or not self._crowded else min(size, self._likely)
            rows = x[done : done + min(first, left)]
            return Batch(tuple(PlannedRun(COMBINATION, space.named(row), log_q) for row in rows), kept)
        found = _counted(log, space, x)
        times = np.bincount(np.minimum(found.at, done), minlength=done + 1)
        strata = np.append(p[:done], p[done:].sum())
        rows = np.array(_next_replicates(strata, times, size))
        drawn = self._draws(int((rows == done).sum()), log)
        return Batch((*(PlannedRun(_REPLICATE, space.named(row)) for row in x[rows[rows < done]]), *drawn), kept)

    def _draws(self, n: int, log: Log) -> list[PlannedRun]:
        """Return n random draws among the combinations that have no run of their own."""
        if n == 0:
            return []
        s, (x, p), done = self.settings, self._points, _done(log)
        share = p[done:] / p[done:].sum()
        rows = stream(s.seed, _REST, log.iteration).choice(len(share), n, p=share)
        return [PlannedRun(_REST, s.scenario.space.named(x[done + k]), float(np.log(share[k]))) for k in rows]

    def _early(self, log: Log) -> tuple[PlannedRun, ...]:
        """Return runs that repeat the likeliest combination before most others are run, where it matters whether there is noise.

        They do not count, and are compared with each other alone: a decision by what counts would bias the estimate.
        """
        x, s = self._points[0], self.settings
        return (PlannedRun(REPEAT, s.scenario.space.named(x[0])),) * _EARLY if log.iteration == 1 and self._crowded else ()

    def _again(self, log: Log, most: int) -> tuple[PlannedRun, ...]:
        """Return up to `most` repeats that tell of noise; early ones that found none say little of other combinations."""
        history, early = log.history, _early_rows(log)
        if not simulator_noise(history, self.settings.scenario.requirement).noisy:
            history = history.where(~early)
        return repeats_wanted(history, self.settings.scenario, most)

    def _left(self, log: Log) -> int:
        """Return how many combinations are still to be run, each for itself."""
        n = len(self._points[0]) - _done(log)
        if n == 0 or (log.history.stage == _REST).any():
            return 0
        return max(self._likely - _done(log), 0) if self._crowded and _noise_decides(log, self.settings) else n


def sums(settings: Settings) -> bool:
    """Return whether every combination of the inputs can be run within the budget, and repeats that tell of noise.

    That takes four early ones more where the sum may be worse than random draws. Not with correlated inputs: the probabilities of
    their combinations have no closed form.
    """
    found = None if settings.scenario.space.correlation is not None else _combinations(settings.scenario.space)
    if found is None:
        return False
    room = settings.budget - len(found[0]) - WANTED
    return room >= (_EARLY if room >= 0 and _is_crowded(found[1], settings.budget) else 0)


def took_sum(log: Log) -> bool:
    """Return whether combinations are summed: not where a smaller budget had begun with draws."""
    return bool(log.iterations) and log.iterations[0].proposal.get("method") == "combinations"


def summed(log: Log, settings: Settings, requirement: Requirement | None = None) -> Summed:
    """Return the sum over the combinations that were run, of the campaign's requirement or another one."""
    space, history = settings.scenario.space, log.history
    x, p = _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))
    found = _counted(log, space, x)
    runs, weight = history.where(np.isin(np.arange(len(history)), found.rows)), len(found.rows) * p[found.at] / found.expected
    critical = (requirement or settings.scenario.requirement).critical_runs(runs)
    noise = stated_noise(history, settings.scenario)
    noisy = noise is not None and (noise.noisy is True or noise.silent is True or noise.lost is not None)
    unrun = np.bincount(found.at[~found.drawn], minlength=len(x)) == 0
    drawn = p[found.at[found.drawn]] / np.exp(history.log_q[found.rows[found.drawn]])
    if len(drawn) and np.allclose(drawn, p[unrun].sum(), rtol=_ROUNDING):  # drawn as likely as they are
        missing = 0.0
    else:
        missing = float(p[np.bincount(found.at, minlength=len(x)) == 0].sum())
    return Summed(
        WeightedShare(weight, critical.astype(np.float64)), WeightedShare(weight, (critical | ~runs.ok).astype(np.float64)),
        missing, len(x), noisy, int(unrun.sum()) if (history.stage == _REST).any() else 0,
    )  # fmt: skip


def _combinations(space: ParameterSpace) -> tuple[Points, Vector] | None:
    """Return the combinations (m, d) that have a probability, and those (m,), the likeliest first; None: not few."""
    cells = space.combinations
    if cells is None:
        return None
    x = space.from_unit(cells)
    p = np.exp(np.sum([each.log_density(x[:, k]) for k, each in enumerate(space.parameters)], axis=0))
    order = np.argsort(-p, kind="stable")
    order = order[p[order] > 0.0]
    return x[order], p[order] / p.sum()


def counted_with(log: Log, space: ParameterSpace) -> tuple[NDArray[np.intp], Vector]:
    """Return the rows (n,) of a log that count, and log densities of all rows with which their weighted mean is the sum.

    A combination has the share of these rows that are its own. Rows that do not count have no density.
    """
    x, _ = _combinations(space) or (np.empty((0, space.dimension)), np.empty(0))
    found = _counted(log, space, x)
    log_q = np.full(len(log.history), np.nan)
    log_q[found.rows] = np.log(found.expected / max(len(found.rows), 1))
    return found.rows, log_q


@dataclass(frozen=True, eq=False)
class _Counted:
    """Runs that count.

    Attributes:
        rows: (n,) of the log.
        at: (n,) combination of each.
        drawn: (n,) whether it is a random draw among those that have no run of their own.
        expected: (n,) number of runs of its combination; of those that are drawn, the expected one.
    """

    rows: NDArray[np.intp]
    at: NDArray[np.intp]
    drawn: Mask
    expected: Vector


def _counted(log: Log, space: ParameterSpace, x: Points) -> _Counted:
    """Return the rows of a log that count and their combinations, rows of x (m, d); others have no probability."""
    rows = np.flatnonzero(np.isin(log.history.stage, (COMBINATION, _REPLICATE, _REST)))
    known = {cell: k for k, cell in enumerate(_cells(space, x))}
    at = np.array([known.get(cell, -1) for cell in _cells(space, log.history.x[rows])], dtype=np.intp)
    rows, at = rows[at >= 0], at[at >= 0]
    drawn, draws = log.history.stage[rows] == _REST, int((log.history.stage == _REST).sum())
    expected = np.bincount(at[~drawn], minlength=len(x))[at].astype(np.float64)
    expected[drawn] = draws * np.exp(log.history.log_q[rows[drawn]])
    return _Counted(rows, at, drawn, expected)


def _done(log: Log) -> int:
    """Return how many combinations have a run of their own."""
    return int((log.history.stage == COMBINATION).sum())


def _early_rows(log: Log) -> Mask:
    """Return (n,) which rows are repeats that were made before most combinations were run."""
    history = log.history
    early = (history.stage == REPEAT) & (history.iteration == 1)
    return early & ((history.stage == COMBINATION) | (history.stage == _REST))[early.argmax() :].any() if early.any() else early


def _noise_decides(log: Log, settings: Settings) -> bool:
    """Return whether early repeats differ, by so much that it matters beside how combinations differ, or only some failed."""
    again = log.history.where((log.history.stage == REPEAT) & (log.history.iteration == 1))
    noise = simulator_noise(again, settings.scenario.requirement)
    if not noise.noisy or not again.ok.all():
        return bool(again.ok.any() and not again.ok.all())
    y = settings.scenario.requirement.told(log.history)[log.history.stage == COMBINATION]
    y = y[np.isfinite(y)]
    return len(y) == 0 or (noise.std or 0.0) >= _HIDES * float(np.abs(y - np.median(y)).mean())


def _is_crowded(p: Vector, budget: int) -> bool:
    """Return whether a run of each combination takes so much of the budget that the sum is worse than random draws, if noisy."""
    return _shares(p, budget - WANTED) > _WORSE / budget


def _shares(p: Vector, n: int) -> float:
    """Return the sum of p^2 / times, where strata of probability p (m,), descending, have n >= m runs by `_next_replicates`."""
    most = (np.cumsum(p) / (max(n - len(p), 0) + np.arange(1, len(p) + 1))).max(initial=0.0)  # p / times: those with several
    return float((p * np.minimum(p, most)).sum())


def _cells(space: ParameterSpace, x: Points) -> list[tuple[float, ...]]:
    return [tuple(row) for row in space.cube.cells(space.to_unit(x))] if len(x) else []


def _next_replicates(p: Vector, times: NDArray[np.intp], n: int) -> list[int]:
    """Return the combinations of the next n runs: each where one more takes most from the sum of p^2 / times.

    It looks at no outcome: an allocation by what came back would be biased.
    """
    counts, chosen = times.astype(np.float64), []
    for _ in range(n):
        chosen.append(int(np.argmax(p**2 / np.maximum(counts * (counts + 1.0), 1e-300))))
        counts[chosen[-1]] += 1.0
    return chosen
