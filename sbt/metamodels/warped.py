"""Metrics are learned in the unit in which their runs are predicted best: warped around the critical edge, on either side apart.

Far values decide the scale of a process and the means of a tree: 1e6 where nothing happens, values over many orders of magnitude,
a slope that is steeper on one side of the edge, a jump at it. In the warped unit an outlier is a few units away, both sides are
alike, and P(critical) is the same before and after.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.metamodels.base import Predictor, Screened, sample_paths, sketched
from sbt.metamodels.censored import Limit, beyond
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import Bins, cell_shares
from sbt.metamodels.warp import LogWarp, Warp
from sbt.metamodels.warped_prediction import WarpedPrediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

if TYPE_CHECKING:
    from sbt.metamodels.gaussian_process import GaussianProcess

__all__ = ["WarpedPredictor", "better_warp"]

_QUANTILES = (0.5, 0.25)  # of the distances to the edge: scales that are tried
_HEAVY, _SMALLER = 10.0, (0.1, 0.03)  # standard deviation over the median distance from which on smaller ones are, too
_STEEPEST = 16.0  # one side's scale over the other's
_FEWEST, _MOST = 10, 200  # rows, from which on warps are compared, and on which at most: half of them those nearest to the edge
_SURE, _SURER, _FEW = 2.0, 3.0, 8  # standard errors, and while so few rows lie on one side: units were taken by chance


def better_warp(
    settings: GaussianProcess, u: Points, y: Vector, critical: CriticalInterval, gap: tuple[float, float] = (0.0, 0.0)
) -> Warp | None:  # fmt: skip
    """Return the warp in whose unit y is learned best; None where its own is, or where M_c has two ends or none.

    Rows are predicted from all others, and scored by the range that they fell into (see `Bins`), half of the weight even, half by
    the share of the space that a row stands for. Scales come first, then how much larger one side's is than the other's.

    Args:
        settings: of the process.
        u: (n, d) rows.
        y: (n,) their metric.
        critical: M_c.
        gap: of the warps, see `gap_of`.
    """
    if not critical.one_sided or len(y) < _FEWEST:
        return None
    edge = critical.edge
    rng = np.random.Generator(np.random.PCG64(0))
    if len(y) > _MOST:
        order = np.argsort(np.abs(y - edge), kind="stable")
        rows = np.sort(np.concatenate([order[: _MOST // 2], rng.permutation(order[_MOST // 2 :])[: _MOST - _MOST // 2]]))
        u, y = u[rows], y[rows]
    distance = np.abs(y - edge)
    if not (distance > 0.0).any() or not np.ptp(y) > 0.0:
        return None
    judge, bins = replace(settings, kernels=1), Bins.around_edge(y, critical)
    weight = 0.5 / len(y) + 0.5 * cell_shares(u, rng)

    inside = critical.contains(y)

    def score(warp: Warp | None) -> Points:
        """Return (2, n) log probabilities of the range that y fell into, and of the side of the edge."""
        values, ends = (y, critical) if warp is None else (warp.values(y), warp.interval(critical))
        left_out = judge.fit(u, values, np.random.Generator(np.random.PCG64(1))).leave_one_out(u, values)
        return np.stack([bins.log_score(left_out, y, warp), np.where(inside, *left_out.log_probability(ends))])

    plain = score(None)

    def gained(warp: Warp) -> tuple[float, float, float]:
        """Return the mean gain over no warp, its standard error, and the mean gain of the sides alone."""
        gain = score(warp) - plain
        mean = gain @ weight
        error = np.sqrt((gain - mean[:, None]) ** 2 @ weight**2)
        return float(mean[0]), float(error[0]), float(mean[1])

    tried = {warp: gained(warp) for warp in _warps(y, critical, gap)}
    best = max(tried, key=lambda warp: tried[warp][0])
    if tried[best][0] < -tried[best][1]:
        return None  # as good as never is one side's scale another then
    for factor in (2.0, 0.5) if inside.any() and not inside.all() else ():
        while (warp := _steeper(best, factor, critical)) not in tried:
            tried[warp] = gained(warp)
            if tried[warp][0] > tried[best][0]:
                best = warp
    best = max(tried, key=lambda warp: tried[warp][0] if tried[warp][2] >= 0.0 else -math.inf)  # no unit may hide the sides
    mean, error, sides = tried[best]
    few = min(int(inside.sum()), int((~inside).sum())) < _FEW
    return best if sides >= 0.0 and mean > (_SURER if few else _SURE) * error else None


def _warps(y: Vector, critical: CriticalInterval, gap: tuple[float, float]) -> list[Warp]:
    """Return warps of y (n,) with this gap and one scale on both sides: usual distances to the edge of uncritical values."""
    distance, safe = np.abs(Warp(critical.edge, 1.0, gap=gap).kept(y)), ~critical.contains(y)
    positive = distance > 0.0
    among = distance[positive & safe] if (positive & safe).any() else distance[positive]
    heavy = float(np.std(y)) > _HEAVY * float(np.median(distance))
    scales = np.unique(np.quantile(among, _QUANTILES + _SMALLER * heavy))
    warps = [Warp(critical.edge, scale, gap=gap) for scale in scales.tolist()]
    logs = critical.edge > 0.0 and y.min() > 0.0 and gap == (0.0, 0.0)
    return [*warps, LogWarp.around(critical.edge)] if logs else warps


def _steeper(warp: Warp, factor: float, critical: CriticalInterval) -> Warp:
    """Return the warp with a scale of the critical side that is so much larger; itself where it is large, or small, enough."""
    if isinstance(warp, LogWarp):
        return warp
    above = warp.scale if warp.above is None else warp.above
    below, above = (warp.scale * factor, above) if math.isfinite(critical.high) else (warp.scale, above * factor)
    return replace(warp, scale=below, above=above) if 1.0 / _STEEPEST <= below / above <= _STEEPEST else warp


@dataclass(frozen=True, eq=False)
class WarpedPredictor:
    """A predictor of the warped metric, as one of the metric.

    Args:
        predictor: of the warped metric.
        warp: increasing.
    """

    predictor: Predictor
    warp: Warp

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d)."""
        return WarpedPrediction.of(self.predictor(u), self.warp)

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and upper bounds of P(y in M_c) at u (n, d)."""
        warped = self.warp.interval(critical)
        if isinstance(self.predictor, Screened):
            return self.predictor.probability_bounds(u, warped)
        p = self.predictor(u).probability(warped)
        return p, p

    def beyond(self, limit: Limit) -> WarpedPredictor:
        """Return the same with a predictor that knows the limit, where it can."""
        return replace(self, predictor=beyond(self.predictor, limit.moved(self.warp.values)))

    def sketch(self, rows: int) -> WarpedPredictor:
        """Return the same with the sketch of its predictor."""
        return WarpedPredictor(sketched(self.predictor, rows), self.warp)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d)."""
        return self.warp.back(sample_paths(self.predictor, u, n, rng))

    @property
    def comparison(self) -> Any:
        """Of a mixture, how its models were compared; None: there was nothing to compare."""
        return getattr(self.predictor, "comparison", None)
