"""Numbers in sentences: how conclusions and reports write values, shares and counts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

__all__ = ["NOTHING", "mixture_shares", "number", "percent", "plural"]

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
    return f"{value:,}" if isinstance(value, int) else f"{value:.{digits}g}"


def percent(value: float) -> str:
    """Return a share as percentage; the space before the sign does not break.

    >>> percent(0.0123) == "1.23\N{NO-BREAK SPACE}%"
    True
    """
    return f"{100 * value:.3g}\N{NO-BREAK SPACE}%"


def plural(n: int, noun: str) -> str:
    """Return a count with its noun.

    >>> plural(1, "run"), plural(1200, "run")
    ('1 run', '1,200 runs')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def mixture_shares(weights: Mapping[str, float]) -> str:
    """Return how much of a mixture each part is, the largest first.

    >>> mixture_shares({"gp": 0.25, "et": 0.75, "ensemble": 0.0}).replace("\N{NO-BREAK SPACE}", " ")
    '75 % et, 25 % gp'
    """
    parts = sorted(((-weight, name) for name, weight in weights.items() if weight > 0.0))
    return ", ".join(f"{100 * -weight:.0f}\N{NO-BREAK SPACE}% {name}" for weight, name in parts)
