"""A process of what a metric was rounded from, as a count or a level of severity was, or goes on as where it ends.

Of such a metric a run tells between which two numbers it lay. Least squares take the steps for noise, so that P(critical) is
vague next to runs that leave no doubt, or for the shape itself, and are surest where a step goes on. Here each run tells its
range. So does a run that ended at the end of a metric, as a distance of 0 is in every collision: it lay there or beyond.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from sbt.metamodels.base import Metamodel, gives_different, is_flag
from sbt.metamodels.censored import Limit
from sbt.metamodels.expectation_propagation import Belief, Hyper, Priors, believe, fitted, latent, latent_paths
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import surely_positive
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "RoundedPredictor", "Rounding", "StepAware", "better_rounded", "beyond_ranges", "in_steps", "rounded_process", "rounding",
    "two_ranges", "without_unit",
]  # fmt: skip

_FEWEST, _TIED = 10, 0.5
"""Rows, and the least share of those between the first and the last value that have the value of a row elsewhere."""
_WHOLE = 1e-3
"""Of a step: how far multiples of it may be off."""
_SAME, _FINEST = 1e-9, 1e-6
"""Of the range of y: within which values are the same but for rounding, and the least step."""
_LEARNED, _MOST = 200, 1000
"""Rows that hyperparameters are found by, and that are learned from, at most: half of them those nearest to the edge."""
_LENGTH, _NOISE = 0.3, 0.03
"""Where the search of hyperparameters starts: length in sqrt(d), noise in standard deviations of y."""
_BOUNDS = ((-3.5, 4.0), (-4.0, 3.0), (-30.0, 30.0), (math.log(1e-3), 1.0))
"""Of log lengths, log spread, mean and log noise, in standard deviations of y."""
_SURE, _SURELY_WORSE = 1.0, 2.0
"""Standard errors by which left-out runs must be predicted better where there is noise, and otherwise may not be worse."""
_AT_EDGE = 1e-9
"""Standard deviations of y, within which the edge is reached."""


@dataclass(frozen=True, eq=False)
class Rounding:
    """What rows of a rounded metric tell, in the unit of the metric.

    Args:
        low, high: (n,) ends of the range that each value stands for; infinite ones of the first and the last value.
        edge: between the ranges of what is critical and what is not.
        width: > 0, of the step at the edge; 0: of a metric that ends somewhere, of which other rows tell exactly what it is.
    """

    low: Vector
    high: Vector
    edge: float
    width: float

    @property
    def in_steps(self) -> bool:
        """Whether the metric comes in steps, rather than ends somewhere."""
        return self.width > 0.0

    def take(self, rows: NDArray[np.intp]) -> Rounding:
        """Return what these rows tell."""
        return replace(self, low=self.low[rows], high=self.high[rows])


@runtime_checkable
class StepAware(Protocol):
    """A metamodel that learns otherwise where the metric comes in steps."""

    def with_rounding(self, told: Rounding) -> Metamodel:
        """Return the same settings for rows of which each tells a range."""
        ...


def in_steps(u: Points, y: Vector, critical: CriticalInterval) -> bool:
    """Say whether y (n,) at u (n, d) has few values: two, one of them critical, or steps over which it is the same."""
    return len(y) > 0 and (is_flag(y, critical) or rounding(u, y, critical) is not None)


def rounding(u: Points, y: Vector, critical: CriticalInterval) -> Rounding | None:
    """Return what y (n,) at u (n, d) tells where it comes in steps; None where it does not, or M_c has two ends.

    Steps of one size are known wherever they lie; those of other metrics of few values end midway between these.

    >>> found = rounding(np.arange(12.0)[:, None], np.repeat([0.0, 1.0, 2.0, 4.0], 3), CriticalInterval(high=2.0))
    >>> found.edge, found.low[3:7].tolist(), found.high[3:7].tolist()
    (2.5, [0.5, 0.5, 0.5, 1.5], [1.5, 1.5, 1.5, 2.5])
    """
    if not critical.one_sided or len(y) < _FEWEST:
        return None
    values, which, inside = _values(y, critical)
    between = (which > 0) & (which < len(values) - 1)
    tied = np.bincount(np.unique(np.column_stack([which, u]), axis=0)[:, 0].astype(np.intp)) > 1
    if inside is None or len(values) < 2 or (tied[which[between]].mean() < _TIED if between.any() else not tied.all()):
        return None
    step = _step(values)
    if step is not None:
        sign, low, high, width = critical.outward, values - 0.5 * step, values + 0.5 * step, step
        last = float(values[0]) + sign * step * math.floor(sign * float(critical.edge - values[0]) / step + _WHOLE)  # critical
        edge = last + 0.5 * sign * step
    elif inside.all() or not inside.any():
        return None
    else:
        middle = 0.5 * (values[1:] + values[:-1])
        low, high = np.append(values[0], middle), np.append(middle, values[-1])
        k = int(np.flatnonzero(inside[1:] != inside[:-1])[0])
        edge, width = float(middle[k]), float(values[k + 1] - values[k])
    low[0], high[-1] = -np.inf, np.inf
    return Rounding(low[which], high[which], edge, width)


def beyond_ranges(y: Vector, limit: Limit | None, moved: Mask, critical: CriticalInterval) -> Rounding | None:
    """Return what y (n,) tells of a metric that goes on beyond its end, where some of the runs were moved; None: it has no end.

    Args:
        y: (n,) the metric.
        limit: what is known of the k runs that were moved, in their order.
        moved: (n,) which these are.
        critical: M_c.
    """
    if limit is None or not critical.one_sided or not _FEWEST <= len(y) <= _MOST:
        return None
    low, high = np.array(y), np.array(y)
    low[moved], high[moved] = np.where(limit.at_most, -np.inf, y[moved]), np.where(limit.at_most, y[moved], np.inf)
    return Rounding(low, high, critical.edge, 0.0)


def two_ranges(y: Vector) -> Rounding:
    """Return what a flag y (n,) tells: on which side of the middle between its two values what it stands for lay."""
    low, high = float(y.min()), float(y.max())
    middle, upper = 0.5 * (low + high), y == high
    return Rounding(np.where(upper, middle, -np.inf), np.where(upper, np.inf, middle), middle, high - low)


def _values(y: Vector, critical: CriticalInterval) -> tuple[Vector, NDArray[np.intp], Mask | None]:
    """Return the different values (k,) of y (n,), which one each is, and whether they are critical; None: rounding decides that.

    Times and sums that are multiples of a step are so but for the last digits.
    """
    every, which = np.unique(y, return_inverse=True)
    first = np.diff(every, prepend=-np.inf) > _SAME * np.ptp(every)
    group = np.cumsum(first) - 1
    inside = critical.contains(every)
    mixed = np.unique(np.column_stack([group, inside]), axis=0).shape[0] > int(first.sum())
    return every[first], group[which], None if mixed else inside[first]


def _step(values: Vector) -> float | None:
    """Return the size of which all differences of values (k,), increasing, are multiples; None where there is none."""
    apart = np.diff(values)
    step, range_ = float(apart.min()), float(values[-1] - values[0])
    step = range_ / round(range_ / step)  # less of the rounding of one difference
    times = (values - values[0]) / step
    return step if step > _FINEST * range_ and bool((np.abs(times - np.round(times)) < _WHOLE).all()) else None


@dataclass(frozen=True, eq=False)
class RoundedPredictor:
    """A process of what a metric was rounded from, as one of the metric, of which P(critical) is that of a range.

    Args:
        u: (m, d) rows.
        hyper: of the process, whose unit is `scale`, about `edge`.
        belief: of the process.
        scale: standard deviation of y > 0, in its unit.
        edge, width: of the rounding, in the unit of the metric.
        critical: M_c, in the unit of y.
        warp: the unit of y; None: that of the metric.
    """

    u: Points
    hyper: Hyper
    belief: Belief
    scale: float
    edge: float
    width: float
    critical: CriticalInterval
    warp: Warp | None

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d)."""
        mean, variance = latent(u, self.u, self.hyper, self.belief)
        told, ratio = self._told(mean)
        noise = ratio * self.scale * self.hyper.noise
        return Prediction.gaussian(told, np.hypot(ratio * self.scale * np.sqrt(variance), noise), noise)

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self._told(latent(u, self.u, self.hyper, self.belief)[0])[0]

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d); the cost is cubic in m."""
        return self._told(latent_paths(u, self.u, self.hyper, self.belief, n, rng))[0]

    def log_sides(self, u: Points, inside: Mask, rows: NDArray[np.intp]) -> Vector:
        """Return (n,) log P of the side of the edge on which runs at u (n, d) fell, those that it learned by all others."""
        mean, variance = latent(u, self.u, self.hyper, self.belief)
        mean[rows], variance[rows] = self.hyper.mean + self.belief.beside, self.belief.wide
        return log_ndtr(np.where(inside, -mean, mean) * self.critical.outward / np.sqrt(variance + self.hyper.noise**2))

    def _told(self, off: Points) -> tuple[Points, Points]:
        """Return the y of what is so far from the edge, in standard deviations, and its distance from M_c over that; shape kept.

        Next to the edge y is as far from M_c; from the next step on it is what was rounded.
        """
        edge, w = self.critical.edge, self.width
        own, end = (edge, edge) if self.warp is None else (float(self.warp.values(np.array(self.edge))), self.warp.edge)
        at = self.edge + self.scale * off if self.warp is None else self.warp.back(own + self.scale * off)
        knots = self.edge + w * np.array([-1.5, -0.5, 0.5, 1.5])
        moved = np.interp(at, knots, [knots[0], end - 0.5 * w, end + 0.5 * w, knots[3]])
        y = np.where((at < knots[0]) | (at > knots[3]), at, moved)
        y = y if self.warp is None else self.warp.values(y)
        near = np.abs(off) < _AT_EDGE
        return y, np.where(near, 1.0, (y - edge) / np.where(near, 1.0, self.scale * off))


def better_rounded(
    told: Rounding, score: Vector, critical: CriticalInterval, u: Points, y: Vector, warp: Warp | None, shares: Vector,
    rng: np.random.Generator,
) -> tuple[RoundedPredictor, Vector] | None:  # fmt: skip
    """Return a process of what y was rounded from, and (n,) what it gains in log P(side) of left-out rows; None where nothing.

    Args:
        told: what each row tells.
        score: (n,) log P(side) that each row has by another metamodel of the others.
        critical: M_c, in the unit of y.
        u: (n, d) rows.
        y: (n,) their metric, as it is learned, in the unit of `warp`.
        warp: that unit; None: that of the metric.
        shares: (n,) of the space that each row stands for.
        rng: the only source of randomness.
    """
    if not np.std(y) > 0.0:
        return None
    found, own = rounded_process(told, critical, u, y, warp, rng)
    gain = own - score
    noisy = gives_different(u, y)  # of which others learn how often, as well
    better = surely_positive(gain, _SURE) and float(shares @ gain) > 0.0 if noisy else not surely_positive(-gain, _SURELY_WORSE)
    return (found, gain) if better else None


def rounded_process(
    told: Rounding, critical: CriticalInterval, u: Points, y: Vector, warp: Warp | None, rng: np.random.Generator
) -> tuple[RoundedPredictor, Vector]:
    """Return a process of what y, of two values or more, was rounded from, and (n,) log P(side) of left-out rows."""
    near = np.argsort(np.abs(y - critical.edge), kind="stable")
    few, rows = (_some(near, most, rng) for most in (_LEARNED, _MOST))
    hyper, _, (low, high) = _learned(told, critical, u, y, warp, few)
    belief = believe(hyper, hyper.covariance(u[rows])[0], low[rows], high[rows])
    found = RoundedPredictor(u[rows], hyper, belief, float(np.std(y)), told.edge, told.width, critical, warp)
    return found, found.log_sides(u, critical.contains(y), rows)


def without_unit(
    told: Rounding, critical: CriticalInterval, u: Points, y: Vector, warp: Warp | None, rng: np.random.Generator
) -> bool:  # fmt: skip
    """Return whether ranges are as likely without a unit, which least squares on the steps have chosen.

    Args:
        told: what each row tells.
        critical: M_c, in the unit of the metric.
        u: (n, d) rows.
        y: (n,) their metric, as it is learned.
        warp: the unit; None: there is none.
        rng: the only source of randomness.
    """
    if warp is None or not np.std(y) > 0.0:
        return True
    if not told.in_steps:
        return False
    few = _some(np.argsort(np.abs(y - critical.edge), kind="stable"), _LEARNED, rng)
    plain = _learned(told, critical, u, y, None, few)[1]
    return plain >= _learned(told, warp.interval(critical), u, warp.values(y), warp, few)[1]


def _learned(
    told: Rounding, critical: CriticalInterval, u: Points, y: Vector, warp: Warp | None, few: NDArray[np.intp]
) -> tuple[Hyper, float, tuple[Vector, Vector]]:  # fmt: skip
    """Return hyperparameters by few rows, their log posterior density, and the ends of all ranges in the unit of the process."""
    scale, d = float(np.std(y)), u.shape[1]
    low, high, edge = (ends if warp is None else warp.values(ends) for ends in (told.low, told.high, np.array(told.edge)))
    low, high = (low - edge) / scale, (high - edge) / scale
    start = Hyper(np.full(d, _LENGTH * math.sqrt(d)), 1.0, float(np.mean(y - critical.edge)) / scale, _NOISE)
    about = math.sqrt(2.0) + 0.5 * math.log(d)
    priors = Priors((about, math.sqrt(3.0)), (0.0, 1.0), (0.0, 2.0), (math.log(0.01), 2.0), _BOUNDS)
    hyper, missed = fitted(u[few], low[few], high[few], start, priors)
    return hyper, -missed, (low, high)


def _some(near: NDArray[np.intp], most: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return up to so many rows, in order: half of them the nearest, the others drawn."""
    if len(near) <= most:
        return np.sort(near)
    return np.sort(np.concatenate([near[: most // 2], rng.permutation(near[most // 2 :])[: most - most // 2]]))
