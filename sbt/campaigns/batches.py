"""What batches of draws with known densities say: the estimate, its limits, and when other draws set them."""

from __future__ import annotations

from dataclasses import dataclass

from sbt.campaigns.counting import FEW_KNOWN, Seen, at_least, denied_by_draws, denied_late, hardly_known, held, nothing_critical
from sbt.campaigns.gate import Limits
from sbt.campaigns.precision import cautions
from sbt.campaigns.unviolated import Unviolated
from sbt.campaigns.wording import plural
from sbt.estimators.intervals import FEW_HITS, CombinedEstimate, CountedBatch, combine_estimates

__all__ = ["Told", "clipped", "told_by_batches"]

_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Told:
    """What batches say of a probability.

    Attributes:
        value: the estimate, failed runs as safe.
        highest: failed runs as critical.
        limits: of the probability; failed runs are safe for the lower one and critical for the upper one.
        low, high: the batches combined, failed runs as safe and as critical.
        hits: counted draws that were critical.
        worst_hits: that were critical or failed.
        exact_bound: upper end of the interval where nothing critical was met.
        warnings: what sets the interval where it is not the spread of the draws, and what may be wrong with it.
    """

    value: float
    highest: float
    limits: Limits
    low: CombinedEstimate
    high: CombinedEstimate
    hits: int
    worst_hits: int
    exact_bound: float | None
    warnings: tuple[str, ...]


def told_by_batches(
    safe: list[CountedBatch], worst: list[CountedBatch], seen: Seen, others: Unviolated, *, drawn_from: str,
    known_of: str = "", unstated: bool = False,
) -> Told:  # fmt: skip
    """Return what batches say of a probability, beside what draws say that no metamodel chose.

    Args:
        safe: the batches, failed runs as safe.
        worst: the same, failed runs as critical.
        seen: what all runs met, and the draws that no metamodel chose.
        others: requirements that no run violated.
        drawn_from: the distribution of these draws in words.
        known_of: of what critical runs are known, in words.
        unstated: runs failed, and no belief of the metamodel states where.
    """
    low, high = combine_estimates(safe), combine_estimates(worst)
    hits, perhaps = (sum(b.hits for b in each) for each in (safe, worst))
    not_hits, misses = (sum(b.misses for b in each) for each in (safe, worst))
    few_low, few_high = min(hits, not_hits) < FEW_HITS, min(perhaps, misses) < FEW_HITS
    drawn, draws, tail = seen.limits, f"{plural(seen.draws, 'draw')} from {drawn_from}", 0.5 * (1.0 + _CONFIDENCE)
    limits = Limits(lambda c: low.limit(c, side=-1, few=few_low), lambda c: high.limit(c, side=1, few=few_high))
    value, exact, warnings = clipped(low.value), None, []
    if hits and misses:
        limits = held(limits, seen, low.value, high.value, unstated=unstated)
    if not seen.critical:
        value, limits = 0.0, Limits(lambda _: 0.0, drawn.upper)
        exact = limits.upper(_CONFIDENCE)
        warnings.append(nothing_critical(drawn_from))
    elif not seen.safe:
        value, limits = value if not_hits else 1.0, Limits(drawn.lower, lambda _: 1.0)
        warnings.append(f"everything was critical: the probability is only bounded from below, by the draws from {drawn_from}")
    elif hits == 0:
        missed = drawn.upper if few_high else limits.upper
        limits = Limits(lambda _: 0.0, lambda c: max(high.limit(c, side=1), missed(c)))
        warnings.append("no counted draw was critical: only an upper bound is given")
    elif misses == 0:
        missed = drawn.lower if few_low else limits.lower
        limits = Limits(lambda c: min(low.limit(c, side=-1), missed(c)), lambda _: 1.0)
        warnings.append("no counted draw was safe: only a lower bound is given")
    elif seen.known < FEW_KNOWN:
        limits = limits.reaching(drawn.upper)
        met = f"critical runs{known_of} are known at {plural(seen.known, 'input')}"
        warnings.append(f"{met}, fewer than {FEW_KNOWN}: {at_least(draws)}")
    elif few_low or few_high:
        few, what = (hits, "critical") if hits < FEW_HITS else (misses, "safe")
        met = f"{few} counted draw{' was' if few == 1 else 's were'} {what}"
        warnings.append(f"only {met}, fewer than {FEW_HITS}: so small a number, or {draws}, set the interval")
    late = hits > 0 and misses > 0 and seen.late
    if late:
        limits = limits.reaching(drawn.upper)
        warnings.append(denied_late(draws))
    highest = max(clipped(high.value), value)
    if not late and (few_low or few_high or hardly_known(value, low.std_error) or hardly_known(highest, high.std_error)):
        limits = limits.within(drawn, value, highest)
        warnings += denied_by_draws(drawn, draws, value, highest, tail)
    if seen.critical:
        limits = others.reached(limits, lambda c: seen.most(seen.failed, c), drawn.upper)
        warnings += others.sentences(draws, seen.most(seen.failed, tail))
    warnings += cautions(len(safe), low.largest_term, value, seen.surprises)
    return Told(value, highest, limits, low, high, hits, perhaps, exact, tuple(warnings))


def clipped(value: float) -> float:
    """Return an estimate of a probability within [0, 1]."""
    return min(max(value, 0.0), 1.0)
