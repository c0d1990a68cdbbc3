"""Subset simulation: from level to level of the metric, in any dimension, by Markov chains.

P(critical) is the product of the shares that reach each next level. Chains are correlated in ways that
their own variance estimate does not see, so the interval comes from repeats alone. A level that a repeat sets by its own
points makes its estimate too high, by a third with 80 points a level: here the points of the other repeats set it.

Source:
    Au and Beck (2001), Probabilistic Engineering Mechanics 16; preconditioned Crank-Nicolson moves with
    an adapted step: Papaioannou, Betz, Zwirglmaier, Straub (2015), Probabilistic Engineering Mechanics 41. The bias of own
    levels: Cerou, Del Moral, Furon, Guyader (2012), Statistics and Computing 22. Levels by other repeats: constructed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, ndtr, stdtrit

from sbt.problem.arrays import Points, Vector

__all__ = ["LEVEL_SHARE", "RepeatedEstimate", "SubsetRun", "combine_repeats", "has_levels", "next_levels"]

LEVEL_SHARE = 0.1
"""Share of a level's points that seeds the next one."""
_ACCEPTANCE = 0.44  # of the chains, near which their correlation is smallest (Papaioannou et al. 2015)
_SPREADS = 0.05, 1.0  # of a step of the chains; 1: independent of where the chain stands


_MOST = 0.5  # of the points, what a first level may keep
_LEVELS = (np.arange(512) + 0.5) / 512  # roots of levels of the variance of repeats: close where it is large
_SAME, _NEAR = 1e-9, 1e-12  # spread of equal repeats over their mean; precision of the cube root of a limit


@dataclass(frozen=True, eq=False)
class SubsetRun:
    """The state of one subset simulation: a value that `ask` and `tell` take one step further.

    Args:
        n: points a level; a multiple of 10.
        z, margin: the points of this level so far and their distances to the critical interval.
        front: (k, d) where the chains stand.
        front_margin: (k,) their margins.
        level: margin that this level's points stay below.
        share: product of the shares of the levels before; of one that has finished, the estimate.
        spread: step of the chains, (0, 1].
        hits: critical points of the last level.
        finished: whether the last level is full and holds enough critical points.
        alone: whether its own points set its levels; else it waits, `full`, for those of others (`next_levels`).
        estimate: P(critical) by its last full level.
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
    alone: bool = True
    full: bool = False
    estimate: float = 0.0

    @property
    def asks(self) -> bool:
        """Whether it has points to run now."""
        return not self.finished and not self.full

    @property
    def width(self) -> int:
        """How many `ask` gives."""
        return self.n if self.levels == 0 else len(self.front)

    def ask(self, rng: np.random.Generator) -> Points:
        """Return the points to run next: all of the first level, then one step of every chain."""
        if self.levels == 0:
            return rng.standard_normal((self.n, self.dimension))
        keep = math.sqrt(1.0 - self.spread**2)
        return keep * self.front + self.spread * rng.standard_normal(self.front.shape)

    def tell(self, z: Points, margin: Vector) -> SubsetRun:
        """Return the state after the runs at z (n, d) of `ask`, with their margins (n,); NaN (failed runs) is never accepted."""
        if self.levels == 0:
            return replace(self, z=z, margin=np.where(np.isnan(margin), np.inf, margin))._filled()
        accept = margin <= self.level
        front = np.where(accept[:, None], z, self.front)
        front_margin = np.where(accept, margin, self.front_margin)
        step = math.exp(math.log(self.spread) + (float(accept.mean()) - _ACCEPTANCE))
        grown = replace(
            self, z=np.concatenate([self.z, front]), margin=np.concatenate([self.margin, front_margin]), front=front,
            front_margin=front_margin, spread=min(max(step, _SPREADS[0]), _SPREADS[1]),
        )  # fmt: skip
        return grown._filled() if len(grown.z) >= self.n else grown

    def _filled(self) -> SubsetRun:
        """Return the state with a full level: at once at the next one, where its own points set it."""
        hits = int((self.margin <= 0).sum())
        filled = replace(self, hits=hits, estimate=self.share * hits / len(self.margin), full=True)
        return filled.after(self.margin) if self.alone else filled

    def after(self, margin: Vector) -> SubsetRun:
        """Return the state at the start of the next level, which these margins set, or finished."""
        reached, level = _levels(margin)
        inside = np.flatnonzero(self.margin <= level)
        over = reached <= 0 or not math.isfinite(reached) or (self.levels > 0 and reached >= self.level)  # the last: a plateau
        if over or (not self.alone and (level <= 0 or not len(inside))):
            return replace(self, share=self.estimate, levels=self.levels + 1, finished=True, full=False)
        most = _seeds(self.n) if self.alone else min(2 * _seeds(self.n), len(inside))
        front = inside[np.linspace(0, len(inside) - 1, most).round().astype(np.intp)]  # of equal ones any, not the deepest
        return replace(
            self, z=self.z[front], margin=self.margin[front], front=self.z[front], front_margin=self.margin[front],
            level=level, share=self.share * len(inside) / len(self.margin), levels=self.levels + 1, full=False,
        )  # fmt: skip


def next_levels(repeats: Sequence[SubsetRun]) -> list[SubsetRun]:
    """Return repeats that wait for each other at their next levels, once all that have not finished are full."""
    if any(repeat.asks for repeat in repeats):
        return list(repeats)
    margins = [repeat.margin for repeat in repeats]
    others = [np.concatenate(margins[:k] + margins[k + 1 :]) for k in range(len(margins))]
    return [r.after(other) if r.full else r for r, other in zip(repeats, others, strict=True)]


def has_levels(margin: Vector) -> bool:
    """Return whether a first level leaves most of these points (failed ones NaN) behind: of a flag it would leave none."""
    known = np.where(np.isnan(margin), np.inf, margin)
    _, level = _levels(known)
    return math.isfinite(level) and float((known <= level).mean()) <= _MOST


def _seeds(n: int) -> int:
    return max(round(LEVEL_SHARE * n), 1)


def _levels(margin: Vector) -> tuple[float, float]:
    """Return the margin that a tenth of the points stays below, and the next level: of many equal values the next lower one."""
    seeds, ordered = _seeds(len(margin)), np.sort(margin)
    reached = float(ordered[seeds - 1])
    below = ordered[ordered < reached]
    many = 2 * len(below) >= seeds and (margin <= reached).sum() > 2 * seeds
    return reached, float(below[-1]) if many else reached


@dataclass(frozen=True)
class RepeatedEstimate:
    """Mean of independent repeats with an interval by their spread: downwards that of t, upwards that of their cube roots.

    The values are skewed, so that a low mean comes with a low spread: a t interval of logarithms ends below the truth two to
    three times as often as it may. Cube roots are nearly normal, and take values of 0.

    Args:
        value, std_error: mean of the repeats and its standard error.
        repeats: how many there are.
        root, root_spread: mean and standard deviation of their cube roots.
        met: repeats that are not 0.

    Source:
        Krishnamoorthy, Mathew, Mukherjee (2008), doi 10.1198/004017007000000353: cube roots of skewed values taken for normal.
        Weerahandi (1993), doi 10.1080/01621459.1993.10476355: the generalised limit of a function of mean and variance, here of
        the third moment.
    """

    value: float
    std_error: float
    repeats: int
    root: float
    root_spread: float
    met: int

    @property
    def tells_spread(self) -> bool:
        """Whether two repeats at least are not 0: of one the spread is not known."""
        return self.met > 1

    def limit(self, confidence: float, *, side: float) -> float:
        """Return the one-sided limit, side -1 or +1, within [0, 1]."""
        if side < 0:
            return max(self.value - float(stdtrit(self.repeats - 1, confidence)) * self.std_error, 0.0)
        low = min(self.value, 1.0) ** (1.0 / 3.0)
        if self.root_spread <= _SAME * self.root or self._sure(low) >= confidence:
            return min(self.value, 1.0)
        if self._sure(1.0) <= confidence:
            return 1.0
        return float(brentq(lambda root: self._sure(root) - confidence, low, 1.0, xtol=_NEAR)) ** 3

    def _sure(self, root: float) -> float:
        """Return the confidence with which the cube root of the mean is at most this one: exact where cube roots are normal.

        Given their standard deviation s, that of an interval for their mean m, as the mean of cubes m^3 + 3 m s^2 grows with m.
        """
        s = self.root_spread * _over_spread(self.repeats - 1)
        m = 2.0 * s * np.sinh(np.arcsinh(0.5 * (root / s) ** 3) / 3.0)
        return float(np.average(ndtr(math.sqrt(self.repeats) * (m - self.root) / s), weights=_LEVELS))


@cache
def _over_spread(freedom: int) -> Vector:
    """Return what a true standard deviation may be over that of a sample, at even roots of levels."""
    return np.asarray(np.sqrt(freedom / chdtri(freedom, 1.0 - _LEVELS**2)))


def combine_repeats(values: Sequence[float]) -> RepeatedEstimate:
    """Return the mean of at least two independent estimates with its standard error."""
    v = np.asarray(values, dtype=np.float64)
    root = np.cbrt(v)
    spread = float(v.std(ddof=1)) / math.sqrt(len(v))
    return RepeatedEstimate(float(v.mean()), spread, len(v), float(root.mean()), float(root.std(ddof=1)), int((v > 0.0).sum()))
