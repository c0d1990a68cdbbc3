"""Failure rates near critical runs of a noisy simulator: from which runs were critical, not from how deep they were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import xlogy

from sbt.metamodels.warp import JointWarp, warp_around
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.combination import MARGIN
from sbt.samplers.noise import hidden_by_noise
from sbt.samplers.search import Search

__all__ = ["LocalRates", "local_rates", "next_repetitions"]

_WIDTHS = (0.4, 0.7, 1.0)  # of the kernel, in length scales; 0.15 counts too few runs (docs/measured/falsification.md)
_RADII = (0.05, 0.1, 0.2)  # and in diagonals of the cube: heavy noise hides all length scales
_WEIGHTS = np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 1e9])[:, None]  # of P(critical), in runs; last: P alone
_LEAST = 1e-4  # rates within this of 0 and 1 are not told apart
_CHUNK = 512  # inputs whose neighbours are weighed at once
_CANDIDATES = 2  # of each mode: where its rate may be largest


@dataclass(frozen=True, eq=False)
class LocalRates:
    """Failure rates at runs: for their order. They are smoothed, and their deviations are no interval.

    Args:
        mean: (n,) rates.
        std: (n,) standard deviations.
    """

    mean: Vector
    std: Vector


def local_rates(
    search: Search, u: Points, y: Vector, counted: Mask, again: Points, critical_again: Mask, rng: np.random.Generator
) -> LocalRates:
    """Return the failure rate at each run, from the share of critical ones among the runs near it and its repetitions.

    A rate is the mean of a beta distribution: critical and uncritical runs near, weighed by a Gaussian kernel along the length
    scales of a Gaussian process of the metric, or in the cube, beside the P(critical) that this process predicts from all other
    runs, with a weight in runs. Widths and weights are averaged by the likelihood of what was critical at each input, predicted
    from the others: where metrics tell rates, P decides, where rare failures are deep, counts do. The first critical run at the
    inputs is left out of its own rate, for it was chosen by its result.

    Args:
        search: what is searched.
        u: (n, d) runs with a metric in the unit cube, n >= 2.
        y: (n,) their metric.
        counted: (n,) the run's seed was drawn: only such runs tell how often something happens.
        again: (m, d) repetitions of some of them with fresh seeds.
        critical_again: (m,) whether these were critical.
        rng: of the fit.

    Source:
        Beta-binomial smoothing over a kernel: Goetschalckx, Poupart and Hoey (2011), Continuous correlated beta processes, IJCAI.
    """
    inputs, critical = search.columns(u), search.critical.contains(y)
    probability, lengthscale = _left_out(search, u, y, inputs, rng)
    every = np.vstack([u, again])
    _, first, group = np.unique(every, axis=0, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    own = group[: len(u)]
    prior = np.bincount(own, probability, len(first)) / np.maximum(np.bincount(own, minlength=len(first)), 1)
    searched = np.bincount(own, counted & critical, len(first))
    hits = searched + np.bincount(group[len(u) :], critical_again, len(first))
    runs = np.bincount(own, counted, len(first)) + np.bincount(group[len(u) :], minlength=len(first))
    at, cube = search.columns(every[first]) / lengthscale, search.cube.embedded(every[first]) / np.sqrt(u.shape[1])
    counts = np.stack([hits, runs], axis=1)
    near = np.concatenate([_near(at, counts, _WIDTHS), _near(cube, counts, _RADII)])  # (widths, groups, 2)
    near_hits, near_runs = near[:, None, :, 0] + _WEIGHTS * prior, near[:, None, :, 1] + _WEIGHTS  # (widths, weights, groups)
    expected = np.clip(near_hits / near_runs, _LEAST, 1.0 - _LEAST)
    likelihood = (xlogy(hits, expected) + xlogy(runs - hits, 1.0 - expected)).sum(axis=2)
    share = np.exp(likelihood - likelihood.max())[:, :, None]
    share /= share.sum()
    chosen = np.minimum(searched, 1.0)
    total = near_runs + runs - chosen
    rate = (near_hits + hits - chosen) / total
    mean = (share * rate).sum(axis=(0, 1))
    square = (share * (rate**2 + rate * (1.0 - rate) / (total + 1.0))).sum(axis=(0, 1))
    return LocalRates(mean[own], np.sqrt(np.maximum(square - mean**2, 0.0))[own])


def next_repetitions(rates: LocalRates, modes: Sequence[Sequence[int]], n: int) -> list[int]:
    """Return n rows to repeat: in turn the one of the largest rate, and the one that most likely exceeds it.

    Candidates are the two of the largest rates in each mode.

    Args:
        rates: at all rows.
        modes: rows of each, with distinct inputs; two rows in all at least.
        n: repetitions wanted.

    Source:
        The leader and its strongest challenger: Kalyanakrishnan et al. (2012), PAC subset selection in stochastic multi-armed
        bandits, ICML (LUCB).
    """
    arms = [row for rows in modes for row in sorted(rows, key=lambda row: -rates.mean[row])[:_CANDIDATES]]
    leader, *rest = sorted(arms, key=lambda row: -rates.mean[row])

    def behind(row: int) -> float:
        spread = np.hypot(rates.std[leader], rates.std[row])
        return float((rates.mean[leader] - rates.mean[row]) / max(spread, 1e-12))

    return [(leader, min(rest, key=behind))[k % 2] for k in range(n)]


def _left_out(search: Search, u: Points, y: Vector, inputs: Points, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Return (n,) P(critical) of each run as all others predict it, and the length scales of the inputs."""
    from sbt.metamodels.gaussian_process import GaussianProcess

    warp = warp_around(y, search.critical)
    interval = MARGIN if isinstance(warp, JointWarp) else warp.interval(search.critical)
    process = GaussianProcess(nu=2.5, input_noise=False, kernels=1)
    process = process.for_noise if hidden_by_noise(u, search.margins(y)) else process
    learned = warp.values(y)
    fitted = process.fit(inputs, learned, rng)
    log_probability = fitted.leave_one_out(inputs, learned).log_probability(interval)[0]
    return np.exp(log_probability), fitted.hyper.roughness**-0.5


def _near(at: Points, counts: Points, widths: Sequence[float]) -> NDArray[np.float64]:
    """Return (widths, g, c) sums of counts (g, c) at all other points than each, weighed by their distance from at (g, d)."""
    found = np.empty((len(widths), *counts.shape))
    for start in range(0, len(at), _CHUNK):
        part = slice(start, start + _CHUNK)
        squares = cdist(at[part], at, "sqeuclidean")
        squares[np.arange(len(squares)), np.arange(len(squares)) + start] = np.inf
        for k, width in enumerate(widths):
            found[k, part] = np.exp(-0.5 * squares / width**2) @ counts
    return found
