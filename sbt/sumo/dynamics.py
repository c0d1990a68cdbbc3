"""Elements of vehicle motion: dead time, lag, jerk-limited braking, kinematic single-track model, wind gusts."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

__all__ = ["MAX_SPEED", "DeadTime", "FirstOrderLag", "Gust", "JerkLimitedStop", "SingleTrack", "next_speed"]

MAX_SPEED = 1e4
"""Commanded speeds must be below this (m/s): no road user comes near it, NaN and infinity are excluded."""
_AT_TARGET = 1e-6
"""Who is as near to a target speed is there (m/s): what SUMO gives back of a commanded speed may be rounded."""


def next_speed(speed: float, acceleration: float, target: float | None, dt: float) -> float:
    """Return the speed after a step of constant acceleration that ends at the target speed and at standstill (m/s).

    Braking below the target never reaches it: it changes nothing. Above it nobody accelerates: the speed stays. NaN gives NaN.
    """
    reached = speed + acceleration * dt
    if target is not None:
        if math.isnan(target):
            return target
        if acceleration < 0.0 and target <= speed + _AT_TARGET:
            reached = max(reached, target)
        elif acceleration > 0.0:
            reached = min(reached, target if target >= speed - _AT_TARGET else speed)
    return 0.0 if reached < 0.0 else reached


class DeadTime:
    """Delays a signal by a constant time; linear interpolation between samples.

    Args:
        delay: dead time (s), >= 0.
        initial: output until the first input has passed.
    """

    def __init__(self, delay: float, initial: float = 0.0):
        self._delay = delay
        self._samples: deque[tuple[float, float]] = deque()
        self._before = (-math.inf, initial)

    def __call__(self, t: float, value: float) -> float:
        """Add the sample (t, value) and return the signal at t - delay; t must not decrease."""
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
    """First-order lag (PT1), exact for an input that is constant over the step.

    Args:
        constant: time constant (s).
        initial: output at the start.
    """

    def __init__(self, constant: float, initial: float = 0.0):
        self._constant = constant
        self._value = initial
        self._step = self._share = 0.0

    def __call__(self, value: float, dt: float) -> float:
        """Return the output after the input has been `value` for dt seconds."""
        if dt != self._step:
            self._step = dt
            self._share = -math.expm1(-dt / self._constant) if self._constant > 0 else 1.0
        self._value += (value - self._value) * self._share
        return self._value


class JerkLimitedStop:
    """Closed-form braking to a standstill: the deceleration ramps up with constant jerk and is then constant.

    Args:
        speed: before braking (m/s).
        onset: time at which the ramp begins (s).
        jerk: slope of the ramp (m/s^3), positive.
        braking: deceleration at the end of the ramp (m/s^2), positive.
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
        """Return the time spent on the ramp and at constant deceleration until t (s)."""
        since = max(t - self.onset, 0.0)
        return min(since, self._ramp), min(max(since - self._ramp, 0.0), self._rest)


class SingleTrack:
    """Kinematic single-track (bicycle) model without tyre slip; the reference point is midway between the axles.

    Args:
        wheelbase: distance of the axles (m).
        steering_max: largest steering angle (rad).

    Source:
        Rajamani (2012), Vehicle Dynamics and Control, 2.2; Polack et al. (2017), doi 10.1109/IVS.2017.7995816
        (valid up to a lateral acceleration of about half the friction limit).
    """

    def __init__(self, wheelbase: float = 2.8, steering_max: float = 0.6):
        self._wheelbase, self._steering_max = wheelbase, steering_max

    def steering(self, curvature: float) -> float:
        """Return the steering angle (rad) for a path curvature (1/m), limited to `steering_max`."""
        return max(-self._steering_max, min(math.atan(self._wheelbase * curvature), self._steering_max))

    def slip(self, steering: float) -> float:
        """Return the slip angle (rad): from the heading to the direction of motion of the reference point."""
        return math.atan(0.5 * math.tan(steering))

    def move(self, x: float, y: float, heading: float, steering: float, distance: float) -> tuple[float, float, float]:
        """Return x, y (m) and heading (rad) after travelling `distance` (m) on an arc of constant steering angle."""
        slip = self.slip(steering)
        turn = distance * math.cos(slip) * math.tan(steering) / self._wheelbase
        chord = distance * (math.sin(0.5 * turn) / (0.5 * turn) if abs(turn) > 1e-9 else 1.0)
        course = heading + slip + 0.5 * turn
        return x + chord * math.cos(course), y + chord * math.sin(course), heading + turn


class Gust:
    """A random speed over time, independent of the simulation step: a sum of harmonics.

    Args:
        rng: source of phases and frequencies.
        deviation: standard deviation (m/s).
        duration: typical duration of a gust (s).
        waves: number of harmonics.

    Source:
        Spectral representation of a Gaussian process, Shinozuka and Deodatis (1991), doi 10.1115/1.3119501.
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
