"""Metrics with heavy tails are learned in a warped unit: 1e6 where nothing happens, or values over many orders of magnitude.

Such values decide the scale of a process and the means of a tree, and near the edge nothing is left of the metric. In the warped
unit an outlier is a few units away, and P(critical) is the same before and after.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbt.metamodels.base import Predictor, Screened, sample_paths, sketched
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import cell_shares
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["WarpedPredictor", "warp_of_heavy_tails"]

_HEAVY = 10.0  # standard deviation over the median distance to the edge: 0.7 of a normal metric, 2 of an exponential one
_QUANTILES = (0.5, 0.25, 0.1, 0.03)  # of the distances to the edge: scales that are tried
_FEWEST = 10  # rows, from which on scales are compared
_FARTHEST = 300.0  # warped units, beyond which values are no numbers any more


def warp_of_heavy_tails(settings: GaussianProcess, u: Points, y: Vector, critical: CriticalInterval) -> Warp | None:
    """Return the warp in whose unit y is learned best; None where its own is, tails are not heavy, or M_c has two ends or none.

    The process gives left-out rows the largest density there, of a few scales. Where runs crowd at the edge of a smooth metric
    tails look heavy, too, and its own unit is the best.

    Args:
        settings: of the process.
        u: (n, d) rows.
        y: (n,) their metric.
        critical: M_c.
    """
    if math.isfinite(critical.low) == math.isfinite(critical.high) or len(y) < _FEWEST:
        return None
    edge = critical.high if math.isfinite(critical.high) else critical.low
    distance, rng = np.abs(y - edge), np.random.Generator(np.random.PCG64(0))
    if not np.std(y) > _HEAVY * np.median(distance) > 0.0 or not _heavy_over_space(distance, cell_shares(u, rng)):
        return None

    def score(warp: Warp | None) -> float:
        learned, slope = (y, 0.0) if warp is None else (warp.values(y), warp.log_slope(y))
        return float((settings.fit(u, learned, rng).leave_one_out(u, learned).log_density(learned) + slope).mean())

    scales = np.unique(np.quantile(distance[distance > 0.0], _QUANTILES)).tolist()
    return max((None, *(Warp(edge, scale) for scale in scales)), key=score)


def _heavy_over_space(distance: Vector, share: Vector) -> bool:
    """Say whether distances to the edge (n,) are heavy-tailed over the space, as runs crowd at the edge."""
    order = np.argsort(distance)
    middle = float(distance[order][np.searchsorted(np.cumsum(share[order]), 0.5 * share.sum())])
    mean = float(np.average(distance, weights=share))
    return math.sqrt(float(np.average((distance - mean) ** 2, weights=share))) > _HEAVY * middle


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
        """Return the prediction of y at u (n, d): of each component the mean goes back, and P(y beyond the edge) stays."""
        found = self.predictor(u)
        mean = np.clip(found.mean, -_FARTHEST, _FARTHEST)
        ratio = self.warp.scale * np.divide(np.sinh(mean), mean, out=np.ones_like(mean), where=np.abs(mean) > 1e-6)
        return Prediction(self.warp.edge + ratio * mean, found.std * ratio, found.weight, found.noise * (found.weight @ ratio))

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and upper bounds of P(y in M_c) at u (n, d)."""
        warped = self.warp.interval(critical)
        if isinstance(self.predictor, Screened):
            return self.predictor.probability_bounds(u, warped)
        p = self.predictor(u).probability(warped)
        return p, p

    def sketch(self, rows: int) -> WarpedPredictor:
        """Return the same with the sketch of its predictor."""
        return WarpedPredictor(sketched(self.predictor, rows), self.warp)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d)."""
        return self.warp.back(np.clip(sample_paths(self.predictor, u, n, rng), -_FARTHEST, _FARTHEST))

    @property
    def comparison(self) -> Any:
        """Of a mixture, how its models were compared; None: there was nothing to compare."""
        return getattr(self.predictor, "comparison", None)
