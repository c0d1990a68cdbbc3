"""Search and level-set problems on the unit cube: needles, deceptive trends, inactive inputs, several regions.

The inputs are uniform, so that the failure probability is the critical fraction of the box.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma

from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.testbeds.problem import NEGATIVE, Function, Problem, Truth, parameters_of

__all__ = ["PROBLEMS", "WELLS"]

_WEIGHT = np.array([1.0, 1.2, 3.0, 3.2])
_STEEPNESS = np.array([
    [10.0, 3.0, 17.0, 3.5, 1.7, 8.0], [0.05, 10.0, 17.0, 0.1, 8.0, 14.0],
    [3.0, 3.5, 1.7, 10.0, 17.0, 8.0], [17.0, 8.0, 0.05, 10.0, 0.1, 14.0],
])  # fmt: skip
_CENTRE = np.array([
    [0.1312, 0.1696, 0.5569, 0.0124, 0.8283, 0.5886], [0.2329, 0.4135, 0.8307, 0.3736, 0.1004, 0.9991],
    [0.2348, 0.1451, 0.3522, 0.2883, 0.3047, 0.6650], [0.4047, 0.8828, 0.8732, 0.5743, 0.1091, 0.0381],
])  # fmt: skip


def hartmann6(x: Points) -> Vector:
    """The Hartmann function of six inputs, minus four Gaussian hills of different weight; minimum -3.32.

    Source:
        Dixon and Szego (1978), Towards global optimisation 2. The level of -2.4 is ours.
    """
    scaled = _STEEPNESS * _CENTRE
    exponent = x**2 @ _STEEPNESS.T - 2.0 * x @ scaled.T + (scaled * _CENTRE).sum(axis=1)  # (n, 4)
    return -np.exp(-exponent) @ _WEIGHT


_USED = (0, 17, 4, 21, 2, 1)


def hartmann6_in_25(x: Points) -> Vector:
    """The Hartmann function of the inputs x1, x18, x5, x22, x3, x2 of 25; the others are idle.

    Source:
        `hartmann6`; hidden among idle inputs as in the literature on Bayesian optimisation in many
        dimensions, e.g. Wang et al. (2016), REMBO.
    """
    return hartmann6(x[:, _USED])


def ball_volume(d: int, radius: float) -> float:
    """Return the volume of a d-dimensional ball."""
    return float(math.pi ** (d / 2.0) / gamma(d / 2.0 + 1.0) * radius**d)


def ball_radius(d: int, volume: float) -> float:
    """Return the radius of the d-dimensional ball of this volume."""
    return float((volume / ball_volume(d, 1.0)) ** (1.0 / d))


def _well(distance: Vector, radius: float, reach: float) -> Vector:
    """Return 1 inside the radius, and a Gaussian funnel around it."""
    return np.exp(-(np.maximum(distance - radius, 0.0) ** 2) / (2.0 * reach**2))


def needle(x: Points, centre: NDArray[np.float64], radius: float, reach: float) -> Vector:
    """A flat bowl on the far side, and a well whose inside, a ball, is all that is critical.

    Source:
        Constructed; exact volume.
    """
    distance = np.sqrt(((x - centre) ** 2).sum(axis=1))
    bowl = 0.6 + 0.6 * ((x - (1.0 - centre)) ** 2).mean(axis=1)
    y = bowl - 1.4 * _well(distance, radius, reach)
    return np.where(distance <= radius, np.minimum(y, -0.05), np.maximum(y, 0.05))


WELLS = (
    ((0.2, 0.2, 0.2, 0.2), 0.12, 0.20),
    ((0.8, 0.2, 0.7, 0.3), 0.10, 0.16),
    ((0.25, 0.8, 0.75, 0.75), 0.10, 0.14),
    ((0.75, 0.8, 0.2, 0.8), 0.08, 0.12),
    ((0.5, 0.5, 0.5, 0.15), 0.08, 0.10),
)
"""Centre, radius and reach of each well."""


def multi_needle(x: Points) -> Vector:
    """Five wells of different size in a wavy plain; the inside of their five balls is critical.

    Source:
        Constructed; exact volume.
    """
    y = 0.5 + 0.3 * np.cos(3.0 * np.pi * x[:, 0]) * np.cos(2.0 * np.pi * x[:, 1]) + 0.2 * x[:, 2]
    inside = np.zeros(len(x), dtype=bool)
    for centre, radius, reach in WELLS:
        distance = np.sqrt(((x - np.array(centre)) ** 2).sum(axis=1))
        y = y - 2.0 * _well(distance, radius, reach)
        inside |= distance <= radius
    return np.where(inside, np.minimum(y, -0.05), np.maximum(y, 0.02))


def deceptive(x: Points, radius: float, sight: float = 3.5) -> Vector:
    """A broad harmless basin in the low corner; the critical ball is in the high one, seen from about `sight` radii away.

    Source:
        Constructed; exact volume.
    """
    broad = 0.35 + 1.1 * np.sqrt(((x - 0.2) ** 2).sum(axis=1) / x.shape[1])
    narrow = (np.sqrt(((x - 0.88) ** 2).sum(axis=1)) / radius - 1.0) / (sight - 1.0)
    return np.minimum(broad, narrow)


def goldstein_price(x: Points) -> Vector:
    """The Goldstein-Price function minus 50, on [-2, 2]^2 mapped from the unit square.

    Source:
        Goldstein and Price (1971), Mathematics of Computation 25; a test function of Part-X, Pedrielli
        et al. (2021). Box and level are ours.
    """
    a, b = 4.0 * x.T - 2.0
    first = 1.0 + (a + b + 1.0) ** 2 * (19.0 - 14.0 * a + 3.0 * a**2 - 14.0 * b + 6.0 * a * b + 3.0 * b**2)
    second = 30.0 + (2.0 * a - 3.0 * b) ** 2 * (18.0 - 32.0 * a + 12.0 * a**2 + 48.0 * b - 36.0 * a * b + 27.0 * b**2)
    return first * second - 50.0


def himmelblau(x: Points) -> Vector:
    """Himmelblau's function minus 40, on [-5, 5]^2 mapped from the unit square.

    Four minima of 0; below 40 the two with positive a are one region.

    Source:
        Himmelblau (1972), Applied nonlinear programming; a test function of Part-X, Pedrielli et al.
        (2021). The level is ours.
    """
    a, b = 10.0 * x.T - 5.0
    return (a**2 + b - 11.0) ** 2 + (a + b**2 - 7.0) ** 2 - 40.0


def interval_ring(x: Points) -> Vector:
    """A smooth hollow; a thin shell of it is critical, [0, 0.02] inside the range: the minimum lies beyond.

    4 - 6 exp(-2 |z|^2) + 0.3 z1 with z = 2 x - 1.

    Source:
        Constructed.
    """
    z = 2.0 * x - 1.0
    return 4.0 - 6.0 * np.exp(-2.0 * (z**2).sum(axis=1)) + 0.3 * z[:, 0]


def wavy_level(x: Points) -> Vector:
    """A cosine in x1 that fades along x2 and tilts with x3: several curved sheets of boundary.

    Source:
        Constructed.
    """
    a, b = 10.0 * x[:, 0] - 5.0, 10.0 * x[:, 1]
    return np.cos(0.8 * a) * np.exp(-0.02 * b**2) + 0.1 * (b - 5.0) * x[:, 2]


def _uniform(
    name: str, title: str, d: int, function: Function, critical: CriticalInterval, share: float, error: float, modes: int
) -> Problem:
    """Return a testbed with uniform inputs on the unit cube."""
    inputs = parameters_of({f"x{k + 1}": (0.0, 1.0) for k in range(d)})
    return Problem(name, title, inputs, function, critical, Truth(share, error, modes, share, error))


def _trap(d: int, share: float, sight: float = 3.5) -> Problem:
    """Return a narrow well of this share of the box beside a broad trap; the well is seen in 1 to 2 % of the box."""
    name = f"deceptive_d{d}" if sight == 3.5 else f"deceptive_d{d}_{share:.0e}".replace("e-0", "e-")
    function = partial(deceptive, radius=ball_radius(d, share), sight=sight)
    return _uniform(name, "A trend to the wrong corner", d, function, NEGATIVE, share, 0.0, 1)


def _needle(centre: tuple[float, ...], reach: float) -> Problem:
    """Return a needle of volume 1e-3 with a funnel of width `reach`, in radii."""
    d, share = len(centre), 1e-3
    radius = ball_radius(d, share)
    function = partial(needle, centre=np.array(centre), radius=radius, reach=reach * radius)
    return _uniform(f"needle_d{d}_1e-3", f"A needle in {d} dimensions", d, function, NEGATIVE, share, 0.0, 1)


_FIVE_BALLS = sum(ball_volume(4, radius) for _, radius, _ in WELLS)
_SMALL = 0.0178

PROBLEMS = (
    _uniform("hartmann6_1e-3", "Two rare minima", 6, hartmann6, CriticalInterval(high=-2.4), 0.0025460447, 1.5e-06, 2),
    _uniform("hartmann6_in_25", "Two rare minima, 19 idle inputs", 25, hartmann6_in_25, CriticalInterval(high=-2.4),
             0.002547708, 3.5e-06, 2),
    _needle((0.7459630321032713, 0.35837893752960165), 2.0),
    _needle((0.3286308868556369, 0.49966682244093397, 0.5468289934227222, 0.28254801512248573), 1.0),
    _uniform("multi_needle_d4", "Five needles", 4, multi_needle, NEGATIVE, _FIVE_BALLS, 0.0, 5),
    _uniform("deceptive_d2", "A trend to the wrong corner", 2, partial(deceptive, radius=_SMALL), NEGATIVE,
             ball_volume(2, _SMALL), 0.0, 1),
    _trap(3, 3e-4), _trap(4, 1e-4), _trap(6, 1e-5), _trap(2, 1e-5, 37.0), _trap(4, 1e-5, 6.2),
    _uniform("goldstein_price_partx", "Goldstein-Price below 50", 2, goldstein_price, NEGATIVE, 0.025970937, 3e-06, 1),
    _uniform("himmelblau_partx", "Himmelblau below 40", 2, himmelblau, NEGATIVE, 0.17649613, 7.9e-06, 3),
    _uniform("interval_ring_d3", "A thin shell", 3, interval_ring, CriticalInterval(0.0, 0.02), 0.00089661055, 3.6e-06, 1),
    _uniform("wavy_level_d3", "Several sheets", 3, wavy_level, CriticalInterval(low=0.55), 0.09103315, 6.4e-05, 1),
)  # fmt: skip
