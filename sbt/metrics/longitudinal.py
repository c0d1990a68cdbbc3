"""Criticality metrics of two road users on the same path: TTC, gap, THW, DRAC, collision.

All are measured between rectangles along the ego's heading. The other road user is *in the path* while the
lateral clearance between the two rectangles is below `margin`: with a margin of 0 the rectangles would touch,
with half the free width of the lane the other one has crossed the lane marking.

Source of the definitions unless stated: Westhofen et al. (2023), Criticality Metrics for Automated
Driving: A Review and Suitability Analysis of the State of the Art, doi 10.1007/s11831-022-09788-7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sbt.metrics.cache import per_trace
from sbt.metrics.geometry import contact_index, contact_moment, rectangles
from sbt.metrics.strips import turned_in_behind
from sbt.problem.arrays import Mask, Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = [
    "BESIDE", "DRAC_LIMIT", "FAR", "HORIZON", "OVERTAKEN", "Encounter", "Signal", "collision", "d_min", "drac_max", "encounter",
    "first_contact", "gap", "impact_speed", "longitudinal_metrics", "relative_speed_at_contact", "thw", "thw_min",
    "time_to_collision", "ttc", "ttc_min",
]  # fmt: skip

HORIZON = 10.0
"""TTC and THW of road users that do not interact, and the largest value reported (s)."""
BESIDE = -5.0
"""Smallest TTC of road users side by side (s)."""
OVERTAKEN = -10.0
"""TTC (s) and gap (m) reported if the ego had passed the other before it entered the path."""
FAR = 1000.0
"""Gap of road users that never share a path (m)."""
DRAC_LIMIT = 100.0
"""Largest DRAC reported (m/s^2); the formula has no limit as the gap approaches 0."""
Signal = Callable[[Trace, str, str, float], Vector]
"""Of a trace, ego, another road user and the margin of the path (m): (t,) numbers."""
_MOMENTS = 1001
"""Times within the step of a contact at which speeds are looked at."""


@dataclass(frozen=True, eq=False)
class Encounter:
    """Relative position and motion of the ego and another road user over a trace, (t,) each.

    Attributes:
        gap: from the ego's front to the other's rear along the ego's heading (m); negative beside or behind it.
        closing: rate at which the gap shrinks (m/s).
        in_path: the other is in the ego's path; never after the first contact.
        ahead: it is in the path and ahead of the ego's front.
        beside: it is in the path and level with the ego.
        speed: of the ego (m/s).
        contact: index of the first contact, None without one.
        rear_end: the contact is a rear-end collision of the ego.
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

    def after_contact(self, values: Vector, at_contact: float) -> Vector:
        """Return the (t,) values, replaced by `at_contact` from a rear-end collision on."""
        if self.contact is None or not self.rear_end:
            return values
        return np.where(np.arange(len(values)) >= self.contact, at_contact, values)


@per_trace
def first_contact(trace: Trace, ego: str, other: str) -> int | None:
    """Return the index of the first contact of two actors, None without one."""
    return contact_index(trace.actor(ego), trace.actor(other))


@per_trace
def encounter(trace: Trace, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Encounter:
    """Return the relative position and motion of two actors."""
    a, b = trace.actor(ego), trace.actor(other)
    seen = [_sighting(rectangles(a)[0], part, a.length, margin) for part in rectangles(b)]
    gap, turn, in_path, behind = seen[0] if len(seen) == 1 else _nearest_in_path(seen)
    passed = np.logical_and.reduce([part[3] for part in seen])
    contact = first_contact(trace, ego, other)
    if contact is not None:  # nothing counts after the first contact
        in_path[contact + 1 :] = False
        passed[contact + 1 :] = passed[contact]
    ahead = in_path & (gap >= 0)
    rear_end = contact is not None and (bool(ahead[contact]) or (contact > 0 and bool(ahead[contact - 1])))
    return Encounter(
        gap, a.speed - b.speed * turn, in_path, ahead, in_path & (gap < 0) & ~behind, a.speed,
        contact, rear_end, bool(passed[-1]),
    )  # fmt: skip


_Sighting = tuple[Vector, Vector, Mask, Mask]
"""Gap (m), cosine of the relative heading, whether in the path, and whether behind the ego, (t,) each."""


def _sighting(a: ActorTrace, b: ActorTrace, length: float, margin: float) -> _Sighting:
    """Return the relation of a rectangle b to the ego's front rectangle a, the ego being of this length (m)."""
    cos, sin = np.cos(a.heading), np.sin(a.heading)
    dx, dy = b.x - a.x, b.y - a.y
    turn, aside = np.cos(b.heading - a.heading), np.abs(np.sin(b.heading - a.heading))
    reach = b.length * np.abs(turn) + b.width * aside  # along the ego's heading: who stands across is as long as it is wide
    broad = b.length * aside + b.width * np.abs(turn)
    gap = dx * cos + dy * sin - 0.5 * (a.length + reach)
    in_path = np.abs(-dx * sin + dy * cos) < 0.5 * (a.width + broad) + margin
    behind = gap <= -(length + reach)
    beside = in_path & (gap < 0) & ~behind
    return gap, turn, in_path, behind | turned_in_behind(a, b, length - 0.5 * a.length, margin, beside)


def _nearest_in_path(seen: list[_Sighting]) -> _Sighting:
    """Return, at every instant, the relation to the part of a long vehicle that the ego would reach first."""
    gap, turn, in_path, behind = (np.stack(columns) for columns in zip(*seen, strict=True))  # (parts, t)
    last = np.where(behind, np.abs(gap), np.inf)  # parts behind the ego come last, the nearest of them first
    rank = np.where(behind, 1e6 + last, gap) + np.where(in_path, 0.0, 1e9)
    nearest = rank.argmin(axis=0)[None]
    first_gap, first_turn = (np.take_along_axis(values, nearest, 0)[0] for values in (gap, turn))
    return first_gap, first_turn, np.logical_or.reduce(in_path), np.take_along_axis(behind, nearest, 0)[0]


def time_to_collision(e: Encounter) -> Vector:
    """Return the (t,) time to collision along the ego's heading (s); meaningful where the other is in the path."""
    closes = e.closing > 0
    ratio = e.gap / np.where(closes, e.closing, np.inf)
    values = np.where(closes, np.minimum(ratio, HORIZON), HORIZON)
    if e.beside.any():
        values = np.where(e.beside, np.where(closes, np.maximum(ratio, BESIDE), BESIDE), values)
    return values


def _smallest(signal: Signal, trace: Trace, ego: str, other: str, margin: float, passed: float) -> float:
    """Return the smallest value of a signal, `passed` if the ego had passed the other before it entered the path."""
    e = encounter(trace, ego, other, margin)
    if e.overtaken and not (e.ahead | e.beside).any():
        return passed
    return float(signal(trace, ego, other, margin).min())


def ttc(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) time to collision along the ego's heading (s)."""
    e = encounter(trace, ego, other, margin)
    return e.after_contact(np.where(e.ahead | e.beside, time_to_collision(e), HORIZON), 0.0)


def ttc_min(ego: str = "ego", other: str = "co", margin: float = 0.0, passed: float = OVERTAKEN) -> Metric:
    """Return the smallest time to collision along the ego's heading (s).

    0 for a rear-end collision, in [-5, 0) if the other enters the path beside the ego, `passed` if the ego
    had passed it before, and 10 if the gap does not shrink or the time is longer.
    """
    return Metric(
        "ttc_min", lambda trace: _smallest(ttc, trace, ego, other, margin, passed), "s", "low", HORIZON,
        "smallest time to collision at constant speeds, along the ego's heading",
        "Hayward (1972), Near-miss determination through use of a scale of danger",
    )  # fmt: skip


def gap(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) gap while the other is in the ego's path (m)."""
    e = encounter(trace, ego, other, margin)
    return e.after_contact(np.where(e.ahead | e.beside, np.minimum(e.gap, FAR), FAR), 0.0)


def d_min(ego: str = "ego", other: str = "co", margin: float = 0.0, passed: float = OVERTAKEN) -> Metric:
    """Return the smallest gap along the ego's heading while the other is in the path (m).

    0 for a rear-end collision, negative beside the ego, `passed` if the ego had passed the other before it
    entered the path, and 1,000 without a shared path.
    """
    return Metric(
        "d_min", lambda trace: _smallest(gap, trace, ego, other, margin, passed), "m", "low", FAR,
        "smallest gap along the ego's heading while the other is in its path",
    )  # fmt: skip


def thw(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) time headway (s)."""
    e = encounter(trace, ego, other, margin)
    return e.after_contact(np.where(e.ahead, np.minimum(e.gap / np.maximum(e.speed, 1e-3), HORIZON), HORIZON), 0.0)


def thw_min(ego: str = "ego", other: str = "co", margin: float = 0.0) -> Metric:
    """Return the smallest time headway behind the other (s), at most 10, 0 for a rear-end collision."""
    return Metric(
        "thw_min", lambda trace: float(thw(trace, ego, other, margin).min()), "s", "low", HORIZON,
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
    """Return the largest deceleration rate to avoid a crash (m/s^2), 0 if the gap does not shrink, at most 100."""
    return Metric(
        "drac_max", lambda trace: _drac_max(trace, ego, other, margin), "m/s^2", "high", 0.0,
        "largest constant deceleration that would just avoid the collision",
        "Almqvist, Hyden and Risser (1991)",
    )  # fmt: skip


def collision(ego: str = "ego") -> Metric:
    """Return 1 if the ego's rectangle touches another one, at or between the recorded instants, else 0."""

    def function(trace: Trace) -> float:
        return float(any(first_contact(trace, ego, other) is not None for other in trace.actors if other != ego))

    return Metric("collision", function, "", "high", 0.0, "the ego's rectangle touched another one")


def relative_speed_at_contact(trace: Trace, ego: str, other: str) -> float:
    """Return the relative speed of two actors at their first contact (m/s), 0 without one.

    Where speeds change evenly within a step, those at the moment of the contact, else those of the step.
    """
    k = first_contact(trace, ego, other)
    if k is None:
        return 0.0
    a, b = trace.actor(ego), trace.actor(other)
    u, v = a.speed[k], b.speed[k]
    if trace.ballistic and k > 0 and np.isfinite(a.x[k - 1] + b.x[k - 1]):
        u, v = _speeds_at_contact(a, b, k, float(trace.time[k] - trace.time[k - 1]))
    dx = u * np.cos(a.heading[k]) - v * np.cos(b.heading[k])
    dy = u * np.sin(a.heading[k]) - v * np.sin(b.heading[k])
    return float(np.hypot(dx, dy))


def _speeds_at_contact(a: ActorTrace, b: ActorTrace, k: int, step: float) -> tuple[float, float]:
    """Return the speeds with which two actors touch within the step (s) before an instant, in which speeds change evenly."""
    time = np.linspace(0.0, 1.0, _MOMENTS)
    (way_a, speed_a), (way_b, speed_b) = (_within_step(each, k, step, time) for each in (a, b))
    x_a, y_a, x_b, y_b = a.x[k] - a.x[k - 1], a.y[k] - a.y[k - 1], b.x[k] - b.x[k - 1], b.y[k] - b.y[k - 1]
    dx, dy = x_b - x_a, y_b - y_a
    along = way_b * (x_b * dx + y_b * dy) - way_a * (x_a * dx + y_a * dy)  # how they have come together, times all of it
    reached = contact_moment(a, b, k) * (dx * dx + dy * dy)
    together = np.append(along >= reached, True)
    at = min(max(int(together.argmax()), 1), _MOMENTS - 1)
    moment = np.interp(reached, along[at - 1 : at + 1], time[at - 1 : at + 1])
    return float(np.interp(moment, time, speed_a)), float(np.interp(moment, time, speed_b))


def _within_step(actor: ActorTrace, k: int, step: float, time: Vector) -> tuple[Vector, Vector]:
    """Return which part of the way of a step an actor has driven after parts of its time, and how fast it is then (m/s).

    Who stops within it stands for the rest; who is moved by poses moves evenly, at the speed of the step.
    """
    before, after = float(actor.speed[k - 1]), float(actor.speed[k])
    way, mean = float(np.hypot(actor.x[k] - actor.x[k - 1], actor.y[k] - actor.y[k - 1])), 0.5 * (before + after)
    stops = after == 0.0 and 0.0 < way < mean * step
    if mean == 0.0 or not (stops or abs(way - abs(mean) * step) <= abs(way - abs(after) * step)):
        return time, np.full(len(time), after)
    done = np.minimum(time * mean * step / way, 1.0) if stops else time
    return done * (before + 0.5 * (after - before) * done) / mean, before + (after - before) * done


def impact_speed(ego: str = "ego", other: str = "co") -> Metric:
    """Return the relative speed at the first contact (m/s), 0 without one."""
    return Metric(
        "impact_speed", lambda trace: relative_speed_at_contact(trace, ego, other), "m/s", "high", 0.0,
        "relative speed at the first contact",
    )  # fmt: skip


def longitudinal_metrics(margin: float = 0.0) -> tuple[Metric, ...]:
    """Return the metrics of this module for the actors `ego` and `co`, with a margin of the path (m)."""
    return (
        ttc_min(margin=margin),
        d_min(margin=margin),
        collision(),
        impact_speed(),
        thw_min(margin=margin),
        drac_max(margin=margin),
    )


TTC_MIN = ttc_min()
D_MIN = d_min()
THW_MIN = thw_min()
DRAC_MAX = drac_max()
COLLISION = collision()
IMPACT_SPEED = impact_speed()
