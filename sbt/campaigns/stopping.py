"""When the count of an estimation begins and when it ends: both look only at finished batches."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sbt.campaigns.clustering import spread_of_draws
from sbt.campaigns.counting import Seen, counted_batches, random_draws
from sbt.campaigns.gate import Limits
from sbt.campaigns.records import EXPLORE, EstimationProposal, PoolSummary
from sbt.campaigns.repeats import simulator_noise
from sbt.campaigns.settings import Settings
from sbt.campaigns.unviolated import Unviolated
from sbt.estimators.importance import Plan
from sbt.estimators.intervals import FEWEST_HITS, WIDEST, combine_estimates
from sbt.loop.stages import Log
from sbt.store.records import Iteration

__all__ = [
    "FEWEST_BATCHES", "count_begins", "draws_that_count", "is_precise", "not_met", "only_unseen", "pools_of", "relative_error",
    "relative_error_of", "spared", "steadier", "trusts_search",
]  # fmt: skip

_LATEST = (0.6, 0.8)
"""The count begins at the latest after this share of the budget: fewer batches would say little about their own spread. After the
second one, if batches are left, where few taught since runs are on both sides of the boundary: it would count what is rare and
weighs much."""
_FEWEST_LEARNED = 3
"""Batches that only teach, at least."""
_VALUES, _STALLED, _USABLE = 4, 1.5, 0.5
"""Learning has stalled where the anticipated coefficient of variation of so many batches varies by less than the factor; it is
usable below the value."""
_VALUES_IN_NOISE = 2
"""The same of a noisy simulator, and the batches that only teach, at least: most of what it anticipates is noise, which learning
does not take away, and a run that does not count is missing later."""
_TARGET = 0.02
"""Anticipated coefficient of variation that is good enough where `stop.cov` sets none."""
_FEWEST_NOMINAL = 15
"""Draws from the inputs' distribution before a campaign by transfer may end early: from scratch there are more by then."""
FEWEST_BATCHES = 4
"""Batches that must count before their spread is taken for a measure of the error."""
_SPARED, _LEAST_GUIDED, _SURPLUS, _HITS_LEFT = 0.05, 0.3, 0.4, 1.1
"""Steps in which guided draws give way to draws from the inputs' distribution, and the share that stays guided; what is left is
expected to have this share of the coefficient of variation that is good enough, and so many times the critical draws that are."""
_LOST, _MEMORY, _EXACT = 10.0, 4, 0.01
"""An earlier metamodel is preferred to the newest one after a loss of precision by this factor against one of so many batches
before, of which the anticipated coefficient of variation of one draw is taken for at least the last value."""


def count_begins(log: Log, settings: Settings, size: int, drawn_share: float) -> bool:
    """Return whether the next batch of this size counts: from the stopping time on.

    It looks only at earlier batches. Were it to look at this batch's pool, pools whose points are mostly
    taken for critical would begin the count more often, and the estimate would be too high.

    Args:
        log: of the campaign.
        settings: of the campaign.
        size: runs of the next batch.
        drawn_share: share of the remaining runs that would count.
    """
    drawn = list(pools_of(log))
    if any(batch.read(EstimationProposal).counted is not None for batch, _ in drawn):
        return True
    noisy = simulator_noise(log.history, settings.scenario.requirement).noisy is True
    values, fewest = (_VALUES_IN_NOISE, _VALUES_IN_NOISE) if noisy else (_VALUES, _FEWEST_LEARNED)
    fewest, spent = fewest if settings.transfer is None else 1, len(log.planned)
    latest, later = (share * settings.budget for share in _LATEST)
    if spent + size > (latest if len(drawn) >= fewest else max(latest, min(later, settings.budget - FEWEST_BATCHES * size))):
        return True
    if len(drawn) < fewest:
        return False
    left = math.sqrt(drawn_share * (settings.budget - spent))
    errors = [relative_error_of(pool) / left for _, pool in drawn[-values:]]
    if len(errors) == values and max(errors) < _STALLED * min(errors) and errors[-1] < _USABLE:
        return True  # learning no longer pays
    target = settings.stop.get("cov")
    return errors[-1] <= (_TARGET if target is None else target)


def draws_that_count(log: Log, settings: Settings, size: int, drawn_share: float) -> float:
    """Return how many draws will have counted when the campaign may end: one batch more than the fewest, or the budget's.

    Args:
        log: of the campaign.
        settings: of the campaign.
        size: runs of the next batch.
        drawn_share: share of the further runs that count.
    """
    counted = sum(len(batch.critical) for batch in counted_batches(log, settings))
    left = settings.budget - len(log.planned)
    if settings.stop.get("cov") is not None:
        left = min(left, max((FEWEST_BATCHES + 1) * size - round(counted / drawn_share), size))
    return counted + drawn_share * left


def spared(pilot: Plan, shares: tuple[float, ...], draws: float, target: float | None) -> tuple[float, ...]:
    """Return the shares of the next draws: precision beyond what was asked goes to draws from the inputs' distribution.

    They bound what no run has met, and what a metamodel denies weighs the less the more of them there are. A pilot pool decides,
    never the pool that is drawn from.

    Args:
        pilot: the plan of a pilot pool with these shares.
        shares: guided, nominal, of the pool, wide.
        draws: how many will count.
        target: coefficient of variation that is good enough; None: `stop.cov` sets none.
    """
    enough = _SURPLUS * (_TARGET if target is None else target)
    hits = min(_HITS_LEFT * FEWEST_HITS, draws * pilot.hits)
    best = 0.0
    for share in np.arange(_SPARED, shares[0] - _LEAST_GUIDED, _SPARED):
        plan = pilot.moved(float(share))
        if relative_error(plan.anticipated, plan.predicted) > enough * math.sqrt(draws) or draws * plan.hits < hits:
            break
        best = float(share)
    return (shares[0] - best, shares[1] + best, *shares[2:])


def is_precise(log: Log, settings: Settings, target: float | None) -> bool:
    """Return whether the estimate has this coefficient of variation, such as that at which `stop.cov` ends the campaign.

    The interval must be narrow as well: where one large error decides the variance, its coefficient says little. So must be
    what draws leave to a requirement that nothing else is known of.
    """
    if target is None or not _is_narrow(log, settings, target):
        return False
    others, found = Unviolated.of(log.history, settings), combine_estimates(counted_batches(log, settings))
    if not others.untold:
        return True
    seen, own = Seen.of(log, settings), Limits(lambda c: found.limit(c, side=-1), lambda c: found.limit(c, side=1))
    limits = others.reached(own, lambda c: seen.most(seen.failed, c), seen.most_critical)
    return 0.5 * (limits.upper(0.975) - limits.lower(0.975)) <= WIDEST * target * found.value


def _is_narrow(log: Log, settings: Settings, target: float | None) -> bool:
    """Return whether the estimate is precise, but for what draws alone tell of."""
    counted = counted_batches(log, settings)
    if target is None or len(counted) < FEWEST_BATCHES:
        return False
    found = combine_estimates(counted)
    hits = sum(b.hits for b in counted)
    half = 0.5 * (found.limit(0.975, side=1) - found.limit(0.975, side=-1))
    between = spread_of_draws(log, counted)
    if between is not None and between.exceeds(target, found.value):  # more warm-ups would narrow it, more runs do not
        return False
    if settings.transfer is not None and Seen.of(log, settings).draws < _FEWEST_NOMINAL:
        return False
    return hits >= FEWEST_HITS and found.std_error <= target * found.value and half <= WIDEST * target * found.value


def trusts_search(log: Log, settings: Settings) -> bool:
    """Return whether a gate would pass while what no run has met may hold more than is left of what is allowed."""
    gate, counted = settings.gate, counted_batches(log, settings, failed_critical=True)
    left = -1.0 if gate is None or not counted else gate.probability - combine_estimates(counted).limit(gate.confidence, side=1)
    if gate is None or left < 0.0:
        return False
    seen = Seen.of(log, settings)
    return seen.most(seen.surprises, gate.confidence) > left


def not_met(log: Log, settings: Settings, counted: int | None, bound: float) -> float:
    """Return what no run has met may hold beside the limits of an estimate, at the confidence of the gate.

    Args:
        log: of the campaign.
        settings: of the campaign.
        counted: runs of the estimate; where they are all random draws, or there is a requirement that nothing else is known of,
            limits have what no run has met.
        bound: `undetected_mass_bound` of the conclusion, where no draws tell.
    """
    if settings.gate is None or counted == random_draws(log.history) > 0 or Unviolated.of(log.history, settings).untold:
        return 0.0
    seen = Seen.of(log, settings)
    return seen.most(seen.surprises, settings.gate.confidence) if seen.draws else bound


def only_unseen(log: Log, settings: Settings) -> bool:
    """Return whether a gate lacks nothing but draws that bound what no run has met: none since the last count was a surprise."""
    target = settings.stop.get("cov")
    enough = _is_narrow(log, settings, _TARGET if target is None else target)
    if settings.gate is None or not enough or not trusts_search(log, settings):
        return False
    return not Seen.of(log, settings).late


def steadier(log: Log, error: float) -> int | None:
    """Return the batch whose metamodel was far more precise than this anticipated error of one draw; None without one.

    A fit can fail: hyperparameters of another mode of their posterior. That shows in an anticipated error ten times as
    large as that of one of the last batches.
    """
    drawn = [(batch.number, pool) for batch, pool in pools_of(log) if not pool.fallback]
    if not drawn:
        return None
    iteration, best = min(drawn[-_MEMORY:], key=lambda item: relative_error_of(item[1]))
    return iteration if error > _LOST * max(relative_error_of(best), _EXACT) else None


def pools_of(log: Log) -> Iterator[tuple[Iteration, PoolSummary]]:
    """Yield the batches that were drawn from a pool, with the pool, since runs are on both sides of the boundary."""
    for batch in log.iterations:
        proposal = batch.read(EstimationProposal)
        if proposal.pool is not None and proposal.phase != EXPLORE:
            yield batch, proposal.pool


def relative_error_of(pool: PoolSummary) -> float:
    """Return the anticipated coefficient of variation of one draw from this pool."""
    return relative_error(pool.anticipated, pool.probability)


def relative_error(anticipated: float, prior: float) -> float:
    """Return the anticipated coefficient of variation of one draw."""
    return math.sqrt(anticipated) / max(prior, 1e-300)
