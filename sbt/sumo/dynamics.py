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
        self._samples: deque[tuple[float, float]] = deque([(-math.inf, initial)])

    def __call__(self, t: float, value: float) -> float:
        """Put `value` in at time t and return the value of t - delay; t must not decrease."""
        samples = self._samples
        samples.append((t, value))
        then = t - self._delay
        while len(samples) > 1 and samples[1][0] <= then:
            samples.popleft()
        before, now = samples[0]
        if len(samples) == 1 or before == -math.inf:
            return now
        after, following = samples[1]
        return now + (following - now) * (then - before) / (after - before)


class FirstOrderLag:
    """Follows its input with time constant `constant` (s): exact for an input held over the step."""

    def __init__(self, constant: float, initial: float = 0.0):
        self._constant = constant
        self._value = initial

    def __call__(self, value: float, dt: float) -> float:
        """Return the output after dt seconds of the input `value`."""
        if self._constant > 0:
            self._value += (value - self._value) * -math.expm1(-dt / self._constant)
        else:
            self._value = value
        return self._value
