"""One input of a logical scenario: its range, unit and distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Vector
from sbt.problem.distribution import Distribution, TruncatedDistribution

__all__ = ["TAIL", "Parameter"]

TAIL = 1e-6
"""An infinite range is searched between these quantiles of its distribution."""


@dataclass(frozen=True)
class Parameter:
    """One input: a range with a unit, and the distribution of the values in it (None: uniform).

    Args:
        name: an identifier.
        low, high: ends of the range in `unit`, both included; infinite only with a distribution.
        unit: as printed, "" for a pure number.
        distribution: distribution of the input, truncated to the range.
        kind: "integer" inputs take the whole numbers of the range.
        description: one line for reports.

    Raises:
        InputError: not low < high, a NaN, an infinite range without a distribution, or an integer range
            whose ends are not whole numbers.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    distribution: Distribution | None = None
    kind: Literal["continuous", "integer"] = "continuous"
    description: str = ""

    def __post_init__(self) -> None:
        for end in ("low", "high"):
            value = getattr(self, end)
            if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
                raise InputError(f"input {self.name}: {end} must be a number, but got {value!r}")
        if not isinstance(self.unit, str):
            raise InputError(f"input {self.name}: a unit must be text (a distribution comes after it), but got {self.unit!r}")
        if not self.name.isidentifier():
            raise InputError(f"an input's name must be an identifier, but got '{self.name}'")
        if not self.low < self.high:
            raise InputError(f"input {self.name}: low < high must hold, but got low {self.low}, high {self.high}")
        if self.kind not in ("continuous", "integer"):
            raise InputError(f"input {self.name}: kind must be continuous or integer, but got '{self.kind}'")
        finite = math.isfinite(self.low) and math.isfinite(self.high)
        if not finite and (self.distribution is None or self.distribution.kind == "uniform"):
            raise InputError(f"input {self.name}: an infinite range needs a distribution, but got none")
        if self.kind == "integer" and not (finite and self.low % 1 == 0 and self.high % 1 == 0):
            raise InputError(f"input {self.name}: an integer range needs whole ends, but got [{self.low}, {self.high}]")
        if self.distribution is not None:
            self.distribution.truncated(*self._support)

    @property
    def range(self) -> str:
        """The range as printed, with its unit."""
        return f"[{self.low:g}, {self.high:g}] {self.unit}".rstrip()

    @property
    def _support(self) -> tuple[float, float]:
        """Return the range of the distribution; whole numbers own half a unit on each side."""
        half = 0.5 if self.kind == "integer" else 0.0
        return self.low - half, self.high + half

    @cached_property
    def truncated(self) -> TruncatedDistribution | None:
        """The truncated distribution, None where the input is uniform on its range."""
        if self.distribution is None or self.distribution.kind == "uniform":
            return None
        return self.distribution.truncated(*self._support)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Finite ends for designs: the range, or its 1e-6 quantiles where it is infinite."""
        if self.truncated is None or (math.isfinite(self.low) and math.isfinite(self.high)):
            return self.low, self.high
        low = self.low if math.isfinite(self.low) else float(self.truncated.ppf(np.array(TAIL)))
        high = self.high if math.isfinite(self.high) else float(self.truncated.isf(np.array(TAIL)))
        return low, high

    @property
    def centre(self) -> float:
        """Middle of the bounds, a whole number for integer inputs."""
        low, high = self.bounds
        return float(math.floor((low + high) / 2)) if self.kind == "integer" else (low + high) / 2

    def contains(self, x: Vector) -> Mask:
        """Return (n,) booleans: the value is in the range (and whole, for integers)."""
        x = np.asarray(x, dtype=np.float64)
        inside = (x >= self.low) & (x <= self.high)
        return inside & (x % 1 == 0) if self.kind == "integer" else inside

    def from_unit(self, u: Vector) -> Vector:
        """Map [0, 1] onto the bounds: linearly, in equal cells for integers."""
        low, high = self.bounds
        if self.kind == "integer":
            return np.clip(np.floor(low + u * (high - low + 1)), low, high)
        return np.clip(low + u * (high - low), low, high)

    def to_unit(self, x: Vector) -> Vector:
        """Map the bounds onto [0, 1]; integers to the middle of their cell."""
        low, high = self.bounds
        if self.kind == "integer":
            return (x - low + 0.5) / (high - low + 1)
        return (x - low) / (high - low)

    def from_normal(self, z: Vector) -> Vector:
        """Map a standard-normal score to the value of the same probability."""
        z = np.asarray(z, dtype=np.float64)
        low, high = self._support
        if self.truncated is None:
            x = np.where(z <= 0, low + (high - low) * ndtr(z), high - (high - low) * ndtr(-z))
        else:
            x = np.where(z <= 0, self.truncated.ppf(ndtr(z)), self.truncated.isf(ndtr(-z)))
        if self.kind == "integer":
            return np.clip(np.floor(x + 0.5), self.low, self.high)
        return np.clip(x, self.low, self.high)

    def to_normal(self, x: Vector) -> Vector:
        """Map a value to its standard-normal score (integers: of their cell's middle)."""
        low, high = self._support
        if self.truncated is None:
            below, above = (x - low) / (high - low), (high - x) / (high - low)
        else:
            below, above = self.truncated.cdf(x), self.truncated.sf(x)
        return np.where(below <= above, ndtri(below), -ndtri(above))

    def log_density(self, x: Vector) -> Vector:
        """Return (n,) log density of the value, log mass for integers, -inf outside the range."""
        x = np.asarray(x, dtype=np.float64)
        with np.errstate(divide="ignore"):
            if self.kind == "integer":
                log_p = np.log(self._cell_mass(x))
            elif self.truncated is None:
                log_p = np.full(x.shape, -math.log(self.high - self.low))
            else:
                log_p = self.truncated.log_density(x)
        return np.where(self.contains(x), log_p, -np.inf)

    def _cell_mass(self, x: Vector) -> Vector:
        """Return the probability of the whole number x."""
        if self.truncated is None:
            return np.full(x.shape, 1.0 / (self.high - self.low + 1))
        upper = self.truncated.sf(x - 0.5) - self.truncated.sf(x + 0.5)
        lower = self.truncated.cdf(x + 0.5) - self.truncated.cdf(x - 0.5)
        return np.where(self.truncated.cdf(x) > 0.5, upper, lower)
