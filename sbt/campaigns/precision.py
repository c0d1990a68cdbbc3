"""What limits an estimate, how many more runs it needs, and whether as many random draws would tell more."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sbt.campaigns.stopping import FEWEST_BATCHES
from sbt.campaigns.wording import plural
from sbt.estimators import binomial
from sbt.estimators.intervals import FEWEST_HITS, WIDEST

if TYPE_CHECKING:
    from sbt.campaigns.estimation import EstimationConclusion

__all__ = ["NO_BETTER", "PRECISE", "always_agree", "as_many_draws", "cautions", "more_runs", "rounded", "too_wide", "width"]

PRECISE = 0.1
"""Coefficient of variation that is asked for by default."""
NO_BETTER = 1.5
"""Factor by which an interval is wider than by as many random draws, from which on that is said."""
_HEAVY = 0.25  # of the estimate: what one draw may move it by before the reader is warned
_FAR = 100.0  # times the runs there are, beyond which a number of runs that would be enough is a guess


def always_agree(found: EstimationConclusion) -> bool:
    """Return whether runs of equal inputs always ended alike, with values that show noise."""
    noise = found.simulator_noise
    return noise is not None and noise.noisy is False and noise.silent is None and noise.lost is None


def more_runs(found: EstimationConclusion, n: int) -> str:
    """Return how many more runs than n give an estimate its precision, whose error is too large.

    What runs of a sum over combinations may miss, as long as they agree, falls with their number; other errors with its root.
    """
    if found.combinations is not None and found.probability and always_agree(found):
        total = rounded(max(-math.log(0.025) / (2.0 * PRECISE * found.probability), n + 1.0))
        more = f"about {rounded(total - n):,} more runs (budget: {total:,})"
        return f"{more}, which repeat combinations, give it to \N{PLUS-MINUS SIGN}20 % (95 %)"
    counted, known, narrow = found.counted or n, bool(found.probability), bool(found.probability) and width(found) <= 1.0
    learns = found.convergence is not None  # told of draws that a metamodel chose
    lacking = counted * (too_wide(found) ** 2 - 1.0)
    return _runs_for_precision(lacking, n or counted, known=known, narrow=narrow, learns=learns)


def as_many_draws(found: EstimationConclusion, n: int) -> str:
    """Return the advice to draw from the inputs' distribution alone, where the interval of n such draws would be much narrower.

    It is that of as many critical, and of as many failed ones, as the estimate expects of them.
    """
    if n == 0 or found.probability is None:
        return ""
    value = min(max(found.probability, 0.0), 1.0)
    worst, tail = max(found.failed_as_critical or 0.0, value), 0.5 * (1.0 + found.confidence)
    low, high = float(binomial.lower(n * value, n, tail)), float(binomial.upper(min(n * worst, n), n, tail))
    if found.high <= NO_BETTER * high and found.high - found.low <= NO_BETTER * (high - low):
        return ""
    return "; as many draws from the inputs' distribution would bound it better (acquisition: {kind: monte_carlo})"


def _runs_for_precision(more: float, made: int, *, known: bool, narrow: bool, learns: bool) -> str:
    """Return how many more runs, beside those that were made, give the estimate its precision.

    Args:
        more: so many.
        made: so many.
        known: the estimate is not 0.
        narrow: its interval is as narrow as asked; only few critical draws count.
        learns: a metamodel chose them.
    """
    if not known or more > _FAR * made:
        return f"a larger budget: ten times {made:,} runs tell how many it takes, since too few critical draws count now"
    if narrow:
        budget = f"about {rounded(more):,} more runs (budget: {rounded(made + more):,})"
        return f"{budget}, until {FEWEST_HITS} critical draws count: its interval is narrow, but of fewer"
    said = f"about {rounded(more):,} more runs (budget: {rounded(made + more):,}) give it to \N{PLUS-MINUS SIGN}20 % (95 %)"
    return f"{said}, fewer where a metamodel goes on to learn" if learns else said


def too_wide(found: EstimationConclusion) -> float:
    """Return how many times too large the error is, by the rule that ends a campaign; up to 1: narrow as asked."""
    few = 0.0 if found.combinations is not None else math.sqrt(FEWEST_HITS / max(found.hits, 1))
    return max(few, width(found))


def width(found: EstimationConclusion) -> float:
    """Return how many times too large the error is, however few critical draws it is of; 0: not known."""
    value = found.probability or 0.0
    if value <= 0.0:
        return 0.0
    error, half = (found.cov or 0.0) / PRECISE, 0.5 * (found.high - found.low) / (PRECISE * value)
    skewed = found.counted is None  # repeats of subset simulation: limits come together faster than runs grow
    return max(error, half / 2.0 if half > WIDEST and not skewed else 0.0)


def rounded(value: float) -> int:
    """Return a number of runs to two digits, upwards."""
    if value < 10:
        return max(math.ceil(value), 1)
    unit = 10 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit) * unit


def cautions(batches: int, largest_term: float, value: float, surprises: int) -> list[str]:
    """Return what makes an estimate, and its interval, less certain than they say."""
    said = []
    if batches < FEWEST_BATCHES:
        counts = "1 batch counts" if batches == 1 else f"{batches} batches count"
        said.append(f"only {counts}, fewer than {FEWEST_BATCHES}: their spread says little")
    if largest_term > _HEAVY * value > 0.0:
        said.append(f"one draw moves the estimate by {largest_term / value:.0%}")
    if surprises:
        draws = plural(surprises, "draw")
        said.append(f"{draws} from the inputs' distribution met a critical region that the metamodel had denied")
    return said
