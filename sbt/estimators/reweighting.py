"""The same runs under other distributions: weights, bounds, and the derivative of a probability by its parameters.

Draws x_j with known density q count under any distribution p' that has no mass where q has none, with weights p'/q in place
of p/q. A tilt is a function t(x) by which weights are multiplied: p'/p gives the probability under p', the score
d log p / d theta its derivative by the parameter theta of p.

Source:
    Rubinstein and Shapiro (1993), Discrete Event Systems: sensitivity by the score function; Fay and Feuer (1997),
    Statistics in Medicine 16: limits of a weighted sum of Poisson counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from sbt.estimators import binomial
from sbt.estimators.importance import stratified_variance
from sbt.estimators.intervals import CountedBatch
from sbt.problem.arrays import Points, Vector

__all__ = ["Predicted", "ReusedBatch", "WeightedShare", "defended_bound", "effective_size", "few_hits_bound"]

_TAIL = 1e-300
_ROUNDING = 1e-9  # of a weight of 1
_BISECTIONS = 60  # of [0, 1]: to the last bit


@dataclass(frozen=True, eq=False)
class Predicted:
    """What a metamodel says of a pool of points from a known density.

    Args:
        x: (N, d) points.
        weight: (N,) p/h over N.
        probability: (N,) its P(critical).
        stratum: (N,) component that each point was drawn from.
    """

    x: Points
    weight: Vector
    probability: Vector
    stratum: Vector


@dataclass(frozen=True, eq=False)
class ReusedBatch:
    """Draws of a batch, to be weighted anew, with a control variate that knows none of them.

    Args:
        x: (n, d) draws.
        coefficient: (n,) p/q of each.
        control_variate: (n,) P(critical) by a metamodel that was fitted to earlier runs only; 0: none.
        critical: (n,) 1 where the run was critical, else 0.
        prediction: of the same metamodel over a pool of its own; None: there is no metamodel.
    """

    x: Points
    coefficient: Vector
    control_variate: Vector
    critical: Vector
    prediction: Predicted | None = None

    @property
    def predicted_at(self) -> Points:
        """(N, d) points of the prediction; none where there is no metamodel."""
        return self.x[:0] if self.prediction is None else self.prediction.x

    def tilted(self, at_draws: Vector, at_pool: Vector) -> CountedBatch:
        """Return the batch with weights times a tilt.

        Args:
            at_draws: (n,) the tilt at the draws.
            at_pool: (N,) the tilt at the points of the prediction.
        """
        coefficient, g = self.coefficient * at_draws, self.control_variate
        prior = pool_variance = 0.0
        if self.prediction is not None:
            terms = self.prediction.weight * self.prediction.probability * at_pool
            prior = float(terms.sum())
            pool_variance = stratified_variance(len(terms) * terms, self.prediction.stratum)
        anticipated = float((coefficient**2 * g * (1.0 - g)).mean())
        return CountedBatch(prior, anticipated, pool_variance, coefficient, g, self.critical)


@dataclass(frozen=True, eq=False)
class WeightedShare:
    """Weighted hits among n independent draws.

    Args:
        weight: (n,) p'/q of every draw.
        critical: (n,) 1 where the run was critical, else 0.
    """

    weight: Vector
    critical: Vector

    @property
    def value(self) -> float:
        """The estimate: mean of weight times critical; unbiased."""
        return float((self.weight * self.critical).mean())

    @property
    def std_error(self) -> float:
        """Standard error of the mean."""
        n = len(self.weight)
        return float((self.weight * self.critical).std(ddof=1)) / n**0.5 if n > 1 else float("inf")

    def lower(self, confidence: float) -> float:
        """Return the one-sided lower limit of a weighted sum of Poisson counts; with weights of 1 the exact one of a share."""
        if self._plain:
            return float(binomial.lower(int(self.critical.sum()), len(self.weight), confidence))
        y, v = self._moments()
        return 0.0 if y == 0.0 else min(v / y * float(gammaincinv(y * y / v, 1.0 - confidence)), 1.0)

    def upper(self, confidence: float) -> float:
        """Return the one-sided upper limit; with equal weights that of a Poisson count, with weights of 1 the exact one."""
        if self._plain:
            return float(binomial.upper(int(self.critical.sum()), len(self.weight), confidence))
        y, v = self._moments()
        top = float(self.weight.max()) / len(self.weight)
        y, v = y + top, v + top * top
        return min(v / max(y, _TAIL) * float(gammaincinv(y * y / max(v, _TAIL), confidence)), 1.0)

    @property
    def _plain(self) -> bool:
        """Whether draws follow the distribution that is asked for."""
        return bool(np.allclose(self.weight, 1.0, rtol=0.0, atol=_ROUNDING))

    def _moments(self) -> tuple[float, float]:
        terms = self.weight * self.critical / len(self.weight)
        return float(terms.sum()), float((terms**2).sum())


def defended_bound(hits: int, nominal: Vector, ratio: Vector, confidence: float) -> float:
    """Return an upper limit of a probability under p' after few hits among draws of which a share follows p.

    A draw meets a region A with probability at least s p(A) >= s p'(A and p'/p <= c) / c, for every c. What p' has beyond c
    counts as critical. c is the one with which the limit would be smallest without a hit: it looks at no run.

    Args:
        hits: critical draws.
        nominal: (n,) s, the share of each draw that is in proportion to p.
        ratio: (m,) p'/p at points that are drawn from p'.
        confidence: of the limit.
    """
    if len(nominal) == 0:
        return 1.0
    at = np.unique(np.quantile(ratio, np.linspace(0.5, 1.0, 26)))
    beyond = np.array([float((ratio > c).mean()) for c in at])
    best = int(np.argmin(at * few_hits_bound(0, nominal, confidence) + beyond))
    return min(float(at[best]) * few_hits_bound(hits, nominal, confidence) + float(beyond[best]), 1.0)


def few_hits_bound(hits: int, nominal: Vector, confidence: float) -> float:
    """Return the upper limit of a probability P after few hits among draws that each meet it with probability s P or more.

    It is the P at which `hits` or fewer are only just credible, whatever the rest of the proposal follows.

    Args:
        hits: critical draws.
        nominal: (n,) s, the share of each draw that is in proportion to the distribution.
        confidence: of the limit.
    """
    if len(nominal) == 0 or hits >= len(nominal):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        p = 0.5 * (low + high)
        low, high = (p, high) if _at_most(hits, nominal * p) > 1.0 - confidence else (low, p)
    return high


def _at_most(hits: int, chances: Vector) -> float:
    """Return the probability of at most `hits` successes in independent trials with these chances."""
    mass = np.zeros(hits + 1)
    mass[0] = 1.0
    for chance in chances:
        mass[1:] = mass[1:] * (1.0 - chance) + mass[:-1] * chance
        mass[0] *= 1.0 - chance
    return float(mass.sum())


def effective_size(weight: Vector) -> float:
    """Return how many draws of equal weight say as much as these: (sum w)^2 / sum w^2."""
    return float(weight.sum() ** 2 / max((weight**2).sum(), _TAIL))
