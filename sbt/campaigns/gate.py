"""The verdict of an estimation: is the probability below a threshold, above it, or is that not known yet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = ["Limits", "gate_verdict"]


@dataclass(frozen=True)
class Limits:
    """One-sided confidence limits of a probability: functions of the confidence."""

    lower: Callable[[float], float]
    upper: Callable[[float], float]


def gate_verdict(limits: Limits, *, probability: float, confidence: float) -> dict[str, Any]:
    """Return the verdict: `pass`, `fail` or `undecided`, with the limits it rests on and a sentence.

    `pass`: the one-sided upper limit (failed runs as critical) is at most the threshold. `fail`: the one-sided
    lower limit (failed runs as safe) is above it. Each is wrong with probability 1 - confidence at most,
    as far as the interval is right. Otherwise nothing is decided, and a larger budget may help.

    Args:
        limits: of the estimate.
        probability: the threshold.
        confidence: of each of the two limits.
    """
    low, high = limits.lower(confidence), limits.upper(confidence)
    sure = f"with {confidence:.3g} confidence"
    if high <= probability:
        verdict, told = "pass", f"{sure} the probability is at most {high:.3g}, within the allowed {probability:.3g}"
    elif low > probability:
        verdict, told = "fail", f"{sure} the probability is at least {low:.3g}, above the allowed {probability:.3g}"
    else:
        verdict = "undecided"
        told = f"{sure} the probability is between {low:.3g} and {high:.3g}: whether it is within {probability:.3g} is open"
    return {
        "verdict": verdict, "probability": probability, "confidence": confidence, "lower": low, "upper": high, "statement": told,
    }  # fmt: skip
