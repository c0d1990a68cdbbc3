"""Numbers in sentences: how conclusions and reports write values, shares and counts."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sbt.problem.combination import MARGIN, CombinedRequirement
from sbt.problem.plain import unit_of
from sbt.problem.requirement import Requirement
from sbt.store.history import History

__all__ = [
    "NOTHING", "digits_beside", "digits_of", "estimating", "failed_words", "input_value", "input_widths", "measured",
    "mixture_shares", "narrow_digits", "number", "percent", "plural", "requirement_words", "unit_of", "widening", "written_unit",
]  # fmt: skip

_NIL = 1e-30  # a rounding error of what is zero
_PLAIN, _MOST_DIGITS = 6, 16  # digits before the point that are written out; those that a double has
_EXACT = 1e9  # below it whole numbers are written out
_NO_SHARE = 1e-15  # a share that is a tail of a metamodel's, and nothing else
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NOTHING = "\N{EN DASH}"
"""Stands where there is no value."""


def number(value: Any, digits: int = 4) -> str:
    """Return a number for people; a dash where there is none.

    >>> number(0.123456), number(None), number(1234567.0)
    ('0.1235', '–', '1.235e+06')
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return NOTHING
    if isinstance(value, (bool, str)):
        return str(value)
    value = 0.0 if isinstance(value, float) and abs(value) < _NIL else value
    return f"{value:,}" if isinstance(value, int) else f"{value:.{digits}g}"


def digits_of(value: float, width: float = math.inf, digits: int = 3, sure: float = math.inf) -> int:
    """Return how many significant digits tell a value of an input: so many, or more where the range is narrow.

    Rounding is to change it by at most 1 % of the range where three digits are asked (each more: a tenth of that), and by no
    more than it is uncertain; thousands are written out.

    Args:
        value: finite, not 0.
        width: of the input's range.
        digits: that are enough where the range begins at 0.
        sure: how uncertain the value is.
    """
    before = math.floor(math.log10(abs(value))) + 1
    finest = 2.0 * min(width * 10.0 ** (1 - digits) if width > 0.0 else math.inf, sure if sure > 0.0 else math.inf)
    after = before - math.floor(math.log10(finest)) if math.isfinite(finest) else 0
    return min(max(digits, after, before if before <= _PLAIN else 0), _MOST_DIGITS)


def input_value(value: Any, width: float = math.inf, digits: int = 3, sure: float = math.inf) -> str:
    """Return a value of an input for people, see `digits_of`; whole numbers in full.

    >>> input_value(3605.6249, 10.0), input_value(0.33912, 1.0), input_value(3605.6249), input_value("truck")
    ('3605.6', '0.339', '3606', 'truck')
    """
    if not isinstance(value, float) or not math.isfinite(value) or abs(value) < _NIL:
        return number(value, digits)
    if value.is_integer() and abs(value) < _EXACT:
        return f"{value:.0f}"
    return number(value, digits_of(value, width, digits, sure))


def input_widths(history: History) -> dict[str, float]:
    """Return how far the values of each input reach in these runs, which digits follow from; infinite where they are alike."""
    if len(history) == 0:
        return {}
    widths = np.ptp(history.x, axis=0)
    return {name: float(width) if width > 0.0 else math.inf for name, width in zip(history.names, widths, strict=True)}


def narrow_digits(inputs: Mapping[str, Any], widths: Mapping[str, float]) -> dict[str, int]:
    """Return how many significant digits tell values of inputs of a narrow range, of those alone that three do not tell."""
    numbers = {name: value for name, value in inputs.items() if isinstance(value, float) and abs(value) >= _NIL}
    finite = {name: value for name, value in numbers.items() if math.isfinite(value)}
    digits = {name: digits_of(value, widths.get(name, math.inf)) for name, value in finite.items()}
    return {name: n for name, n in digits.items() if n > digits_of(finite[name])}


def failed_words(history: History) -> str:
    """Return how many of these runs failed, and why the first of them did; "" where none did."""
    failed = np.flatnonzero(~history.ok)
    if len(failed) == 0:
        return ""
    first = history.record(int(failed[0]))
    return f"{len(failed):,} of {plural(len(history), 'run')} failed; run {first.index}: {first.reason}"


def percent(value: float) -> str:
    """Return a share as percentage; the space before the sign does not break.

    >>> percent(0.0123) == "1.23\N{NO-BREAK SPACE}%", percent(9.5e-89) == "0\N{NO-BREAK SPACE}%"
    (True, True)
    """
    value = 0.0 if abs(value) < _NO_SHARE else value
    return f"{100 * value:.3g}\N{NO-BREAK SPACE}%"


def plural(n: int, noun: str) -> str:
    """Return a count with its noun.

    >>> plural(1, "run"), plural(1200, "run")
    ('1 run', '1,200 runs')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def written_unit(unit: str) -> str:
    """Return a unit as it is printed.

    >>> written_unit("m/s^2"), written_unit("1/s^3"), written_unit("s")
    ('m/s²', '1/s³', 's')
    """
    return re.sub(r"\^-?\d+", lambda power: power[0][1:].translate(_RAISED), unit)


def measured(name: str, value: Any, unit: str = "", digits: int = 3) -> str:
    """Return a value with its name and unit.

    >>> measured("a_co", -9.7352, "m/s^2"), measured("kind", "truck")
    ('a_co -9.74 m/s²', 'kind truck')
    """
    return f"{name} {number(value, digits)} {written_unit(unit)}".rstrip()


def digits_beside(value: float, requirement: Requirement, digits: int = 3) -> int:
    """Return how many significant digits tell a metric: so many, or more where it would be on the other side of the edge."""
    critical = MARGIN if requirement.combined else requirement.critical
    told = np.array([value, *(float(f"{value:.{n}g}") for n in range(digits, _MOST_DIGITS))])
    same = critical.contains(told) == critical.contains(told[:1])
    return digits + int(same[1:].argmax()) if same[1:].any() else _MOST_DIGITS


def requirement_words(requirement: Requirement, unit: str, units: Mapping[str, str] | None = None) -> str:
    """Return when a run is critical; `units` by metric are those of a combination's."""
    if isinstance(requirement, CombinedRequirement):
        joint, units = " or " if requirement.how == "any" else " and ", units or {}
        said = [requirement_words(item, unit_of(units, item.metric), units) + _called(item) for item in requirement.items]
        nested = (isinstance(item, CombinedRequirement) for item in requirement.items)
        return joint.join(f"({words})" if inner else words for words, inner in zip(said, nested, strict=True))
    low, high, name = requirement.critical.low, requirement.critical.high, requirement.metric
    tail = f" {written_unit(unit)}" if unit else ""
    if math.isinf(low):
        return f"{name} ≤ {high:g}{tail}"
    if math.isinf(high):
        return f"{name} ≥ {low:g}{tail}"
    return f"{name} in [{low:g}, {high:g}]{tail}"


def _called(requirement: Requirement) -> str:
    """Return the name of one of several requirements, where it has one of its own."""
    return f" ({requirement.name})" if requirement.name and requirement.name != requirement.metric else ""


def mixture_shares(weights: Mapping[str, float]) -> str:
    """Return how much of a mixture each part is, the largest first.

    >>> mixture_shares({"gp": 0.25, "et": 0.75, "ensemble": 0.0}).replace("\N{NO-BREAK SPACE}", " ")
    '75 % et, 25 % gp'
    """
    parts = sorted(((-weight, name) for name, weight in weights.items() if weight > 0.0))
    return ", ".join(f"{100 * -weight:.0f}\N{NO-BREAK SPACE}% {name}" for weight, name in parts)


def estimating(recorded: bool) -> str:
    """Return what says how probable failures are; of recorded rows only what made them can."""
    return f"campaign: estimation{' with the simulator that the rows are of' if recorded else ''}"


def widening(recorded: bool) -> str:
    """Return what to do where all is critical; recorded rows have no wider ranges."""
    wider = "" if recorded else "widen the ranges of the inputs, or "
    return f"{wider}change the requirement: where all is critical there is nothing to tell apart"
