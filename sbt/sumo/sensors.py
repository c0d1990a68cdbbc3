"""What the AV under test perceives: noisy, sampled, limited in range and to its own path."""

from __future__ import annotations

import numpy as np

from sbt.sumo.actors import State

__all__ = ["RangeSensor", "Target"]


Target = tuple[float, float]
"""The nearest road user ahead in the path, as measured: gap from bumper to bumper (m), rate at which it shrinks (m/s)."""

_BLOCK = 128


class RangeSensor:
    """A forward-looking radar that measures the nearest road user in the own path.

    Measurements come every `period` with Gaussian noise and hold until the next one. A road user is
    in the path when the lateral clearance between the two rectangles is below `margin`.

    Args:
        rng: source of the noise.
        period: of the measurements (s).
        reach: greatest gap that is measured (m).
        margin: lateral clearance up to which a road user counts as in the path (m).
        gap_noise: standard deviation of the gap (m).
        speed_noise: standard deviation of the closing speed (m/s).
    """

    def __init__(
        self, rng: np.random.Generator, *, period: float = 0.05, reach: float = 200.0, margin: float = 0.85,
        gap_noise: float = 0.25, speed_noise: float = 0.15,
    ):  # fmt: skip
        self._rng = rng
        self._period, self._reach, self._margin = period, reach, margin
        self._noise = (gap_noise, speed_noise)
        self._buffer: list[tuple[float, float]] = []
        self._next = 0
        self._held: Target | None = None

    def __call__(self, t: float, own: State, others: tuple[State, ...]) -> Target | None:
        """Return the latest measurement at time t; None where nothing is in the path."""
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
            return None
        noise = self._buffer[tick] if tick < len(self._buffer) else self._draw(tick)
        closing = own.speed - nearest.speed * (nearest.cos * cos + nearest.sin * sin) + noise[1]
        gap = smallest + noise[0]
        self._held = held = (gap if gap > 0.0 else 0.0, closing)
        return held

    def _draw(self, tick: int) -> tuple[float, float]:
        """Return the noise of one tick: the same whatever was in the path before."""
        while tick >= len(self._buffer):
            noise = self._rng.standard_normal((_BLOCK, 2)) * self._noise
            self._buffer += [(a, b) for a, b in noise.tolist()]
        return self._buffer[tick]
