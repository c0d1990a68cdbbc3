"""Estimation by two levels of fidelity: coarse runs of many pairs, runs of the scenario where the coarse ones say it matters.

    P = (1/N) [ sum over the pool of g1 + sum over coarse runs of (g2 - g1) / r1 + sum over fine runs of (1 - g2) / (r1 r2) ]

over a pool of N pairs (x, seed) from the inputs' distribution. g1 is the belief that a pair is critical before any run of it,
g2 the one after its coarse run; r1 and r2 are the known probabilities with which pairs were run. Unbiased for any beliefs that
were learned from earlier pairs only: each sum corrects the one before it.

Source:
    Neyman (1938), doi 10.1080/01621459.1938.10503378: double sampling; Saerndal, Swensson and Wretman (1992), chapter 9: the
    difference estimator in two phases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sbt.estimators.clusters import deviations
from sbt.estimators.importance import at_most_one, rows_at
from sbt.problem.arrays import Vector

__all__ = ["Shares", "TwoPhases", "drawn", "inclusion", "split", "split_as_if_normal"]

_EVEN, _EVEN_FINE = 0.2, 0.4
"""Share of the draws that no belief has a say in, of all pairs and of those that were run coarse: it bounds what a belief misses.
A fault that coarse runs lack is met in the latter alone; a larger share costs little (7 % of the error at .5)."""
_LARGEST_CORRELATION = 0.995
_LEAST = 0.05
"""Share of the coarse runs that runs of the scenario follow at least."""
_NO_DOUBT = 1e-6
_THRESHOLDS = 40
_CLEARLY, _AS_IF = 0.95, 0.8
"""Variance times cost over that without, below which what was learned is used: by critical pairs, and as if all were normal."""
_RESAMPLES, _SURELY, _DOUBT = 60, 0.9, 1.0
"""Resamples of the pairs, and in what share of them it must be so; standard deviations that a correlation is lowered by."""


def inclusion(size: Vector, weight: Vector, n: int, *, fine: bool = False) -> Vector:
    """Return (m,) probabilities of being drawn, sum n: in proportion to a size, a share to the weight alone, none above 1.

    Args:
        size: (m,) what a draw would tell: weight times the standard deviation of what it corrects.
        weight: (m,) > 0, of a point under the inputs' distribution.
        n: number of draws, at most m.
        fine: of pairs that were run coarse: two fifths go to the weight alone, else a fifth.
    """
    even = _EVEN_FINE if fine else _EVEN
    if n >= len(size):
        return np.ones(len(size))
    told = size / size.sum() if size.sum() > 0.0 else weight / weight.sum()
    return at_most_one((1.0 - even) * told + even * weight / weight.sum(), n)


def drawn(probability: Vector, order: Vector, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return rows drawn with these probabilities (m,), whose sum is a whole number, systematically along an order."""
    rows, n = np.argsort(order, kind="stable"), round(float(probability.sum()))
    if n >= len(rows):
        return rows
    return np.unique(rows[rows_at(probability[rows], (np.arange(n) + rng.random()) / max(n, 1))])


@dataclass(frozen=True, eq=False)
class TwoPhases:
    """What a batch estimates before its fine runs, and how those correct it.

    Args:
        pool: number of pairs N.
        total, squares: sums of g1 and of its square over the pool.
        before: (m,) g1 of the pairs that were run coarse.
        first: (m,) r1 of these.
        after: (m,) g2 of these; g1 again where there is no coarse run.
        second: (m,) r2 of these, 0 < r2 <= 1.
    """

    pool: int
    total: float
    squares: float
    before: Vector
    first: Vector
    after: Vector
    second: Vector

    @property
    def _corrections(self) -> Vector:
        """(m,) what coarse runs add to the first sum."""
        return np.asarray((self.after - self.before) / self.first)

    @property
    def prior(self) -> float:
        """The first two sums."""
        return (self.total + float(self._corrections.sum())) / self.pool

    @property
    def pool_variance(self) -> float:
        """Variance of the first two sums: through the pool, and through which of its pairs were run coarse."""
        corrected = self.before + self._corrections
        squares = self.squares + float((corrected**2 - self.before**2).sum())
        return max(squares / self.pool - self.prior**2, 0.0) / self.pool

    def by_warm_up(self, seeds: NDArray[np.int64], warm_ups: int) -> Vector:
        """Return (k,) what coarse runs with these seeds (m,) add to the sums for each of the k warm-ups that they choose."""
        return deviations(self._corrections / self.pool, 1.0 / self.first, seeds, warm_ups)

    def coefficient(self, chosen: NDArray[np.intp]) -> Vector:
        """Return (n,) n / (N r1 r2) of the fine runs: those of the pairs `chosen` (n,)."""
        return np.asarray(len(chosen) / (self.pool * self.first[chosen] * self.second[chosen]))

    def anticipated(self, n: int) -> float:
        """Return the variance of one of n fine draws if the belief after the coarse runs is right."""
        terms = self.after * (1.0 - self.after) / (self.first**2 * self.second)
        return n * float(terms.sum()) / self.pool**2


@dataclass(frozen=True)
class Shares:
    """What ways to draw are worth, in variance times cost over that of crude Monte Carlo: smaller is better.

    Attributes:
        two_levels: with coarse runs.
        one_level: with runs of the scenario alone: 1 at random, less where they are drawn by what inputs tell.
        fine: share of the coarse runs that a run of the scenario best follows.
        by_inputs: what inputs tell clearly pays, so that pairs are drawn by it.
        pays: coarse runs clearly pay.
    """

    two_levels: float
    one_level: float
    fine: float
    by_inputs: bool
    pays: bool


def split(critical: Vector, before: Vector, after: Vector, weight: Vector, cost: float, rng: np.random.Generator) -> Shares:
    """Return what coarse runs are worth, by pairs run at both levels.

    What is learned is used only where it pays by far in nine of ten resamples of the pairs: its beliefs are as uncertain.

    Args:
        critical: (n,) 1 where the run of the scenario was critical.
        before: (n,) belief before any run of the pair, learned without it.
        after: (n,) belief after its coarse run, learned without it.
        weight: (n,) of the pair under the inputs' distribution, any scale.
        cost: of a coarse run, in runs of the scenario.
        rng: the only source of randomness.
    """
    n = len(critical)
    times = np.vstack([np.ones(n), rng.multinomial(n, np.ones(n) / n, _RESAMPLES)])
    w = times * weight
    w = w[(w @ critical > 0.0) & (w @ (1.0 - critical) > 0.0)]
    w /= w.sum(axis=1, keepdims=True)
    p = w @ critical
    errors = (critical - before) ** 2, (critical - after) ** 2
    one = _one_level(w, before, errors[0]) / (p * (1.0 - p))
    by_inputs = bool(np.quantile(one, _SURELY) < _CLEARLY)
    prior = before if by_inputs else np.full(n, p[0])
    two, fine = _two_levels(w, prior, after, errors[1], cost)
    two /= p * (1.0 - p)
    rest = one if by_inputs else np.ones(len(one))
    return Shares(float(two[0]), float(rest[0]), fine, by_inputs, bool(np.quantile(two / rest, _SURELY) < _CLEARLY))


def split_as_if_normal(before: float, after: float, p: float, cost: float, pairs: float = math.inf) -> Shares:
    """Return what coarse runs are worth for an event of which too few were met, as if all were normal.

    The rarer the event, the fewer runs of the scenario need follow the coarse ones. Whether they pay is judged by correlations
    that are lower by what so few pairs leave open.

    Args:
        before: correlation of the metric with what is predicted before any run of the pair.
        after: with what is predicted after its coarse run.
        p: probability of the event, 0 < p < 1.
        cost: of a coarse run, in runs of the scenario.
        pairs: number of them, by which correlations are known.
    """
    z = np.linspace(-8.0, 8.0, 401)
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    w = np.outer(np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum(), weights / weights.sum()).reshape(1, -1)
    t, found = float(ndtri(p)), []
    for lower in (0.0, _DOUBT / math.sqrt(max(pairs - 3.0, 1.0))):
        low, high = (max(math.tanh(math.atanh(min(max(r, 0.0), _LARGEST_CORRELATION)) - lower), 0.0) for r in (before, after))
        high = max(high, low + 1e-3)
        share = low / high
        coarse = (share * z[:, None] + math.sqrt(1.0 - share**2) * nodes).ravel()
        one = np.repeat(ndtr((t - low * z) / math.sqrt(1.0 - low**2)), len(nodes))
        two = ndtr((t - high * coarse) / math.sqrt(1.0 - high**2))
        found.append((one, two, float(_one_level(w, one, one * (1.0 - one))[0]) / (p * (1.0 - p))))
    by_inputs = found[1][2] < _AS_IF
    prior = [one if by_inputs else np.full(w.size, p) for one, _, _ in found]
    (two, fine), (surely, _) = (
        _two_levels(w, g1, g2, g2 * (1.0 - g2), cost) for g1, (_, g2, _) in zip(prior, found, strict=True)
    )
    rest, surest = (found[0][2], found[1][2]) if by_inputs else (1.0, 1.0)
    pays = float(surely[0]) / (p * (1.0 - p)) < _AS_IF * surest
    return Shares(float(two[0]) / (p * (1.0 - p)), rest, fine, by_inputs, pays)


def _draws(belief: Vector, w: Vector) -> tuple[Vector, Vector]:
    """Return (m,) standard deviations that a belief leaves, and inclusion relative to an even one, mean 1 under w (m,)."""
    size = np.sqrt(np.maximum(belief * (1.0 - belief), _NO_DOUBT))
    return size, (1.0 - _EVEN) * size / (w @ size) + _EVEN


def _one_level(w: NDArray[np.float64], before: Vector, errors: Vector) -> Vector:
    """Return (k,) variance times cost of draws by a belief, under weights (k, m)."""
    return np.asarray(w @ (errors / _draws(before, w[0])[1]))


def _two_levels(w: NDArray[np.float64], before: Vector, after: Vector, errors: Vector, cost: float) -> tuple[Vector, float]:
    """Return (k,) variance times cost with coarse runs, under weights (k, m), and the best share of fine ones under the first.

    A pair that was not run coarse cannot be run further: however few the pairs are that matter, the coarse runs must find them.
    """
    (left, _), (_, first) = _draws(after, w[0]), _draws(before, w[0])

    def worth(weights: NDArray[np.float64], second: Vector) -> Vector:
        variance = weights @ (((after - before) ** 2 + errors / second) / first)
        return np.asarray(variance * (weights @ (first * (cost + second))))

    thresholds = np.geomspace(float(left.max()), float(left.min()), _THRESHOLDS)
    seconds = [np.clip(left / threshold, _LEAST, 1.0) for threshold in thresholds]
    best = seconds[int(np.argmin([worth(w[:1], second)[0] for second in seconds]))]
    return worth(w, best), float(w[0] @ (first * best))
