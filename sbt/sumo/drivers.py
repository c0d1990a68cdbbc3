"""Controllers that the built-in scenarios use: an ego of ACC and AEB, and scripted others."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from sbt.errors import InputError
from sbt.sumo.actors import KEEP, Action, Pose, State
from sbt.sumo.dynamics import DeadTime, FirstOrderLag, Gust
from sbt.sumo.sensors import PERIOD, RangeSensor, Target

__all__ = ["AccAeb", "ArcExit", "Braking", "LaneChange", "SpeedProfile", "Stationary", "Walk"]

_as_action = partial(tuple.__new__, Action)
"""An `Action` of its four parts, without the default values that take most of the time to make one."""


class AccAeb:
    """Adaptive cruise control with automatic emergency braking on a noisy radar.

    ACC holds the set speed, or follows with a constant time gap (gap and closing-speed feedback, the
    form of Milanes and Shladover (2014), doi 10.1016/j.trc.2014.09.001), within comfort limits. AEB
    brakes fully once the target is closer than a driver could still stop from: when the time to
    collision falls below closing / (2 aeb_braking) + aeb_reserve; it holds until nothing closes in. Its first demand
    counts for the share of the radar's period, half of it before the measurement and half after, in which it is due:
    the clock of the radar does not show in how the vehicle brakes. The demand passes a dead time and a first-order
    lag before it becomes acceleration.

    Args:
        rng: source of the sensor noise.
        set_speed: cruising speed (m/s).
        reaction_time: dead time from measurement to actuation (s).
        lag, lag_2: time constants of the actuation, one after the other (s).
        time_gap: wanted headway (s).
        distance_min: wanted gap at standstill (m).
        acc_accel, acc_braking: comfort limits of ACC (m/s^2), both positive.
        aeb_braking: deceleration that AEB demands and the vehicle can reach (m/s^2), positive.
        aeb_reserve: time that AEB keeps in hand beyond the last moment to brake (s); None: AEB knows
            `aeb_distance` only.
        aeb_distance: gap below which AEB brakes whenever the target closes in (m).
        gap_noise, speed_noise: standard deviations of the sensor (m, m/s).
        sensor_range: of the radar (m).
        path_margin: lateral clearance up to which a road user counts as in the path (m).
        smoothing: time constant of the radar's track of the target (s); 0: raw measurements.

    Raises:
        InputError: a negative time, distance or limit.
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
        self._sensor = sensor.__call__  # a bound method is called faster than an object
        self._delay = DeadTime(reaction_time).__call__
        self._lag = FirstOrderLag(lag).__call__
        self._lag_2 = FirstOrderLag(lag_2).__call__ if lag_2 > 0 else None
        self._last = self._reached = 0.0
        self._due = 0.0
        self._target: Target | None = None

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the acceleration over the next step: the mean of the lag's output at its ends."""
        demand = self._delay(t, self._demand(own, self._sensor(t, own, others)))
        before, dt = self._reached, t - self._last
        after = self._lag(demand, dt)
        if self._lag_2 is not None:
            after = self._lag_2(after, dt)
        self._reached, self._last = after, t
        return _as_action((0.5 * (before + after), None, None, None))

    def _demand(self, own: State, target: Target | None) -> float:
        """Return the acceleration that ACC and AEB ask for."""
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
        """Return AEB's share of the demand: from its second measurement on 1, until nothing closes in."""
        if self._due:
            return 1.0 if new else self._due
        limit = self._aeb_distance
        if self._aeb_reserve is not None:  # the gap from which it can only just stop, and the reserve
            limit = max(limit, closing * (closing / (2 * self._aeb_braking) + self._aeb_reserve))
        period = max(step, PERIOD)
        window = 0.0 if self._target is None else 0.5 * period  # nothing can be due of a target before it is seen
        since = (limit - gap) / closing + window
        return min(since / period, 1.0) if since > 0.0 else 0.0


class LaneChange:
    """Holds its speed and changes to another lane at once, continuously in SUMO."""

    def __init__(self, lane: int):
        self._lane = lane
        self._started = False

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the lane change at first, then nothing new."""
        if self._started:
            return KEEP
        self._started = True
        return Action(speed=own.speed, lane=self._lane)


class Braking:
    """Brakes at once with a constant deceleration down to a final speed and holds it.

    Args:
        deceleration: m/s^2, positive.
        final_speed: m/s.
    """

    def __init__(self, deceleration: float, final_speed: float):
        self._action = Action(acceleration=-deceleration, speed=final_speed)

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the braking, which ends at the final speed."""
        return self._action


class SpeedProfile:
    """Accelerates from a speed to another, holds it, brakes to a stop: exact at every step, however long.

    Args:
        acceleration: of the first part (m/s^2), positive.
        speed: that is held (m/s).
        hold: time for which it is held (s).
        deceleration: of the last part (m/s^2), positive.
    """

    def __init__(self, acceleration: float, speed: float, hold: float, deceleration: float):
        self._acceleration, self._speed, self._deceleration = acceleration, speed, deceleration
        self._brakes = speed / acceleration + hold
        self.end = self._brakes + speed / deceleration
        """When it stands still again (s)."""

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
    """Walks straight on at a constant speed, pushed by gusts of wind along and across.

    Args:
        start: where it starts and which way it walks.
        speed: m/s.
        along, across: what the wind adds forwards and to the left.
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
    """Stands where it is."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose it has."""
        return Action(speed=0.0, pose=(own.x, own.y, own.heading))


class ArcExit:
    """Drives out on an arc to the left: accelerates from standstill, holds its speed, brakes to a stop.

    Args:
        start: where it stands.
        radius: of the arc of its middle (m).
        acceleration, speed, hold, deceleration: as of a `SpeedProfile`.
    """

    def __init__(self, start: Pose, radius: float, acceleration: float, speed: float, hold: float, deceleration: float):
        self._start, self._radius = start, radius
        self._profile = SpeedProfile(acceleration, speed, hold, deceleration)
        self.end = self._profile.end
        """When it stands again (s)."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose and the speed at the end of the step."""
        end = t + own.step
        turn = self._profile.distance(end) / self._radius
        x, y, heading = self._start
        chord = 2.0 * self._radius * math.sin(0.5 * turn)
        course = heading + 0.5 * turn
        pose = (x + chord * math.cos(course), y + chord * math.sin(course), heading + turn)
        return Action(speed=self._profile.at(end), pose=pose)
