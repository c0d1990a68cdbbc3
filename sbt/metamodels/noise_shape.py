"""The shape of noise: what a seed adds is seldom Gaussian, and seldom the same everywhere.

A time to collision has a cap, and one seed in fifty ends in a collision wherever: of a metric that is critical with 2 % of the
seeds a process with Gaussian noise stated 1e-6. So the noise is a mixture of Gaussians, learned from left-out rows. Dense traffic
decides more than sparse traffic does: where that predicts the sides of left-out rows better, the noise depends on the inputs.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.metamodels.base import gives_different
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import surely_positive
from sbt.metamodels.stepped import side_score
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["ShapedPredictor", "better_uneven", "shaped"]

_MOST = 4  # components
_FEWEST = 30  # rows, from which on a shape shows
_NARROWEST = 0.02  # variance of a component, of the prediction's
_NOISY = 0.1  # share of the noise in the variance of y, from which on its shape counts
_UNEVEN, _TIED = 0.05, 0.05  # the same where it may depend on the inputs; share of rows of one value, as of a cap, up to which
_SURE = 2.0  # standard errors by which it must predict left-out rows better then, as in estimations
_PRICE = 2.0  # log probability of the sides of all rows by which the shape must be better (as in Akaike's criterion)


@dataclass(frozen=True, eq=False)
class ShapedPredictor:
    """A Gaussian process whose errors are distributed as a mixture of Gaussians.

    Args:
        process: its mean and standard deviation.
        offset: (k,) means of the components, in standard deviations; 0 in the mean.
        width: (k,) their standard deviations > 0, likewise.
        weight: (k,) sum 1.
    """

    process: GaussianProcessPredictor
    offset: Vector
    width: Vector
    weight: Vector

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        return self._shaped(self.process(u))

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self.process.mu(u)

    def leave_one_out(self, u: Points, y: Vector) -> Prediction:
        """Return the prediction of each row from all others, see `GaussianProcessPredictor`; the shape is kept."""
        return self._shaped(self.process.leave_one_out(u, y))

    def sketch(self, rows: int) -> ShapedPredictor:
        """Return the same with the sketch of its process."""
        return ShapedPredictor(self.process.sketch(rows), self.offset, self.width, self.weight)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of the mean of y as a function at u (m, d)."""
        return self.process.sample_paths(u, n, rng)

    def _shaped(self, p: Prediction) -> Prediction:
        mean, std = p.mean + self.offset[:, None] * p.std, self.width[:, None] * p.std
        size = float(np.sqrt(self.weight @ (self.width**2 + self.offset**2)))
        return Prediction(mean, std, self.weight, size * p.noise)


def shaped(
    process: GaussianProcessPredictor, u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator
) -> ShapedPredictor | None:
    """Return the process with the shape of its errors where equal rows differ and the sides are predicted better so; else None.

    The number of components is that of the least Akaike criterion.

    Args:
        process: fitted to y, its errors Gaussian.
        u: (n, d) rows.
        y: (n,) their metric.
        critical: M_c.
        rng: the only source of randomness.
    """
    if not _noisy(process, u, y, _NOISY):
        return None
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture  # its import takes a quarter of a second

    left_out, inside = process.leave_one_out(u, y), critical.contains(y)
    error = ((y - left_out.mean[0]) / left_out.std[0])[:, None]
    best, least = None, float((error**2 + np.log(2.0 * np.pi)).sum())
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # of two values there is hardly a mixture: it need not be the best
        for k in range(1, min(_MOST, len(np.unique(error))) + 1):
            mixture = GaussianMixture(k, reg_covar=_NARROWEST, n_init=2, random_state=int(rng.integers(2**31))).fit(error)
            if mixture.aic(error) < least:
                best, least = mixture, float(mixture.aic(error))
    if best is None:
        return None
    offset = best.means_[:, 0] - float(best.weights_ @ best.means_[:, 0])
    found = ShapedPredictor(process, offset, np.sqrt(best.covariances_[:, 0, 0]), best.weights_ / best.weights_.sum())
    sides = [np.where(inside, *p.log_probability(critical)).sum() for p in (found._shaped(left_out), left_out)]
    return found if sides[0] > sides[1] + _PRICE else None


def better_uneven(
    settings: GaussianProcess, process: GaussianProcessPredictor, critical: CriticalInterval, u: Points, y: Vector,
    shares: Vector, rng: np.random.Generator,
) -> GaussianProcessPredictor | None:  # fmt: skip
    """Return a process whose noise depends on the inputs where equal rows differ and it predicts left-out rows better; else None.

    Not where many rows have one value: next to a cap there is little noise, and beyond it none that could be learned.

    Args:
        settings: of the process.
        process: fitted to y with one noise.
        critical: M_c.
        u: (n, d) rows.
        y: (n,) their metric.
        shares: (n,) of the space that each row stands for.
        rng: the only source of randomness.
    """
    if not _noisy(process, u, y, _UNEVEN) or np.unique(y, return_counts=True)[1].max() > _TIED * len(y):
        return None
    uneven = settings.with_input_noise.fit(u, y, rng)
    one, other = process.leave_one_out(u, y), uneven.leave_one_out(u, y)
    gain = other.log_density(y) - one.log_density(y)
    sides = side_score(other, y, critical) - side_score(one, y, critical)
    return uneven if surely_positive(gain, _SURE) and sides.mean() > 0.0 and shares @ sides > 0.0 else None


def _noisy(process: GaussianProcessPredictor, u: Points, y: Vector, least: float) -> bool:
    """Return whether noise is worth a closer look: equal rows differ, and it is not small."""
    return len(y) >= _FEWEST and process.hyper.noise >= least and gives_different(u, y)
