"""Responsibility-Sensitive Safety (RSS): safe longitudinal and lateral distances, and their violation.

Source: Shalev-Shwartz, Shammah and Shashua (2017), On a formal model of safe and scalable self-driving
cars, arXiv 1708.06374: the safe longitudinal distances in the same and in opposite directions, the
safe lateral distance, and the dangerous situation, where both are violated.

Measured in the ego's frame, for road users in about the same or the opposite direction (within 45 degrees).
Crossing traffic is not assessed, because RSS would need the right of way. The longitudinal distance is the duty of
the road user behind: the ego cannot violate it where the other is completely behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sbt.errors import InputError
from sbt.metrics.arcs import after_shares, while_passing
from sbt.metrics.exposure import integral
from sbt.metrics.geometry import contact_moment, part_pairs
from sbt.metrics.longitudinal import FAR, first_contact
from sbt.metrics.strips import turned_in_behind
from sbt.problem.arrays import Mask, Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["Rss", "lateral_margin", "longitudinal_margin", "rss_lateral_min", "rss_longitudinal_min", "rss_violation"]

_SOURCE = "Shalev-Shwartz, Shammah and Shashua (2017), arXiv 1708.06374"
_MIN_COS = np.cos(np.pi / 4)
"""Of the angle between the courses of road users that are assessed."""
_TOUCH = 1e-9
"""Who is level by less than this (m) touches the other lengthwise."""


@dataclass(frozen=True)
class Rss:
    """The parameters of RSS, which the paper leaves to the regulator; the defaults are the choice of this package.

    Args:
        response: response time (s).
        acceleration: largest acceleration during the response time (m/s^2).
        braking: smallest deceleration after the response time (m/s^2).
        hard_braking: largest deceleration of the road user ahead (m/s^2).
        correct_braking: smallest deceleration of a road user in its own lane towards oncoming traffic (m/s^2).
        lateral_acceleration: largest lateral acceleration during the response time (m/s^2).
        lateral_braking: smallest lateral deceleration after it (m/s^2).
        lateral_margin: smallest lateral distance, mu of the paper (m).

    Raises:
        InputError: a parameter is negative, or a deceleration is 0.
    """

    response: float = 1.0
    acceleration: float = 3.5
    braking: float = 4.0
    hard_braking: float = 8.0
    correct_braking: float = 3.0
    lateral_acceleration: float = 0.2
    lateral_braking: float = 0.8
    lateral_margin: float = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            positive = "braking" in entry.name
            if not (0 < value < np.inf or (value == 0 and not positive)):
                raise InputError(f"rss.{entry.name} must be {'> 0' if positive else '>= 0'} and finite, but got {value}")

    def same_direction(self, rear: Vector | float, front: Vector | float) -> Vector:
        """Return the (t,) safe distance of road users in the same direction (m), from speeds >= 0 (m/s), arrays or numbers."""
        fastest = rear + self.response * self.acceleration
        covered = rear * self.response + 0.5 * self.acceleration * self.response**2 + fastest**2 / (2 * self.braking)
        return np.maximum(covered - front**2 / (2 * self.hard_braking), 0.0)

    def opposite_direction(self, own: Vector, oncoming: Vector) -> Vector:
        """Return the (t,) safe distance of oncoming road users (m), from their speeds >= 0 (m/s); `own` is in its own lane."""

        def covered(speed: Vector, braking: float) -> Vector:
            fastest = speed + self.response * self.acceleration
            return 0.5 * (speed + fastest) * self.response + fastest**2 / (2 * braking)

        return covered(own, self.correct_braking) + covered(oncoming, self.braking)

    def sideways(self, towards: Vector, away: Vector) -> Vector:
        """Return the (t,) safe lateral distance (m).

        A lateral motion apart after the response time is not relied on, as it may end at once.

        Args:
            towards: (t,) lateral speed of one road user, positive towards the other (m/s).
            away: (t,) lateral speed of the other in the same direction, positive away from the first (m/s).
        """
        change = self.response * self.lateral_acceleration
        one, two = towards + change, away - change  # after the response time
        moved = 0.5 * (towards + one - away - two) * self.response
        stopping = (np.maximum(one, 0.0) ** 2 + np.minimum(two, 0.0) ** 2) / (2 * self.lateral_braking)
        return self.lateral_margin + np.maximum(moved + stopping, 0.0)


DEFAULT = Rss()


@dataclass(frozen=True, eq=False)
class _Relation:
    """Position of the other in the ego's frame, (t,) each: `gap` < 0 while level, `clearance` < 0 while in the path."""

    gap: Vector
    clearance: Vector
    ahead: Mask
    left: Mask
    turn: Vector


def _relation(one: ActorTrace, two: ActorTrace) -> _Relation:
    found = [_relation_of(a, b) for a, b in part_pairs(one, two)]
    if len(found) == 1:
        return found[0]
    gap, clearance = (np.stack([getattr(r, name) for r in found]) for name in ("gap", "clearance"))  # (pairs, t)
    apart = np.nan_to_num(np.hypot(np.maximum(gap, 0.0), np.maximum(clearance, 0.0)), nan=np.inf)
    nearest = np.where(apart <= apart.min(axis=0) + _TOUCH, gap, np.inf).argmin(axis=0)  # of several the one that is most level
    rows = np.arange(len(nearest))
    fields = ("gap", "clearance", "ahead", "left", "turn")
    return _Relation(*(np.stack([getattr(r, name) for r in found])[nearest, rows] for name in fields))


def _relation_of(a: ActorTrace, b: ActorTrace) -> _Relation:
    cos, sin = np.cos(a.heading), np.sin(a.heading)
    dx, dy, turn = b.x - a.x, b.y - a.y, b.heading - a.heading
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    gap = np.abs(along) - 0.5 * (a.length + b.length * c + b.width * s)
    clearance = np.abs(across) - 0.5 * (a.width + b.length * s + b.width * c)
    return _Relation(np.where(np.abs(gap) < _TOUCH, 0.0, gap), clearance, along >= 0, across >= 0, turn)


def _behind(one: ActorTrace, two: ActorTrace, aside: Vector | float) -> Mask:
    """Return (t,) whether all of the other in the ego's path, so much wider (m), is behind: no duty is the ego's."""
    found = np.ones(len(one.x), dtype=bool)
    for a, b in part_pairs(one, two):
        r = _relation_of(a, b)
        clear, level = (r.clearance >= aside) | ((r.gap >= 0) & ~r.ahead), (r.gap < 0) & (r.clearance < aside)
        found &= clear | turned_in_behind(a, b, 0.5 * a.length, aside, level)
    return found


def _until_contact(trace: Trace, ego: str, other: str) -> tuple[ActorTrace, ActorTrace]:
    """Return the two, from the instant of their first contact on as they were when they began to touch, within its step."""
    a, b = trace.actor(ego), trace.actor(other)
    k = first_contact(trace, ego, other)
    if k is None:
        return a, b
    row, moment = np.arange(len(a.x)), contact_moment(a, b, k) if k else 0.0
    step, share = np.where(row < k, row, max(k - 1, 0)), np.where(row < k, 0.0, moment)
    return after_shares(a, step, share), after_shares(b, step, share)


def _margin_along(r: _Relation, own: ActorTrace, other: ActorTrace, rules: Rss) -> Vector:
    cos = np.cos(r.turn)
    along = np.abs(other.speed * cos)
    same = rules.same_direction(np.where(r.ahead, own.speed, along), np.where(r.ahead, along, own.speed))
    safe = np.where(cos > 0, same, rules.opposite_direction(own.speed, along))
    assessed = (np.abs(cos) >= _MIN_COS) & (r.ahead | (r.gap < 0))
    return np.where(assessed, np.minimum(r.gap - safe, FAR), FAR)


def _safe_aside(r: _Relation, other: ActorTrace, rules: Rss) -> Vector:
    leftwards = other.speed * np.sin(r.turn)
    return rules.sideways(np.zeros(len(leftwards)), np.where(r.left, leftwards, -leftwards))


def _margin_aside(r: _Relation, other: ActorTrace, rules: Rss) -> Vector:
    safe = _safe_aside(r, other, rules)
    return np.where(np.abs(np.cos(r.turn)) >= _MIN_COS, np.minimum(r.clearance - safe, FAR), FAR)


def longitudinal_margin(trace: Trace, ego: str, other: str, margin: float = 0.0, rules: Rss = DEFAULT) -> Vector:
    """Return the (t,) longitudinal distance minus the safe one (m), at any lateral position; 1,000 where the ego has no duty.

    From the first contact on it stays.
    """
    own, co = _until_contact(trace, ego, other)
    return _margin_along(_relation(own, co), own, co, rules)


def lateral_margin(trace: Trace, ego: str, other: str, margin: float = 0.0, rules: Rss = DEFAULT) -> Vector:
    """Return the (t,) lateral distance minus the safe one (m), at any longitudinal position; at most 1,000.

    From the first contact on it stays.
    """
    own, co = _until_contact(trace, ego, other)
    return _margin_aside(_relation(own, co), co, rules)


def rss_longitudinal_min(ego: str = "ego", other: str = "co", margin: float = 0.0, rules: Rss = DEFAULT) -> Metric:
    """Return the smallest longitudinal distance minus the safe one while the other is in the ego's path (m)."""

    def function(trace: Trace) -> float:
        own, co = _until_contact(trace, ego, other)
        r = _relation(own, co)
        in_path = (r.clearance < margin) & ~_behind(own, co, margin)
        return float(_margin_along(r, own, co, rules)[in_path].min(initial=FAR))

    return Metric(
        "rss_longitudinal_min", function, "m", "low", FAR,
        "smallest gap less the safe longitudinal distance of RSS, while the other is in the ego's path", _SOURCE,
    )  # fmt: skip


def rss_lateral_min(ego: str = "ego", other: str = "co", rules: Rss = DEFAULT) -> Metric:
    """Return the smallest lateral distance minus the safe one while the two are level (m), at instants or between them."""

    def function(trace: Trace) -> float:
        own, co = _until_contact(trace, ego, other)
        r, way = _relation(own, co), np.hypot(np.diff(co.x - own.x), np.diff(co.y - own.y))
        between = while_passing(own, co, r.gap[1:] + r.gap[:-1] < way)
        within = _relation(*between)
        least = float(_margin_aside(r, co, rules)[r.gap < 0].min(initial=FAR))
        return float(_margin_aside(within, between[1], rules)[within.gap < 0].min(initial=least))

    return Metric(
        "rss_lateral_min", function, "m", "low", FAR,
        "smallest lateral clearance less the safe lateral distance of RSS, while the two are level", _SOURCE,
    )  # fmt: skip


def rss_violation(ego: str = "ego", other: str = "co", rules: Rss = DEFAULT) -> Metric:
    """Return the time during which both safe distances are violated (s), the dangerous situation of RSS, until a collision."""

    def function(trace: Trace) -> float:
        own, co = _until_contact(trace, ego, other)
        r = _relation(own, co)
        dangerous = (_margin_along(r, own, co, rules) < 0) & (_margin_aside(r, co, rules) < 0)
        if dangerous.any():
            dangerous &= ~_behind(own, co, _safe_aside(r, co, rules))
        return integral(trace, dangerous, ego, other)

    return Metric(
        "rss_violation", function, "s", "high", 0.0,
        "time during which the safe longitudinal and the safe lateral distance of RSS are both violated", _SOURCE,
    )  # fmt: skip


RSS_LONGITUDINAL_MIN = rss_longitudinal_min()
RSS_LATERAL_MIN = rss_lateral_min()
RSS_VIOLATION = rss_violation()
