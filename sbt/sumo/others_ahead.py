"""What a driver sees of the other road users ahead, relative to its own lane of travel."""

from __future__ import annotations

from dataclasses import dataclass

from sbt.sumo.actors import State

__all__ = ["WANDERING", "OthersAhead", "Seen"]

WANDERING = 0.375
"""Deviation of a vehicle's centre from the centre of its lane that is normal wandering (m): UN Regulation 157."""


@dataclass(slots=True)
class Seen:
    """Another road user ahead, along and across the driver's heading.

    Attributes:
        gap: from the driver's front to its rear (m); negative where the two are side by side.
        speed: along the driver's heading (m/s).
        closing: rate at which the gap shrinks (m/s).
        deceleration: of the other (m/s^2); 0 where it does not brake.
        clearance: lateral distance of the two rectangles (m); negative where they overlap: the other is in the path.
        approach: rate at which the clearance shrinks (m/s).
        wandered: how long ago it left the zone of normal wandering towards the path (s); negative: it did not.
        entered: it was beside the path before, and has moved into it.
    """

    gap: float
    speed: float
    closing: float
    deceleration: float
    clearance: float
    approach: float
    wandered: float
    entered: bool

    def time_to_collision(self) -> float:
        """Return the time until the gap is closed at constant speeds (s); 0 side by side, infinite where it does not shrink."""
        if self.closing <= 0.0:
            return float("inf")
        return max(self.gap, 0.0) / self.closing

    def needed_braking(self, own_speed: float) -> float:
        """Return the constant deceleration that avoids a collision (m/s^2), if the other goes on as it does.

        A braking road user goes on braking to a standstill.
        """
        gap = max(self.gap, 1e-3)
        needed = 0.5 * self.closing**2 / gap if self.closing > 0.0 else 0.0
        if self.deceleration > 0.0 and self.speed >= 0.0:
            needed = max(needed, 0.5 * own_speed**2 / (gap + 0.5 * self.speed**2 / self.deceleration))
        return needed


@dataclass(slots=True)
class _Track:
    """What is remembered of a road user: its clearance now and at most, and when it left its wandering zone."""

    clearance: float
    farthest: float
    left: float | None = None


class OthersAhead:
    """Follows the road users ahead of a driver; one instance a run.

    Lateral speeds are differences between steps, as SUMO does not give them. A road user is hidden while a nearer one is in
    the path and within its wandering zone around the driver's centre line, so that a cut-out reveals what is ahead of it.

    Args:
        wandering: deviation towards the path that is normal (m).
    """

    def __init__(self, wandering: float = WANDERING):
        self._wandering = wandering
        self._tracks: dict[str, _Track] = {}
        self._last = 0.0

    def look(self, t: float, own: State, others: tuple[State, ...]) -> list[Seen]:
        """Return the visible road users whose centre is ahead of the driver's, the nearest first."""
        dt, self._last = t - self._last, t
        found: list[tuple[float, float, Seen]] = []
        for other in others:
            dx, dy = other.x - own.x, other.y - own.y
            along = dx * own.cos + dy * own.sin
            if along <= 0.0:
                self._tracks.pop(other.name, None)
                continue
            turn_cos, turn_sin = other.cos * own.cos + other.sin * own.sin, other.sin * own.cos - other.cos * own.sin
            half_length = 0.5 * (other.length * abs(turn_cos) + other.width * abs(turn_sin))
            half_width = 0.5 * (other.length * abs(turn_sin) + other.width * abs(turn_cos))
            across = abs(dy * own.cos - dx * own.sin)
            clearance = across - 0.5 * own.width - half_width
            track, approach = self._follow(other.name, t, clearance, dt)
            if turn_cos < 0.0 and clearance > 0.0:
                continue  # oncoming, beside the path
            speed = other.speed * turn_cos
            wandered = -1.0 if track.left is None else t - track.left
            gap = along - 0.5 * own.length - half_length
            entered = clearance <= 0.0 < track.farthest
            seen = Seen(gap, speed, own.speed - speed, max(-other.acceleration, 0.0), clearance, approach, wandered, entered)
            found.append((along, across, seen))
        found.sort(key=lambda each: each[0])
        nearest = next((k for k, (_, across, seen) in enumerate(found) if seen.clearance < 0.0 and across <= WANDERING), None)
        return [seen for _, _, seen in (found if nearest is None else found[: nearest + 1])]

    def _follow(self, name: str, t: float, clearance: float, dt: float) -> tuple[_Track, float]:
        """Update what is remembered of a road user; return it, and the rate at which the clearance shrinks."""
        track = self._tracks.get(name)
        if track is None:
            self._tracks[name] = track = _Track(clearance, clearance)
            return track, 0.0
        approach = (track.clearance - clearance) / dt if dt > 0.0 else 0.0
        track.clearance = clearance
        track.farthest = max(track.farthest, clearance)
        if track.farthest - clearance <= self._wandering:
            track.left = None
        elif track.left is None:
            track.left = t
        return track, approach
