"""Subset simulation: from level to level of the metric, in any dimension, by Markov chains.

P(critical) is the product of the shares that reach each next level. Chains are correlated in ways that
their own variance estimate does not see, so the interval comes from independent repeats alone.

Source:
    Au and Beck (2001), Probabilistic Engineering Mechanics 16; preconditioned Crank-Nicolson moves with
    an adapted step: Papaioannou, Betz, Zwirglmaier, Straub (2015), Probabilistic Engineering Mechanics 41.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import stdtrit

from sbt.problem.arrays import Points, Vector

__all__ = ["LEVEL_SHARE", "RepeatedEstimate", "SubsetRun", "combine_repeats"]

LEVEL_SHARE = 0.1
"""Share of a level's points that seeds the next one."""
_ACCEPTANCE = 0.44  # of the chains, near which their correlation is smallest (Papaioannou et al. 2015)
_SPREADS = 0.05, 1.0  # of a step of the chains; 1: independent of where the chain stands


@dataclass(frozen=True, eq=False)
class SubsetRun:
    """The state of one subset simulation: a value that `ask` and `tell` take one step further.

    Args:
        n: points a level; a multiple of 10.
        z, margin: the points of this level so far and their distances to the critical interval.
        front: (k, d) where the chains stand.
        front_margin: (k,) their margins.
        level: margin that this level's points stay below.
        share: product of the shares of the levels before.
        spread: step of the chains, (0, 1].
        hits: critical points of the last level.
        finished: whether the last level is full and holds enough critical points.
    """

    n: int
    dimension: int
    z: Points = field(default_factory=lambda: np.empty((0, 0)))
    margin: Vector = field(default_factory=lambda: np.empty(0))
    front: Points = field(default_factory=lambda: np.empty((0, 0)))
    front_margin: Vector = field(default_factory=lambda: np.empty(0))
    level: float = math.inf
    share: float = 1.0
    spread: float = 0.6
    hits: int = 0
    levels: int = 0
    finished: bool = False

    def ask(self, rng: np.random.Generator) -> Points:
        """Return the points to run next: all of the first level, then one step of every chain."""
        if self.levels == 0:
            return rng.standard_normal((self.n, self.dimension))
        keep = math.sqrt(1.0 - self.spread**2)
        return keep * self.front + self.spread * rng.standard_normal(self.front.shape)

    def tell(self, z: Points, margin: Vector) -> SubsetRun:
        """Return the state after the runs at z (n, d) of `ask`, with their margins (n,); NaN (failed runs) is never accepted."""
        if self.levels == 0:
            return replace(self, z=z, margin=np.where(np.isnan(margin), np.inf, margin))._next()
        accept = margin <= self.level
        front = np.where(accept[:, None], z, self.front)
        front_margin = np.where(accept, margin, self.front_margin)
        step = math.exp(math.log(self.spread) + (float(accept.mean()) - _ACCEPTANCE))
        grown = replace(
            self, z=np.concatenate([self.z, front]), margin=np.concatenate([self.margin, front_margin]), front=front,
            front_margin=front_margin, spread=min(max(step, _SPREADS[0]), _SPREADS[1]),
        )  # fmt: skip
        return grown._next() if len(grown.z) >= self.n else grown

    def _next(self) -> SubsetRun:
        """Return the state at the start of the next level, or finished."""
        hits = int((self.margin <= 0).sum())
        seeds = max(round(LEVEL_SHARE * self.n), 1)
        order = np.argsort(self.margin, kind="stable")
        level = float(self.margin[order[seeds - 1]])
        stuck = level >= self.level and self.levels > 0  # a plateau: no progress is possible
        if hits >= seeds or not math.isfinite(level) or stuck:
            return replace(self, hits=hits, share=self.share * hits / len(self.margin), levels=self.levels + 1, finished=True)
        below = self.margin[self.margin < level]
        if 2 * len(below) >= seeds and (self.margin <= level).sum() > 2 * seeds:  # many equal values: on to the next one
            level = float(below.max())
        inside = np.flatnonzero(self.margin <= level)
        front = inside[np.linspace(0, len(inside) - 1, seeds).round().astype(np.intp)]  # of equal ones any, not the deepest
        return replace(
            self, z=self.z[front], margin=self.margin[front], front=self.z[front], front_margin=self.margin[front],
            level=level, share=self.share * len(inside) / len(self.margin), levels=self.levels + 1, hits=hits,
        )  # fmt: skip


@dataclass(frozen=True)
class RepeatedEstimate:
    """Mean of independent repeats with the t interval of their standard error."""

    value: float
    std_error: float
    repeats: int

    def limit(self, confidence: float, *, side: float) -> float:
        """Return the one-sided limit, side -1 or +1, clipped to [0, 1]."""
        reach = float(stdtrit(self.repeats - 1, confidence)) * self.std_error
        return min(max(self.value + side * reach, 0.0), 1.0)


def combine_repeats(values: Sequence[float]) -> RepeatedEstimate:
    """Return the mean of at least two independent estimates with its standard error."""
    v = np.asarray(values, dtype=np.float64)
    return RepeatedEstimate(float(v.mean()), float(v.std(ddof=1)) / math.sqrt(len(v)), len(v))
