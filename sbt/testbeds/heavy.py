"""Metrics with heavy tails: values over many orders of magnitude, or a number that stands for nothing."""

from __future__ import annotations

import math

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.testbeds.problem import uniform

__all__ = ["PROBLEMS"]

_STEEP, _EDGE = 24.0, 1.3
_NONE = 1e6


def steep_bowl(x: Points) -> Vector:
    """exp(24 |x - 0.7|^2) - 1.3: a ball of radius 0.105, and 1e20 in the far corner.

    Source:
        Constructed.
    """
    return np.exp(_STEEP * ((x - 0.7) ** 2).sum(axis=1)) - _EDGE


def sentinel(x: Points) -> Vector:
    """A cone, 5 |x12 - 0.4| + x3 - 0.6, and 1e6 where x3 exceeds 0.6 and x1 0.3: no encounter.

    Source:
        Constructed.
    """
    cone = 5.0 * np.hypot(x[:, 0] - 0.4, x[:, 1] - 0.4) + x[:, 2] - 0.6
    return np.where((x[:, 2] > 0.6) & (x[:, 0] > 0.3), _NONE, cone)


_BALL = 0.5 * math.pi**2 * (math.log(_EDGE) / _STEEP) ** 2
_CONE = math.pi / 25.0 * 0.6**3 / 3.0

PROBLEMS = (
    uniform("steep_bowl_d4", "A bowl over twenty orders of magnitude", 4, steep_bowl, _BALL),
    uniform("sentinel_d3", "A cone, and 1e6 where nothing is met", 3, sentinel, _CONE),
)
