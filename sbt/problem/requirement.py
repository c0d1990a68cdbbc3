"""A requirement: a safety metric and the closed interval of values that violate it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Vector

__all__ = ["CriticalInterval", "Requirement"]


@dataclass(frozen=True)
class CriticalInterval:
    """M_c = [low, high], closed; either end may be infinite.

    Raises:
        InputError: not low <= high, a NaN, or both ends infinite.

    Source:
        Winkelmann et al. (2022), section V-A.

    >>> CriticalInterval(-5.0, 0.5).contains(np.array([-6.0, -5.0, 0.5, 0.6])).tolist()
    [False, True, True, False]
    """

    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise InputError(f"a critical interval needs low <= high, but got [{self.low}, {self.high}]")
        if math.isinf(self.low) and math.isinf(self.high):
            raise InputError("a critical interval needs at least one finite end, but got [-inf, inf]")

    def contains(self, y: Vector) -> Mask:
        """Return (n,) booleans: y in M_c. NaN is not contained."""
        return (np.asarray(y) >= self.low) & (np.asarray(y) <= self.high)

    def margin(self, y: Vector) -> Vector:
        """Return (n,) the signed distance of y to M_c, <= 0 where critical, in the unit of y."""
        return np.maximum(self.low - np.asarray(y), np.asarray(y) - self.high)


@dataclass(frozen=True)
class Requirement:
    """The name of a safety metric and the values of it that violate the requirement."""

    metric: str
    critical: CriticalInterval
