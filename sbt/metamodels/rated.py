"""A process of how often a run is critical, of a noisy metric that has two values, as a collision has that traffic decides.

A process of such a metric has one Gaussian noise for a rate of .05 and one of .45, and says of both what neither is. Labels of 0
and 1 have the rate as their mean, whatever the noise is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from sbt.metamodels.base import is_rate
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.sided import placed_by
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["RatePredictor", "better_rate"]


@dataclass(frozen=True, eq=False)
class RatePredictor:
    """A process of labels, 1 where a run is critical: P(critical) is its mean, never closer to 0 or 1 than n runs can tell.

    Args:
        process: fitted to the labels.
        critical: M_c, in the unit of the metric; one of its ends is infinite.
        apart: distance of the metric's two values > 0.
    """

    process: GaussianProcessPredictor
    critical: CriticalInterval
    apart: float

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d): its P of the critical interval is the rate."""
        found = self.process(u)
        mean, std = self._of_rates(found.mean[0])
        return Prediction.gaussian(mean, std, std * found.noise / found.std[0])

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self(u).mean[0]

    def sketch(self, rows: int) -> RatePredictor:
        """Return the same with the sketch of its process."""
        return replace(self, process=self.process.sketch(rows))

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d)."""
        return self._of_rates(self.process.sample_paths(u, n, rng))[0]

    def rates(self, mean: Points) -> Points:
        """Return P(critical) where the labels' mean is (..., n), by the rule of succession."""
        least = 1.0 / (len(self.process.u) + 2.0)
        return np.clip(mean, least, 1.0 - least)

    def _of_rates(self, mean: Points) -> tuple[Points, Points]:
        return placed_by(self.critical, -ndtri(self.rates(mean)), self.apart)


def better_rate(
    settings: GaussianProcess, score: Vector, critical: CriticalInterval, u: Points, y: Vector, rng: np.random.Generator
) -> tuple[RatePredictor, Vector] | None:
    """Return a process of the rate, and (n,) what it gains in log P(side) of left-out rows; None where that is nothing.

    Args:
        settings: of the process.
        score: (n,) log P(side) that each row has by another metamodel of the others.
        critical: M_c.
        u: (n, d) rows.
        y: (n,) their metric.
        rng: the only source of randomness.
    """
    if not critical.one_sided or not is_rate(u, y):
        return None
    hit = critical.contains(y)
    process = settings.for_noise.fit(u, hit.astype(np.float64), rng)
    found = RatePredictor(process, critical, float(np.ptp(y)))
    p = found.rates(process.leave_one_out(u, hit.astype(np.float64)).mean[0])
    gain = np.log(np.where(hit, p, 1.0 - p)) - score
    return (found, gain) if gain.mean() > 0.0 else None
