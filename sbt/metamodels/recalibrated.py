"""Recalibration: sigma of any metamodel scaled by its errors on held-out rows.

Off by default: measured to help the likelihood of all runs a little and to hurt that of critical ones
where sigma was wide on purpose (see docs/measured/metamodels.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sbt.metamodels.base import Metamodel, Predictor, check_rows, fitted, predicted, split_validation, with_target
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = ["Recalibrated", "RecalibratedPredictor"]

_FEWEST = 50  # rows from which on sigma is scaled: ten held-out rows estimate a factor to about 20 %
_PRIOR = 5.0  # weight of no change, in rows
_LEAST = 1e-3  # of the factor: a prediction that was exact by chance keeps a sigma


@dataclass(frozen=True)
class Recalibrated:
    """A metamodel whose sigma is multiplied by one factor.

    The factor is the root mean square of the z-scores of the first 20 % of the rows under a fit to the
    others, shrunk a little to 1; then the metamodel is fitted to all rows. Fewer than 50 rows: 1.

    Args:
        metamodel: settings of any metamodel.

    Source:
        Levi et al. (2022), Evaluating and calibrating uncertainty prediction in regression tasks: sigma scaling.
    """

    metamodel: Metamodel

    def with_target(self, critical: CriticalInterval) -> Recalibrated:
        """Return the same for a known M_c."""
        return replace(self, metamodel=with_target(self.metamodel, critical))

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> RecalibratedPredictor:
        """Return the predictor learned from u (n, d) and y (n,); see `Metamodel.fit`."""
        u, y = check_rows(u, y)
        factor = 1.0
        if len(y) >= _FEWEST:
            held_out, training = split_validation(len(y))
            prediction = predicted(fitted(self.metamodel, u[training], y[training], rng), u[held_out])
            z = (y[held_out] - prediction.mu) / prediction.sigma
            size = max(float(np.sqrt(np.mean(z**2))), _LEAST)
            factor = size ** (len(z) / (len(z) + _PRIOR))
        return RecalibratedPredictor(fitted(self.metamodel, u, y, rng), factor)


@dataclass(frozen=True, eq=False)
class RecalibratedPredictor:
    """A predictor with sigma multiplied by `factor` > 0; the mean stays."""

    predictor: Predictor
    factor: float

    def __call__(self, u: Points) -> Prediction:
        """Return the prediction at u (n, d)."""
        return predicted(self.predictor, u).rescaled(self.factor)
