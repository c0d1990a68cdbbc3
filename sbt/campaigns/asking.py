"""What reused draws say: the probability under another distribution or requirement, and its sensitivity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sbt.campaigns.again import Reused
from sbt.campaigns.batches import told_by_batches
from sbt.campaigns.clustering import spread_of_batches
from sbt.campaigns.counting import nothing_critical
from sbt.campaigns.estimation import Concluded, EstimationConclusion, on_warm_ups
from sbt.campaigns.gate import Limits
from sbt.estimators.intervals import CountedBatch, combine_estimates
from sbt.estimators.reweighting import ReusedBatch, WeightedShare, defended_bound, effective_size
from sbt.problem.arrays import Points, Vector
from sbt.problem.sensitivity import SpaceParameter, space_parameters

__all__ = ["Sensitivity", "answer", "sensitivities"]

_CONFIDENCE = 0.95
_HEAVY = 0.25
"""Share of the weight that one draw may carry before the reader is warned."""


@dataclass(frozen=True)
class Sensitivity:
    """What one parameter of the distributions does to the probability P.

    Attributes:
        input, parameter, value: which, as configured.
        derivative: dP / d parameter, by the score function; None where it is not known: an end of the distribution at which it
            has a density moves with the parameter, or no draw says anything of it.
        std_error: of the derivative.
        elasticity: relative change of P for a relative change of the parameter; None where P or the parameter is 0.
        change: 10 % of the parameter, or of the standard deviation of the input where the parameter is 0.
        raised, lowered: P with the parameter larger and smaller by that, from the same runs; None where they do not reach.
    """

    input: str
    parameter: str
    value: float
    derivative: float | None
    std_error: float | None
    elasticity: float | None
    change: float
    raised: float | None
    lowered: float | None


def answer(found: Reused) -> EstimationConclusion:
    """Return the probability that the draws give, with its interval, or a bound where few are critical."""
    weight = np.concatenate([b.coefficient for b in found.batches])
    size = effective_size(weight)
    told, limits = _from_nominal(found) if found.crude else _from_batches(found)
    batches, worst = ([_weighted(b) for b in each] for each in (found.batches, found.worst))
    told, _ = on_warm_ups(told, limits, spread_of_batches(found.warm_up, batches, worst))
    share = float(weight.max() / weight.sum())
    warnings = list(told.warnings)
    if share > _HEAVY:
        warnings.append(f"one draw carries {share:.0%} of the weight")
    if found.failed:
        counts = f"{found.failed} of {len(weight)} draws failed"
        warnings.insert(0, f"{counts}: the estimate and its lower end count them as safe, the upper end as critical")
    return replace(told, effective_sample_size=size, largest_weight_share=share, counted=len(weight), warnings=tuple(warnings))


def _from_batches(found: Reused) -> Concluded:
    """Return what batches with a control variate say."""
    safe, worst = ([_weighted(b) for b in each] for each in (found.batches, found.worst))
    told = told_by_batches(safe, worst, found.seen, found.unviolated, drawn_from="the campaign's distribution")
    unseen = found.seen.most(found.seen.surprises, _CONFIDENCE)
    return _conclusion(
        told.value, told.limits, told.low.std_error, told.highest, told.hits, unseen, told.exact_bound, [*told.warnings]
    )  # fmt: skip


def _from_nominal(found: Reused) -> Concluded:
    """Return what draws from the campaign's distribution itself say."""
    batch, worst = found.batches[0], found.worst[0]
    low, high = (WeightedShare(b.coefficient, b.critical) for b in (batch, worst))
    seen = found.seen
    hits, misses, not_hits = _weighted(batch).hits, _weighted(worst).misses, _weighted(batch).misses
    missed = defended_bound(0, seen.nominal, seen.ratio, _CONFIDENCE)
    value, exact, warnings = min(low.value, 1.0), None, []
    limits = Limits(low.lower, high.upper)
    if not hits:
        limits = Limits(low.lower, lambda c: defended_bound(int(worst.critical.sum()), found.nominal, seen.ratio, c))
        exact = limits.upper(_CONFIDENCE)
        warnings.append(nothing_critical("the campaign's distribution"))
    elif not misses:
        value = value if not_hits else 1.0
        limits = Limits(lambda c: 1.0 - defended_bound(not_hits, found.nominal, seen.ratio, c), lambda _: 1.0)
        warnings.append("no counted draw was safe: only a lower bound is given")
    return _conclusion(value, limits, low.std_error, min(high.value, 1.0), hits, missed, exact, warnings)


def _conclusion(
    value: float, limits: Limits, std_error: float, worst: float, hits: int, missed: float, exact: float | None,
    warnings: list[str],
) -> Concluded:  # fmt: skip
    tail = 0.5 * (1.0 + _CONFIDENCE)
    return EstimationConclusion(
        value, limits.lower(tail), limits.upper(tail), cov=std_error / value if value > 0 else None, hits=hits,
        failed_as_safe=value, failed_as_critical=worst, undetected_mass_bound=missed, exact_bound=exact, warnings=tuple(warnings),
    ), limits  # fmt: skip


def _weighted(batch: ReusedBatch) -> CountedBatch:
    return batch.tilted(np.ones(len(batch.x)), np.ones(len(batch.predicted_at)))


def sensitivities(found: Reused) -> tuple[Sensitivity, ...]:
    """Return what each parameter of the distributions does to the probability, that which 10 % of change most first."""
    p = _combined(found, [_weighted(b) for b in found.batches])[0]
    told = [_sensitivity(found, each, p) for each in space_parameters(found.space)]

    def reach(each: Sensitivity) -> float:
        """Return how much 10 % change; what is not known comes last."""
        ends = [abs(end - p) for end in (each.raised, each.lowered) if end is not None]
        return max(ends, default=-1.0 if each.derivative is None else abs(each.derivative) * each.change)

    return tuple(sorted(told, key=reach, reverse=True))


def _sensitivity(found: Reused, parameter: SpaceParameter, p: float) -> Sensitivity:
    derivative, std_error = None, None
    if parameter.smooth:
        derivative, std_error = _combined(found, _tilted_batches(found, parameter.score(_points(found))))
    if not std_error:
        derivative = std_error = None
    elasticity = parameter.value / p * derivative if derivative is not None and p > 0 and parameter.value != 0.0 else None
    raised, lowered = (_changed(found, parameter, parameter.value + side * parameter.tenth) for side in (1.0, -1.0))
    return Sensitivity(
        parameter.input, parameter.name, parameter.value, derivative, std_error, elasticity, parameter.tenth, raised, lowered
    )


def _changed(found: Reused, parameter: SpaceParameter, value: float) -> float | None:
    """Return P with another value of a parameter; None where the draws are worth too few with it, or the error exceeds it."""
    ratio = parameter.ratio(_points(found), value)
    if ratio is None:
        return None
    batches = _tilted_batches(found, ratio)
    weight = np.concatenate([b.coefficient for b in batches])
    if not weight.any() or effective_size(weight) < found.least:
        return None
    p, std_error = _combined(found, batches)
    return min(p, 1.0) if 0.0 < std_error <= p else None


def _points(found: Reused) -> Points:
    """Return the draws of all batches and the points that were predicted, batch by batch."""
    return np.concatenate([part for b in found.batches for part in (b.x, b.predicted_at)])


def _tilted_batches(found: Reused, tilt: Vector) -> list[CountedBatch]:
    """Return the batches with weights times a tilt, given at `_points`."""
    parts = iter(np.split(tilt, np.cumsum([n for b in found.batches for n in (len(b.x), len(b.predicted_at))])[:-1]))
    return [b.tilted(next(parts), next(parts)) for b in found.batches]


def _combined(found: Reused, batches: list[CountedBatch]) -> tuple[float, float]:
    """Return the estimate of all batches and its standard error."""
    if found.crude:
        return batches[0].value, float((batches[0].errors ** 2).sum() + batches[0].pool_variance) ** 0.5
    combined = combine_estimates(batches)
    return combined.value, combined.std_error
