"""A noisy problem in which depth deceives: one disc fails often and barely, the other one rarely and deeply.

    python benchmarks/noise.py --scenarios two_discs --budget 100 --seeds 10

Within 0.15 of (0.25, 0.3) nine runs in ten are critical, by about 0.1; within 0.15 of (0.75, 0.7) two in ten, by about 10.
Elsewhere none is, and the metric grows with the distance to the nearer disc.
"""

from __future__ import annotations

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.problem.metric import Metric
from sbt.problem.plain import Values
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.testbeds.problem import parameters_of

__all__ = ["SCENARIO", "rates"]

_CENTRES, _RADIUS = np.array([[0.25, 0.3], [0.75, 0.7]]), 0.15
_RATES, _DEPTHS = np.array([0.9, 0.2]), (0.1, 10.0)


def rates(x: Points) -> Vector:
    """Return (n,) failure rates at x (n, 2)."""
    inside: Points = _distances(x) < _RADIUS
    return inside @ _RATES


def _distances(x: Points) -> Points:
    return np.hypot(*(x[:, None, :] - _CENTRES).transpose(2, 0, 1))


def _evaluate(values: Values, seed: int) -> dict[str, float]:
    x, rng = np.array([[values["x1"], values["x2"]]], dtype=np.float64), stream(seed, "two_discs")
    draw, scatter = rng.random(), abs(rng.standard_normal())
    distance = _distances(x)[0]
    which = int(distance.argmin())
    if draw < rates(x)[0]:
        return {"y": -_DEPTHS[which] * (1.0 + 0.3 * scatter)}
    return {"y": 0.3 + max(distance[which] - _RADIUS, 0.0) + 0.1 * scatter}


SCENARIO = LogicalScenario(
    name="two_discs", space=ParameterSpace(parameters_of({"x1": (0.0, 1.0), "x2": (0.0, 1.0)})),
    requirement=Requirement("y", high=0.0), evaluate=_evaluate, metrics=(Metric("y"),),
    description="Two discs: one fails often and barely, the other one rarely and deeply.",
)  # fmt: skip
