"""The verdict of an estimation: is the probability below a threshold, above it, or is that not known yet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sbt.campaigns.settings import Gate

__all__ = ["CONDITION", "GateVerdict", "Limits", "gate_verdict"]

CONDITION = "if the search has met whatever is critical"
"""How the statement of a pass begins that trusts the search."""
_KNOWN = 1.0
"""Coefficient of variation above which an estimate is no number to rely on: a few draws of very unequal weight decide it."""


@dataclass(frozen=True)
class Limits:
    """One-sided confidence limits of a probability: functions of the confidence."""

    lower: Callable[[float], float]
    upper: Callable[[float], float]

    def reaching(self, upper: Callable[[float], float]) -> Limits:
        """Return limits of which the upper one is at least this one."""
        return Limits(self.lower, lambda confidence: max(self.upper(confidence), upper(confidence)))

    def within(self, others: Limits, low: float, high: float) -> Limits:
        """Return the nearer ones of these limits and of others with half of their error, but none that denies an estimate.

        Where the others deny it they are the estimate itself: what lies beyond it both deny.
        """

        def lower(confidence: float) -> float:
            return max(self.lower(confidence), min(others.lower(0.5 * (1.0 + confidence)), low))

        def upper(confidence: float) -> float:
            return min(self.upper(confidence), max(others.upper(0.5 * (1.0 + confidence)), high))

        return Limits(lower, upper)


@dataclass(frozen=True)
class GateVerdict:
    """The verdict of a gate.

    Attributes:
        verdict: pass, fail or undecided.
        probability, confidence: what was asked.
        lower, upper: the one-sided limits that it rests on.
        statement: the verdict in words.
    """

    verdict: str
    probability: float
    confidence: float
    lower: float
    upper: float
    statement: str


def gate_verdict(
    limits: Limits, gate: Gate, undetected: float = 0.0, surprises: int = 0, cov: float | None = None
) -> GateVerdict:
    """Return the verdict: `pass`, `fail` or `undecided`, with the limits it rests on and a sentence.

    `pass`: the one-sided upper limit (failed runs as critical) is at most the threshold. `fail`: the one-sided
    lower limit (failed runs as safe) is above it. Each is wrong with probability 1 - confidence at most,
    as far as the interval is right. Otherwise nothing is decided, and a larger budget may help. Neither is it where draws met
    critical runs that the metamodel denied, of which there may be more than is allowed: the interval rests on that metamodel; nor
    where the estimate is less than its standard error.

    Args:
        limits: of the probability.
        gate: what was asked.
        undetected: what no run has met may hold beside the limits: a `pass` says so where both are more than is allowed.
        surprises: draws from the inputs' distribution that were critical where the metamodel denied it.
        cov: coefficient of variation of the estimate; None: there is no estimate, or the limits are exact.
    """
    low, high = limits.lower(gate.confidence), limits.upper(gate.confidence)
    sure, allowed = f"with {gate.confidence:.15g} confidence", f"{gate.probability:.15g}"
    least, most = (_beside(end, gate.probability) for end in (low, high))
    if high <= gate.probability < undetected and surprises:
        were = "draw was" if surprises == 1 else "draws were"
        verdict, statement = "undecided", (
            f"{surprises} {were} critical where the metamodel denied it: by these draws alone such runs may hold up to"
            f" {undetected:.2g}, and the upper limit of {most} cannot be relied on; whether it is within {allowed} is open"
        )
    elif high <= gate.probability < undetected and cov is not None and cov > _KNOWN:
        verdict, statement = "undecided", (
            f"the estimate has a coefficient of variation of {cov:.2g}, and the upper limit of {most} cannot be relied on;"
            f" whether it is within {allowed} is open"
        )
    elif high <= gate.probability:
        verdict, statement = "pass", f"{sure} the probability is at most {most}, within the allowed {allowed}"
        if high + undetected > gate.probability:
            unmet = "a critical region that no run has met, or failures that few seeds show, could hold up to"
            more = "" if undetected > gate.probability else " more"
            statement = f"{CONDITION}, {statement}; {unmet} {undetected:.2g}{more}"
    elif low > gate.probability:
        verdict, statement = "fail", f"{sure} the probability is at least {least}, above the allowed {allowed}"
    else:
        verdict, ends = "undecided", f"at least {least} and at most {most}"
        statement = f"{sure} each the probability is {ends}: whether it is within {allowed} is open"
    return GateVerdict(verdict, gate.probability, gate.confidence, low, high, statement)


def _beside(end: float, allowed: float) -> str:
    """Return an end with as many digits, three at least, as tell on which side of what is allowed it lies."""
    for digits in range(3, 17):
        rounded = float(f"{end:.{digits}g}")
        if end == allowed or (rounded != allowed and (rounded > allowed) == (end > allowed)):
            break
    return f"{end:.{digits}g}"
