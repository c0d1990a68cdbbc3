"""A distribution from a recorded sample: a Gaussian kernel density with a stated bandwidth.

The distribution is that of the kernel density, not of the sample: its tails are those of a normal of one
bandwidth about the outermost values. What was never recorded has a probability by the bandwidth alone.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp, ndtr

from sbt.errors import InputError
from sbt.problem.arrays import Vector
from sbt.problem.plain import check_table

__all__ = ["KernelDensity", "kernel_density", "silverman"]

_FEWEST = 10
_TERMS = 2_000_000  # distances between points and values that are held at once
_RARE = 1e-290  # mass below which its log is summed in logs
_MOST_NODES, _STEPS = 20_000, 60  # tabulated points, and steps from them at most
_NEAR = 1e-5  # step, in bandwidths, after which the next one would be of rounding
_DENSE = 32  # tabulated points a bandwidth
_STEEP, _WIDE = 2.0, 1.5  # change of slope between two of them, and their distance over the usual, up to which a cubic will do


def silverman(values: Vector) -> float:
    """Return 0.9 min(s, IQR / 1.34) n^(-1/5), the bandwidth where none is stated.

    Source:
        Silverman (1986), Density Estimation for Statistics and Data Analysis, eq. (3.31).
    """
    low, high = np.quantile(values, [0.25, 0.75])
    spreads = [s for s in (float(values.std(ddof=1)), float(high - low) / 1.34) if s > 0]
    return 0.9 * min(spreads) * len(values) ** -0.2 if spreads else 0.0


@dataclass(frozen=True, eq=False)
class KernelDensity:
    """A mixture of equally likely normals about the recorded values, with the methods of a SciPy distribution.

    Args:
        values: (n,) recorded, sorted.
        bandwidth: standard deviation of each normal > 0, in the unit of the values.
    """

    values: Vector
    bandwidth: float

    def _over(self, x: ArrayLike, of_terms: Callable[[NDArray[np.float64]], Vector]) -> Vector:
        """Return a function of the distances to all values, in bandwidths, at each x; few at a time, for the memory."""
        points = np.asarray(x, dtype=np.float64)
        flat, size = points.reshape(-1), max(_TERMS // len(self.values), 1)
        found = np.empty(len(flat))
        for k in range(0, len(flat), size):
            found[k : k + size] = of_terms((flat[k : k + size, None] - self.values) / self.bandwidth)
        return found.reshape(points.shape)

    def cdf(self, x: ArrayLike) -> Vector:
        """Return P(X <= x)."""
        return self._over(x, lambda terms: ndtr(terms).mean(axis=-1))

    def sf(self, x: ArrayLike) -> Vector:
        """Return P(X > x)."""
        return self._over(x, lambda terms: ndtr(-terms).mean(axis=-1))

    def logpdf(self, x: ArrayLike) -> Vector:
        """Return the log density."""
        norm = math.log(len(self.values) * self.bandwidth * math.sqrt(2.0 * math.pi))
        return self._over(x, lambda terms: logsumexp(-0.5 * terms**2, axis=-1)) - norm

    def ppf(self, q: ArrayLike) -> Vector:
        """Return the q quantile."""
        with np.errstate(divide="ignore"):
            return self._solved(np.log(np.asarray(q, dtype=np.float64)), 1.0)

    def isf(self, q: ArrayLike) -> Vector:
        """Return the value that is exceeded with probability q."""
        with np.errstate(divide="ignore"):
            return self._solved(np.log(np.asarray(q, dtype=np.float64)), -1.0)

    def _log_mass(self, x: ArrayLike, side: float) -> Vector:
        """Return log P(side X <= side x)."""

        def log_mass(terms: NDArray[np.float64]) -> Vector:
            mass = ndtr(side * terms).mean(axis=-1)
            found, rare = np.log(np.maximum(mass, _RARE)), mass < _RARE
            found[rare] = logsumexp(log_ndtr(side * terms[rare]), axis=-1) - math.log(len(self.values))
            return np.asarray(found)

        return self._over(x, log_mass)

    @cached_property
    def _nodes(self) -> Vector:
        """(m,) x from 40 bandwidths below the least value to 40 above the largest, dense where values are."""
        low, high, h = float(self.values[0]), float(self.values[-1]), self.bandwidth
        inner = np.linspace(low - 8.0 * h, high + 8.0 * h, min(math.ceil(_DENSE * ((high - low) / h + 16.0)) + 1, _MOST_NODES))
        outer = h * np.arange(8 * _DENSE + 1, 40 * _DENSE + 1) / _DENSE
        return np.concatenate([(low - outer)[::-1], inner, high + outer])

    @cached_property
    def _tables(self) -> Mapping[float, tuple[Vector, Vector, Vector]]:
        """For each side increasing log P(side X <= side x) at nodes, x there, and the derivative of x by it."""
        x, found = self._nodes, {}
        density = self.logpdf(x)
        for side in (1.0, -1.0):
            mass = self._log_mass(x, side)
            order = np.flatnonzero(np.diff(side * mass, prepend=-np.inf) > 0.0)[:: int(side)]
            found[side] = mass[order], x[order], side * np.exp(np.minimum(mass - density, 700.0))[order]
        return found

    def _solved(self, log_q: Vector, side: float) -> Vector:
        """Return x with log P(side X <= side x) = log_q; infinite at q = 0 and 1.

        A cubic between tabulated points; where these are far apart, or slopes change between them, Newton steps within their
        interval follow, halves of it where one leaves it.
        """
        mass, x, slope = self._tables[side]
        k = np.clip(np.searchsorted(mass, log_q) - 1, 0, len(mass) - 2)
        width = mass[k + 1] - mass[k]
        t = np.clip((log_q - mass[k]) / width, 0.0, 1.0)
        a, b = np.minimum(x[k], x[k + 1]), np.maximum(x[k], x[k + 1])
        at = (1.0 + 2.0 * t) * (1.0 - t) ** 2 * x[k] + t**2 * (3.0 - 2.0 * t) * x[k + 1]
        at = np.clip(at + width * t * (1.0 - t) * ((1.0 - t) * slope[k] - t * slope[k + 1]), a, b)
        steep = np.maximum(slope[k] / slope[k + 1], slope[k + 1] / slope[k]) > _STEEP
        rough = (steep | (b - a > _WIDE / _DENSE * self.bandwidth)).reshape(-1)
        at, a, b, flat = at.reshape(-1), a.reshape(-1).copy(), b.reshape(-1).copy(), log_q.reshape(-1)
        left = np.flatnonzero(rough & np.isfinite(flat) & (flat < 0.0))
        for _ in range(_STEPS):
            y = at[left]
            log_mass = self._log_mass(y, side)
            error = log_mass - flat[left]
            above = error * side > 0.0
            a[left], b[left] = np.where(above, a[left], y), np.where(above, y, b[left])
            moved = y - error * np.exp(np.minimum(log_mass - self.logpdf(y), 700.0)) * side
            at[left] = np.where((moved >= a[left]) & (moved <= b[left]), moved, 0.5 * (a[left] + b[left]))
            left = left[np.abs(at[left] - y) > _NEAR * self.bandwidth]
            if len(left) == 0:
                break
        at = at.reshape(log_q.shape)
        return np.asarray(np.where(np.isneginf(log_q), -side * np.inf, np.where(log_q >= 0.0, side * np.inf, at)))


def kernel_density(given: Mapping[str, float | str]) -> KernelDensity:
    """Return the distribution that `{kind: empirical, file: speeds.csv, column: v, bandwidth: 0.5}` describes.

    Args:
        given: `file` (CSV with a header) and `column`; `bandwidth` in the unit of the values, by default
            Silverman's rule.

    Raises:
        InputError: another key, a file or column that is not there, fewer than 10 finite numbers, or all equal
            without a bandwidth.
    """
    if not {"file", "column"} <= set(given) or not set(given) <= {"file", "column", "bandwidth"}:
        raise InputError(f"distribution 'empirical' takes file, column and bandwidth, but got {', '.join(given) or 'none'}")
    values = _column(str(given["file"]), str(given["column"]))
    bandwidth = given.get("bandwidth", silverman(values))
    if isinstance(bandwidth, str) or not (math.isfinite(bandwidth) and bandwidth > 0):
        raise InputError(f"distribution 'empirical' needs a bandwidth > 0, in the unit of the values, but got {bandwidth}")
    return KernelDensity(values, float(bandwidth))


@lru_cache(maxsize=32)
def _column(file: str, column: str) -> Vector:
    """Return the sorted numbers of one column of a CSV file."""
    check_table(Path(file))
    try:
        with Path(file).open(newline="", encoding="utf-8-sig") as lines:
            rows = csv.DictReader(lines)
            names = rows.fieldnames or []
            if column not in names:
                raise InputError(f"distribution 'empirical': {file} must have the column {column}, but has {', '.join(names)}")
            values = np.array([float(row[column]) for row in rows])
    except OSError as error:
        raise InputError(f"distribution 'empirical' needs a readable file, but {file}: {error.strerror}") from None
    except (TypeError, ValueError, csv.Error) as error:
        raise InputError(f"distribution 'empirical': column {column} of {file} must hold numbers, but: {error}") from None
    if len(values) < _FEWEST or not np.isfinite(values).all():
        raise InputError(f"distribution 'empirical' needs at least {_FEWEST} finite numbers, but {file} has {len(values)} rows")
    return np.sort(values)
