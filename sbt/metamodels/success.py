"""Where runs succeed: P(a run gives a metric), learned from the runs that did and those that did not.

A run that fails tells nothing about the metric, so that a metamodel of the metric alone stays uncertain where runs
fail, and everything that looks for uncertainty goes there again and again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sbt.metamodels.classifier import classifier
from sbt.problem.arrays import Mask, Points, Vector

if TYPE_CHECKING:
    from sbt.metamodels.extra_trees import ForestPredictor
    from sbt.metamodels.gaussian_process import GaussianProcessPredictor

__all__ = ["LogSuccess", "Success", "failure_probability", "learned_success"]

LogSuccess = Callable[[Points], Vector]
"""(n, d) metamodel inputs -> (n,) log P(a run there gives a metric) <= 0, -inf where one is not worth the try."""

_LEAST, _LEAST_OF_BASE = 0.1, 0.5
"""Below the smaller of a tenth and half of the share of runs that succeed, a place is left to the space-filling runs."""
_MOST_EXACT = 1000  # rows up to which a Gaussian process takes seconds; a forest is quicker from there on
_SURE = 0.95  # P by a forest, from which on a run gives a metric, and below 1 - which it fails
_SHOWN = 4.0  # log evidence of the inputs above that of chance; labels of chance reach 4 once in eighty
_COMPARED = 300  # rows of many that this is asked of


@dataclass(frozen=True, eq=False)
class Success:
    """Log P(a run gives a metric), as a function.

    Attributes:
        predict: (n, d) points -> (n,) P.
        ends: the same -> (n,) ends of the 95 % interval of P.
        least: P below which the log is -inf.
        gain: log evidence that inputs decide which runs fail, above that of chance alone.
    """

    predict: Callable[[Points], Vector]
    ends: Callable[[Points], tuple[Vector, Vector]]
    least: float
    gain: float

    def __call__(self, points: Points) -> Vector:
        """Return (n,) log P, -inf where a run would most likely be lost."""
        p = np.clip(self.predict(points), 0.0, 1.0)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(np.where(p < self.least, 0.0, p)))

    @property
    def shown(self) -> bool:
        """Whether it shows that inputs decide which runs fail."""
        return self.gain > _SHOWN

    def of(self, inputs: Callable[[Points], Points]) -> Success:
        """Return the same of points of which `inputs` makes its own."""
        return replace(self, predict=lambda u: self.predict(inputs(u)), ends=lambda u: self.ends(inputs(u)))


def learned_success(u: Points, ok: Mask, rng: np.random.Generator) -> Success | None:
    """Return log P(a run gives a metric), of which shares of the space can be told; None where all runs gave one, or none.

    Least squares on labels would smooth small places away in which all runs fail (docs/measured/boundary.md).

    Args:
        u: (n, d) metamodel inputs of all runs.
        ok: (n,) the run gave a metric.
        rng: of the fit.
    """
    if len(u) < 2 or ok.all() or not ok.any():
        return None
    least = min(_LEAST, _LEAST_OF_BASE * float(ok.mean()))
    if len(u) <= _MOST_EXACT:
        found = classifier(u, ok, rng)
        return Success(found, found.ends, least, found.gain)
    predictor = _fitted(u, ok, rng)

    def ends(points: Points) -> tuple[Vector, Vector]:
        p = np.clip(predictor(points).mu, 0.0, 1.0)
        return np.where(p > _SURE, p, 0.0), np.where(p < 1.0 - _SURE, p, 1.0)

    few = rng.permutation(len(u))[:_COMPARED]
    gain = classifier(u[few], ok[few], rng).gain if 0 < ok[few].sum() < len(few) else 0.0
    return Success(lambda points: predictor(points).mu, ends, least, gain)


def failure_probability(u: Points, ok: Mask, rng: np.random.Generator) -> Callable[[Points], Vector]:
    """Return P(a run gives no metric) as a function of the metamodel's inputs, never closer to 0 or 1 than n runs can tell.

    The ends are 1 / (n + 2) away: that of an event which n runs have not met, by the rule of succession. Noise of labels that
    depends on the inputs would cost five times as much, and predicted new labels no better (docs/measured/estimation.md).

    Args:
        u: (n, d) metamodel inputs of all runs, n >= 2.
        ok: (n,) the run gave a metric.
        rng: of the fit.
    """
    least = 1.0 / (len(u) + 2.0)
    predictor = _fitted(u, ok, rng)
    return lambda points: np.clip(1.0 - predictor.mu(points), least, 1.0 - least)


def _fitted(u: Points, ok: Mask, rng: np.random.Generator) -> GaussianProcessPredictor | ForestPredictor:
    """Return a predictor of the labels 0 and 1: a Gaussian process, or a forest where there are many."""
    from sbt.metamodels.extra_trees import ExtraTrees
    from sbt.metamodels.gaussian_process import GaussianProcess

    if len(u) <= _MOST_EXACT:
        return GaussianProcess(certainly_noisy=True, input_noise=False, kernels=1).fit(u, ok.astype(np.float64), rng)
    return ExtraTrees().fit(u, ok.astype(np.float64), rng)
