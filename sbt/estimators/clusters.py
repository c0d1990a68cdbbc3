"""Intervals from runs that come in clusters: those that began with the same warmed traffic are not independent of each other.

Source:
    Korn and Graubard (1998), Confidence intervals for proportions with small expected number of positive counts estimated
    from survey data, Survey Methodology 24: the effective number of runs; Cameron and Miller (2015), A practitioner's guide to
    cluster-robust inference, doi 10.3368/jhr.50.2.317: the variance between clusters with K / (K - 1), and t with K - 1 degrees.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from sbt.problem.arrays import Vector

__all__ = ["clustered_error", "deviations", "effective_runs", "reach"]


def clustered_error(terms: Vector, cluster: Vector) -> float | None:
    """Return the standard error of a sum of terms of mean zero that are independent between clusters, not within.

    Args:
        terms: (n,) what each run adds to the estimate, less the mean.
        cluster: (n,) number of the cluster of each run.

    Returns:
        The error; None with a single cluster, whose difference from others is not known.
    """
    names, places = np.unique(cluster, return_inverse=True)
    k = len(names)
    if k < 2:
        return None
    sums = np.bincount(places, weights=terms)
    return math.sqrt(k / (k - 1.0) * float((sums**2).sum()))


def deviations(values: Vector, share: Vector, seeds: NDArray[np.int64], clusters: int) -> Vector:
    """Return (k,) what each cluster of a pool adds to a sum over it, less its part of that sum.

    Args:
        values: (n,) terms of the sum.
        share: (n,) of the pool that a term stands for, any scale.
        seeds: (n,) of the pairs; modulo their number they choose the cluster.
        clusters: their number k, >= 1.
    """
    sums, part = (np.bincount(seeds % clusters, each, clusters) for each in (values, share))
    return np.asarray(sums - part / part.sum() * values.sum())


def reach(error: float, clusters: int, confidence: float) -> float:
    """Return how far a one-sided limit at this confidence is from the estimate.

    >>> round(reach(0.1, 20, 0.975), 4)
    0.2093
    """
    return float(stdtrit(clusters - 1.0, confidence)) * error


def effective_runs(critical: Vector, cluster: Vector, confidence: float = 0.95) -> float:
    """Return the number of independent runs that say as much of a share as these, at most their number.

    Args:
        critical: (n,) 1 where a run was critical, else 0.
        cluster: (n,) number of the cluster of each run.
        confidence: of the two-sided interval.
    """
    n, share = len(critical), float(np.mean(critical)) if len(critical) else 0.0
    error = clustered_error((critical - share) / max(n, 1), cluster)
    if error is None or not 0.0 < share < 1.0:
        return float(n)  # nothing, or all, was critical: the spread between clusters is not known
    tail = 0.5 * (1.0 + confidence)
    few = float(stdtrit(n - 1.0, tail)) / float(stdtrit(len(np.unique(cluster)) - 1.0, tail))
    independent = share * (1.0 - share) / max(error**2, 1e-300)
    return min(float(n), max(independent * few**2, 1.0))
