"""A process for a metric that jumps at its critical edge, as it does with contact.

Where the metric is -1.4 on the one side and 0.02 on the other, a smooth process swings across the edge at 0, and takes a plateau
just outside of the critical set for critical by a third. So the jump is widened: critical and uncritical values are moved away
from the edge, and P(critical) is asked of the moved values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.metamodels.gaussian_process import GaussianProcess
from sbt.metamodels.gp_predictor import GaussianProcessPredictor
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.stacking import Bins
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Step", "SteppedPredictor", "better_stepped", "jumps", "side_score"]

_HALF_WIDTHS = (1.0, 4.0)  # of the standard deviation of y
_FEWEST = 4  # runs of equal value next to the edge: a floor
_EQUAL = 1e-6  # of the range
_GAP = 0.2  # of the standard deviation of y between the nearest values on both sides: more than chance leaves
_FEWEST_BESIDE = 5  # runs on each side, from which on a gap tells anything
_EXACT = 0.01  # of the standard deviation of y: a process that predicts all rows near the edge so well goes through it
_NEAR = 2.0  # gaps, at least those that tell of a jump, from the edge
_FEWEST_HITS = 1  # with none, the surest "no" is the best
_SURE = 3.0  # standard errors
_INSIDE = 1e-3  # slope of the way back within the jump


@dataclass(frozen=True)
class Step:
    """y moved away from the edge by `half` on both sides.

    Args:
        edge: the finite end of the critical interval.
        half: >= 0, in the unit of y.
        critical: the interval; one of its ends is infinite.
    """

    edge: float
    half: float
    critical: CriticalInterval

    def moved(self, y: Vector) -> Vector:
        """Return y (n,) moved."""
        return y + np.where(self.critical.contains(y), -1.0, 1.0) * self.critical.outward * self.half

    def values(self, ends: Vector) -> Vector:
        """Return ends (n,) of ranges of y, moved: one at the edge stays there."""
        return ends + np.sign(ends - self.edge) * self.half

    def back(self, moved: Vector) -> Vector:
        """Return values (...,) of y: within the jump they are next to the edge."""
        off = moved - self.edge
        outside = np.sign(off) * np.maximum(np.abs(off) - (1.0 - _INSIDE) * self.half, _INSIDE * np.abs(off))
        return np.asarray(self.edge + outside)

    def prediction(self, found: Prediction) -> Prediction:
        """Return a prediction of moved values as one of y: means go back, P of the critical interval stays."""
        off = found.mean - self.edge
        mean = self.back(found.mean)
        ratio = np.where(np.abs(off) > 1e-12, (mean - self.edge) / np.where(off == 0.0, 1.0, off), _INSIDE)
        ratio = np.maximum(ratio, _INSIDE)
        return Prediction(mean, found.std * ratio, found.weight, found.noise * ratio.mean(axis=0))


@dataclass(frozen=True, eq=False)
class SteppedPredictor:
    """A process of the moved values.

    Args:
        process: fitted to them.
        step: how they were moved.
    """

    process: GaussianProcessPredictor
    step: Step

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction of y at u (n, d)."""
        return self.step.prediction(self.process(u))

    def mu(self, u: Points) -> Vector:
        """Return the (n,) mean of y at u (n, d)."""
        return self.step.back(self.process.mu(u))

    def sketch(self, rows: int) -> SteppedPredictor:
        """Return the same with the sketch of its process."""
        return SteppedPredictor(self.process.sketch(rows), self.step)

    def leave_one_out(self, u: Points, y: Vector) -> Prediction:
        """Return the prediction of each row from all others, see `GaussianProcessPredictor`."""
        return self.step.prediction(self.process.leave_one_out(u, self.step.moved(y)))

    def log_score(self, bins: Bins, u: Points, y: Vector) -> Vector:
        """Return (n,) log probabilities of the ranges that y (n,) at u (n, d) fell into, each row predicted from all others."""
        return bins.log_score(self.process.leave_one_out(u, self.step.moved(y)), y, self.step)

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and upper bounds of P(y in M_c) for the interval that the step is at the edge of."""
        return self.process.probability_bounds(u, critical)

    def sample_paths(self, u: Points, n: int, rng: np.random.Generator) -> Points:
        """Return (n, m) draws of y as a function at u (m, d)."""
        return self.step.back(self.process.sample_paths(u, n, rng))


def better_stepped(
    settings: GaussianProcess, process: GaussianProcessPredictor, critical: CriticalInterval, u: Points, y: Vector,
    shares: Vector, rng: np.random.Generator,
) -> SteppedPredictor | None:  # fmt: skip
    """Return the process of moved values where it predicts the sides of left-out rows better than `process`; else None.

    Only where there seems to be a jump, because a fit costs time; better by three standard errors, and over the space.

    Args:
        settings: of the process.
        process: fitted to y as it is.
        critical: the interval.
        u: (n, d) rows.
        y: (n,) their metric.
        shares: (n,) of the space that each row stands for.
        rng: the only source of randomness.
    """
    if not jumps(y, critical, lambda: process.leave_one_out(u, y)):
        return None
    plain, best, found = side_score(process.leave_one_out(u, y), y, critical), 0.0, None
    for width in _HALF_WIDTHS:
        step = Step(critical.edge, width * float(np.std(y)), critical)
        stepped = SteppedPredictor(settings.fit(u, step.moved(y), rng), step)
        score = side_score(stepped.leave_one_out(u, y), y, critical)
        gain = score - plain
        if gain.mean() > max(_SURE * gain.std() / math.sqrt(len(y)), best) and shares @ gain > 0.0:
            best, found = float(gain.mean()), stepped
    return found


def side_score(prediction: Prediction, y: Vector, critical: CriticalInterval) -> Vector:
    """Return (n,) log P(the side of the edge that y fell on)."""
    inside, outside = prediction.log_probability(critical)
    return np.where(critical.contains(y), inside, outside)


def jumps(y: Vector, critical: CriticalInterval, left_out: Callable[[], Prediction] | None = None) -> bool:
    """Say whether y (n,) seems to jump at the only end of the critical interval: a floor at it, or a gap.

    It does not where a process predicts the rows near the edge from all others (`left_out`): runs at the edge that lie on one
    side by chance, or by choice, leave a gap beside it, and cost it log 2 each however well it knows where the edge is.
    """
    if not critical.one_sided:
        return False
    margin, hit = critical.margin(y), critical.contains(y)
    if int(hit.sum()) < _FEWEST_HITS or hit.all():
        return False
    nearest, spread = float(margin[~hit].min()), float(np.std(y))
    gap = nearest - float(margin[hit].max())
    floor: Mask = margin[~hit] <= nearest + _EQUAL * float(np.ptp(y))
    on_floor = int(floor.sum()) >= _FEWEST and not floor.all()
    beside = min(int(hit.sum()), int((~hit).sum())) >= _FEWEST_BESIDE
    if not on_floor and not (beside and gap > _GAP * spread):
        return False
    near = np.abs(margin) <= _NEAR * max(gap, _GAP * spread)
    return left_out is None or float(np.abs(left_out().mu - y)[near].max(initial=0.0)) > _EXACT * spread
