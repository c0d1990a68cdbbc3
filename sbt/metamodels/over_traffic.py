"""P(critical | inputs) as the mean over the traffic that seeds draw, beside what a metamodel of the inputs says of the metric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sbt.metamodels.base import Predictor, predicted, sketched
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

if TYPE_CHECKING:
    from sbt.metamodels.gp_predictor import GaussianProcessPredictor

__all__ = ["MeanOverTraffic", "OverTrafficPrediction", "OverTrafficPredictor"]

_LEAST = 1e-6  # P, below which a mean of forests tells nothing more
_FITTED = 300  # points that length scales are fitted to


@dataclass(frozen=True, eq=False)
class MeanOverTraffic:
    """P(critical | inputs) between points where it is known, by a Gaussian process of it.

    Args:
        process: of P.
        low, high: the least and the largest P at a point, beyond which there is none.
    """

    process: GaussianProcessPredictor
    low: float
    high: float

    @classmethod
    def of(cls, u: Points, p: Vector, rng: np.random.Generator) -> MeanOverTraffic:
        """Return what lies between metamodel inputs u (m, d), whose P are p (m,) with errors of their own."""
        from sbt.metamodels.gaussian_process import GaussianProcess  # PyTorch

        process = GaussianProcess(kernels=1, input_noise=False, fit_rows=_FITTED).fit(u, p, rng)
        low, high = (float(np.clip(end, _LEAST, 1.0 - _LEAST)) for end in (p.min(), p.max()))
        return cls(process, low, high)

    def __call__(self, u: Points) -> Vector:
        """Return (n,) P(critical) at metamodel inputs u (n, d)."""
        return np.clip(self.process(u).mean[0], self.low, self.high)


@dataclass(frozen=True, eq=False)
class OverTrafficPrediction(Prediction):
    """A prediction of y whose P(y in M_c) is that of the mean over traffic.

    Args:
        values: of y, by a metamodel of the inputs.
        critical: M_c; the P of other intervals is that of `values`.
        p: (n,) P(y in M_c).
    """

    values: Prediction | None = None
    critical: CriticalInterval | None = None
    p: Vector | None = None

    @classmethod
    def of(cls, values: Prediction, critical: CriticalInterval, p: Vector) -> OverTrafficPrediction:
        """Return the prediction `values` with P(y in M_c) = p (n,)."""
        own = {field.name: getattr(values, field.name) for field in fields(Prediction)}
        return cls(**own, values=values, critical=critical, p=p)

    @property
    def _all(self) -> tuple[Prediction, CriticalInterval, Vector]:
        if self.values is None or self.critical is None or self.p is None:
            raise ValueError("a prediction over traffic needs values, a critical interval and P")
        return self.values, self.critical, self.p

    def with_values(self, values: Prediction) -> OverTrafficPrediction:
        """Return the prediction of other values, with the same P."""
        return self.of(values, *self._all[1:])

    def take(self, index: NDArray[Any] | slice) -> OverTrafficPrediction:
        """Return the prediction at the points that `index` (integers, mask or slice) selects."""
        values, critical, p = self._all
        return self.of(values.take(index), critical, p[index])

    def joined(self, others: Sequence[Prediction]) -> OverTrafficPrediction:
        """Return the prediction at these points and, behind them, at those of the others."""
        values, critical, p = self._all
        rest = [other._all for other in others if isinstance(other, OverTrafficPrediction)]
        return self.of(values.joined([r[0] for r in rest]), critical, np.concatenate([p, *(r[2] for r in rest)]))

    def log_density(self, y: Vector) -> Vector:
        """Return (n,) log density of y (n,), by the metamodel of the inputs."""
        return self._all[0].log_density(y)

    def cdf(self, y: Vector) -> Vector:
        """Return (n,) P(Y <= y) at y (n,), by the metamodel of the inputs."""
        return self._all[0].cdf(y)

    def quantile(self, q: float) -> Vector:
        """Return (n,) y with P(Y <= y) = q, by the metamodel of the inputs."""
        return self._all[0].quantile(q)

    def log_probability(self, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) log P(y in M_c) and (n,) log P(y not in M_c)."""
        values, own, p = self._all
        return (np.log(p), np.log1p(-p)) if critical == own else values.log_probability(critical)


@dataclass(frozen=True, eq=False)
class OverTrafficPredictor:
    """Predicts y by a metamodel of the inputs, and P(y in M_c) by the mean over traffic.

    Args:
        predictor: of y.
        mean: of P.
        critical: M_c.
    """

    predictor: Predictor
    mean: MeanOverTraffic
    critical: CriticalInterval

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at metamodel inputs u (n, d)."""
        return OverTrafficPrediction.of(predicted(self.predictor, u), self.critical, self.mean(u))

    def sketch(self, rows: int) -> OverTrafficPredictor:
        """Return the same with the sketch of its metamodel, itself where that has none."""
        rough = sketched(self.predictor, rows)
        return self if rough is self.predictor else replace(self, predictor=rough)
