"""A prediction whose Gaussians are those of the warped metric.

P of any interval, densities and quantiles are exact in that unit: a component that is unsure on which side of a jump it is has
values on both sides of it, which no Gaussian in the unit of the metric has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError
from sbt.metamodels.prediction import Prediction
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["WarpedPrediction"]


@dataclass(frozen=True, eq=False)
class WarpedPrediction(Prediction):
    """A prediction of y by one of the warped y.

    Mean and standard deviation of each component are the moments of y, see `Warp.moments`.

    Args:
        warped: of the warped y, at the same n points.
        warp: increasing.
    """

    warped: Prediction | None = None
    warp: Warp | None = None

    @classmethod
    def of(cls, warped: Prediction, warp: Warp) -> WarpedPrediction:
        """Return the prediction of y."""
        mean, std = warp.moments(warped.mean, warped.std)
        noise = warped.weight @ warp.moments(warped.mean, np.broadcast_to(warped.noise, warped.mean.shape))[1]
        noise = np.where(warped.noise > 0.0, noise, 0.0)
        return cls(mean, std, warped.weight, noise, warped=warped, warp=warp)

    @cached_property
    def _both(self) -> tuple[Prediction, Warp]:
        if self.warped is None or self.warp is None:
            raise InputError("a warped prediction needs what is predicted of the warped metric, and the warp, but got none")
        return self.warped, self.warp

    @property
    def in_unit(self) -> tuple[Prediction, Callable[[Points], Points]]:
        """What is predicted of the warped y, and the way back to y."""
        warped, warp = self._both
        return warped, warp.back

    def _like(self, warped: Prediction) -> WarpedPrediction:
        """Return the prediction by another one of the warped metric; it ends where this one does."""
        kept = {name: getattr(self, name) for name in ("lowest", "highest", "scale")}
        return replace(WarpedPrediction.of(warped, self._both[1]), **kept)

    def take(self, index: NDArray[Any] | slice) -> WarpedPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        return self._like(self._both[0].take(index))

    def widened(self, factor: float) -> WarpedPrediction:
        """Return the prediction with every standard deviation of a component multiplied, in the warped unit."""
        return self._like(self._both[0].widened(factor))

    def rescaled(self, factor: float) -> WarpedPrediction:
        """Return the prediction with the standard deviation multiplied, in the warped unit."""
        return self._like(self._both[0].rescaled(factor))

    def with_tails(self, factor: Vector, probability: Vector) -> WarpedPrediction:
        """Return the prediction with every component in several widths, in the warped unit."""
        return self._like(self._both[0].with_tails(factor, probability))

    def joined(self, others: Sequence[Prediction]) -> WarpedPrediction:
        """Return the prediction at these points and, behind them, at those of the others, which have the same weights."""
        return self._like(self._both[0].joined([other._both[0] for other in others if isinstance(other, WarpedPrediction)]))

    def log_density(self, y: Vector) -> Vector:
        """Return (n,) log density at y (n,)."""
        warped, warp = self._both
        return warped.log_density(warp.values(y)) + warp.log_slope(y)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,)."""
        warped, warp = self._both
        return warped.cdf(warp.values(y))

    def log_probability(self, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c), both accurate in the tails."""
        warped, warp = self._both
        return warped.log_probability(warp.interval(self._open(critical)))

    def quantile(self, q: float) -> Vector:
        """Return (n,) y with P(Y <= y) = q, for q in (0, 1)."""
        warped, warp = self._both
        return warp.back(warped.quantile(q))
