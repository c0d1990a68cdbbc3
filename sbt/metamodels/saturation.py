"""Metrics that end at the critical edge, such as a distance that is 0 in every collision, and metrics that come in steps.

Where critical is "at most 0", all critical runs have the value of the edge, so that a metamodel of the metric is as unsure inside
the critical region as on its boundary. What is learned in their place goes on beyond the edge, as deep as the nearest uncritical
runs are far. A speed of impact ends on the other side of the edge: it is 0 wherever nothing touches. Of a count, or a rounded
number, whole regions have the value of the edge: the boundary lies midway to the next one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from sbt.metamodels.base import Metamodel, Predictor, Screened, fitted, is_flag, sample_paths, sketched, with_target
from sbt.metamodels.censored import Limit, beyond
from sbt.metamodels.prediction import Prediction, Scale, reached_beyond
from sbt.metamodels.rounded import StepAware, beyond_ranges, rounding
from sbt.metamodels.warp import Warp, gap_of
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.combination import MARGIN
from sbt.problem.requirement import CriticalInterval, as_passed, as_reached, within_scale

__all__ = ["Ending", "Opened", "centred", "on_side", "opened", "opened_and_limit", "scored"]

_FEWEST = 2
"""Critical runs with the value of the edge: one may be there by chance."""
_MANY, _NEAR = 0.25, 0.25
"""Least share of the uncritical, or critical, runs that have the last value, where a metric ends with it; its largest margin over
the depth of the deepest run."""
_DEEP = 0.5
"""Share of the depth of the last critical value that other runs must reach."""
_OUTWARDS = 0.5
"""Least of these moves, in that by the usual slope."""
_SURELY = 0.5
"""What is certain of a move away from M_c."""
_LEAST = 0.25
"""Least depth beyond the edge, in the median margin of the uncritical runs that are nearest to critical ones."""
_ENOUGH, _MOST = 8, 400
"""Uncritical runs from which on a process is asked, and that it learns from at most: those nearest to the edge."""
_USUAL = 0.9
"""Quantile of the margins that asinh begins to bend at."""
_FEWEST_OTHERS, _RANKS = 3, 2.0
"""Fewest different values on the other side of M_c than the one that stands for none; log likelihoods of left-out runs that the
square of a standard error counts (both add up over runs that tell the same)."""
_LAST, _SHARE_LAST = 3, 0.05
"""Inputs with the last value, at least, and their share of the runs, where the metric has no values beyond it."""
_LEAST_WARPED, _DEEPEST = 1e-3, 3.0
"""Ends of a depth, in asinh(margin / usual margin)."""


def opened(u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> Vector:
    """Return y with the values at the edge of M_c moved into it, where no run lies beyond the edge; else `centred`.

    So are two values that chance decides between: those at the edge are no deeper than they are. Where instead many
    uncritical runs have the same, last value, much nearer to the edge than the deepest run, these are moved away from it; and
    where many critical runs have the deepest value, which others come up to, as a time to collision of 0, these go on.

    A Gaussian process of the uncritical margins says where each of them would lie; it is the mean of that prediction, cut off
    at the edge (one step of the expectation maximisation for censored values). Where few runs are uncritical, the depth is the
    least, over them, of slope times distance less their margin, with the median slope to the nearest critical run.

    Args:
        u: (n, d) metamodel inputs.
        y: (n,) finite values of the metric, in any unit in which `critical` is given.
        critical: M_c; with two finite ends only values beyond one of them are moved.
        rng: the only source of randomness, used where something is moved.

    Source:
        Tobin (1958), Estimation of relationships for limited dependent variables, Econometrica 26.

    >>> u = np.array([[0.0], [0.2], [0.3], [0.4], [0.5]])
    >>> opened(u, np.array([0.0, 0.0, 0.1, 0.2, 0.3]), CriticalInterval(high=0.0), None).round(2).tolist()
    [-0.2, -0.02, 0.1, 0.2, 0.3]
    """
    return opened_and_limit(u, y, critical, rng)[0]


def opened_and_limit(u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> tuple[Vector, Limit | None]:
    """Return what `opened` does, and what is known of the values that it moved; None where it moved none, or steps alone."""
    if not critical.one_sided:
        moved = y
        for end in (CriticalInterval(high=critical.high), CriticalInterval(low=critical.low)):
            moved = _opened_outside(u, moved, end, rng)
        return moved, _limit(u, y, moved, critical)
    margin = critical.margin(y)
    tied = margin == 0.0
    if is_flag(y, critical) and min(np.unique(y, return_counts=True)[1]) >= _FEWEST:  # one alone may be a speed of impact
        return centred(u, y, critical), None
    if tied.sum() < _FEWEST or (margin < 0.0).any():
        y = centred(u, y, critical)
        moved = _opened_outside(u, _opened_inside(u, y, critical, rng), critical, rng)
    else:
        moved = _moved(u, y, tied, margin, critical, rng)
    return moved, _limit(u, y, moved, critical)


def _limit(u: Points, y: Vector, moved: Vector, critical: CriticalInterval) -> Limit | None:
    """Return that the metric goes on beyond y (n,) where it was moved; away from M_c, half as far as it was moved."""
    tied = moved != y
    surely = np.where(critical.margin(y[tied]) > 0.0, _SURELY, 0.0)  # else steep edges are expected wherever nothing is known
    return Limit(u[tied], moved[tied], y[tied] + surely * (moved - y)[tied], (moved < y)[tied]) if tied.any() else None


def _opened_inside(u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> Vector:
    """Return y with the last critical value moved on where the metric ends with it beyond the edge."""
    margin = critical.margin(y)
    once = np.unique(np.column_stack([u, y]), axis=0, return_index=True)[1]  # a repetition may have the same value anywhere
    if not _ends_inside(margin[once]).any():
        return y
    return _moved(u, y, margin == margin.min(), margin - margin.min(), critical, rng)


def _ends_inside(margin: Vector) -> Mask:
    """Return (n,) which margins are the deepest one, where a metric ends with it beyond the edge; all False where it goes on.

    Other runs must come half as deep, or it may be a jump: a collision that counts -5, a flag.
    """
    deepest = margin.min(initial=np.inf)
    tied, rest = margin == deepest, margin[margin > deepest]
    many = tied.sum() >= max(_FEWEST, _MANY * (margin <= 0.0).sum()) and len(rest) >= _ENOUGH
    return np.asarray(tied & bool(many and rest.min() <= _DEEP * deepest < 0.0))


def _opened_outside(u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> Vector:
    """Return y with the last uncritical value moved away from M_c where the metric ends with it."""
    margin = critical.margin(y)
    tied = _ends_outside(margin, len(np.unique(u[margin <= 0.0], axis=0)))
    if not tied.any():
        return y
    left = margin.max() - margin - sum(gap_of(margin, MARGIN))
    return _moved(u, y, tied, left, critical, rng, outwards=True)


def _ends_outside(margin: Vector, inputs: int) -> Mask:
    """Return (n,) which margins are the last one, where a metric ends with it; all False where it goes on.

    Critical runs, which are at so many inputs, must differ: a flag has no depth.
    """
    outside = margin > 0.0
    tied, depth = margin == margin.max(initial=-np.inf), -margin[~outside]
    if tied.sum() < max(_FEWEST, _MANY * outside.sum()) or not len(depth):
        return np.zeros(len(margin), dtype=bool)
    differ = len(np.unique(depth)) > 1 or inputs == 1
    return np.asarray(tied & outside & bool(differ and margin.max() <= _NEAR * depth.max()))


def _moved(
    u: Points, y: Vector, tied: Mask, left: Vector, critical: CriticalInterval, rng: np.random.Generator, *,
    outwards: bool = False,
) -> Vector:  # fmt: skip
    """Return y with the tied values (n,) moved into M_c, or away from it; `left` (n,) is how far others are from that value."""
    depth = np.ones(int(tied.sum()))
    if not tied.all():
        told = _extrapolated if (~tied).sum() >= _ENOUGH else _by_slope
        depth = told(u[tied], u[~tied], left[~tied], rng)
        if outwards and told is _extrapolated:  # it knows critical runs alone, and expects more where it knows nothing
            depth = np.maximum(depth, _OUTWARDS * _by_slope(u[tied], u[~tied], left[~tied], rng))
    moved = np.array(y, dtype=np.float64)
    moved[tied] += depth if math.isfinite(critical.low) != outwards else -depth
    return moved


def on_side(u: Points, y: Vector, critical: CriticalInterval) -> Vector:
    """Return y with a value that stands for none on the other side of M_c where runs are predicted better so.

    A time to collision in [0, 1.5] s is -1 where none comes: as a number it lies next to the collisions, but those runs are next
    to long times, or to anything. A speed of impact of 0, of which [1, 5] is critical, is where it belongs: speeds grow with the
    distance from such runs. Both count: how the sides of left-out runs are predicted, and how surely the values grow.

    Args:
        u: (n, d) metamodel inputs.
        y: (n,) finite values of the metric.
        critical: M_c; with one finite end y is returned.

    >>> u = np.linspace(0.0, 1.0, 8)[:, None]
    >>> on_side(u, np.array([0.0, 0.6, 1.2, 1.8, 2.0, 2.5, -1.0, -1.0]), CriticalInterval(0.0, 1.5)).tolist()
    [0.0, 0.6, 1.2, 1.8, 2.0, 2.5, 2.75, 2.75]
    """
    if critical.one_sided or len(y) == 0:
        return y
    for last, there, to in ((y.min(), y > critical.high, np.inf), (y.max(), y < critical.low, -np.inf)):
        away = (y == last) & ~critical.contains(y)
        if away.sum() < _FEWEST or (away & there).any() or len(np.unique(y[there])) < _FEWEST_OTHERS:
            continue
        moved, z = within_scale(np.where(away, to, y), critical), np.sign(to) * _rises_from(u, y, away)
        if _sides_told(u, moved, critical) - _sides_told(u, y, critical) > _RANKS * z * abs(z):
            return moved
    return y


def _rises_from(u: Points, y: Vector, away: Mask) -> float:
    """Return how surely y (n,) grows with the distance from some runs: standard errors of the rank correlation."""
    from scipy.stats import rankdata

    rest = ~away
    ranks = rankdata(cdist(u[rest], u[away]).min(axis=1)), rankdata(y[rest])
    constant = any(np.ptp(each) == 0.0 for each in ranks)
    return 0.0 if constant else float(np.corrcoef(*ranks)[0, 1]) * math.sqrt(rest.sum() - 1)


def _sides_told(u: Points, y: Vector, critical: CriticalInterval) -> float:
    """Return the sum of log P(the side of M_c that a run fell on), each as a process says that learned all others."""
    from sbt.metamodels.gaussian_process import GaussianProcess
    from sbt.metamodels.stepped import side_score

    rng = np.random.Generator(np.random.PCG64(1))  # the same rows both times
    rows = np.sort(rng.permutation(len(y))[:_MOST])
    critical, u = as_passed(critical, y), u[rows]
    y = opened(u, y[rows], critical, rng)
    if critical.one_sided:
        warp = Warp.around_edge(y, critical)
        y, critical = warp.values(y), warp.interval(critical)
    process = GaussianProcess(nu=2.5, input_noise=False, kernels=1).fit(u, y, rng)
    return float(side_score(process.leave_one_out(u, y), y, critical).sum())


def centred(u: Points, y: Vector, critical: CriticalInterval) -> Vector:
    """Return y with the values next to the edge of M_c moved as far to either side of it, where metrics come in steps.

    They do where both the last critical and the first uncritical value occur at two inputs or more; else y is returned.

    Args:
        u: (n, d) metamodel inputs.
        y: (n,) finite values of the metric.
        critical: M_c; with two finite ends y is returned.

    >>> u = np.arange(6.0)[:, None]
    >>> centred(u, np.array([0.0, 1.0, 1.0, 2.0, 2.0, 3.0]), CriticalInterval(low=2.0)).tolist()
    [0.0, 1.5, 1.5, 2.5, 2.5, 3.0]
    """
    margin = critical.margin(y)
    inside = margin <= 0.0
    if inside.all() or not inside.any() or not critical.one_sided:
        return y
    ends = float(margin[inside].max()), float(margin[~inside].min())
    steps = [margin == end for end in ends]
    if any(step.sum() < _FEWEST or len(np.unique(u[step], axis=0)) < _FEWEST for step in steps):
        return y
    half, sign = 0.5 * (ends[1] - ends[0]), -1.0 if math.isfinite(critical.low) else 1.0
    moved = np.array(y, dtype=np.float64)
    for step, end, to in zip(steps, ends, (-half, half), strict=True):
        moved[step] += sign * (to - end)
    return moved


def _extrapolated(at: Points, u: Points, margin: Vector, rng: np.random.Generator) -> Vector:
    """Return how deep (k,) points are by a process of margins (m,) > 0 at u (m, d): the mean of what it predicts below 0."""
    from sbt.metamodels.gaussian_process import GaussianProcess

    scale, process = float(np.quantile(margin, _USUAL)), GaussianProcess(nu=2.5, input_noise=False, kernels=1)
    rows = np.argsort(margin, kind="stable")[:_MOST]
    with np.errstate(over="ignore"):
        prediction = process.fit(u[rows], np.arcsinh(margin[rows] / scale), rng)(at)
        alpha = -prediction.mu / prediction.sigma
        ratio = np.exp(-0.5 * alpha**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(alpha))
        cut = np.minimum(prediction.mu - prediction.sigma * ratio, -_LEAST_WARPED)
    return np.asarray(scale * np.sinh(np.minimum(-cut, _DEEPEST)))


def _by_slope(at: Points, u: Points, margin: Vector, rng: np.random.Generator) -> Vector:
    """Return how deep (k,) points are by the usual slope from runs at u (m, d) with margins (m,) > 0 to the nearest of them."""
    del rng
    distance = cdist(at, u)
    nearest = distance.min(axis=0)
    apart = nearest > 0.0
    slope = float(np.median(margin[apart] / nearest[apart])) if apart.any() else 0.0
    least = _LEAST * float(np.median(margin[distance.argmin(axis=1)]))
    return np.maximum((slope * distance - margin).min(axis=1), least)


def scored(y: Vector, mu: Vector, critical: CriticalInterval) -> Vector:
    """Return the values that predictions mu (n,) are scored by: of a run where a metric ends, its side alone."""
    lowest, highest = _ends(critical, y)
    y = np.where((y == lowest) & (mu < y) | (y == highest) & (mu > y), mu, y)
    critical = as_reached(critical, y)
    margin = critical.margin(y)
    at_edge = margin == 0.0
    if not at_edge.any() or (margin < 0.0).any():
        beyond = critical.margin(mu) - margin
        ends = _ends_outside(margin, int((margin <= 0.0).sum())) & (beyond > 0.0) | _ends_inside(margin) & (beyond < 0.0)
        return np.where(ends, mu, y) if critical.one_sided else y
    return np.where(at_edge & critical.contains(mu), mu, y)


@dataclass(frozen=True)
class Opened:
    """A metamodel that learns metrics which end at the critical edge as if they went on, and steps by where they lie.

    Args:
        metamodel: learns them.
        critical: M_c.
        beyond: the metamodel is told of M_c, and metrics that end go on; otherwise only steps are looked for.
    """

    metamodel: Metamodel
    critical: CriticalInterval
    beyond: bool = True

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> Predictor:
        """Return the predictor; see `Metamodel.fit`."""
        y = on_side(u, y, self.critical)
        critical = as_passed(self.critical, y)
        if self.beyond:
            metamodel, (learned, limit) = with_target(self.metamodel, critical), opened_and_limit(u, y, critical, rng)
            told = rounding(u, y, critical) or beyond_ranges(y, limit, learned != y, critical)
            metamodel = metamodel.with_rounding(told) if told is not None and isinstance(metamodel, StepAware) else metamodel
        else:
            metamodel, learned, limit = self.metamodel, centred(u, y, critical), None
        steps = _steps(y, learned) if limit is None else ()
        predictor = beyond(fitted(metamodel, u, learned, rng), limit)
        lowest, highest = _ends(self.critical, y)
        if critical != self.critical:  # what goes on beyond the last value is not beyond an end of M_c that no run lies beyond
            lowest = y.min() if critical.low < self.critical.low and learned.min() < y.min() else lowest
            highest = y.max() if critical.high > self.critical.high and learned.max() > y.max() else highest
        scale = _scale(u, y, self.critical, steps, limit)
        known = scale is not None or np.isfinite([lowest, highest]).any()
        return Ending(predictor, lowest, highest, scale) if known else predictor


def _scale(
    u: Points, y: Vector, critical: CriticalInterval, steps: tuple[tuple[float, float], ...], limit: Limit | None
) -> Scale | None:
    """Return which values the metric has, as far as its runs tell; None: any."""
    if is_flag(y, critical):
        return Scale(float(y.min()), float(y.max()), flag=critical)
    low, high = _last(u, y, y.min(), -np.inf), _last(u, y, y.max(), np.inf)
    if limit is not None:  # what was moved beyond the last value
        low, high = y.min() if limit.at_most.any() else low, high if limit.at_most.all() else y.max()
    return Scale(float(low), float(high), steps) if steps or np.isfinite([low, high]).any() else None


def _steps(y: Vector, learned: Vector) -> tuple[tuple[float, float], ...]:
    """Return (learned, value) pairs of the values y (n,) that were moved, and of their neighbours; none where nothing was."""
    moved = np.unique(y[learned != y])
    if not len(moved):
        return ()
    near = [v for v in (y[y < moved[0]].max(initial=-np.inf), y[y > moved[-1]].min(initial=np.inf)) if np.isfinite(v)]
    pairs = {(float(learned[y == v][0]), float(v)) for v in (*near, *moved)}
    return tuple(sorted(pairs))


def _last(u: Points, y: Vector, end: float, beyond: float) -> float:
    """Return the last value of y (n,), where it ends with it as several inputs u (n, d) have it; else `beyond`."""
    inputs = len(np.unique(u[y == end], axis=0))
    return float(end) if inputs >= max(_LAST, _SHARE_LAST * len(y)) else beyond


def _ends(critical: CriticalInterval, y: Vector) -> tuple[float, float]:
    """Return where the metric ends: the end of M_c that `as_reached` leaves out, and infinity."""
    reached = as_reached(critical, y)
    return critical.low if reached.low < critical.low else -np.inf, critical.high if reached.high > critical.high else np.inf


@dataclass(frozen=True)
class Ending:
    """A predictor of a metric that ends at an end of M_c, or has a scale of its own.

    Args:
        predictor: of the metric, as if it went on.
        lowest, highest: where it ends, at an end of M_c.
        scale: which values it has, for what is told; None: any.
    """

    predictor: Predictor
    lowest: float
    highest: float
    scale: Scale | None = None

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d), which knows where the metric ends."""
        return replace(self.predictor(u), lowest=self.lowest, highest=self.highest, scale=self.scale)

    def __getattr__(self, name: str) -> Any:
        """Return what else the predictor offers: left-out rows, how it compares."""
        if name.startswith("__") or name == "predictor":
            raise AttributeError(name)
        return getattr(self.predictor, name)

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return quick lower and upper bounds (n,) of P(y in M_c); 0 and 1 where the predictor has none."""
        if isinstance(self.predictor, Screened):
            return self.predictor.probability_bounds(u, reached_beyond(critical, self.lowest, self.highest))
        return np.zeros(len(u)), np.ones(len(u))

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the metric as a function, at u (m, d)."""
        return np.clip(sample_paths(self.predictor, u, n, rng), self.lowest, self.highest)

    def sketch(self, rows: int) -> Ending:
        """Return what predicts about the same from so many rows."""
        rough = sketched(self.predictor, rows)
        return self if rough is self.predictor else replace(self, predictor=rough)
