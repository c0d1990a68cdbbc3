"""Exact binomial limits of a probability from `hits` of `n` independent runs.

Source:
    Clopper and Pearson (1934), doi 10.1093/biomet/26.4.404.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv

from sbt.problem.arrays import Vector

__all__ = ["interval", "lower", "unmet_draws", "upper"]


def lower(hits: ArrayLike, n: ArrayLike, confidence: float) -> Vector:
    """Return the one-sided lower limit at this confidence: 0 without a hit.

    Args:
        hits: critical runs, 0 to n; of any shape that broadcasts with `n`.
        n: runs; without any, the limit is 0.
        confidence: in (0, 1).
    """
    return _lower(hits, n, 1.0 - confidence)


def upper(hits: ArrayLike, n: ArrayLike, confidence: float) -> Vector:
    """Return the one-sided upper limit at this confidence: 1 where every run is a hit.

    Args:
        hits: critical runs, 0 to n; of any shape that broadcasts with `n`.
        n: runs; without any, the limit is 1.
        confidence: in (0, 1).

    >>> upper([0, 0, 100], [100, 300, 100], 0.95).round(4).tolist()  # 3 / n without a hit
    [0.0295, 0.0099, 1.0]
    """
    hits, n = np.asarray(hits, np.float64), np.asarray(n, np.float64)
    return np.where(hits < n, betaincinv(hits + 1.0, np.maximum(n - hits, 0.5), confidence), 1.0)


def unmet_draws(bound: float, confidence: float) -> int:
    """Return how many runs without a hit have this upper limit, in (0, 1), at this confidence: the inverse of `upper`.

    >>> unmet_draws(float(upper(0, 24, 0.95)), 0.95)
    24
    """
    return round(math.log1p(-confidence) / math.log1p(-bound))


def interval(hits: ArrayLike, n: ArrayLike, confidence: float = 0.95) -> tuple[Vector, Vector]:
    """Return the lower and the upper end of the two-sided interval, with half of the error on each side.

    Args:
        hits: critical runs, 0 to n; of any shape that broadcasts with `n`.
        n: runs; without any, the interval is (0, 1).
        confidence: in (0, 1).

    >>> low, high = interval(10, 50)
    >>> round(float(low), 4), round(float(high), 4)
    (0.1003, 0.3372)
    """
    tail = (1.0 - confidence) / 2.0
    return _lower(hits, n, tail), upper(hits, n, 1.0 - tail)


def _lower(hits: ArrayLike, n: ArrayLike, tail: float) -> Vector:
    hits, n = np.asarray(hits, np.float64), np.asarray(n, np.float64)
    return np.where(hits > 0, betaincinv(np.maximum(hits, 0.5), n - hits + 1.0, tail), 0.0)
