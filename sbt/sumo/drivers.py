"""Controllers of the built-in scenarios: an ego with ACC and AEB, and scripted road users."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from sbt.errors import InputError
from sbt.problem.profile import Curve
from sbt.problem.trace import FieldOfView
from sbt.sumo.actors import KEEP, Action, Pose, State
from sbt.sumo.dynamics import DeadTime, FirstOrderLag, Gust
from sbt.sumo.sensors import PERIOD, RangeSensor, Target

__all__ = ["AccAeb", "ArcExit", "Braking", "GivenSpeed", "LaneChange", "SpeedProfile", "Stationary", "Walk"]

_as_action = partial(tuple.__new__, Action)
"""Makes an `Action` from a tuple of its four fields; faster than the constructor, which handles defaults."""


class AccAeb:
    """Adaptive cruise control (ACC) and automatic emergency braking (AEB) with a noisy radar.

    ACC keeps the set speed, or follows at a constant time gap by feedback of gap and closing speed within
    comfort limits. AEB demands full braking when the time to collision falls below
    closing / (2 aeb_braking) + aeb_reserve, until the gap no longer shrinks. When AEB triggers within a period
    of the radar, its first demand is weighted by the fraction of the period in which it is due (half a period
    before and half a period after the measurement), so that the sampling of the radar causes no jumps in the
    braking. The demanded acceleration passes a dead time and first-order lags.

    Args:
        rng: source of the sensor noise.
        set_speed: cruising speed (m/s).
        reaction_time: dead time from measurement to actuation (s).
        lag: time constant of the actuation (s).
        lag_2: time constant of a second lag after it (s).
        time_gap: desired time gap (s).
        distance_min: desired gap at standstill (m).
        acc_accel: largest acceleration of ACC (m/s^2).
        acc_braking: largest deceleration of ACC (m/s^2), positive.
        aeb_braking: deceleration that AEB demands and the vehicle can reach (m/s^2), positive.
        aeb_reserve: time between the trigger of AEB and the last moment at which full braking avoids the collision
            (s); None: only `aeb_distance` triggers AEB.
        aeb_distance: gap below which AEB triggers whenever the gap shrinks (m).
        gap_noise: standard deviation of the measured gap (m).
        speed_noise: standard deviation of the measured closing speed (m/s).
        sensor_range: range of the radar (m).
        path_margin: lateral clearance up to which a road user counts as in the path (m).
        smoothing: time constant of the radar's tracking filter (s); 0: unfiltered measurements.

    Raises:
        InputError: a setting is not a number >= 0.

    Source:
        ACC: Milanes and Shladover (2014), doi 10.1016/j.trc.2014.09.001.
    """

    def __init__(
        self, rng: np.random.Generator, set_speed: float, *, reaction_time: float = 0.2, lag: float = 0.1, lag_2: float = 0.0,
        time_gap: float = 1.5, distance_min: float = 3.0, acc_accel: float = 2.0, acc_braking: float = 3.5,
        aeb_braking: float = 9.0, aeb_reserve: float | None = 0.5, aeb_distance: float = 1.0, gap_noise: float = 0.25,
        speed_noise: float = 0.15, sensor_range: float = 200.0, path_margin: float = 0.85, smoothing: float = 0.0,
    ):  # fmt: skip
        given = {k: v for k, v in locals().items() if k not in ("self", "rng")}
        for name, value in given.items():
            if name == "aeb_reserve" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating) or not value >= 0:
                raise InputError(f"ego.{name} must be a number >= 0, but got {value!r}")
        self._set_speed = set_speed
        self._time_gap, self._distance_min = time_gap, distance_min
        self._acc_accel, self._acc_braking = acc_accel, acc_braking
        self._aeb_braking, self._aeb_reserve, self._aeb_distance = aeb_braking, aeb_reserve, aeb_distance
        sensor = RangeSensor(
            rng, reach=sensor_range, margin=path_margin, gap_noise=gap_noise, speed_noise=speed_noise, smoothing=smoothing
        )
        self._radar = (sensor_range, path_margin)
        self._sensor = sensor.__call__  # calling a bound method is faster than calling an object
        self._delay = DeadTime(reaction_time).__call__
        self._lag = FirstOrderLag(lag).__call__
        self._lag_2 = FirstOrderLag(lag_2).__call__ if lag_2 > 0 else None
        self._last = self._reached = 0.0
        self._due = 0.0
        self._target: Target | None = None

    def field_of_view(self, length: float, width: float) -> FieldOfView:
        """Return where the radar at the front sees somebody, in a vehicle of this size (m): in its path."""
        reach, margin = self._radar
        return FieldOfView(max(reach, 1e-9), 0.5 * length, half_width=0.5 * width + margin)

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the acceleration over the next step: the mean of the actuated values at its ends."""
        demand = self._delay(t, self._demand(own, self._sensor(t, own, others)))
        before, dt = self._reached, t - self._last
        after = self._lag(demand, dt)
        if self._lag_2 is not None:
            after = self._lag_2(after, dt)
        self._reached, self._last = after, t
        return _as_action((0.5 * (before + after), None, None, None))

    def _demand(self, own: State, target: Target | None) -> float:
        """Return the acceleration that ACC and AEB demand."""
        demand, due = 0.4 * (self._set_speed - own.speed), 0.0
        if target is not None:
            gap, closing = target
            if closing > 0.0:
                due = self._emergency(gap, closing, target is not self._target, own.step)
            follow = 0.1 * (gap - self._distance_min - self._time_gap * own.speed) - 0.6 * closing
            if follow < demand:
                demand = follow
        self._due, self._target = due, target
        if demand < -self._acc_braking:
            demand = -self._acc_braking
        elif demand > self._acc_accel:
            demand = self._acc_accel
        return demand - due * (demand + self._aeb_braking) if due else demand

    def _emergency(self, gap: float, closing: float, new: bool, step: float) -> float:
        """Return the weight of AEB in the demand: a fraction at the first measurement, then 1 until the gap no longer shrinks."""
        if self._due:
            return 1.0 if new else self._due
        limit = self._aeb_distance
        if self._aeb_reserve is not None:  # braking distance at the closing speed, and the reserve
            limit = max(limit, closing * (closing / (2 * self._aeb_braking) + self._aeb_reserve))
        period = max(step, PERIOD)
        window = 0.0 if self._target is None else 0.5 * period  # AEB cannot be due before the first measurement
        since = (limit - gap) / closing + window
        return min(since / period, 1.0) if since > 0.0 else 0.0


class LaneChange:
    """Keeps its speed and starts a lane change at once.

    Args:
        lane: index of the target lane.
    """

    def __init__(self, lane: int):
        self._lane = lane
        self._started = False

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the lane change in the first step, and no change afterwards."""
        if self._started:
            return KEEP
        self._started = True
        return Action(speed=own.speed, lane=self._lane)


class Braking:
    """Brakes with a constant deceleration from the start down to a final speed, and keeps it; keeps its own where that is lower.

    Args:
        deceleration: m/s^2, positive.
        final_speed: m/s.
        jerk: rate at which the deceleration grows and ends (m/s^3); infinite: at once.
    """

    def __init__(self, deceleration: float, final_speed: float, jerk: float = math.inf):
        self._deceleration, self._final, self._jerk = deceleration, final_speed, jerk
        self._first: float | None = None

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the deceleration with the final speed as its limit, or the speed at the end of the step on a ramp."""
        if self._first is None:
            self._first, self._final = own.speed, min(self._final, own.speed)
        if self._jerk == math.inf:
            return Action(acceleration=-self._deceleration, speed=self._final)
        return Action(speed=self._at(t + own.step, self._first))

    def _at(self, t: float, first: float) -> float:
        """Return the speed at time t (m/s), in closed form: the deceleration is a trapezoid, or a triangle."""
        drop = first - self._final
        ramp = min(self._deceleration / self._jerk, math.sqrt(drop / self._jerk))
        if ramp <= 0.0:
            return first
        strongest = self._jerk * ramp
        end = ramp + drop / strongest
        if t >= end:
            return self._final
        if t > end - ramp:
            return self._final + 0.5 * self._jerk * (end - t) ** 2
        return first - 0.5 * self._jerk * min(t, ramp) ** 2 - strongest * max(t - ramp, 0.0)


class GivenSpeed:
    """Drives the speed of a curve over time, such as that of a profile; below 0 it stands.

    Args:
        curve: speed (m/s) over the time of the scenario (s).
    """

    def __init__(self, curve: Curve):
        self._curve = curve

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the speed at the end of the step."""
        return Action(speed=max(self._curve(t + own.step), 0.0))


class SpeedProfile:
    """Accelerates from standstill to a speed, keeps it, and brakes to a standstill; in closed form, exact for any step.

    Args:
        acceleration: of the first phase (m/s^2), positive.
        speed: of the second phase (m/s).
        hold: duration of the second phase (s).
        deceleration: of the last phase (m/s^2), positive.
    """

    def __init__(self, acceleration: float, speed: float, hold: float, deceleration: float):
        self._acceleration, self._speed, self._deceleration = acceleration, speed, deceleration
        self._brakes = speed / acceleration + hold
        self.end = self._brakes + speed / deceleration
        """Time at which it stands still again (s)."""

    def at(self, t: float) -> float:
        """Return the speed at time t (m/s)."""
        return max(min(self._acceleration * t, self._speed, self._speed - self._deceleration * (t - self._brakes)), 0.0)

    def distance(self, t: float) -> float:
        """Return the distance covered by time t (m)."""
        rise, fall = self._speed / self._acceleration, self._speed / self._deceleration
        first, last = min(t, rise), min(max(t - self._brakes, 0.0), fall)
        held = min(max(t - rise, 0.0), self._brakes - rise)
        return 0.5 * self._acceleration * first**2 + self._speed * (held + last) - 0.5 * self._deceleration * last**2

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the speed at the end of the step."""
        return Action(speed=self.at(t + own.step))


class Walk:
    """Walks straight ahead at a constant speed, plus the displacement by gusts of wind.

    Args:
        start: initial pose.
        speed: without wind (m/s).
        along: gusts in the walking direction.
        across: gusts to the left.
    """

    def __init__(self, start: Pose, speed: float, along: Gust, across: Gust):
        self._start, self._speed, self._along, self._across = start, speed, along, across

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose and the speed at the end of the step."""
        end = t + own.step
        x, y, heading = self._start
        cos, sin = math.cos(heading), math.sin(heading)
        ahead, left = self._speed * end + self._along.distance(end), self._across.distance(end)
        return Action(
            speed=self._speed + self._along.speed(end), pose=(x + ahead * cos - left * sin, y + ahead * sin + left * cos, heading)
        )


class Stationary:
    """Stays where it is."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the current pose."""
        return Action(speed=0.0, pose=(own.x, own.y, own.heading))


class ArcExit:
    """Leaves a parking space on an arc to the left, with a `SpeedProfile`.

    Args:
        start: initial pose.
        radius: of the arc on which the centre moves (m).
        acceleration: of the first phase (m/s^2), positive.
        speed: of the second phase (m/s).
        hold: duration of the second phase (s).
        deceleration: of the last phase (m/s^2), positive.
    """

    def __init__(self, start: Pose, radius: float, acceleration: float, speed: float, hold: float, deceleration: float):
        self._start, self._radius = start, radius
        self._profile = SpeedProfile(acceleration, speed, hold, deceleration)
        self.end = self._profile.end
        """Time at which it stands still again (s)."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose and the speed at the end of the step."""
        end = t + own.step
        turn = self._profile.distance(end) / self._radius
        x, y, heading = self._start
        chord = 2.0 * self._radius * math.sin(0.5 * turn)
        course = heading + 0.5 * turn
        pose = (x + chord * math.cos(course), y + chord * math.sin(course), heading + turn)
        return Action(speed=self._profile.at(end), pose=pose)
