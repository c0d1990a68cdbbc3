"""Parts of motion: dead time, lag, braking with limited jerk, kinematic single-track model, gusts of wind."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

__all__ = ["DeadTime", "FirstOrderLag", "Gust", "JerkLimitedStop", "SingleTrack"]


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


class JerkLimitedStop:
    """Braking to a stop whose deceleration grows with a limited jerk: exact at any time.

    Args:
        speed: before (m/s).
        onset: time at which the deceleration begins to grow (s).
        jerk: rate at which it grows (m/s^3), positive.
        braking: what it grows to (m/s^2), positive.
    """

    def __init__(self, speed: float, onset: float, jerk: float, braking: float):
        self._speed, self.onset, self._jerk, self._braking = speed, onset, jerk, braking
        self._ramp = min(braking / jerk, math.sqrt(2.0 * speed / jerk))
        self._rest = self._speed_after(self._ramp) / braking

    def _speed_after(self, ramp: float) -> float:
        return max(self._speed - 0.5 * self._jerk * ramp**2, 0.0)

    def at(self, t: float) -> float:
        """Return the speed at time t (m/s)."""
        ramp, rest = self._times(t)
        return max(self._speed_after(ramp) - self._braking * rest, 0.0) if t < self.onset + self._ramp + self._rest else 0.0

    def distance(self, t: float) -> float:
        """Return the distance covered from the onset (negative before) to time t (m)."""
        ramp, rest = self._times(t)
        ahead = self._speed * (ramp + min(t - self.onset, 0.0)) - self._jerk * ramp**3 / 6.0
        return ahead + self._speed_after(ramp) * rest - 0.5 * self._braking * rest**2

    def _times(self, t: float) -> tuple[float, float]:
        """Return how long the deceleration has grown and has been constant (s)."""
        since = max(t - self.onset, 0.0)
        return min(since, self._ramp), min(max(since - self._ramp, 0.0), self._rest)


class SingleTrack:
    """Kinematic single-track model (tyres roll without side slip), about the middle of the vehicle.

    Args:
        wheelbase: axle distance (m), the middle is in the middle of it.
        steering_max: largest steering angle (rad).

    Source:
        Rajamani (2012), Vehicle Dynamics and Control, 2.2; Polack et al. (2017), doi 10.1109/IVS.2017.7995816
        (valid up to a lateral acceleration of about half the friction limit).
    """

    def __init__(self, wheelbase: float = 2.8, steering_max: float = 0.6):
        self._wheelbase, self._steering_max = wheelbase, steering_max

    def steering(self, curvature: float) -> float:
        """Return the steering angle for a curvature of the path (1/m), within the limit."""
        return max(-self._steering_max, min(math.atan(self._wheelbase * curvature), self._steering_max))

    def slip(self, steering: float) -> float:
        """Return the angle from the vehicle's heading to the course of its middle (rad)."""
        return math.atan(0.5 * math.tan(steering))

    def move(self, x: float, y: float, heading: float, steering: float, distance: float) -> tuple[float, float, float]:
        """Return x, y (m) and heading (rad) after `distance` at a constant steering angle: an arc.

        The heading is the vehicle's; its middle moves along it turned by the slip angle.
        """
        slip = self.slip(steering)
        turn = distance * math.cos(slip) * math.tan(steering) / self._wheelbase
        chord = distance * (math.sin(0.5 * turn) / (0.5 * turn) if abs(turn) > 1e-9 else 1.0)
        course = heading + slip + 0.5 * turn
        return x + chord * math.cos(course), y + chord * math.sin(course), heading + turn


class Gust:
    """A random speed that varies smoothly in time, the same whatever the step: a sum of waves.

    Args:
        rng: source of phases and frequencies.
        deviation: standard deviation (m/s).
        duration: typical time of one gust (s).
        waves: number of waves.

    Source:
        spectral representation of a Gaussian process, Shinozuka and Deodatis (1991), doi 10.1115/1.3119501.
    """

    def __init__(self, rng: np.random.Generator, deviation: float, duration: float = 2.0, waves: int = 6):
        frequency = (np.arange(waves) + rng.random(waves)) / waves * 2.0 + 0.1  # 0.1 to 2.1 gusts in `duration`
        self._omega = (2.0 * math.pi / (2.0 * duration) * frequency).tolist()
        self._phase = (2.0 * math.pi * rng.random(waves)).tolist()
        self._amplitude = deviation * math.sqrt(2.0 / waves)

    def speed(self, t: float) -> float:
        """Return the speed at time t (m/s)."""
        return self._amplitude * sum(math.cos(w * t + p) for w, p in zip(self._omega, self._phase, strict=True))

    def distance(self, t: float) -> float:
        """Return the distance covered from 0 to t (m)."""
        waves = zip(self._omega, self._phase, strict=True)
        return self._amplitude * sum((math.sin(w * t + p) - math.sin(p)) / w for w, p in waves)
