"""Controllers for emergency braking: for a pedestrian who steps onto the road, and for a car that leaves its parking space."""

from __future__ import annotations

import math

import numpy as np

from sbt.problem.trace import FieldOfView
from sbt.sumo.actors import Action, Obstacle, State
from sbt.sumo.dynamics import DeadTime, FirstOrderLag, JerkLimitedStop
from sbt.sumo.occlusion import Occluders, outline

__all__ = ["EmergencyStop", "PedestrianBraking"]

_TICK = 0.05
"""Period of the sensors (s)."""
GRAVITY = 9.81
"""Gravitational acceleration (m/s^2)."""


class TickNoise:
    """Standard Gaussian numbers by the tick of a sensor, independent of the step and of what was seen before."""

    def __init__(self, rng: np.random.Generator, columns: int):
        self._rng, self._columns = rng, columns
        self._rows: list[list[float]] = []

    def __call__(self, tick: int) -> list[float]:
        """Return the numbers of one tick."""
        while tick >= len(self._rows):
            self._rows += self._rng.standard_normal((64, self._columns)).tolist()
        return self._rows[tick]


class PedestrianBraking:
    """Keeps its speed, and brakes for a pedestrian on a collision course.

    A camera behind the windscreen detects the pedestrian within `sight` once the centre of the body is not
    occluded, and measures position and velocity with noise. A conflict is predicted if the pedestrian, walking
    on, would be in the corridor of the ego while the ego passes, with a time margin as long as the ego can still
    stop. After `confirmations` consecutive conflicts the ego brakes as soon as `firmness` times the constant
    deceleration that would stop it `clearance` ahead of the pedestrian reaches `braking_min`, and until the
    pedestrian has left the corridor on the far side. The friction of the tyres limits the deceleration.

    Args:
        rng: source of the sensor noise.
        set_speed: the speed it keeps (m/s).
        friction: coefficient between tyre and road.
        sight: range of the camera (m).
        obstacles: rectangles that may occlude the pedestrian.
        camera: distance of the camera behind the front bumper (m).
        confirmations: consecutive frames (0.05 s) with a conflict before it brakes.
        reaction_time: dead time from decision to actuation (s).
        lag: time constant of the brakes (s).
        braking_min: smallest demanded deceleration (m/s^2).
        braking_max: largest demanded deceleration (m/s^2).
        firmness: factor on the required deceleration.
        clearance: desired distance to the pedestrian at standstill (m).
        side: lateral clearance between the sides of the ego and of its corridor (m).
        time_margin: how much earlier or later than the ego the pedestrian may pass to count as a conflict (s).
        position_noise: standard deviation of a measured coordinate (m).
        speed_noise: standard deviation of a measured velocity component (m/s).
    """

    def __init__(
        self, rng: np.random.Generator, set_speed: float, *, friction: float = 0.9, sight: float = 80.0,
        obstacles: tuple[Obstacle, ...] = (), camera: float = 1.6, confirmations: int = 4, reaction_time: float = 0.2,
        lag: float = 0.1, braking_min: float = 3.0, braking_max: float = 9.0, firmness: float = 1.2, clearance: float = 1.5,
        side: float = 0.4, time_margin: float = 0.6, position_noise: float = 0.1, speed_noise: float = 0.1,
    ):  # fmt: skip
        self._noise = TickNoise(rng, 4)
        self._set_speed = set_speed
        self._limit = friction * GRAVITY
        self._sight, self._camera = sight, camera
        self._occluders = Occluders((*o.pose, o.length, o.width) for o in obstacles)
        self._hidden_by = tuple(o.name for o in obstacles)
        self._confirmations = confirmations
        self._delay, self._lag = DeadTime(reaction_time), FirstOrderLag(lag)
        self._range = (braking_min, braking_max)
        self._firmness, self._clearance, self._side, self._time_margin = firmness, clearance, side, time_margin
        self._deviation = (position_noise, position_noise, speed_noise, speed_noise)
        self._next = self._conflicts = 0
        self._braking = False
        self._demand = self._reached = self._last = 0.0

    def field_of_view(self, length: float, width: float) -> FieldOfView:
        """Return where the camera sees somebody, in a vehicle of this size (m)."""
        return FieldOfView(self._sight, 0.5 * length - self._camera, hidden_by=self._hidden_by)

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the acceleration over the next step: the mean of the actuated values at its ends."""
        tick = int(t / _TICK + 1e-6)
        if tick >= self._next:
            self._next = tick + 1
            self._demand = self._decide(tick, own, others[0]) if others else 0.0
        demand = self._delay(t, self._demand)
        before = self._reached
        self._reached = after = self._lag(demand, t - self._last)
        self._last = t
        cruise = 0.5 * (self._set_speed - own.speed) if demand == 0.0 else 0.0
        return Action(max(0.5 * (before + after), -self._limit) + cruise)

    def _decide(self, tick: int, own: State, person: State) -> float:
        """Return the demanded acceleration."""
        seen = self._measure(tick, own, person)
        if seen is None:
            return self._demand
        gap, offset, towards = seen
        corridor = 0.5 * own.width + self._side + 0.5 * person.width
        gone = gap < 0.0 or (offset < -corridor and towards > 0.0)
        needed = self._firmness * own.speed**2 / (2.0 * max(gap - self._clearance, 0.05))
        least, most = self._range
        if gone:
            self._braking, self._conflicts = False, 0
        elif not self._braking:
            margin = self._time_margin if needed <= most else 0.0
            self._conflicts = self._conflicts + 1 if self._conflict(gap, offset, towards, corridor, margin, own) else 0
            self._braking = self._conflicts >= self._confirmations and needed >= least
        return -min(max(needed, least), most) if self._braking else 0.0

    def _conflict(self, gap: float, offset: float, towards: float, corridor: float, margin: float, own: State) -> bool:
        """Return whether the pedestrian is in the corridor while the ego passes; `towards` is the speed to the left."""
        if abs(offset) < corridor:
            return True
        if towards <= 0.05 or offset < 0.0:
            return False
        enters, leaves = (offset - corridor) / towards, (offset + corridor) / towards
        speed = max(own.speed, 0.1)
        arrives, passed = gap / speed, (gap + own.length) / speed
        return enters < passed + margin and leaves > arrives - margin

    def _measure(self, tick: int, own: State, person: State) -> tuple[float, float, float] | None:
        """Return the measured gap ahead, offset to the right and speed to the left of the pedestrian; None: not visible."""
        ahead = 0.5 * own.length - self._camera
        eye = np.array([own.x + ahead * own.cos, own.y + ahead * own.sin])
        middle = np.array([[person.x, person.y]])
        if math.hypot(person.x - eye[0], person.y - eye[1]) > self._sight or self._occluders.occlude(eye, middle)[0]:
            return None
        n = [a * b for a, b in zip(self._noise(tick), self._deviation, strict=True)]
        dx, dy = person.x - own.x + n[0], person.y - own.y + n[1]
        vx, vy = person.speed * person.cos + n[2], person.speed * person.sin + n[3]
        gap = dx * own.cos + dy * own.sin - 0.5 * own.length - 0.5 * person.width
        return gap, dx * own.sin - dy * own.cos, vy * own.cos - vx * own.sin


class EmergencyStop:
    """Drives straight ahead, and stops for a car that it sees leaving a parking space.

    A sensor at the front sees those points of the car's outline that are ahead and not occluded by other cars.
    When the northernmost visible point has moved by `threshold` since it was first seen, the ego brakes after
    `delay` to a standstill; its deceleration grows with `jerk` up to `braking`. The time of the movement is
    interpolated between the frames of the sensor, which are 0.05 s apart.

    Args:
        rng: source of the sensor noise.
        set_speed: the speed it keeps (m/s).
        threshold: movement that counts as leaving (m).
        delay: dead time (s).
        braking: deceleration (m/s^2), positive.
        jerk: rate at which the deceleration grows (m/s^3), positive.
        target: name of the observed car; the others may occlude it.
        position_noise: standard deviation of the position of the northernmost point (m).
    """

    def __init__(
        self, rng: np.random.Generator, set_speed: float, *, threshold: float = 0.3, delay: float = 0.3,
        braking: float = 6.0, jerk: float = 12.0, target: str = "co_1", position_noise: float = 0.015,
    ):  # fmt: skip
        self._noise = TickNoise(rng, 1)
        self._speed, self._threshold, self._target, self._deviation = set_speed, threshold, target, position_noise
        self._delay, self._jerk, self._braking = delay, jerk, braking
        self._next = 0
        self._first: float | None = None
        self._moved = 0.0
        self._stop: JerkLimitedStop | None = None

    def field_of_view(self, length: float, width: float) -> FieldOfView:
        """Return where the sensor at the front sees something, in a vehicle of this size (m)."""
        return FieldOfView(ahead=0.5 * length)

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose and the speed at the end of the step."""
        tick = int(t / _TICK + 1e-6)
        if tick >= self._next and self._stop is None:
            self._next = tick + 1
            moment = self._departure(tick, own, others)
            if moment is not None:
                self._stop = JerkLimitedStop(self._speed, max(moment + self._delay, t), self._jerk, self._braking)
        end = t + own.step
        if self._stop is None:
            speed, distance = self._speed, self._speed * own.step
        else:
            speed, distance = self._stop.at(end), self._stop.distance(end) - self._stop.distance(t)
        return Action(speed=speed, pose=(own.x + distance * own.cos, own.y + distance * own.sin, own.heading))

    def _departure(self, tick: int, own: State, others: tuple[State, ...]) -> float | None:
        """Return when the visible part of the observed car had moved by the threshold (s); None as long as it has not."""
        watched = next((o for o in others if o.name == self._target), None)
        if watched is None:
            return None
        eye = np.array([own.x + 0.5 * own.length * own.cos, own.y + 0.5 * own.length * own.sin])
        points = outline(watched)
        ahead = (points - eye) @ np.array([own.cos, own.sin]) > 0.0
        seen = ahead & ~Occluders.of(o for o in others if o is not watched).occlude(eye, points)
        if not seen.any():
            return None
        upper = float(points[seen, 1].max()) + self._deviation * self._noise(tick)[0]
        if self._first is None:
            self._first = upper
        before, self._moved = self._moved, upper - self._first
        if self._moved < self._threshold:
            return None
        return (tick - (self._moved - self._threshold) / max(self._moved - before, 1e-9)) * _TICK
