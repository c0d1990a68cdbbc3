"""Runs that gave no metric, in the sentences of conclusions: what is not known, and what more runs cannot mend."""

from __future__ import annotations

import math

import numpy as np

from sbt.campaigns.wording import number, percent, plural
from sbt.loop.stages import Facts

__all__ = [
    "decides_bound", "equally_near", "failed_runs", "lost_runs", "narrower", "nearest_words", "none_gave_a_metric",
    "nothing_known", "repetitions", "runs_to_halve", "why_they_fail",
]  # fmt: skip

_HALF = 0.5
"""Of an interval or a bound: where failed runs alone make up as much, twice the precision is out of reach."""


def none_gave_a_metric(facts: Facts) -> bool:
    """Return whether there are runs, and none gave a metric."""
    return len(facts.history) > 0 and not facts.history.ok.any()


def nothing_known(facts: Facts) -> list[str]:
    """Return that so few runs gave a metric that nothing follows from them, and what to do."""
    n, ok = len(facts.history), int(facts.history.ok.sum())
    of = f" of {facts.scenario}" if facts.scenario else ""
    if ok == n:
        return [f"Nothing is known{of}: {plural(n, 'run')} {'is' if n == 1 else 'are'} too few.", "Next: a larger budget."]
    return [
        f"Nothing is known{of}: {f'only {ok:,}' if ok else 'none'} of {plural(n, 'run')} gave a metric.",
        f"Next: {why_they_fail()}.",
    ]


def why_they_fail() -> str:
    """Return the advice for runs that fail."""
    return "look at why they failed (table of failed runs in the report, export), mend it, and run the campaign in a new store"


def failed_runs(counting: int, failed: int, n: int, beside: int = 0) -> tuple[str, ...]:
    """Return how many of n runs failed, and how an estimate counts those that it counts; () where none failed.

    Args:
        counting: failed draws of the estimate.
        failed: failed runs.
        n: runs.
        beside: failed draws that only its upper end has.
    """
    if not failed:
        return ()
    said = f"{failed} of {n} runs failed"
    if not counting + beside:
        return (f"{said}, none of them a draw that counts",)
    rest = "" if counting + beside == failed else "; the others are no draws that count"
    if not counting:
        return (f"{said}: the upper end counts {'them' if beside == failed else f'{beside} of them'} as critical{rest}",)
    safe = "them" if counting == failed else f"{counting} of them"
    worst = f"{counting + beside} " if beside else ""
    return (f"{said}: the estimate and its lower end count {safe} as safe, the upper end {worst}as critical{rest}",)


def lost_runs(lost: int, n: int) -> str:
    """Return how many runs gave no metric, and how ends of an interval count them."""
    return f"{lost:,} of {plural(n, 'run')} gave no metric: the lower end counts them as uncritical, the upper end as critical"


def runs_to_halve(lost: int, n: int, low: float, high: float) -> float:
    """Return how many more runs halve the interval of a share of n; inf where failed ones make up half of its width.

    The width is the share of failed runs, which stays, and what shrinks with the root of their number.

    >>> runs_to_halve(0, 100, 0.2, 0.4), round(runs_to_halve(12, 100, 0.266, 0.582), -2), runs_to_halve(20, 100, 0.2, 0.6)
    (300.0, 2600.0, inf)
    """
    failing, width = lost / max(n, 1), high - low
    left = _HALF * width - failing
    return n * (((width - failing) / left) ** 2 - 1.0) if left > 0.0 else math.inf


def decides_bound(worst: float, bound: float) -> str | None:
    """Return that more runs hardly lower a bound, where failed runs make up half of it; None where they do not.

    Args:
        worst: estimate with every failed run as critical.
        bound: upper one.
    """
    if worst <= 0.0 or worst < _HALF * bound:
        return None
    return f"failed runs decide the bound, and more runs never lower it much below {percent(worst)}: {why_they_fail()}"


def narrower(value: float, worst: float, high: float, more: str) -> str:
    """Return what lowers the upper end of an interval where runs fail: to mend them, or first more runs.

    Args:
        value: the estimate.
        worst: the same with every failed run as critical.
        high: upper end of the interval.
        more: what more of would bring the upper end to `worst`, in words.
    """
    end, about = number(high, 3), f"{number(worst, 3)}, as far as these tell"
    if worst < _HALF * (value + high):
        kept = f"{more} bring the upper end of the interval, {end}, to about {about}, where failed runs keep it"
        return f"{kept}; {why_they_fail()}"
    decide = f"failed runs decide the width of the interval: its upper end, {end}, counts them as critical"
    return f"{decide}, and {more} would bring it to about {about}; {why_they_fail()}"


def equally_near(facts: Facts) -> int:
    """Return at how many different inputs a run came as near to the critical interval, or as deep into it, as any."""
    margins = facts.requirement.margins(facts.history)
    nearest = np.nanmin(margins, initial=np.inf)
    return len(np.unique(facts.history.x[margins == nearest], axis=0)) if np.isfinite(nearest) else 0


def nearest_words(run: int, metric: str, facts: Facts) -> str:
    """Return what to make of the run that came closest to the critical interval, where none lies in it."""
    alike = equally_near(facts)
    if alike < 2:
        return f"look at run {run}, which came closest ({metric})"
    if alike < _HALF * int(facts.history.ok.sum()):
        return f"look at run {run}, which came closest, as others did ({metric})"
    return (
        f"runs at {alike:,} inputs came equally close ({metric}), so that nothing leads the search: take a metric that tells how"
        " near a run came, such as severity, ttc_min or distance_min"
    )


def repetitions(again: int, gave: int, lost: int, how: str = "") -> str:
    """Return in how many of the repetitions that gave a metric a run was critical again, beside those that gave none.

    >>> repetitions(2, 3, 0), repetitions(2, 2, 1)
    ('2 of 3 repetitions', '2 of the 2 repetitions that gave a metric (1 gave none)')
    """
    if not lost:
        return f"{again} of {gave} repetitions{how}"
    return f"{again} of the {plural(gave, 'repetition')}{how} that gave a metric ({lost} gave none)"
