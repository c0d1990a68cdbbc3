"""How often a run is critical, learned beside the values of a noisy metric that chance makes now this and now that.

Where traffic decides whether there is a conflict, a time to collision is .4 s with three seeds in ten and 10 s with the others,
and a count of conflicts is skewed. A process of such values has Gaussian noise: its P(critical) is that of a bell about 7 s.
Labels of 0 and 1 have the rate as their mean, whatever the noise is, but do not know how near to the edge a run was. So both are
asked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri
from scipy.stats import normaltest

from sbt.metamodels.base import gives_different
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.noise_shape import ShapedPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import mixture_score, stacking_weights
from sbt.metamodels.stepped import SteppedPredictor, side_score
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["LabelledPredictor", "better_labelled"]

Values = GaussianProcessPredictor | ShapedPredictor | SteppedPredictor

_FEWEST = 30  # rows, from which on a shape shows
_GAUSSIAN = 0.05  # P(Gaussian errors are as skewed or heavy-tailed), above which labels are not asked
_PRIOR = 5.0  # weight of equal weights, in rows, as of the metamodels that are mixed
_NARROWEST = 0.1  # standard deviation of y, of that by the values, where they lie on the other side than P says


@dataclass(frozen=True, eq=False)
class LabelledPredictor:
    """A process of labels, 1 where a run is critical, and a predictor of the values: P(critical) is a mean of both.

    Args:
        process: fitted to the labels.
        values: fitted to the metric.
        critical: M_c, in the unit of the metric; one of its ends is infinite.
        weight: of the labels, in [0, 1].
    """

    process: GaussianProcessPredictor
    values: Values
    critical: CriticalInterval
    weight: float

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d): of all Gaussians with that P the nearest one to what the values say."""
        found = self.values(u)
        mean, std = found.mu, found.sigma
        p = self.weight * _rates(self.process, u) + (1.0 - self.weight) * found.probability(self.critical)
        ratio = -ndtri(np.clip(p, 1e-12, 1.0 - 1e-12))
        off = self.critical.outward * (mean - self.critical.edge)
        width = np.maximum((std + ratio * off) / (1.0 + ratio**2), _NARROWEST * std)
        return Prediction.gaussian(self.critical.edge + self.critical.outward * ratio * width, width, width * found.noise / std)

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self(u).mean[0]

    def sketch(self, rows: int) -> LabelledPredictor:
        """Return the same with the sketches of its processes."""
        return replace(self, process=self.process.sketch(rows), values=self.values.sketch(rows))

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d): those of the values, about the mean and as wide as y is here."""
        told, found = self(u), self.values(u)
        return told.mean[0] + (self.values.sample_paths(u, n, rng) - found.mu) * (told.std[0] / found.sigma)


def _rates(process: GaussianProcessPredictor, u: Points) -> Vector:
    """Return (n,) P(critical) by a process of labels, never closer to 0 or 1 than its rows can tell (rule of succession)."""
    return _within(process.mu(u), len(process.u))


def _within(mean: Vector, n: int) -> Vector:
    least = 1.0 / (n + 2.0)
    return np.clip(mean, least, 1.0 - least)


def better_labelled(
    settings: GaussianProcess, values: Values, critical: CriticalInterval, u: Points, y: Vector, shares: Vector,
    rng: np.random.Generator,
) -> tuple[LabelledPredictor, Vector] | None:  # fmt: skip
    """Return a mean of labels and values, and (n,) log P(side) of left-out rows by it; None where there is no use for labels.

    Only where equal rows differ, and left-out errors of the values are not Gaussian: of Gaussian noise a process of the values
    knows more. A flag has labels alone (`flags`). The weights are those by which left-out sides are likeliest, rows and
    space counting the same; few rows say too little to choose one of both.

    Args:
        settings: of the process.
        values: predictor of the metric, with its own P(side).
        critical: M_c.
        u: (n, d) rows.
        y: (n,) their metric.
        shares: (n,) of the space that each row stands for.
        rng: the only source of randomness.
    """
    hit = critical.contains(y)
    if not critical.one_sided or len(y) < _FEWEST or not hit.any() or hit.all() or not gives_different(u, y):
        return None
    if _gaussian(values, u, y):
        return None
    labels = hit.astype(np.float64)
    process = settings.for_noise.fit(u, labels, rng)
    p = _within(process.leave_one_out(u, labels).mean[0], len(y))
    scores = np.stack([np.log(np.where(hit, p, 1.0 - p)), side_score(values.leave_one_out(u, y), y, critical)])
    weights = stacking_weights(scores, _PRIOR, 0.5 + 0.5 * len(y) * shares / shares.sum())
    return LabelledPredictor(process, values, critical, float(weights[0])), mixture_score(scores, weights)


def _gaussian(values: Values, u: Points, y: Vector) -> bool:
    """Return whether left-out errors of the values look like Gaussian noise."""
    process = values if isinstance(values, GaussianProcessPredictor) else values.process
    learned = values.step.moved(y) if isinstance(values, SteppedPredictor) else y
    left_out = process.leave_one_out(u, learned)
    return bool(normaltest((learned - left_out.mean[0]) / left_out.std[0]).pvalue > _GAUSSIAN)
