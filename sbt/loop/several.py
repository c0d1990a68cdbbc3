"""What the log keeps of each requirement of a combination, and whether its metrics are independent given the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from sbt.metamodels.joint import JointPrediction, JointPredictor
from sbt.metamodels.scores import scores
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.store.records import Independence, RequirementFit, Validation

__all__ = ["each_requirement", "independence"]

_FEWEST = 8  # runs that a correlation is taken of


def each_requirement(
    predictor: JointPredictor, parts: Sequence[Requirement], probe: JointPrediction, weights: Vector | None,
    seen: tuple[JointPrediction, Points] | None,
) -> tuple[RequirementFit, ...]:  # fmt: skip
    """Return the share of the space and the scores of each requirement.

    Args:
        predictor: of the combination.
        parts: (q,) its requirements.
        probe: prediction at fixed points of the space.
        weights: (n,) of these points; None: equal.
        seen: prediction at runs that nothing learned from, and their metrics (m, q); None: there are none.
    """
    found = []
    for k, (part, one) in enumerate(zip(parts, predictor.parts, strict=True)):
        validation = None
        if seen is not None:
            known = np.isfinite(seen[1][:, k])
            here: Any = scores(seen[0].parts[k].take(known), seen[1][known, k], part.critical)
            validation = Validation(**here)
        comparison = getattr(getattr(one, "predictor", one), "comparison", None)
        share = float(np.average(probe.parts[k].probability(part.critical), weights=weights))
        found.append(RequirementFit(
            part.label, share, validation, None if comparison is None else dict(comparison.weights),
            None if comparison is None else comparison.reason,
        ))  # fmt: skip
    return tuple(found)


def independence(parts: Sequence[Requirement], prediction: JointPrediction, y: Points) -> Independence | None:
    """Return the pair of requirements whose residuals correlate most, on runs (m, q) that nothing learned from.

    None with fewer than eight runs that have both.
    """
    residuals = [(y[:, k] - part.mu) / part.sigma for k, part in enumerate(prediction.parts)]
    found: list[Independence] = []
    for i, j in combinations(range(len(parts)), 2):
        both = np.isfinite(residuals[i]) & np.isfinite(residuals[j])
        a, b = (_ranks(residuals[k][both]) for k in (i, j))
        if len(a) >= _FEWEST and a.std() > 0 and b.std() > 0:
            correlation = float(np.corrcoef(a, b)[0, 1])
            sides = _side(parts[i].critical) * _side(parts[j].critical)
            together = None if sides == 0 else correlation * sides > 0
            found.append(Independence((parts[i].label, parts[j].label), correlation, len(a), together))
    if not found:
        return None
    return replace(max(found, key=lambda one: abs(one.correlation)), pairs=len(found) if len(found) > 1 else None)


def _side(critical: CriticalInterval) -> int:
    """Return on which side a metric is critical: -1 below, 1 above, 0 between two ends."""
    return int(np.isinf(critical.low)) * -1 + int(np.isinf(critical.high))


def _ranks(values: Vector) -> Vector:
    """Return ranks, of equal values their mean: one residual far out does not decide a correlation."""
    from scipy.stats import rankdata

    return np.asarray(rankdata(values), dtype=np.float64)

