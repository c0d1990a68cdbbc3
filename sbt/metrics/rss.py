"""Responsibility-Sensitive Safety: safe distances lengthwise and sideways, and their violation.

Source: Shalev-Shwartz, Shammah and Shashua (2017), On a formal model of safe and scalable self-driving
cars, arXiv 1708.06374: the safe longitudinal distances in the same and in opposite directions, the
safe lateral distance, and the dangerous situation, where both are violated.

Measured in ego's frame, for road users in about the same or the opposite direction (within 45 degrees);
crossing traffic, for which RSS needs the right of way, is not judged. Lengthwise the duty is that of
the one behind: there is nothing to violate for ego where the other is wholly behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sbt.errors import InputError
from sbt.metrics.exposure import integral
from sbt.metrics.longitudinal import FAR
from sbt.problem.arrays import Mask, Vector
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["Rss", "lateral_margin", "longitudinal_margin", "rss_lateral_min", "rss_longitudinal_min", "rss_violation"]

_SOURCE = "Shalev-Shwartz, Shammah and Shashua (2017), arXiv 1708.06374"
_ALIGNED = np.cos(np.pi / 4)


@dataclass(frozen=True)
class Rss:
    """The constants of RSS, which the paper leaves to the regulator; these are this package's choice.

    Args:
        response: response time (s).
        acceleration: largest acceleration during the response time (m/s^2).
        braking: deceleration at least applied after it (m/s^2).
        hard_braking: deceleration at most applied by the one ahead (m/s^2).
        correct_braking: deceleration at least applied by the one in its own lane, towards oncoming traffic (m/s^2).
        lateral_acceleration: largest acceleration to the side during the response time (m/s^2).
        lateral_braking: deceleration to the side at least applied after it (m/s^2).
        lateral_margin: distance that is kept sideways at least, mu of the paper (m).

    Raises:
        InputError: a negative constant, or a deceleration of 0.
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
            above = "braking" in entry.name
            if not (0 < value < np.inf or (value == 0 and not above)):
                raise InputError(f"rss.{entry.name} must be {'> 0' if above else '>= 0'} and finite, but got {value}")

    def same_direction(self, rear: Vector, front: Vector) -> Vector:
        """Return the (t,) safe distance between two in one direction (m), from their speeds >= 0 (m/s)."""
        fastest = rear + self.response * self.acceleration
        covered = rear * self.response + 0.5 * self.acceleration * self.response**2 + fastest**2 / (2 * self.braking)
        return np.maximum(covered - front**2 / (2 * self.hard_braking), 0.0)

    def opposite_direction(self, own: Vector, oncoming: Vector) -> Vector:
        """Return the (t,) safe distance between two that meet (m); `own` is in its lane, speeds >= 0 (m/s)."""

        def covered(speed: Vector, braking: float) -> Vector:
            fastest = speed + self.response * self.acceleration
            return 0.5 * (speed + fastest) * self.response + fastest**2 / (2 * braking)

        return covered(own, self.correct_braking) + covered(oncoming, self.braking)

    def sideways(self, towards: Vector, away: Vector) -> Vector:
        """Return the (t,) safe lateral distance (m).

        A speed that is apart after the response time is not counted on: that one may stop at once.

        Args:
            towards: (t,) lateral speed of the one, positive towards the other (m/s).
            away: (t,) lateral speed of the other in the same direction, so positive away from the one (m/s).
        """
        change = self.response * self.lateral_acceleration
        one, two = towards + change, away - change  # after the response time
        moved = 0.5 * (towards + one - away - two) * self.response
        stopping = (np.maximum(one, 0.0) ** 2 + np.minimum(two, 0.0) ** 2) / (2 * self.lateral_braking)
        return self.lateral_margin + np.maximum(moved + stopping, 0.0)


DEFAULT = Rss()


@dataclass(frozen=True, eq=False)
class _Relation:
    """Where the other is in ego's frame, (t,) each: `gap` < 0 while level, `clearance` < 0 while in ego's path."""

    gap: Vector
    clearance: Vector
    ahead: Mask
    left: Mask
    turn: Vector


def _relation(trace: Trace, ego: str, other: str) -> _Relation:
    a, b = trace.actor(ego), trace.actor(other)
    cos, sin = np.cos(a.heading), np.sin(a.heading)
    dx, dy, turn = b.x - a.x, b.y - a.y, b.heading - a.heading
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    gap = np.abs(along) - 0.5 * (a.length + b.length * c + b.width * s)
    clearance = np.abs(across) - 0.5 * (a.width + b.length * s + b.width * c)
    return _Relation(gap, clearance, along >= 0, across >= 0, turn)


def longitudinal_margin(trace: Trace, ego: str, other: str, margin: float = 0.0, rules: Rss = DEFAULT) -> Vector:
    """Return the (t,) distance lengthwise less the safe one (m), 1,000 where ego has no duty, wherever the other is sideways."""
    r, own = _relation(trace, ego, other), trace.actor(ego).speed
    cos = np.cos(r.turn)
    along = np.abs(trace.actor(other).speed * cos)
    same = rules.same_direction(np.where(r.ahead, own, along), np.where(r.ahead, along, own))
    safe = np.where(cos > 0, same, rules.opposite_direction(own, along))
    judged = (np.abs(cos) >= _ALIGNED) & (r.ahead | (r.gap < 0))
    return np.where(judged, np.minimum(r.gap - safe, FAR), FAR)


def lateral_margin(trace: Trace, ego: str, other: str, margin: float = 0.0, rules: Rss = DEFAULT) -> Vector:
    """Return the (t,) distance sideways less the safe one (m), at most 1,000, wherever the other is lengthwise."""
    r = _relation(trace, ego, other)
    leftwards = trace.actor(other).speed * np.sin(r.turn)
    safe = rules.sideways(np.zeros(len(trace.time)), np.where(r.left, leftwards, -leftwards))
    return np.where(np.abs(np.cos(r.turn)) >= _ALIGNED, np.minimum(r.clearance - safe, FAR), FAR)


def _worst(values: Vector, where: Mask) -> float:
    return float(values[where].min()) if where.any() else FAR


def rss_longitudinal_min(ego: str = "ego", other: str = "co", margin: float = 0.0, rules: Rss = DEFAULT) -> Metric:
    """Return the smallest distance lengthwise less the safe one while the other is in ego's path (m)."""

    def function(trace: Trace) -> float:
        in_path = _relation(trace, ego, other).clearance < margin
        return _worst(longitudinal_margin(trace, ego, other, rules=rules), in_path)

    return Metric(
        "rss_longitudinal_min", function, "m", "low", FAR,
        "smallest gap less the safe longitudinal distance of RSS, while the other is in the ego's path", _SOURCE,
    )  # fmt: skip


def rss_lateral_min(ego: str = "ego", other: str = "co", rules: Rss = DEFAULT) -> Metric:
    """Return the smallest distance sideways less the safe one while the two are level (m)."""

    def function(trace: Trace) -> float:
        level = _relation(trace, ego, other).gap < 0
        return _worst(lateral_margin(trace, ego, other, rules=rules), level)

    return Metric(
        "rss_lateral_min", function, "m", "low", FAR,
        "smallest lateral clearance less the safe lateral distance of RSS, while the two are level", _SOURCE,
    )  # fmt: skip


def rss_violation(ego: str = "ego", other: str = "co", rules: Rss = DEFAULT) -> Metric:
    """Return for how long both safe distances are violated (s), the dangerous situation of RSS, until a collision."""

    def function(trace: Trace) -> float:
        lengthwise = longitudinal_margin(trace, ego, other, rules=rules)
        dangerous = (lengthwise < 0) & (lateral_margin(trace, ego, other, rules=rules) < 0)
        return integral(trace, dangerous, ego, other)

    return Metric(
        "rss_violation", function, "s", "high", 0.0,
        "time during which the safe longitudinal and the safe lateral distance of RSS are both violated", _SOURCE,
    )  # fmt: skip


RSS_LONGITUDINAL_MIN = rss_longitudinal_min()
RSS_LATERAL_MIN = rss_lateral_min()
RSS_VIOLATION = rss_violation()
