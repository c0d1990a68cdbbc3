"""A process of a metric of two values, as a collision has: P(critical) by a probit link.

A process of the values takes them for Gaussian. One run of ninety that collides is nine standard deviations from the others, so
that a collision is impossible wherever nothing is known; with two or three runs, where the sides meet is as sure as it is wrong.
Of a noisy simulator it has one noise for a rate of .05 and one of .45. Labels say no more than on which side a run fell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from sbt.metamodels.base import gives_different
from sbt.metamodels.classifier import Classifier, classifier
from sbt.metamodels.expectation_propagation import latent, latent_paths
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.rounded import RoundedPredictor, rounded_process, two_ranges
from sbt.metamodels.sided import placed_by
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["FlagPredictor", "flag_process"]

_MOST = 1000
"""Runs of a noisy flag that are learned from at most, drawn at random: expectation propagation costs their cube."""


@dataclass(frozen=True, eq=False)
class FlagPredictor:
    """A process of how often a noisy flag is critical, as one of the metric.

    Args:
        process: fitted to the labels, True where a run is critical.
        critical: M_c, in the unit of the metric; one of its ends is infinite.
        apart: distance of the metric's two values > 0.
    """

    process: Classifier
    critical: CriticalInterval
    apart: float

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d)."""
        mean, variance = latent(u, self.process.u, self.process.hyper, self.process.belief)
        width = np.sqrt(1.0 + variance)
        told, std = placed_by(self.critical, -mean / width, self.apart)
        return Prediction.gaussian(told, std, std / width)

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self(u).mean[0]

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the mean of y as a function at u (m, d), which is that of a rate; the cost is cubic in m."""
        drawn = latent_paths(u, self.process.u, self.process.hyper, self.process.belief, n, rng)
        return placed_by(self.critical, -drawn, self.apart)[0]


def flag_process(
    critical: CriticalInterval, u: Points, y: Vector, rng: np.random.Generator
) -> tuple[FlagPredictor | RoundedPredictor, Vector]:
    """Return the process of a metric of two values, and (n,) log P(side) of left-out rows.

    Where equal rows agree it is that of a function of which the metric tells the side; else that of a rate.

    Args:
        critical: M_c, which has one of them; one of its ends is infinite.
        u: (n, d) rows.
        y: (n,) their metric.
        rng: the only source of randomness.
    """
    if not gives_different(u, y):
        return rounded_process(two_ranges(y), critical, u, y, None, rng)
    hit, rows = critical.contains(y), np.sort(rng.permutation(len(y))[:_MOST])
    if not hit[rows].any() or hit[rows].all():  # neither would be learned of
        rows[0] = int(np.flatnonzero(hit != hit[rows[0]])[0])
    process = classifier(u[rows], hit[rows], rng)
    mean, variance = latent(u, process.u, process.hyper, process.belief)
    mean[rows], variance[rows] = process.hyper.mean + process.belief.beside, process.belief.wide
    ratio = mean / np.sqrt(1.0 + variance)
    return FlagPredictor(process, critical, float(np.ptp(y))), log_ndtr(np.where(hit, ratio, -ratio))
