"""Deceleration needed to avoid the road user ahead (DRAC, MDRAC, BTN), and TTC at constant accelerations (MTTC).

All are measured along the ego's heading while the other is ahead in the path, as in `sbt.metrics.longitudinal`.
Each exists as a signal, (t,) numbers, and as a metric, the worst of them.
"""

from __future__ import annotations

import numpy as np

from sbt.metrics.longitudinal import DRAC_LIMIT, HORIZON, Encounter, encounter
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["CAPABILITY", "REACTION", "btn", "btn_max", "drac", "mdrac", "mdrac_max", "mttc", "mttc_min"]

REACTION = 1.0
"""Reaction time of MDRAC (s), the default of SUMO's SSM device."""
CAPABILITY = 8.0
"""Deceleration that the ego can reach (m/s^2), about that on a dry road."""
_TINY_GAP = 1e-9
"""Lower bound of gaps in denominators (m)."""


def _deceleration(e: Encounter, values: Vector) -> Vector:
    """Return the (t,) decelerations within [0, DRAC_LIMIT]: 0 while nobody is ahead, the limit from a rear-end collision on."""
    return e.after_contact(np.where(e.ahead, np.clip(values, 0.0, DRAC_LIMIT), 0.0), DRAC_LIMIT)


def drac(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) deceleration rate to avoid a crash (m/s^2): closing^2 / (2 gap)."""
    e = encounter(trace, ego, other, margin)
    return _deceleration(e, np.maximum(e.closing, 0.0) ** 2 / (2 * np.maximum(e.gap, _TINY_GAP)))


def mdrac(trace: Trace, ego: str, other: str, margin: float, reaction: float = REACTION) -> Vector:
    """Return the (t,) DRAC after a reaction time at constant speeds (m/s^2)."""
    e = encounter(trace, ego, other, margin)
    left = e.gap - np.maximum(e.closing, 0.0) * reaction
    return _deceleration(e, np.maximum(e.closing, 0.0) ** 2 / (2 * np.maximum(left, _TINY_GAP)))


def mdrac_max(ego: str = "ego", other: str = "co", margin: float = 0.0, reaction: float = REACTION) -> Metric:
    """Return the largest modified DRAC (m/s^2), with a reaction time (s); 0 if the gap does not shrink, at most 100."""
    return Metric(
        "mdrac_max", lambda trace: float(mdrac(trace, ego, other, margin, reaction).max()), "m/s^2", "high", 0.0,
        "largest deceleration that would just avoid the collision after a reaction time",
        "as measured by SUMO's SSM device",
    )  # fmt: skip


def btn(trace: Trace, ego: str, other: str, margin: float, capability: float = CAPABILITY) -> Vector:
    """Return the (t,) brake threat number: the constant deceleration that the ego needs, divided by the one it can reach.

    The other keeps its acceleration, and stays where it comes to a standstill if it brakes. Without an acceleration of
    the other this is DRAC divided by `capability`; so it is of one that comes towards the ego, whom no braking of the ego
    alone avoids.
    """
    e, b = encounter(trace, ego, other, margin), trace.actor(other)
    turn = np.cos(b.heading - trace.actor(ego).heading)
    speed, braking = b.speed * turn, -b.acceleration * turn  # of the other, along the ego's heading
    gap, closing = np.maximum(e.gap, _TINY_GAP), np.maximum(e.closing, 0.0)
    needed = closing**2 / (2 * gap) + np.where(speed > 0, braking, 0.0)
    stops = (speed > 0) & (braking > 0)
    standstill = speed / np.maximum(braking, 1e-9)  # time until the other stands still (s), where it brakes
    first = stops & (2 * gap > closing * standstill)  # it stands still before the speeds would be equal
    until = gap + 0.5 * speed * standstill
    needed = np.where(first, e.speed**2 / (2 * np.maximum(until, _TINY_GAP)), np.where(closing > 0, needed, 0.0))
    return _deceleration(e, needed) / capability


def btn_max(ego: str = "ego", other: str = "co", margin: float = 0.0, capability: float = CAPABILITY) -> Metric:
    """Return the largest brake threat number; from 1 on, braking with `capability` (m/s^2) no longer avoids a collision."""
    return Metric(
        "btn_max", lambda trace: float(btn(trace, ego, other, margin, capability).max()), "", "high", 0.0,
        "largest share of the possible deceleration that would just avoid the collision",
        "Brannstrom, Sjoberg and Coelingh (2008), A situation and threat assessment algorithm for a rear-end "
        "collision avoidance system",
    )  # fmt: skip


def mttc(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) time to collision at constant accelerations (s): the first t > 0 at which the gap is 0.

    The root of gap = closing t + a t^2 / 2, in a form without cancellation; accelerations are extrapolated beyond a
    standstill.
    """
    e, a, b = encounter(trace, ego, other, margin), trace.actor(ego), trace.actor(other)
    relative = a.acceleration - b.acceleration * np.cos(b.heading - a.heading)
    square = e.closing**2 + 2 * relative * e.gap
    rate = e.closing + np.sqrt(np.maximum(square, 0.0))
    meets = e.ahead & (square >= 0) & (2 * e.gap < HORIZON * rate)
    return e.after_contact(np.where(meets, 2 * e.gap / np.where(meets, rate, 1.0), HORIZON), 0.0)


def mttc_min(ego: str = "ego", other: str = "co", margin: float = 0.0) -> Metric:
    """Return the smallest time to collision at constant accelerations (s), at most 10, 0 for a rear-end collision."""
    return Metric(
        "mttc_min", lambda trace: float(mttc(trace, ego, other, margin).min()), "s", "low", HORIZON,
        "smallest time to collision at constant accelerations, along the ego's heading",
        "Ozbay, Yang, Bartin and Mudigonda (2008), Derivation and validation of new simulation-based surrogate "
        "safety measure, doi 10.3141/2083-12",
    )  # fmt: skip


MTTC_MIN = mttc_min()
MDRAC_MAX = mdrac_max()
BTN_MAX = btn_max()
