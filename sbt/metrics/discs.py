"""Two persons: discs, which touch wherever they turn."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from sbt.problem.arrays import Vector

__all__ = ["disc_span", "discs_of", "is_person"]

_PERSON = 1.0
"""Whose body is shorter and narrower than this (m) is a person."""


class _Body(Protocol):
    """A rectangle, or (n,) of them."""

    @property
    def length(self) -> Any: ...
    @property
    def width(self) -> Any: ...


def is_person(body: _Body) -> Any:
    """Return whether a body, or (n,) whether each of some, is that of a person."""
    return np.maximum(body.length, body.width) < _PERSON


def discs_of(a: _Body, b: _Body) -> Any:
    """Return the distance at which two persons touch (m), NaN where one of them is none; None where none are."""
    single = isinstance(a.length, float | int) and isinstance(b.length, float | int)
    if single and max(a.length, a.width, b.length, b.width) >= _PERSON:
        return None  # quickly, as this is asked of every pair at every step
    larger = [np.maximum(each.length, each.width) for each in (a, b)]
    persons = np.maximum(*larger) < _PERSON
    if not np.any(persons):
        return None
    lesser = [np.minimum(each.length, each.width) for each in (a, b)]
    return np.where(persons, 0.5 * (lesser[0] + lesser[1]), np.nan)


def disc_span(
    span: tuple[Vector, Vector], x: Vector, y: Vector, rate_x: Vector, rate_y: Vector, reach: Any
) -> tuple[Vector, Vector]:
    """Return (t,) the times at which moving discs begin and end to overlap; begin > end if never.

    Args:
        span: what holds where there are no discs.
        x: (t,) from the centre of one to that of the other at time 0.
        y: likewise.
        rate_x: its rate of change.
        rate_y: likewise.
        reach: (t,) sum of the radii; NaN: no discs.
    """
    rate = rate_x * rate_x + rate_y * rate_y
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        middle, inside = -(x * rate_x + y * rate_y) / rate, reach * reach - (x * rate_y - y * rate_x) ** 2 / rate
        half = np.sqrt(inside / rate)
    touch = x * x + y * y <= reach * reach
    still, past = rate == 0.0, ~(inside >= 0.0)
    enter = np.where(still, np.where(touch, -np.inf, np.inf), np.where(past, np.inf, middle - half))
    leave = np.where(still, np.where(touch, np.inf, -np.inf), np.where(past, -np.inf, middle + half))
    return np.where(np.isnan(reach), span[0], enter), np.where(np.isnan(reach), span[1], leave)
