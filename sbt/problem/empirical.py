"""A distribution from a recorded sample: a Gaussian kernel density with a stated bandwidth.

The distribution is that of the kernel density, not of the sample: its tails are those of a normal of one
bandwidth about the outermost values. What was never recorded has a probability by the bandwidth alone.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, logsumexp, ndtr

from sbt.errors import InputError
from sbt.problem.arrays import Vector
from sbt.problem.plain import check_table

__all__ = ["KernelDensity", "kernel_density", "silverman"]

_FEWEST = 10


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

    def _terms(self, x: ArrayLike) -> NDArray[np.float64]:
        return (np.asarray(x, dtype=np.float64)[..., None] - self.values) / self.bandwidth

    def cdf(self, x: ArrayLike) -> Vector:
        """Return P(X <= x)."""
        return np.asarray(ndtr(self._terms(x)).mean(axis=-1))

    def sf(self, x: ArrayLike) -> Vector:
        """Return P(X > x)."""
        return np.asarray(ndtr(-self._terms(x)).mean(axis=-1))

    def logpdf(self, x: ArrayLike) -> Vector:
        """Return the log density."""
        terms = -0.5 * self._terms(x) ** 2
        norm = math.log(len(self.values) * self.bandwidth * math.sqrt(2.0 * math.pi))
        return np.asarray(logsumexp(terms, axis=-1)) - norm

    def ppf(self, q: ArrayLike) -> Vector:
        """Return the q quantile."""
        with np.errstate(divide="ignore"):
            return self._solved(np.log(np.asarray(q, dtype=np.float64)), 1.0)

    def isf(self, q: ArrayLike) -> Vector:
        """Return the value that is exceeded with probability q."""
        with np.errstate(divide="ignore"):
            return self._solved(np.log(np.asarray(q, dtype=np.float64)), -1.0)

    def _solved(self, log_q: Vector, side: float) -> Vector:
        """Return x with log P(side X <= side x) = log_q by bisection; infinite at q = 0 and 1."""
        low = np.full(log_q.shape, self.values[0] - 40.0 * self.bandwidth)
        high = np.full(log_q.shape, self.values[-1] + 40.0 * self.bandwidth)
        for _ in range(60):
            middle = 0.5 * (low + high)
            mass = logsumexp(log_ndtr(side * self._terms(middle)), axis=-1) - math.log(len(self.values))
            below = (mass < log_q) if side > 0 else (mass > log_q)
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(np.where(np.isneginf(log_q), -side * np.inf, np.where(log_q >= 0.0, side * np.inf, high)))


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
