"""The estimate from all batches of an estimation: value, interval, and the bounds beside it.

Weights of the batches are fixed before their results are known: weights by inverse variance would
prefer batches that met no surprise, and are biased for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from sbt.errors import InputError
from sbt.problem.arrays import Vector

__all__ = ["CombinedEstimate", "CountedBatch", "combine_estimates", "few_hits_bound", "undetected_mass"]

FEWEST_HITS = 10
"""Critical runs below which there is a one-sided bound instead of an interval: the variance of fewer says little."""
_BISECTIONS = 60  # of [0, 1]: to the last bit


@dataclass(frozen=True, eq=False)
class CountedBatch:
    """A batch that enters the estimate, with its outcomes.

    Args:
        prior: the metamodel's prediction of the probability: mean of w pi over the pool.
        anticipated: variance of one draw if the metamodel is right.
        pool_variance: of the batch through its pool.
        coefficient: (n,) w / (N r) of the draws.
        control_variate: (n,) pi of the draws, as the correction subtracts it.
        critical: (n,) 1 where the run was critical, else 0.
    """

    prior: float
    anticipated: float
    pool_variance: float
    coefficient: Vector
    control_variate: Vector
    critical: Vector

    @property
    def value(self) -> float:
        """Estimate of this batch alone; may be negative."""
        return self.prior + float((self.coefficient * (self.critical - self.control_variate)).mean())

    @property
    def variance(self) -> float:
        """The larger of realised and anticipated variance, plus the pool's."""
        n, terms = len(self.critical), self.coefficient * (self.critical - self.control_variate)
        realised = float(terms.var(ddof=1)) / n if n > 1 else math.inf
        return max(realised, self.anticipated / n) + self.pool_variance


@dataclass(frozen=True)
class CombinedEstimate:
    """An estimate from all counted batches.

    Attributes:
        value: unbiased, may be negative.
        std_error: from the larger of the batches' own and the between-batch variance.
        freedom: degrees of freedom of its t quantile.
        effective_sample_size: of the weights of the draws.
        largest_share: share of the sum of weights that the largest one has.
    """

    value: float
    std_error: float
    freedom: float
    effective_sample_size: float
    largest_share: float

    def limit(self, confidence: float, *, side: float) -> float:
        """Return the one-sided limit at this confidence, side -1 below or +1 above, clipped to [0, 1]."""
        reach = float(stdtrit(self.freedom, confidence)) * self.std_error
        return min(max(self.value + side * reach, 0.0), 1.0)


def combine_estimates(batches: Sequence[CountedBatch]) -> CombinedEstimate:
    """Return the estimate with weights sqrt(t) n_t, t = 1 for the first batch that counts.

    Source:
        Owen and Zhou (2019), arXiv 1901.02976: weights of adaptive importance sampling fixed in advance.

    Raises:
        InputError: no batch.
    """
    if not batches:
        raise InputError("an estimate needs at least one counted batch, but got none")
    c = np.array([math.sqrt(t + 1.0) * len(b.critical) for t, b in enumerate(batches)])
    c /= c.sum()
    values = np.array([b.value for b in batches])
    value = float(c @ values)
    own = float((c**2) @ np.array([b.variance for b in batches]))
    share = float((c**2).sum())
    between = float((c**2) @ (values - value) ** 2) / (1.0 - share) if len(batches) > 1 else 0.0
    weights = np.concatenate([ct / len(b.critical) * b.coefficient for ct, b in zip(c, batches, strict=True)])
    total = float(weights.sum())
    return CombinedEstimate(
        value, math.sqrt(max(own, between)), max(1.0 / share - 1.0, 1.0),
        total**2 / float((weights**2).sum()) if total > 0 else 0.0, float(weights.max()) / total if total > 0 else 1.0,
    )  # fmt: skip


def few_hits_bound(hits: int, nominal: Vector, confidence: float) -> float:
    """Return the exact upper limit of a probability after few hits, from the defensive share of the draws.

    Every draw meets a region of probability P with probability at least s P, s the share that is drawn
    in proportion to the nominal distribution, whatever the metamodel predicts. The limit is the P at which `hits`
    or fewer are only just credible.

    Args:
        hits: critical draws.
        nominal: (n,) s of each draw.
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


def undetected_mass(nominal: Vector, surprises: int, confidence: float = 0.95) -> float:
    """Return the largest probability that a region may hold which the metamodel takes for uncritical.

    3 / n_p at 95 %, n_p the number of draws in proportion to the nominal distribution, while none of them was a
    surprise (a critical run to which the metamodel gave next to no probability).

    Args:
        nominal: (n,) share of each draw that is in proportion to the nominal distribution.
        surprises: critical runs to which the metamodel gave next to no probability.
        confidence: of the bound.
    """
    return few_hits_bound(surprises, nominal, confidence)
