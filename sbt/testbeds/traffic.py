"""Closed-form traffic situations with the typical difficulties of simulated driving, evaluated in microseconds.

They have plateaus without interaction, jumps at contact, and critical intervals inside the range of the metric.
"""

from __future__ import annotations

import math

import numpy as np

from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval
from sbt.testbeds.problem import NEGATIVE, Problem, Truth, lognormal, normal, parameters_of

__all__ = ["PROBLEMS"]

_GRAVITY = 9.81
_NO_CONFLICT = 10.0


def cut_in(x: Points) -> Vector:
    """Minimum time to collision (s) after a cut-in: the ego coasts for its delay, then brakes with b.

    G = gap - v delay - v^2 / (2 b) is the gap left when both are equally fast. While braking with
    closing speed w the time to collision is G / w + w / (2 b), smallest at w = sqrt(2 b G) where v gets
    that low, else at v. At most 10 (no conflict: a plateau); a collision (G < 0) scores minus a tenth
    of the impact speed (a jump at contact).

    Source:
        Constructed.
    """
    gap, v, delay, b = x.T
    closing = v > 0.0
    v = np.where(closing, v, 1.0)
    left = gap - v * delay - v**2 / (2.0 * b)
    w = np.sqrt(2.0 * b * np.abs(left))
    ttc = np.where(w < v, w / b, left / v + v / (2.0 * b))
    y = np.where(left < 0.0, -0.1 * np.minimum(w, v), np.minimum(ttc, _NO_CONFLICT))
    return np.where(closing, y, _NO_CONFLICT)


def pedestrian(x: Points) -> Vector:
    """Passing margin (m) to a pedestrian who steps out 4 m beside the lane's middle, the ego braking after its delay.

    Positive: the rear (4.5 m) has cleared the crossing before the pedestrian enters the 2.5 m wide strip,
    or the front is still before it when they leave; at most 12. A collision scores minus the braking
    distance that was missing, at least 0.02.

    Source:
        Constructed after the Jaywalking scenario of Winkelmann et al. (2022).
    """
    speed, walking, distance, delay, friction = x.T
    b = _GRAVITY * friction

    def travelled(t: Vector) -> Vector:
        braking = np.clip(t - delay, 0.0, speed / b)
        return speed * np.minimum(t, delay) + braking * (speed - 0.5 * b * braking)

    cleared = travelled(2.75 / walking) - 4.5 - distance
    short = distance - travelled(5.25 / walking)
    missing = speed * delay + speed**2 / (2.0 * b) - distance
    margin = np.minimum(np.where(cleared > 0.0, cleared, short), 12.0)
    return np.where((cleared > 0.0) | (short > 0.0), margin, -np.maximum(missing, 0.02))


def plateau_ttc(x: Points) -> Vector:
    """A flat 10 unless two timings nearly coincide, then a funnel, and a cliff to -1 where x5 > 0.8; x6 is idle.

    P = 0.042 * 0.056 * 0.2: 98 % of the box says nothing about where the critical wedge is.

    Source:
        Constructed; exact volume.
    """
    first = np.abs(x[:, 0] - 0.3 - 0.4 * x[:, 1]) / 0.06
    second = np.abs(x[:, 2] - 0.7 + 0.3 * x[:, 3]) / 0.08
    apart = np.maximum(first, second)
    funnel = np.where(apart < 1.0, 2.0 * apart + 4.0 * (1.0 - x[:, 4]) ** 2, _NO_CONFLICT)
    return np.where((apart < 0.35) & (x[:, 4] > 0.8), -1.0, funnel)


_CUT_IN = (
    Parameter("gap", -math.inf, math.inf, "m", lognormal(30.0, 12.0), description="gap after the cut-in"),
    Parameter("closing_speed", -math.inf, math.inf, "m/s", normal(2.0, 3.0), description="ego minus other"),
    Parameter("delay", -math.inf, math.inf, "s", lognormal(0.8, 0.25), description="until the ego brakes"),
    Parameter("deceleration", 3.0, 10.0, "m/s^2", normal(7.0, 1.2), description="of the braking ego"),
)
_CUT_IN_BOX = ((2.0, 120.0), (-10.0, 20.0), (0.2, 3.0), (3.0, 10.0))
_PEDESTRIAN = (
    Parameter("speed", 4.0, 9.0, "m/s", normal(6.0, 0.8), description="of the ego"),
    Parameter("walking_speed", -math.inf, math.inf, "m/s", lognormal(1.25, 0.35), description="of the pedestrian"),
    Parameter("distance", 0.0, 50.0, "m", description="from the ego's front to the crossing line"),
    Parameter("delay", -math.inf, math.inf, "s", lognormal(0.9, 0.35), description="until the ego brakes"),
    Parameter("friction", 0.25, 1.0, "", normal(0.7, 0.12), description="of tyre and road"),
)
_PEDESTRIAN_BOX = ((4.0, 9.0), (0.4, 3.0), (0.0, 50.0), (0.2, 3.0), (0.25, 1.0))

PROBLEMS = (
    Problem("cut_in_crash", "Cut-in with delayed braking: collision", _CUT_IN, cut_in, NEGATIVE,
            Truth(0.0015176718, 4.8e-07, 1, 0.144300, 2.1e-05), box=_CUT_IN_BOX),
    Problem("cut_in_near_miss", "Cut-in with delayed braking: near miss, no collision", _CUT_IN, cut_in,
            CriticalInterval(0.0, 0.6), Truth(0.00080271207, 4.7e-07, 1, 0.006017, 2.1e-05), box=_CUT_IN_BOX),
    Problem("pedestrian", "A pedestrian steps out", _PEDESTRIAN, pedestrian, NEGATIVE,
            Truth(0.0933851, 6.5e-05, None, 0.152653, 2.5e-05), box=_PEDESTRIAN_BOX),
    Problem("plateau_ttc_d6", "A funnel in a plateau", parameters_of({f"x{k + 1}": (0.0, 1.0) for k in range(6)}), plateau_ttc,
            NEGATIVE, Truth(0.042 * 0.056 * 0.2, 0.0, 1, 0.042 * 0.056 * 0.2)),
)  # fmt: skip
