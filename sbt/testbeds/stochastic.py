"""Problems of which noise decides: no inputs fail with most seeds, and the failure rate is what differs."""

from __future__ import annotations

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.testbeds.problem import NEGATIVE, Problem, Truth, parameters_of

__all__ = ["PROBLEMS"]


def two_hollows(x: Points) -> Vector:
    """A plain with two hollows; under noise of 0.35 they fail with 14 and 8 % of the seeds, the plain with 0.2 %.

    1 - 0.62 exp(-|x - (0.25, 0.3)|^2 / 0.0512) - 0.5 exp(-|x - (0.75, 0.7)|^2 / 0.0288).

    Source:
        Constructed.
    """
    first = ((x - np.array([0.25, 0.3])) ** 2).sum(axis=1) / 0.0512
    second = ((x - np.array([0.75, 0.7])) ** 2).sum(axis=1) / 0.0288
    return 1.0 - 0.62 * np.exp(-first) - 0.5 * np.exp(-second)


def slope(x: Points) -> Vector:
    """A slope in four inputs with a wave across it; under noise of 0.35 the failure rate grows to 14 % in two places.

    1.3 - 0.9 (x1 + 0.8 x2 + 0.6 x3 + 0.4 x4) / 2.8 + 0.125 cos(2 pi x3).

    Source:
        Constructed.
    """
    return 1.3 - 0.9 * (x @ np.array([1.0, 0.8, 0.6, 0.4])) / 2.8 + 0.125 * np.cos(2.0 * np.pi * x[:, 2])


def ramp(x: Points) -> Vector:
    """A ramp, 4 (x1 + x2 + x3) - 1.2, whose noise grows along x1 from 0.2 to 2.2; x4 is idle.

    Source:
        Constructed.
    """
    return 4.0 * x[:, :3].sum(axis=1) - 1.2


def growing(x: Points) -> Vector:
    """Return the noise of the ramp."""
    return 0.2 + 2.0 * x[:, 0]


def _unit(d: int) -> dict[str, tuple[float, float]]:
    return {f"x{k + 1}": (0.0, 1.0) for k in range(d)}


PROBLEMS = (
    Problem("two_hollows_noisy", "Two places that fail with one seed in ten", parameters_of(_unit(2)), two_hollows, NEGATIVE,
            Truth(0.0136524465, 0.0, None, 0.0136524465), noise=0.35),
    Problem("slope_noisy", "A rate that grows along four inputs", parameters_of(_unit(4)), slope, NEGATIVE,
            Truth(0.0134660028, 0.0, None, 0.0134660028), noise=0.35),
    Problem("ramp_uneven_d4", "A ramp whose noise grows along an input", parameters_of(_unit(4)), ramp, NEGATIVE,
            Truth(0.0112252483, 0.0, None, 0.0112252483), noise=growing),
)  # fmt: skip
