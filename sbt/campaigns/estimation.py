"""Estimation: the probability of a critical scenario under the inputs' distribution, with an honest interval."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sbt.campaigns.counting import Seen, counted_batches, drawn_shares
from sbt.campaigns.crude import MonteCarloStage, SubsetStage, law_share, repeats_of
from sbt.campaigns.gate import Limits, gate_verdict
from sbt.campaigns.parts import Settings
from sbt.campaigns.sequential import FEWEST_BATCHES, SequentialStage
from sbt.errors import InputError
from sbt.estimators.intervals import FEWEST_HITS, CountedBatch, combine_estimates, few_hits_bound
from sbt.estimators.subset import combine_repeats
from sbt.loop.stages import Campaign, Fit, Log, Stage

__all__ = ["recipe"]

_HIGH_DIMENSION = 20
_CONFIDENCE = 0.95
_HEAVY = 0.25
_NOTHING = "nothing critical was met: the probability is only bounded from above, by the draws from the law"
Conclusion = dict[str, Any]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: `difference` (the sequential estimator), `monte_carlo`, or `subset`.

    `auto` is `subset` from 20 inputs on, `difference` below.

    Raises:
        InputError: recorded rows, which have no law to draw from, or an unknown method.
    """
    if settings.scenario.pool is not None:
        raise InputError("estimation needs a scenario that can be run anywhere, but recorded rows have no proposal density")
    method = settings.method
    if method == "auto":
        method = "subset" if settings.scenario.space.dimension >= _HIGH_DIMENSION else "difference"
    if method == "monte_carlo":
        cov = settings.stop.get("cov")
        depends = None if cov is None else f"stop.cov = {cov:g} ends it where the results say (null: the whole budget is run)"
        return replace(_campaign(settings, MonteCarloStage(settings), _from_law), depends=depends)
    if method == "subset":
        return _campaign(settings, SubsetStage(settings), _from_repeats)
    if method == "difference":
        return _campaign(settings, SequentialStage(settings), _from_batches)
    raise InputError(f"estimation draws by auto, difference, monte_carlo or subset, but got '{method}'")


def _campaign(settings: Settings, stage: Stage, concluded: Any) -> Campaign:
    def conclude(log: Log) -> tuple[Conclusion, Fit | None]:
        found, limits = concluded(log, settings)
        failed = int((~log.history.ok).sum())
        if failed:
            found["warnings"].insert(0, (
                f"{failed} of {len(log.history)} runs failed: the lower end counts them as safe, the upper end as critical"
            ))  # fmt: skip
        if settings.gate is not None:
            found["gate"] = gate_verdict(limits, **settings.gate)
        return found, None

    return Campaign((stage,), conclude)


def _conclusion(probability: float | None, limits: Limits, **rest: Any) -> Conclusion:
    """Return the keys of an estimation in their order."""
    tail = 0.5 * (1.0 + _CONFIDENCE)
    found: Conclusion = {
        "probability": probability, "low": limits.lower(tail), "high": limits.upper(tail), "confidence": _CONFIDENCE,
        "cov": None, "effective_sample_size": 0.0, "hits": 0, "failed_as_safe": probability, "failed_as_critical": probability,
        "undetected_mass_bound": 1.0, "warnings": [],
    }  # fmt: skip
    return found | rest


def _from_batches(log: Log, settings: Settings) -> tuple[Conclusion, Limits]:
    """Return what the sequential estimator says."""
    safe, critical = counted_batches(log, settings), counted_batches(log, settings, failed_critical=True)
    if not safe:
        return _uncounted(log, settings)
    low, high, seen = combine_estimates(safe), combine_estimates(critical), Seen.of(log, settings)
    hits, misses = _hits(safe), sum(len(b.critical) for b in critical) - _hits(critical)
    counted = drawn_shares(log)
    undetected = few_hits_bound(seen.surprises, counted, _CONFIDENCE)
    value, rest = _clipped(low.value), {}
    limits, warnings = Limits(lambda c: low.limit(c, side=-1), lambda c: high.limit(c, side=1)), []
    if not seen.critical:
        limits, value = _nothing_critical(log, seen), 0.0
        rest["exact_bound"] = limits.upper(_CONFIDENCE)
        warnings.append(_NOTHING)
    elif not seen.safe:
        limits = Limits(lambda c: 1.0 - few_hits_bound(seen.failed_draws, counted, c), lambda _: 1.0)
        warnings.append("everything was critical: the probability is only bounded from below, by the draws from the law")
    elif hits < FEWEST_HITS:
        limits = Limits(lambda _: 0.0, lambda c: few_hits_bound(_hits(critical), counted, c))
        warnings.append(f"only {hits} counted draws were critical, fewer than {FEWEST_HITS}: only an upper bound is given")
    elif misses < FEWEST_HITS:
        limits = Limits(lambda c: 1.0 - few_hits_bound(misses, counted, c), lambda _: 1.0)
        warnings.append(f"only {misses} counted draws were safe, fewer than {FEWEST_HITS}: only a lower bound is given")
    if len(safe) < FEWEST_BATCHES:
        warnings.append(f"only {len(safe)} batches count, fewer than {FEWEST_BATCHES}: their spread says little")
    if low.largest_share > _HEAVY and 0.0 < value < 1.0:
        warnings.append(f"one draw carries {low.largest_share:.0%} of the weight")
    if undetected > value:
        warnings.append(
            "no interval can see a critical region that no run has met: such a region may hold up to "
            f"{undetected:.2g} (95 %), more than the estimate"
        )  # fmt: skip
    return _conclusion(
        value, limits, cov=low.std_error / low.value if value > 0 else None, hits=hits, failed_as_safe=value,
        effective_sample_size=low.effective_sample_size, failed_as_critical=max(_clipped(high.value), value),
        undetected_mass_bound=undetected, warnings=warnings, largest_weight_share=low.largest_share,
        convergence=_convergence(log, safe, critical),
        counted=int(sum(len(b.critical) for b in safe)), **rest,
    ), limits  # fmt: skip


def _convergence(log: Log, safe: list[CountedBatch], critical: list[CountedBatch]) -> list[dict[str, float]]:
    """Return estimate and interval after each counted batch but the first, whose spread is not known."""
    counted = [how["iteration"] for how in log.iterations if how.get("phase") == "count"]
    tail, steps = 0.5 * (1.0 + _CONFIDENCE), []
    for k in range(2, len(safe) + 1):
        low, high = combine_estimates(safe[:k]), combine_estimates(critical[:k])
        runs = int((log.history.iteration <= counted[k - 1]).sum())
        steps.append({
            "runs": runs, "probability": _clipped(low.value), "low": low.limit(tail, side=-1), "high": high.limit(tail, side=1)
        })  # fmt: skip
    return steps


def _uncounted(log: Log, settings: Settings) -> tuple[Conclusion, Limits]:
    """Return what is known before any draw counts: the bound by the draws there are."""
    seen, told = Seen.of(log, settings), []
    limits = _nothing_critical(log, seen) if not seen.critical else Limits(lambda _: 0.0, lambda _: 1.0)
    told.append(f"no draw counts: {len(log.history)} runs are too few for hunting, learning and counting")
    rest = {} if seen.critical else {"exact_bound": limits.upper(_CONFIDENCE)}
    return _conclusion(None, limits, warnings=told + ([] if seen.critical else [_NOTHING]), **rest), limits


def _nothing_critical(log: Log, seen: Seen) -> Limits:
    """Return the exact bound while no run was critical; failed draws might have been."""
    return Limits(lambda _: 0.0, lambda c: few_hits_bound(seen.failed_draws, drawn_shares(log), c))


def _from_law(log: Log, settings: Settings) -> tuple[Conclusion, Limits]:
    """Return what crude Monte Carlo says; its interval is exact, with few hits too."""
    share = law_share(log, settings)
    limits = Limits(share.lower, share.upper)
    rest: Conclusion = {"warnings": []}
    if share.hits == 0:
        rest = {"exact_bound": share.upper(_CONFIDENCE), "warnings": [_NOTHING]}
    return _conclusion(
        share.value if share.n else None, limits, cov=share.cov, effective_sample_size=float(share.n), hits=share.hits,
        failed_as_safe=share.value, failed_as_critical=(share.hits + share.failed) / max(share.n, 1),
        undetected_mass_bound=1.0 - (1.0 - _CONFIDENCE) ** (1.0 / max(share.n, 1)), counted=share.n, **rest,
    ), limits  # fmt: skip


def _from_repeats(log: Log, settings: Settings) -> tuple[Conclusion, Limits]:
    """Return what the repeats of subset simulation say."""
    repeats = repeats_of(log, settings)
    unfinished = sum(not r.finished for r in repeats)
    n = len(log.history)
    first = law_share(log, settings, stage="subset level 0")
    undetected = 1.0 - (1.0 - _CONFIDENCE) ** (1.0 / max(first.n, 1))
    hits = int(sum(r.hits for r in repeats))
    if unfinished:
        limits = Limits(lambda _: 0.0, first.upper)
        told = (
            f"{unfinished} of {len(repeats)} repeats of subset simulation did not reach the critical interval in {n} runs: "
            "only the draws from the law bound the probability; give a larger budget"
        )
        rest = {"exact_bound": limits.upper(_CONFIDENCE)} if hits == 0 else {}
        return _conclusion(None, limits, hits=hits, undetected_mass_bound=undetected, warnings=[told], **rest), limits
    found = combine_repeats([r.share for r in repeats])
    if found.value == 0.0:
        limits = Limits(lambda _: 0.0, first.upper)
        told = _NOTHING + "; subset simulation came to a level from which no run got lower"
        return _conclusion(
            0.0, limits, undetected_mass_bound=undetected, exact_bound=limits.upper(_CONFIDENCE), warnings=[told]
        ), limits  # fmt: skip
    failed = int((~log.history.ok).sum())
    limits = Limits(lambda c: found.limit(c, side=-1), lambda c: first.upper(c) if failed else found.limit(c, side=1))
    caution = ["the interval is that of independent repeats: it cannot see a region that no chain has met"]
    return _conclusion(
        found.value, limits, cov=found.std_error / found.value, hits=hits, effective_sample_size=float(found.repeats),
        failed_as_critical=first.upper(_CONFIDENCE) if failed else found.value, undetected_mass_bound=undetected,
        warnings=caution,
    ), limits  # fmt: skip


def _clipped(value: float) -> float:
    return min(max(value, 0.0), 1.0)


def _hits(batches: list[CountedBatch]) -> int:
    return int(sum(b.critical.sum() for b in batches))
