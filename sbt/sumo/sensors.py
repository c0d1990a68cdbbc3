"""The radar of the AV under test: noisy, sampled, limited in range and to its own path."""

from __future__ import annotations

import math

import numpy as np

from sbt.sumo.actors import State

__all__ = ["PERIOD", "RangeSensor", "Target", "Track"]


Target = tuple[float, float]
"""The measured nearest road user ahead in the path: bumper-to-bumper gap (m) and closing speed (m/s)."""

PERIOD = 0.05
"""Of the radar's measurements (s)."""
_BLOCK = 128
"""Measurements for which noise is drawn at once."""


class Track:
    """Tracking filter for one road user: gap, speed and acceleration.

    The speed passes a critically damped g-h filter, which follows a constant acceleration without lag; the gap is
    predicted with the closing speed and therefore has no lag either.

    Args:
        smoothing: time constant (s), > 0.

    Source:
        Brookner (1998), Tracking and Kalman Filtering Made Easy, 1.2.6 (critically damped g-h filter).
    """

    def __init__(self, smoothing: float):
        self._smoothing = smoothing
        self._name = ""
        self._dt = self._last = 0.0
        self._gains = (1.0, 1.0, 1.0)
        self._state = (0.0, 0.0, 0.0, 0.0)

    def __call__(self, t: float, name: str, own_speed: float, gap: float, speed: float) -> Target:
        """Add a measurement of `name` at time t (s): gap (m) and speed (m/s). A new name restarts the filter."""
        dt = t - self._last
        self._last = t
        if name != self._name:
            self._name, acceleration = name, 0.0
        else:
            if abs(dt - self._dt) > 1e-9:
                fading = math.exp(-dt / self._smoothing)
                self._dt, self._gains = dt, (1.0 - fading, 1.0 - fading**2, (1.0 - fading) ** 2 / dt)
            of_gap, of_speed, of_acceleration = self._gains
            before, expected, acceleration, closing = self._state
            expected += acceleration * dt
            off = speed - expected
            speed = expected + of_speed * off
            acceleration += of_acceleration * off
            expected_gap = before - 0.5 * dt * (closing + own_speed - speed)
            gap = expected_gap + of_gap * (gap - expected_gap)
        self._state = (gap, speed, acceleration, own_speed - speed)
        return gap if gap > 0.0 else 0.0, own_speed - speed

    def lose(self) -> None:
        """Stop tracking: there is no road user in the path."""
        self._name = ""


class RangeSensor:
    """A forward-looking radar that measures the nearest road user in the ego's path.

    A measurement is taken every `period`, with Gaussian noise, and is held until the next one. A road user is
    in the path if the lateral clearance between the two rectangles is below `margin`.

    Args:
        rng: source of the noise.
        period: of the measurements (s).
        reach: greatest gap that is measured (m).
        margin: lateral clearance up to which a road user counts as in the path (m).
        gap_noise: standard deviation of the gap (m).
        speed_noise: standard deviation of the closing speed (m/s).
        smoothing: time constant of the `Track` (s); 0: unfiltered measurements.
    """

    def __init__(
        self, rng: np.random.Generator, *, period: float = PERIOD, reach: float = 200.0, margin: float = 0.85,
        gap_noise: float = 0.25, speed_noise: float = 0.15, smoothing: float = 0.0,
    ):  # fmt: skip
        self._rng = rng
        self._period, self._reach, self._margin = period, reach, margin
        self._track = Track(smoothing) if smoothing > 0.0 else None
        self._noise = (gap_noise, speed_noise)
        self._buffer: list[list[float]] = []
        self._next = 0
        self._held: Target | None = None

    def __call__(self, t: float, own: State, others: tuple[State, ...]) -> Target | None:
        """Return the latest measurement at time t (s); None if nothing is in the path."""
        tick = int(t / self._period + 1e-6)
        if tick < self._next:
            return self._held
        self._next = tick + 1
        x, y, cos, sin, length, width = own.x, own.y, own.cos, own.sin, own.length, own.width
        nearest: State | None = None
        smallest = self._reach
        for other in others:
            dx, dy = other.x - x, other.y - y
            gap = dx * cos + dy * sin - 0.5 * (length + other.length)
            if 0.0 <= gap < smallest and abs(dy * cos - dx * sin) - 0.5 * (width + other.width) < self._margin:
                nearest, smallest = other, gap
        if nearest is None:
            self._held = None
            if self._track is not None:
                self._track.lose()
            return None
        noise = self._buffer[tick] if tick < len(self._buffer) else self._draw(tick)
        closing = own.speed - nearest.speed * (nearest.cos * cos + nearest.sin * sin) + noise[1]
        gap = smallest + noise[0]
        if self._track is not None:
            self._held = held = self._track(t, nearest.name, own.speed, gap, own.speed - closing)
        else:
            self._held = held = (gap if gap > 0.0 else 0.0, closing)
        return held

    def _draw(self, tick: int) -> list[float]:
        """Return the noise of one measurement, which does not depend on what was in the path before."""
        while tick >= len(self._buffer):
            self._buffer += (self._rng.standard_normal((_BLOCK, 2)) * self._noise).tolist()
        return self._buffer[tick]
