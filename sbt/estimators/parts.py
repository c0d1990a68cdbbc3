"""What the metamodels of a combination state of each requirement, at the points of the pool that draws come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sbt.estimators.importance import Plan, stratified_variance
from sbt.estimators.surrogate import JointLogProbability, LogProbability
from sbt.problem.arrays import Points, Vector

__all__ = ["PartOfPool", "parts_of_pool"]


@dataclass(frozen=True, eq=False)
class PartOfPool:
    """One requirement of a combination in a pool: its own prediction of the probability, and a control variate.

    Attributes:
        pi: (N,) P(it is violated).
        prior: mean of w pi, the prediction of its probability.
        anticipated: variance of one draw in the difference form, if its metamodel is right.
        pool_variance: of the prior through the pool.
    """

    pi: Vector
    prior: float
    anticipated: float
    pool_variance: float


def parts_of_pool(
    log_probability: LogProbability | None, z: Points, plan: Plan, stratum: Vector
) -> Sequence[PartOfPool] | None:  # fmt: skip
    """Return what is stated of each requirement at the pool's points z (N, d); None without a combination."""
    if not isinstance(log_probability, JointLogProbability):
        return None
    found, w = [], plan.weight
    for part in log_probability.parts:
        log_pi, log_not = part(z)
        pi = np.exp(log_pi)
        one_draw = np.where(plan.probability > 0, w**2 * pi * np.exp(log_not) / np.maximum(plan.probability, 1e-300), 0.0)
        found.append(PartOfPool(
            pi, float((w * pi).sum()), float(one_draw.sum()), stratified_variance(len(w) * w * pi, stratum)
        ))  # fmt: skip
    return found
