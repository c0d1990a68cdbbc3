"""What a campaign says of each requirement of a combination, beside what it says of the combination."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from sbt.campaigns.batches import told_by_batches
from sbt.campaigns.clustering import spread_of_draws, spread_of_share
from sbt.campaigns.counting import DRAWN, Seen, counted_batches, counted_iterations, with_event
from sbt.campaigns.crude import NOMINAL_STAGES, nominal_proportion, nominal_rows
from sbt.campaigns.gate import Limits
from sbt.campaigns.parts import CriticalShare, share_of
from sbt.campaigns.records import EstimationProposal
from sbt.campaigns.settings import Settings
from sbt.campaigns.summing import summed, took_sum
from sbt.campaigns.unviolated import Unviolated
from sbt.campaigns.wording import number, percent
from sbt.estimators.intervals import CountedBatch
from sbt.loop.stages import Log
from sbt.problem.requirement import Requirement
from sbt.store.history import History
from sbt.store.records import Independence, RequirementFit

__all__ = [
    "RequirementEstimate", "each_estimate", "each_share", "estimates_words", "fits_words",
    "independence_words", "shares_words", "violations_words",
]  # fmt: skip

_CONFIDENCE = 0.95
_LEVEL = 0.05  # at which the largest correlation of residuals is no chance, of all pairs together
_CORRELATED, _FEW = 0.3, 30  # |correlation| from which on P(critical) of a combination is off; runs that do not tell how much


@dataclass(frozen=True)
class RequirementEstimate:
    """The probability that a run violates one requirement of a combination, from the draws that estimate the combination.

    Attributes:
        name: of the requirement.
        probability: the estimate, failed runs counted as safe.
        low, high: ends of its interval; failed runs count as safe for the low end and as critical for the high end.
        hits: counted draws that violate it.
    """

    name: str
    probability: float
    low: float
    high: float
    hits: int


def each_share(history: History, requirement: Requirement) -> dict[str, CriticalShare] | None:
    """Return the share of an even or random design that violates each requirement; None where there is only one."""
    if not requirement.combined:
        return None
    return {part.label: share_of(history, part) for part in requirement.parts}


def each_estimate(log: Log, settings: Settings, confidence: float = _CONFIDENCE) -> tuple[RequirementEstimate, ...] | None:
    """Return the probability of each requirement of a combination; None where there is one, or nothing counts yet.

    From the draws that count; without such, of those that were made from the inputs' distribution (of subset simulation, its
    first level), or summed over all combinations of inputs.
    """
    if not settings.scenario.requirement.combined:
        return None
    if took_sum(log):
        tail = 0.5 * (1.0 + confidence)
        sums = [(part.label, summed(log, settings, part)) for part in settings.scenario.requirement.parts]
        return tuple(RequirementEstimate(n, s.share.value, s.lower(tail), s.upper(tail), s.hits) for n, s in sums)
    if counted_iterations(log):
        return _from_batches(log, settings, confidence)
    stage = next((stage for stage in NOMINAL_STAGES if (log.history.stage == stage).any()), None)
    return None if stage is None else _from_nominal(log, settings, stage, confidence)


def _from_nominal(log: Log, settings: Settings, stage: str, confidence: float) -> tuple[RequirementEstimate, ...]:
    """Return the estimates from draws of the inputs' distribution."""
    tail, found = 0.5 * (1.0 + confidence), []
    for part in settings.scenario.requirement.parts:
        share = nominal_proportion(log, settings, stage, part)
        between = spread_of_share(log.history, nominal_rows(log, stage), part.critical_runs(log.history))
        limits, worst = Limits(share.lower, share.upper), (share.hits + share.failed) / max(share.n, 1)
        limits = limits if between is None else between.widened(limits, share.value, worst)
        found.append(RequirementEstimate(part.label, share.value, limits.lower(tail), limits.upper(tail), share.hits))
    return tuple(found)


def _from_batches(log: Log, settings: Settings, confidence: float) -> tuple[RequirementEstimate, ...] | None:
    """Return the estimates from the batches that count; None before one is complete."""
    tail, found = 0.5 * (1.0 + confidence), []
    for k, part in enumerate(settings.scenario.requirement.parts):
        safe, critical = (_batches_of(k, part, log, settings, failed_critical=failed) for failed in (False, True))
        if not safe:
            return None
        told = told_by_batches(safe, critical, _seen(part, log, settings), Unviolated(), drawn_from="the inputs' distribution")
        between = spread_of_draws(log, safe, critical)
        limits = told.limits if between is None else between.widened(told.limits, told.value, told.highest)
        ends = min(limits.lower(tail), told.value), max(limits.upper(tail), told.value)
        found.append(RequirementEstimate(part.label, told.value, *ends, told.hits))
    return tuple(found)


def _seen(part: Requirement, log: Log, settings: Settings) -> Seen:
    """Return what the runs met of one requirement; what the metamodel denied is known of the combination."""
    one = replace(settings, scenario=replace(settings.scenario, requirement=part))
    return Seen.of(log, one, settings.scenario.requirement)


def _batches_of(k: int, part: Requirement, log: Log, settings: Settings, *, failed_critical: bool) -> list[CountedBatch]:
    """Return the counted batches with the outcomes, and the metamodel's statements, of the k-th requirement."""
    history = log.history
    critical = part.critical_runs(history) | (failed_critical & ~history.ok)
    proposals = {batch.number: batch.read(EstimationProposal).counted for batch in log.iterations}
    found = []
    for whole, number_of in zip(counted_batches(log, settings), _complete(log), strict=True):
        rows = np.flatnonzero((history.stage == DRAWN) & (history.iteration == number_of))
        draws = proposals[number_of]
        outcomes = critical[rows].astype(np.float64)
        if draws is None or draws.parts is None:  # importance weights alone: no statement of the metamodel is used
            found.append(replace(
                whole, prior=0.0, anticipated=0.0, pool_variance=0.0, control_variate=np.zeros(len(rows)), critical=outcomes
            ))  # fmt: skip
            continue
        mine = draws.parts[k]
        mine = (mine.failed_critical or mine) if failed_critical else mine
        found.append(with_event(replace(whole, critical=outcomes), mine))
    return found


def _complete(log: Log) -> list[int]:
    """Return the numbers of the batches that count and whose draws are all there."""
    drawn = log.history.stage == DRAWN
    planned = {batch.number: batch.read(EstimationProposal).counted for batch in log.iterations}
    return [
        n for n in counted_iterations(log)
        if (found := planned[n]) is not None and (drawn & (log.history.iteration == n)).sum() >= len(found.coefficient)
    ]  # fmt: skip


def estimates_words(estimates: tuple[RequirementEstimate, ...] | None, confidence: float = _CONFIDENCE) -> list[str]:
    """Return the probability of each requirement in words; nothing where there is one."""
    if not estimates:
        return []
    each = "; ".join(f"{e.name} {number(e.probability)} ({number(e.low)} to {number(e.high)})" for e in estimates)
    alone = ", each estimated for itself, so that they need not fit together exactly"
    return [f"Of each requirement, from the same draws{alone} ({percent(confidence)} intervals): {each}."]


def shares_words(shares: Mapping[str, CriticalShare] | None, of: str = "") -> list[str]:
    """Return the share (of which runs) that violates each requirement in words; nothing where there is one."""
    each = [
        f"{name} {percent(s.critical_fraction)} ({percent(s.low)} to {percent(s.high)})"
        for name, s in (shares or {}).items() if s.critical_fraction is not None
    ]  # fmt: skip
    lost = any(share.lost for share in (shares or {}).values())
    ends = f"95 % intervals{', whose ends count failed runs as uncritical and as critical' if lost else ''}"
    return [f"Shares that violate each requirement{of} ({ends}): {'; '.join(each)}."] if each else []


def violations_words(counts: Mapping[str, int] | None) -> list[str]:
    """Return how many runs violate each requirement in words; nothing where there is one, or no critical run."""
    return [f"Critical runs that violate {', '.join(f'{name}: {n}' for name, n in counts.items())}."] if counts else []


def fits_words(fits: tuple[RequirementFit, ...] | None) -> list[str]:
    """Return the share of each requirement as its metamodel sees it; nothing where there is one."""
    if not fits:
        return []
    return [f"By its metamodels, {', '.join(f'{percent(f.critical_fraction)} violates {f.name}' for f in fits)}."]


def independence_words(found: Independence | None) -> list[str]:
    """Return whether the metrics are independent given the inputs, as P(critical) of the combination takes them to be."""
    if found is None:
        return []
    names = " and ".join(found.between)
    said = f"Residuals of {names} correlate by {number(found.correlation, 2)} on {found.runs} held-out runs"
    if abs(found.correlation) * math.sqrt(found.runs - 1.0) < -ndtri(0.5 * _LEVEL / (found.pairs or 1)):
        return [f"{said}: no sign that the requirements are not independent given the inputs."]
    much = "is slightly off" if abs(found.correlation) < _CORRELATED else "is off"
    much = "may be off" if found.runs < _FEW else much
    told = f"{said}: P(critical) of the combination takes them as independent, and {much} where both are unsure"
    often = "likelier" if found.together else "less likely"
    return [f"{told}{'' if found.together is None else f': both at once are {often} than it states'}."]
