"""A process that learns on which side of the critical edge a run falls, where the metric jumps there.

Of a collision, a count or a metric of three values a process learns plateaus and a wall between them: its length scales are those
of the wall, and far from any run it knows next to nothing. How far a run is from the nearest one on the other side changes evenly
over the space, and is 0 where the sides meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

from sbt.metamodels.base import gives_different
from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_algebra import inverse_lower
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.noise_shape import ShapedPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import surely_positive
from sbt.metamodels.stepped import SteppedPredictor, jumps, side_score
from sbt.metamodels.torch_tools import single_threaded
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["SidedPredictor", "better_sided", "placed_by"]

Values = GaussianProcessPredictor | ShapedPredictor | SteppedPredictor

_FEWEST, _MOST = 3, 2000  # runs on each side; in all: one inverse of their covariance
_SURE = 1.0  # standard errors: left-out runs, most of them at the edge, say less for distances than points of the space do
_FACTORS = np.geomspace(1.0, 8.0, 13)  # of the standard deviation
_LEAST = 0.1  # distance of the mean from the edge, in standard deviations of y, where the values are on the other side


@dataclass(frozen=True, eq=False)
class SidedPredictor:
    """A process of signed distances, negative where runs are critical, that knows the sides, and a predictor of the values.

    Args:
        process: fitted to the distances of runs to the nearest one on the other side.
        values: fitted to the metric.
        critical: M_c, in the unit of the metric; one of its ends is infinite.
        factor: on the standard deviation of the distance, >= 1.
        least: distance > 0 of the mean from the edge at least, in the unit of the metric.
    """

    process: GaussianProcessPredictor
    values: Values
    critical: CriticalInterval
    factor: float
    least: float

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d): P of the critical interval is that of a negative distance."""
        found = self.process(u)
        mean, std = self._of_values(found.mean[0] / (self.factor * found.std[0]), self.values.mu(u))
        return Prediction(mean[None], std[None], np.ones(1), np.zeros(len(u)))

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self(u).mean[0]

    def sketch(self, rows: int) -> SidedPredictor:
        """Return the same with the sketches of its processes."""
        return replace(self, process=self.process.sketch(rows), values=self.values.sketch(rows))

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d)."""
        found, drawn = self.process(u), self.process.sample_paths(u, n, rng)
        mean, std = found.mean[0], found.std[0]
        latent = np.sqrt(np.maximum(std**2 - found.noise**2, 1e-12 * std**2))  # what the distance is not sure of is the side's
        ratio = mean / (self.factor * std) + (drawn - mean) / latent
        return self._of_values(ratio, self.values.mu(u))[0]

    def _of_values(self, ratio: Points, value: Vector) -> tuple[Points, Points]:
        """Return mean and standard deviation of y where the distance is (..., n) of its own and `values` predicts (n,)."""
        far = _side(self.critical, ratio) * (value - self.critical.edge)
        return placed_by(self.critical, ratio, np.maximum(far, self.least))


def placed_by(critical: CriticalInterval, ratio: Points, far: Points | float) -> tuple[Points, Points]:
    """Return mean and standard deviation of y that is critical with the probability of a Gaussian below -ratio (..., n).

    The mean is on the likelier side, up to `far` from the edge, at the edge where neither is likelier.
    """
    size = np.sqrt(1.0 + ratio**2)
    return critical.edge + _side(critical, ratio) * far * np.abs(ratio) / size, far / size


def _side(critical: CriticalInterval, ratio: Points) -> Points:
    """Return in which direction from the edge the likelier side lies, 1 or -1."""
    return np.where(ratio < 0.0, -1.0, 1.0) * critical.outward


def better_sided(
    settings: GaussianProcess, values: Values, critical: CriticalInterval, u: Points, y: Vector, shares: Vector,
    rng: np.random.Generator,
) -> tuple[SidedPredictor, Vector] | None:  # fmt: skip
    """Return a process of signed distances, and (n,) what it gains in log P(side) of left-out rows; None where that is nothing.

    Only where the metric seems to jump at the edge of M_c, and equal rows agree. Distances are measured in the length scales of
    a process of the metric. Where a row is left out, the distances of others that it was nearest to are to the next one.

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
    few = min(int(hit.sum()), int((~hit).sum())) < _FEWEST
    if few or len(y) > _MOST or gives_different(u, y) or not jumps(y, critical, lambda: values.leave_one_out(u, y)):
        return None
    plain = values if isinstance(values, GaussianProcessPredictor) else values.process
    longest = plain.hyper.lengthscale[int(np.argmax(plain.hyper.outputscale))]
    distance, without, nearest = _signed(u / longest, hit)
    process = settings.fit(u, distance, rng)
    if len(process.u) != len(u):  # repetitions, which it learned once
        return None
    ratio = _left_out(process, u, distance, without, nearest)
    sign = np.where(hit, -1.0, 1.0)
    scores = log_ndtr(sign * ratio / _FACTORS[:, None])
    best = int(np.argmax(scores @ (0.5 / len(y) + 0.5 * shares)))
    gain = scores[best] - side_score(values.leave_one_out(u, y), y, critical)
    if not (surely_positive(gain, _SURE) and shares @ gain > 0.0):
        return None
    return SidedPredictor(process, values, critical, float(_FACTORS[best]), _LEAST * float(np.std(y))), gain


def _signed(v: Points, hit: Mask) -> tuple[Vector, Vector, NDArray[np.intp]]:
    """Return (n,) signed distances of v (n, d) to the nearest row on the other side, to the next one, and which is nearest."""
    distance, nearest = np.empty((len(v), 2)), np.empty(len(v), dtype=np.intp)
    for mine, others in ((hit, ~hit), (~hit, hit)):
        distance[mine], found = cKDTree(v[others]).query(v[mine], k=2)
        nearest[mine] = np.flatnonzero(others)[found[:, 0]]
    distance *= np.where(hit, -1.0, 1.0)[:, None]
    return distance[:, 0], distance[:, 1], nearest


def _left_out(
    process: GaussianProcessPredictor, u: Points, distance: Vector, without: Vector, nearest: NDArray[np.intp]
) -> Vector:
    """Return (n,) means over standard deviations of each distance, predicted from all other rows."""
    found, rows = process.leave_one_out(u, distance), np.arange(len(u))
    with single_threaded():
        inverse = inverse_lower(process.factor)
    mean, across = found.mean[0].copy(), inverse[np.maximum(nearest, rows), np.minimum(nearest, rows)]
    np.add.at(mean, nearest, -across / inverse[nearest, nearest] * (without - distance))
    return np.asarray(mean / found.std[0])
