"""Thin or bent critical sets, each of one piece: straight lines between their parts leave them."""

from __future__ import annotations

import math

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.testbeds.problem import uniform

__all__ = ["PROBLEMS"]

_RADIUS, _HALF = 0.3, 0.012
_SHELL, _SHELL_HALF = 0.35, 0.01


def ring(x: Points) -> Vector:
    """Distance to a circle of radius 0.3 about the middle, minus 0.012: a kink within the critical set.

    Source:
        Constructed.
    """
    return np.abs(np.hypot(x[:, 0] - 0.5, x[:, 1] - 0.5) - _RADIUS) - _HALF


def shell(x: Points) -> Vector:
    """Distance to a sphere of radius 0.35 about the middle, minus 0.01.

    Source:
        Constructed.
    """
    return np.abs(np.sqrt(((x - 0.5) ** 2).sum(axis=1)) - _SHELL) - _SHELL_HALF


def banana(x: Points) -> Vector:
    """A bent valley, 50 times as long as wide: |x2 - 0.15 - 2.8 (x1 - 0.5)^2| - 0.015.

    Source:
        Constructed, after the valley of Rosenbrock (1960), The Computer Journal 3.
    """
    return np.abs(x[:, 1] - 0.15 - 2.8 * (x[:, 0] - 0.5) ** 2) - 0.015


def corner(x: Points) -> Vector:
    """An L of two bars, 0.04 wide: where x1 or x2 is near 0.2, and the other one between 0.18 and 0.9.

    Source:
        Constructed.
    """
    along = np.maximum(np.abs(x - 0.54) - 0.36, 0.0)
    across = np.abs(x - 0.2)
    upright, level = np.hypot(across[:, 0], along[:, 1]), np.hypot(across[:, 1], along[:, 0])
    return np.minimum(upright, level) - 0.02


_RING = math.pi * ((_RADIUS + _HALF) ** 2 - (_RADIUS - _HALF) ** 2)
_BALLS = 4.0 / 3.0 * math.pi * ((_SHELL + _SHELL_HALF) ** 3 - (_SHELL - _SHELL_HALF) ** 3)

PROBLEMS = (
    uniform("ring_d2", "A thin ring", 2, ring, _RING),
    uniform("shell_d3", "A thin sphere", 3, shell, _BALLS),
    uniform("banana_d2", "A bent valley", 2, banana, 0.03),
    uniform("corner_d2", "An L", 2, corner, 0.0585135, 1e-6),
)
