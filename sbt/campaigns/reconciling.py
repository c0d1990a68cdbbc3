"""Do the figures of a boundary fit what its runs say? Held-out runs, and all that fill the space evenly."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbt.campaigns.wording import percent, plural
from sbt.estimators.binomial import interval

if TYPE_CHECKING:
    from sbt.campaigns.boundary import BoundaryConclusion
    from sbt.campaigns.parts import CriticalShare

__all__ = ["denial", "ends", "nowhere_likely", "reconciled"]

_HARDLY = 100  # held-out runs, below which their interval is too wide to confirm a share
_MANY = 1000  # held-out runs, from which on they are as sharp as the metamodel
_MORE = 2  # times the held-out runs, from which on all even ones tell more
_VAGUE = 0.5  # of the critical share: expected on the wrong side, from which on no place is known


def nowhere_likely(found: BoundaryConclusion, where: str, condition: str, few: str | None) -> str:
    """Return how much of the space is critical, where the metamodel sees no boundary: P may be small everywhere."""
    share, wrong = found.critical_fraction or 0.0, found.expected_misclassified or 0.0
    if share < 0.5 and wrong > 0.0 and wrong >= _VAGUE * share:
        lead = f"The metamodel expects {percent(share)} of runs{where} that fill the parameter space to be critical ({condition})"
        return f"{lead}, but {f'not how far they reach: {few}' if few else 'knows no place where most are'}"
    lead = f"{percent(share)} of the parameter space{where} is critical ({condition})"
    return f"{lead} by the metamodel, but {few}" if few else lead


def denial(found: BoundaryConclusion, runs: CriticalShare, *, recorded: bool = False) -> str:
    """Return that held-out runs deny the share of the metamodel, or its certainty, or all even runs its share; else nothing.

    Recorded rows that are left over deny its certainty alone, as in `reconciled`.
    """
    share, held_out, every = found.critical_fraction or 0.0, _as_told(found, runs), _as_told(found, found.even_fraction)
    denied = not recorded and held_out is not None and not _holds(held_out, share)
    denied = denied and not (every is not None and _holds(every, share))
    whose = "held-out runs" if denied or _too_sure(found) else "runs that fill the space evenly" if _unlike_even(found) else None
    return "" if whose is None else f" The {whose} deny its figures (below): do not rely on it yet."


def reconciled(
    found: BoundaryConclusion, runs: CriticalShare, learned: int, *, recorded: bool = False, uneven: str = ""
) -> list[str]:
    """Return the critical share by the metamodel and by the held-out runs alone, whether they agree, and what runs deny.

    Recorded rows that are left over were not drawn at random: they check no share; `uneven` ones deny no certainty, either, as
    there may be more of them where the metamodel is unsure.
    """
    if recorded:
        said = f"The metamodel takes {percent(found.critical_fraction or 0.0)} of the parameter space to be critical."
        return [said, *([] if uneven else _too_sure(found))]
    return [*_by_held_out(found, runs, learned), *_unlike_even(found), *_too_sure(found)]


def _by_held_out(found: BoundaryConclusion, runs: CriticalShare, learned: int) -> list[str]:
    share, held_out, every = found.critical_fraction or 0.0, _as_told(found, runs), _as_told(found, found.even_fraction)
    where, told = ("the parameter space", "") if found.failing_fraction is None else ("what gives a metric", " that gave one")
    said = f"The metamodel takes {percent(share)} of {where} to be critical"
    if found.critical_range is not None:
        said += f" ({' to '.join(map(percent, found.critical_range))}, as runs fail or not)"
    if held_out is None:
        return [f"{said}; no held-out run checks that."]
    alone = f"the {plural(held_out.counted, 'held-out run')}{told} alone say {percent(held_out.critical_fraction or 0.0)}"
    said = f"{said}; {alone} ({ends(held_out)})"
    if not _holds(held_out, share):
        if every is not None and _holds(every, share):
            agree = f"all {plural(every.counted, 'run')} that fill the space evenly, these among them ({ends(every)})"
            return [f"{said}. It lies outside of their interval, but within that of {agree}: run more to tell which is chance."]
        return [f"{said}. The held-out runs deny that: it lies outside of their interval. Trust the runs, and run more."]
    if held_out.counted < _HARDLY:
        more = "" if every is None or every.counted < _MORE * held_out.counted or not _holds(every, share) else _in_all(every)
        return [f"{said}. So few runs hardly test it: it lies within their interval{more}."]
    sharper = share and found.critical_range is None and held_out.counted < min(_MANY, learned)
    more = f"; the metamodel's figure, which rests on {plural(learned, 'other run')}, is the sharper one" if sharper else ""
    return [f"{said}. They agree: it lies within that interval{more}."]


def _in_all(every: CriticalShare) -> str:
    return f", and within that of all {plural(every.counted, 'run')} that fill the space evenly, these among them ({ends(every)})"


def _unlike_even(found: BoundaryConclusion) -> list[str]:
    """Return that the runs that fill the space deny the share of the metamodel; nothing where they do not."""
    runs, share = _as_told(found, found.even_fraction), found.critical_fraction or 0.0
    if runs is None or found.every_combination is not None or _holds(runs, share):
        return []
    more = "critical runs lie where it does not expect them" if share < runs.low else "fewer runs are critical than it expects"
    measured = f"{percent(runs.critical_fraction or 0.0)} ({ends(runs)})"
    return [
        f"All {plural(runs.counted, 'run')} that fill the space evenly say {measured}. They deny the metamodel's"
        f" {percent(share)}: {more}. One such interval in twenty misses by chance; else trust the runs."
    ]


def _as_told(found: BoundaryConclusion, runs: CriticalShare | None) -> CriticalShare | None:
    """Return the share of runs that compares with the metamodel's: of those that gave a metric; None where none did."""
    if runs is None or runs.critical_fraction is None:
        return None
    return runs if found.failing_fraction is None else runs.given_a_metric


def _holds(runs: CriticalShare, share: float) -> bool:
    """Return whether the interval of the runs holds a share."""
    return runs.low <= share <= runs.high


def _too_sure(found: BoundaryConclusion) -> list[str]:
    """Return where the held-out runs deny the certainty that the metamodel states; nothing where they do not."""
    scores, expected = found.validation, found.expected_misclassified
    if scores is None or scores.error_rate is None or expected is None:
        return []
    least = float(interval(round(scores.error_rate * scores.n), scores.n)[0])
    if expected >= least:
        return []
    return [
        f"The metamodel is too sure: it expects {percent(expected)} on the wrong side, but of the held-out runs"
        f" {percent(scores.error_rate)} were (at least {percent(least)} with 97.5 % confidence)."
    ]


def ends(share: CriticalShare) -> str:
    """Return the ends of the interval of a share, in words."""
    return f"{percent(share.confidence)} interval {percent(share.low)} to {percent(share.high)}"
