"""What of a log counts: complete batches with known densities, and what all runs met."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sbt.campaigns.gate import Limits
from sbt.campaigns.records import CountedDraws, EstimationProposal, EventDraws, PoolSummary
from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import number
from sbt.errors import InputError
from sbt.estimators import binomial
from sbt.estimators.intervals import CountedBatch
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.combination import CombinedRequirement
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.store.history import History
from sbt.store.records import Iteration

__all__ = [
    "DENIED", "DRAWN", "FEW_KNOWN", "LEARNED", "NOMINAL", "RANDOM", "Seen", "at_least", "counted_batches", "counted_iterations",
    "crude_rows", "denied_by_draws", "denied_late", "hardly_known", "held", "nothing_critical", "random_draws", "with_event",
]  # fmt: skip

DRAWN = "estimation"
"""Stage of runs that were drawn with a known density."""
NOMINAL = "monte_carlo"
"""Stage of runs that were drawn from the inputs' distribution."""
RANDOM = "random"
"""Stage of such draws of a campaign with many inputs before it is known how it goes on, or after what counts has ended."""
LEARNED = "learn"
"""Stage of draws that only teach."""
FEW_KNOWN = 10
"""Inputs of critical runs, below which the size of their region was a guess: 4 of 30 intervals lay below a P of .02 that 150 runs
beside a plateau had met 3 to 10 times. The exact limit of random draws holds whatever the metamodel makes of them."""
DENIED = 0.01
"""P(critical) below which a critical draw is a surprise to the metamodel."""
_HARDLY = 0.5
"""Coefficient of variation above which the limits of an estimate are no wider than those of random draws."""


def counted_batches(log: Log, settings: Settings, *, failed_critical: bool = False) -> list[CountedBatch]:
    """Return the batches that count, with their outcomes; failed runs count as stated.

    Raises:
        InputError: a counted run has no proposal density.
    """
    history = log.history
    critical = settings.scenario.requirement.critical_runs(history) | (failed_critical & ~history.ok)
    found, drawn = [], history.stage == DRAWN
    for batch, pool, draws in _counted(log):
        rows = np.flatnonzero(drawn & (history.iteration == batch.number))
        if len(rows) < len(draws.coefficient):
            continue  # a batch counts only when it is complete
        if np.isnan(history.log_q[rows]).any():
            raise InputError("an estimate needs runs with a known proposal density, but a counted run has none")
        prior = pool.probability if batch.read(EstimationProposal).method == "difference" else 0.0
        of_batch = CountedBatch(
            prior, pool.anticipated, draws.pool_variance, np.array(draws.coefficient), np.array(draws.control_variate),
            critical[rows].astype(np.float64), draws.weight, _array(draws.by_warm_up),
        )  # fmt: skip
        stated = draws.failed_critical if failed_critical else None
        found.append(of_batch if stated is None else with_event(of_batch, stated))
    return found


def with_event(batch: CountedBatch, stated: EventDraws) -> CountedBatch:
    """Return a batch with what the metamodel states of another event of its draws."""
    return replace(
        batch, prior=stated.probability, anticipated=stated.anticipated, pool_variance=stated.pool_variance,
        control_variate=np.array(stated.pi), by_warm_up=_array(stated.by_warm_up) if stated.by_warm_up else batch.by_warm_up,
    )  # fmt: skip


def _array(values: tuple[float, ...] | None) -> Vector | None:
    return None if values is None else np.array(values)


def _counted(log: Log) -> Iterator[tuple[Iteration, PoolSummary, CountedDraws]]:
    """Yield the batches that count, with their pool and draws; the first of two levels only where others follow it."""
    proposals = [batch.read(EstimationProposal) for batch in log.iterations]
    rounds = any(proposal.levels is not None for proposal in proposals)
    for batch, proposal in zip(log.iterations, proposals, strict=True):
        if proposal.counted is not None and (proposal.pool is not None or rounds):
            yield batch, proposal.pool or PoolSummary(len(proposal.counted.pi), 0.0, 0.0, 1), proposal.counted


def crude_rows(history: History) -> Mask:
    """Return which draws from the inputs' distribution an estimate by crude Monte Carlo has.

    Those before a metamodel had drawn do not count again after it: whether it is left depends on what they met.
    """
    rows = history.stage == NOMINAL
    guided = history.iteration[np.isin(history.stage, (DRAWN, LEARNED))]
    later = rows & (history.iteration > guided.max(initial=-1))
    return later if later.any() else rows


def random_draws(history: History) -> int:
    """Return how many runs an estimate by crude Monte Carlo has, where all of its draws count."""
    crude = int(crude_rows(history).sum())
    return crude + int((history.stage == RANDOM).sum()) if crude else 0


def counted_iterations(log: Log) -> list[int]:
    """Return the numbers of the batches that count."""
    return [batch.number for batch, _, _ in _counted(log)]


def _denied(proposal: EstimationProposal) -> float:
    """Return the P(critical) below which a critical draw is a surprise; beside other drivers much less than the mean is none."""
    return DENIED * (proposal.pool.probability if proposal.pairs is not None and proposal.pool is not None else 1.0)


@dataclass(frozen=True)
class Seen:
    """What all runs met, and what the draws in proportion to the inputs' distribution met.

    Attributes:
        critical, safe: runs of any kind.
        draws: in proportion to the inputs' distribution, those that only teach among them: independent of each other, with
            any metamodel. With constraints a point of a pool that was drawn again is none: it is not another one.
        hits: critical ones of these draws.
        failed: failed ones of these draws.
        failed_apart: of these, draws of other stages than those that the estimate is of.
        surprises: critical ones of these draws to which the metamodel gave next to no probability.
        known: different inputs of critical runs; where any of several requirements is enough, of the one that is known by fewest.
        late: whether one of them came after the last batch that counts.
    """

    critical: int
    safe: int
    draws: int
    hits: int
    failed: int
    surprises: int
    known: int
    late: bool = False
    failed_apart: int = 0

    @property
    def without_failed_apart(self) -> Seen:
        """The same, had the failed draws of other stages been uncritical."""
        return replace(self, failed=self.failed - self.failed_apart, failed_apart=0)

    @classmethod
    def of(cls, log: Log, settings: Settings, required: Requirement | None = None) -> Seen:
        """Count the runs of a log; `required`: by the campaign, where the requirement of the settings is asked for afterwards.

        A surprise is critical by both then: what the metamodel said is of its own.
        """
        history = log.history
        critical = settings.scenario.requirement.critical_runs(history)
        told = critical if required is None else critical & required.critical_runs(history)
        drawn = np.isin(history.stage, (DRAWN, LEARNED))
        plain = np.flatnonzero(np.isin(history.stage, (NOMINAL, RANDOM)))  # until values came that can be followed
        rows, surprising, surprised = [plain], [np.zeros(len(plain), dtype=np.bool_)], -1
        for batch in log.iterations:
            proposal = batch.read(EstimationProposal)
            nominal = proposal.nominal
            if nominal is not None:
                first = np.flatnonzero(drawn & (history.iteration == batch.number))[: len(nominal.pi)]
                own = _different(settings.scenario.space, history.x[first])
                first = first[own]
                rows.append(first)
                surprising.append(np.array(nominal.pi)[own] < _denied(proposal))
                surprised = batch.number if (told[first] & surprising[-1]).any() else surprised
        mine, denied = np.concatenate(rows), np.concatenate(surprising)
        return cls(
            int(critical.sum()), int((history.ok & ~critical).sum()), len(mine), int(critical[mine].sum()),
            int((~history.ok[mine]).sum()), int((told[mine] & denied).sum()),
            _known(settings.scenario.requirement, history), surprised > max(counted_iterations(log), default=surprised),
            int((~history.ok & (history.stage != DRAWN))[mine].sum()),
        )  # fmt: skip

    def most(self, hits: int, confidence: float) -> float:
        """Return the exact upper limit of the probability of what these draws met so many times."""
        return float(binomial.upper(hits, self.draws, confidence)) if self.draws else 1.0

    def most_critical(self, confidence: float) -> float:
        """Return the exact upper limit of the probability of being critical by these draws alone, failed ones as critical."""
        return self.most(self.hits + self.failed, confidence)

    @property
    def limits(self) -> Limits:
        """The exact limits of that probability by these draws alone, failed ones as safe below and as critical above."""
        return Limits(lambda confidence: 1.0 - self.most(self.draws - self.hits, confidence), self.most_critical)


def _different(space: ParameterSpace, x: Points) -> NDArray[np.intp]:
    """Return the rows of draws x (n, d) from a pool without those of a point of it that was drawn before.

    Where little is admissible a pool may have few points of weight. Inputs that are all discrete do not tell points apart.
    """
    if not space.constraints or all(p.discrete for p in space.parameters):
        return np.arange(len(x))
    return np.sort(np.unique(x, axis=0, return_index=True)[1])


def _known(requirement: Requirement, history: History) -> int:
    """Return the number of different inputs of critical runs, of the requirement that is known by fewest where any is enough."""
    if isinstance(requirement, CombinedRequirement) and requirement.how == "any":
        return min((n for n in (_known(item, history) for item in requirement.items) if n), default=0)
    return len(np.unique(history.x[requirement.critical_runs(history)], axis=0))


def held(limits: Limits, seen: Seen, low: float, high: float, *, unstated: bool) -> Limits:
    """Return limits that reach the exact bounds by draws from the inputs' distribution, where an estimate left [0, 1].

    Args:
        limits: by the estimates.
        seen: what these draws met.
        low: the estimate with failed runs as safe.
        high: as critical.
        unstated: runs failed, and no belief states where: the upper limit reaches the exact bound too.
    """
    lower = (lambda c: min(limits.lower(c), seen.limits.lower(c))) if low >= 1.0 else limits.lower
    found = Limits(lower, limits.upper)
    return found.reaching(seen.most_critical) if high <= 0.0 or unstated else found


def hardly_known(value: float, std_error: float) -> bool:
    """Return whether an estimate, or what it leaves to 1, is little more than its standard error."""
    return std_error > _HARDLY * min(value, 1.0 - value)


def nothing_critical(drawn_from: str = "the inputs' distribution") -> str:
    """Return in words that draws from a distribution alone bound a probability, as none that counts was critical."""
    return f"no draw that counts was critical: the probability is only bounded from above, by draws from {drawn_from}"


def at_least(draws: str) -> str:
    """Return in words what draws that no metamodel has chosen say of an upper limit."""
    return f"the upper end is at least that of {draws}"


def denied_late(draws: str) -> str:
    """Return in words what a late surprise does to an upper limit."""
    return f"a draw after the last one that counts was critical where the metamodel denied it: {at_least(draws)}"


def denied_by_draws(drawn: Limits, draws: str, low: float, high: float, confidence: float) -> tuple[str, ...]:
    """Return in words that limits by draws that no metamodel has chosen deny an estimate, low to high; () where they do not."""
    least, most = drawn.lower(confidence), drawn.upper(confidence)
    if most < low:
        return (f"{draws} alone deny the estimate: by them the probability is at most {number(most, 2)}",)
    return (f"{draws} alone deny the estimate: by them the probability is at least {number(least, 2)}",) if least > high else ()
