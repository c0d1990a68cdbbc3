"""Criticality metrics of two road users that share a path: TTC, distance, THW, DRAC, collision.

All are measured along the ego's heading between rectangles. The other one counts as *in the path*
while the lateral clearance between the two rectangles is below `margin`: 0 means the rectangles
would touch, half the free width of the lane means it has crossed the marking.

Source of the definitions unless stated: Westhofen et al. (2023), Criticality Metrics for Automated
Driving: A Review and Suitability Analysis of the State of the Art, doi 10.1007/s11831-022-09788-7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.metrics.geometry import contact_index
from sbt.problem.arrays import Mask, Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = [
    "BESIDE", "DRAC_LIMIT", "FAR", "HORIZON", "OVERTAKEN", "Encounter", "collision", "d_min", "drac_max", "encounter",
    "first_contact", "impact_speed", "thw_min", "time_to_collision", "ttc_min",
]  # fmt: skip

HORIZON = 10.0
"""TTC and THW from which on there is no interaction (s)."""
BESIDE = -5.0
"""Smallest TTC of two that drive side by side (s)."""
OVERTAKEN = -10.0
"""TTC that says the ego had passed before the other came into its path (s)."""
FAR = 1000.0
"""Distance of two that never share a path (m)."""
DRAC_LIMIT = 100.0
"""Largest DRAC reported (m/s^2); the formula has no limit as the gap closes."""


@dataclass(frozen=True, eq=False)
class Encounter:
    """How ego and one other stand to each other over a trace, (t,) each.

    Attributes:
        gap: from ego's front to the other's rear along ego's heading (m), negative beside or behind.
        closing: rate at which the gap shrinks (m/s).
        in_path: the other is in ego's path.
        ahead, beside: it is in the path and ahead of ego's front, or level with ego.
        speed: of ego (m/s).
        contact: first index with contact, None without; nobody is in the path after it.
        rear_end: the contact came from behind.
        overtaken: at the end the ego is past the other.
    """

    gap: Vector
    closing: Vector
    in_path: Mask
    ahead: Mask
    beside: Mask
    speed: Vector
    contact: int | None
    rear_end: bool
    overtaken: bool

    def held(self, values: Vector, at_contact: float) -> Vector:
        """Return (t,) values that are `at_contact` from a rear-end contact on."""
        if self.contact is None or not self.rear_end:
            return values
        return np.where(np.arange(len(values)) >= self.contact, at_contact, values)


@per_trace
def first_contact(trace: Trace, ego: str, other: str) -> int | None:
    """Return the index of the first contact of two actors, None without one; kept for the last few traces."""
    return contact_index(trace.actor(ego), trace.actor(other))


@per_trace
def encounter(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Encounter:
    """Return how `ego` and `other` stand to each other; kept for the last few traces."""
    a, b = trace.actor(ego), trace.actor(other)
    cos, sin = np.cos(a.heading), np.sin(a.heading)
    dx, dy = b.x - a.x, b.y - a.y
    turn = np.cos(b.heading - a.heading)
    gap = dx * cos + dy * sin - 0.5 * (a.length + b.length)
    offset = np.abs(-dx * sin + dy * cos)
    in_path = offset < 0.5 * (a.width + b.width) + margin
    behind = gap <= -(a.length + b.length)
    contact = first_contact(trace, ego, other)
    if contact is not None:  # what follows the first contact does not count
        in_path[contact + 1 :] = False
        behind[contact + 1 :] = behind[contact]
    ahead = in_path & (gap >= 0)
    rear_end = contact is not None and (bool(ahead[contact]) or (contact > 0 and bool(ahead[contact - 1])))
    return Encounter(
        gap, a.speed - b.speed * turn, in_path, ahead, in_path & (gap < 0) & ~behind, a.speed,
        contact, rear_end, bool(behind[-1]),
    )  # fmt: skip


def time_to_collision(e: Encounter) -> Vector:
    """Return the (t,) TTC along ego's heading (s); it means something where the other is in the path."""
    closes = e.closing > 0
    ratio = e.gap / np.where(closes, e.closing, np.inf)
    ttc = np.where(closes, np.minimum(ratio, HORIZON), HORIZON)
    if e.beside.any():
        ttc = np.where(e.beside, np.where(closes, np.maximum(ratio, BESIDE), BESIDE), ttc)
    if e.contact is not None and e.rear_end:
        ttc[e.contact] = 0.0
    return ttc


def _ttc_min(trace: Trace, ego: str, other: str, margin: float, passed: float) -> float:
    e = encounter(trace, ego, other, margin)
    shared = e.ahead | e.beside
    if not shared.any():
        return passed if e.overtaken else HORIZON
    return float(time_to_collision(e)[shared].min())


def ttc_min(ego: str = "ego", other: str = "co", margin: float = 0.0, passed: float = OVERTAKEN) -> Metric:
    """Return the smallest time to collision along ego's heading (s).

    0 for a rear-end collision; in [-5, 0) where the other comes into the path beside ego; `passed` where
    ego had passed it by then; 10 where they do not close in, or take longer than that to.
    """
    return Metric(
        "ttc_min", lambda trace: _ttc_min(trace, ego, other, margin, passed), "s", "low", HORIZON,
        "smallest time to collision at constant speeds, along the ego's heading",
        "Hayward (1972), Near-miss determination through use of a scale of danger",
    )  # fmt: skip


def _d_min(trace: Trace, ego: str, other: str, margin: float, passed: float) -> float:
    e = encounter(trace, ego, other, margin)
    shared = e.ahead | e.beside
    if not shared.any():
        return passed if e.overtaken else FAR
    gap = np.where(np.arange(len(e.gap)) == e.contact, 0.0, e.gap) if e.rear_end else e.gap
    return float(min(gap[shared].min(), FAR))


def d_min(ego: str = "ego", other: str = "co", margin: float = 0.0, passed: float = OVERTAKEN) -> Metric:
    """Return the smallest gap along ego's heading while the other is in the path (m).

    0 for a rear-end collision, negative beside, `passed` where ego had passed before, 1,000 without a
    shared path.
    """
    return Metric(
        "d_min", lambda trace: _d_min(trace, ego, other, margin, passed), "m", "low", FAR,
        "smallest gap along the ego's heading while the other is in its path",
    )  # fmt: skip


def _thw_min(trace: Trace, ego: str, other: str, margin: float) -> float:
    e = encounter(trace, ego, other, margin)
    if not e.ahead.any():
        return HORIZON
    return float(np.minimum(e.gap / np.maximum(e.speed, 1e-3), HORIZON)[e.ahead].min())


def thw_min(ego: str = "ego", other: str = "co", margin: float = 0.0) -> Metric:
    """Return the smallest time headway behind the other (s), at most 10."""
    return Metric(
        "thw_min", lambda trace: _thw_min(trace, ego, other, margin), "s", "low", HORIZON,
        "smallest gap divided by the ego's speed, while the other is ahead in its path",
    )  # fmt: skip


def _drac_max(trace: Trace, ego: str, other: str, margin: float) -> float:
    e = encounter(trace, ego, other, margin)
    if e.rear_end:
        return DRAC_LIMIT
    if not e.ahead.any():
        return 0.0
    closing = np.maximum(e.closing[e.ahead], 0.0)
    return float(np.minimum(closing**2 / (2 * np.maximum(e.gap[e.ahead], 1e-9)), DRAC_LIMIT).max())


def drac_max(ego: str = "ego", other: str = "co", margin: float = 0.0) -> Metric:
    """Return the largest deceleration rate to avoid a crash (m/s^2), 0 without closing in, at most 100."""
    return Metric(
        "drac_max", lambda trace: _drac_max(trace, ego, other, margin), "m/s^2", "high", 0.0,
        "largest constant deceleration that would just avoid the collision",
        "Almqvist, Hyden and Risser (1991)",
    )  # fmt: skip


def collision(ego: str = "ego") -> Metric:
    """Return 1 where ego's rectangle touches another's at any time, steps in between included, else 0."""

    def function(trace: Trace) -> float:
        return float(any(first_contact(trace, ego, other) is not None for other in trace.actors if other != ego))

    return Metric("collision", function, "", "high", 0.0, "the ego's rectangle touched another one")


def impact_speed(ego: str = "ego", other: str = "co") -> Metric:
    """Return the speed of ego relative to the other at the first contact (m/s), 0 without one."""

    def function(trace: Trace) -> float:
        k = first_contact(trace, ego, other)
        if k is None:
            return 0.0
        a, b = trace.actor(ego), trace.actor(other)
        dx = a.speed[k] * np.cos(a.heading[k]) - b.speed[k] * np.cos(b.heading[k])
        dy = a.speed[k] * np.sin(a.heading[k]) - b.speed[k] * np.sin(b.heading[k])
        return float(np.hypot(dx, dy))

    return Metric("impact_speed", function, "m/s", "high", 0.0, "relative speed at the first contact")


TTC_MIN = ttc_min()
D_MIN = d_min()
THW_MIN = thw_min()
DRAC_MAX = drac_max()
COLLISION = collision()
IMPACT_SPEED = impact_speed()
