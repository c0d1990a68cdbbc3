"""Problems in which a part of the runs gives no metric, as where SUMO refuses a start or a controller leaves the road.

The share of failing runs and where they lie are known; P counts a run that fails as uncritical.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector
from sbt.testbeds.problem import Function, Problem, Truth
from sbt.testbeds.search import PROBLEMS as SEARCH

__all__ = ["PROBLEMS"]

Fails = Callable[[Points], Mask]


def failing(x: Points, function: Function, fails: Fails) -> Vector:
    """Another testbed of which a part of the box gives no metric.

    Source:
        Constructed.
    """
    return np.where(fails(x), np.nan, function(x))


def _above_diagonal(x: Points) -> Mask:
    """Half of the box: x4 > x2. The needle's bowl descends into it; the needle lies apart."""
    return x[:, 3] > x[:, 1]


def _above_wave(x: Points) -> Mask:
    """A wavy half of the box, across the sheets of `wavy_level_d3`."""
    return x[:, 1] > 0.5 + 0.2 * np.sin(6.0 * x[:, 0])


def _two_cylinders(x: Points) -> Mask:
    """Two cylinders, 37 % of the box, in the inputs x1 and x5 of `hartmann6_1e-3`; both minima lie outside."""
    first = np.hypot(x[:, 0] - 0.75, x[:, 4] - 0.55)
    second = np.hypot(x[:, 0] - 0.15, x[:, 4] - 0.85)
    return (first < 0.3) | (second < 0.2)


def _problem(
    name: str, title: str, of: str, fails: Fails, share: float, error: float, modes: int | None
) -> Problem:  # fmt: skip
    """Return the testbed `of` without the metric where `fails`, and its critical share of the box."""
    whole = next(p for p in SEARCH if p.name == of)
    function = partial(failing, function=whole.function, fails=fails)
    return Problem(name, title, whole.parameters, function, whole.critical, Truth(share, error, modes, share, error))


PROBLEMS = (
    _problem("needle_half_fails", "A needle; half of the runs fail", "needle_d4_1e-3", _above_diagonal, 1e-3, 0.0, 1),
    _problem("hartmann6_third_fails", "Two rare minima; 38 % of the runs fail", "hartmann6_1e-3", _two_cylinders, 0.0024282,
             1.1e-05, 2),
    _problem("wavy_half_fails", "Several sheets; half of the runs fail", "wavy_level_d3", _above_wave, 0.081039, 6.4e-05, None),
)  # fmt: skip
