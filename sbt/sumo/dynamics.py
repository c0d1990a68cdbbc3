"""Parts of a vehicle's longitudinal dynamics: dead time, first-order lag, rate limit."""

from __future__ import annotations

import math
from collections import deque

__all__ = ["DeadTime", "FirstOrderLag"]


class DeadTime:
    """Gives back what was put in `delay` seconds ago, linearly between samples.

    Args:
        delay: dead time (s), >= 0.
        initial: output until the first input has come through.
    """

    def __init__(self, delay: float, initial: float = 0.0):
        self._delay = delay
        self._samples: deque[tuple[float, float]] = deque()
        self._before = (-math.inf, initial)

    def __call__(self, t: float, value: float) -> float:
        """Put `value` in at time t and return the value of t - delay; t must not decrease."""
        samples = self._samples
        samples.append((t, value))
        then = t - self._delay + 1e-9
        while samples and samples[0][0] <= then:
            self._before = samples.popleft()
        start, now = self._before
        if then - start < 1e-6 or not samples or start == -math.inf:
            return now
        end, following = samples[0]
        return now + (following - now) * (then - start) / (end - start)


class FirstOrderLag:
    """Follows its input with time constant `constant` (s): exact for an input held over the step."""

    def __init__(self, constant: float, initial: float = 0.0):
        self._constant = constant
        self._value = initial
        self._step = self._share = 0.0

    def __call__(self, value: float, dt: float) -> float:
        """Return the output after dt seconds of the input `value`."""
        if dt != self._step:
            self._step = dt
            self._share = -math.expm1(-dt / self._constant) if self._constant > 0 else 1.0
        self._value += (value - self._value) * self._share
        return self._value
