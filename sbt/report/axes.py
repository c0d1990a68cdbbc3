"""Ranges of axes, and the critical interval on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.requirement import CriticalInterval, Measured, Requirement, within_scale
from sbt.report.style import CRITICAL, REGION

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["padded", "reach", "shade"]


def shade(critical: CriticalInterval, ends: tuple[float, float], ax: Axes, *, along: str) -> None:
    """Shade the critical interval within `ends`."""
    beyond = ends[1] - ends[0]
    low, high = max(critical.low, ends[0] - beyond), min(critical.high, ends[1] + beyond)
    span, line = (ax.axvspan, ax.axvline) if along == "x" else (ax.axhspan, ax.axhline)
    span(low, high, color=REGION, linewidth=0, zorder=0, label="critical")
    for end in (critical.low, critical.high):
        if ends[0] <= end <= ends[1]:
            line(end, color=CRITICAL, linewidth=0.9, zorder=1)


def reach(y: Vector, critical: CriticalInterval, middle: float = 1.0) -> tuple[float, float]:
    """Return the range of an axis that shows the values and the nearest end of the critical interval."""
    tail = (1 - middle) / 2
    ends = [e for e in (critical.low, critical.high) if np.isfinite(e)]
    low, high = (float(np.quantile(y, q)) for q in (tail, 1 - tail)) if len(y) else (min(ends), max(ends))
    nearest = min(ends, key=lambda e: max(low - e, e - high, 0.0))
    low, high = min(low, nearest), max(high, nearest)
    gap = 0.05 * (high - low) if high > low else 0.5
    return low - gap, high + gap


def drawn(requirement: Requirement, runs: Measured) -> Vector:
    """Return (n,) the numbers that runs are drawn at: what they are told by, infinities at the ends of the scale."""
    return within_scale(requirement.told(runs), requirement.critical)


def padded(low: float, high: float) -> tuple[float, float]:
    """Return the range with a little air, so that runs on its ends are whole markers."""
    return low - 0.02 * (high - low), high + 0.02 * (high - low)
