"""What the repeats of subset simulation say, and the draws from the inputs' distribution beside them."""

from __future__ import annotations

from sbt.campaigns.counting import nothing_critical
from sbt.campaigns.crude import FIRST_LEVEL, nominal_proportion, repeats_of
from sbt.campaigns.gate import Limits
from sbt.campaigns.settings import Settings
from sbt.estimators.monte_carlo import Proportion
from sbt.estimators.subset import RepeatedEstimate, combine_repeats
from sbt.loop.stages import Log
from sbt.problem.plain import Json

__all__ = ["are_precise", "limits_by_repeats", "told_by_repeats"]

def are_precise(log: Log, settings: Settings, target: float | None) -> bool:
    """Return whether all repeats have finished, with an estimate of this coefficient of variation."""
    repeats = repeats_of(log, settings)
    if target is None or not all(r.finished for r in repeats):
        return False
    found = combine_repeats([r.estimate for r in repeats])
    return 0.0 < found.std_error <= target * found.value


def limits_by_repeats(found: RepeatedEstimate, first: Proportion | None) -> Limits:
    """Return the limits by the repeats, or those of draws from the inputs' distribution, with half of the error, if nearer."""
    limits = Limits(lambda c: found.limit(c, side=-1), lambda c: found.limit(c, side=1))
    return limits if first is None else limits.within(Limits(first.lower, first.upper), found.value, found.value)


def told_by_repeats(log: Log, settings: Settings, confidence: float) -> tuple[float | None, Limits, Json]:
    """Return the estimate, its limits, and what else a conclusion has, by name.

    A repeat that the budget cut off states what its last full level holds. Where no repeat met anything critical, the draws
    from the inputs' distribution are all that is known. They also bound what repeats say, with half of the error.
    """
    repeats = repeats_of(log, settings)
    cut, n = sum(not r.finished for r in repeats), len(log.history)
    found, first = combine_repeats([r.estimate for r in repeats]), nominal_proportion(log, settings, FIRST_LEVEL)
    rest: Json = {"undetected_mass_bound": 1.0 - (1.0 - confidence) ** (1.0 / max(first.n, 1))}
    if found.value == 0.0 and first.hits:
        said = f"no chain of subset simulation met anything critical: this is the share of {first.n:,} random draws"
        worst = (first.hits + first.failed) / first.n
        rest |= {"cov": first.cov, "hits": first.hits, "failed_as_critical": worst, "effective_sample_size": float(first.n)}
        return first.value, Limits(first.lower, first.upper), rest | {"warnings": (said,)}
    if found.value == 0.0:
        said = nothing_critical() + "; subset simulation came to a level from which no run got lower"
        if cut:
            said = (
                f"{cut} of {len(repeats)} repeats of subset simulation did not reach the critical interval in {n} runs: "
                "only the draws from the inputs' distribution bound the probability; give a larger budget"
            )
        limits = Limits(lambda _: 0.0, first.upper)
        return None if cut else 0.0, limits, rest | {"exact_bound": limits.upper(confidence), "warnings": (said,)}
    failed = bool((~log.history.ok).any())
    reached = found.tells_spread and (not cut or all(r.estimate > 0.0 for r in repeats))
    plain = None if settings.scenario.space.constraints else first
    limits = limits_by_repeats(found, plain)
    if failed or not reached:
        limits = Limits(limits.lower, lambda c: max(first.upper(c), found.value))
    warnings = ["the interval is that of repeats: it cannot see a region that no chain has met"]
    if cut:
        warnings.append(
            f"the budget cut off {cut} of {len(repeats)} repeats of subset simulation: what their last full levels hold is stated"
        )
    if not found.tells_spread:
        warnings.append(
            f"only one of {len(repeats)} repeats of subset simulation met anything critical, and their spread is not known:"
            f" {first.n:,} random draws set the upper end; give a larger budget"
        )
    return found.value, limits, rest | {
        "cov": found.std_error / found.value, "hits": int(sum(r.hits for r in repeats)), "warnings": tuple(warnings),
        "effective_sample_size": float(found.repeats),
        "failed_as_critical": first.upper(confidence) if failed else found.value,
    }  # fmt: skip
