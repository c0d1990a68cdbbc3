"""Lane keeping: a camera that sees the lane's markings, and the controller that steers by them."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dgesv

from sbt.sumo.actors import Action, Obstacle, State
from sbt.sumo.dynamics import DeadTime, FirstOrderLag, SingleTrack
from sbt.sumo.occlusion import Occluders

__all__ = ["LaneKeeping", "MarkingSensor"]

_TICK = 0.05
"""Period of the camera (s)."""
_EDGE = 1.0
"""Over so much of an obstacle, or so near to the end of what the camera reaches, a point fades (m): about the distance
of two points, so that the fit changes continuously where points come into sight one by one."""
_SLOTS = 64
"""Numbers of noise a frame and marking: every 64th point has the same, and they are not seen together."""


class MarkingSensor:
    """Sees the points of two markings ahead of it that no obstacle hides, and fits the middle of the lane to them.

    The lane's middle ahead is a cubic in the vehicle's frame, y = c0 + c1 x + c2 x^2 + c3 x^3: offset,
    direction, half the curvature, a sixth of its rate. Every tick a least-squares fit to the points seen
    is drawn a little to the last one, so that it goes on from what it knew where few or none are seen.
    A point has full weight in plain sight, less where a corner of an obstacle or the end of the reach is
    within a metre, and none behind a metre of obstacle: what is seen changes continuously as the vehicle moves.

    Args:
        rng: source of the noise.
        left, right: (n, 2) points of the two markings (m).
        lane: distance of the two markings (m).
        obstacles: what hides them.
        reach: radius of the circle in whose front half points are seen (m).
        noise: standard deviation of a point across (m).

    Attributes:
        seen: how many points of the left and of the right marking were seen last, those half seen as a half.
    """

    _MEMORY = np.array([1.5, 60.0, 6e3, 6e6])
    """Weight of the last coefficients in points^2 of information: little against two markings in full sight
    (40, 3e3, 8e5, 2e8), much against the few points in front of an obstacle, so that noise does not steer."""

    _KNOWN = np.diag(_MEMORY)

    def __init__(
        self, rng: np.random.Generator, left: np.ndarray, right: np.ndarray, *, lane: float,
        obstacles: tuple[Obstacle, ...] = (), reach: float = 20.0, noise: float = 0.05,
    ):  # fmt: skip
        self._rng, self._reach, self._noise = rng, reach, noise
        self._points = np.concatenate([left, right])
        self._x, self._y = np.ascontiguousarray(self._points.T)
        self._side = np.concatenate([np.full(len(left), 0.5 * lane), np.full(len(right), -0.5 * lane)])
        self._slot = np.concatenate([np.arange(len(left)) % _SLOTS, _SLOTS + np.arange(len(right)) % _SLOTS])
        self._obstacles = [(o, math.hypot(0.5 * o.length, 0.5 * o.width)) for o in obstacles]
        self._boxes: dict[tuple[Obstacle, ...], Occluders] = {}
        self._fit = np.zeros(4)
        self.seen = (0.0, 0.0)

    def __call__(self, own: State) -> np.ndarray:
        """Return the (4,) coefficients of the lane's middle in the vehicle's frame."""
        noise = self._noise * self._rng.standard_normal(2 * _SLOTS)
        eye = np.array([own.x, own.y])
        east, north = self._x - own.x, self._y - own.y
        (near,) = ((east * east + north * north < self._reach**2) & (east * own.cos + north * own.sin > 0.0)).nonzero()
        side, east, north = self._side[near], east[near], north[near]
        x = east * own.cos + north * own.sin
        y = north * own.cos - east * own.sin
        seen = np.minimum(np.minimum(x, self._reach - np.sqrt(x * x + y * y)) / _EDGE, 1.0)
        around = tuple([o for o, radius in self._obstacles if self._may_hide(own, o.pose[0] - own.x, o.pose[1] - own.y, radius)])
        if around:
            if around not in self._boxes:
                self._boxes[around] = Occluders((*o.pose, o.length, o.width) for o in around)
            seen *= np.maximum(1.0 - self._boxes[around].blocked_length(eye, self._points[near]) / _EDGE, 0.0)
        self.seen = (float(seen[side > 0].sum()), float(seen[side < 0].sum()))
        y += noise[self._slot[near]]
        _, c1, c2, c3 = self._fit
        turn = np.arctan(c1 + x * (2.0 * c2 + 3.0 * c3 * x))  # from a marking to the middle, across the lane as known
        x, y = x + side * np.sin(turn), y - side * np.cos(turn)
        square = x * x
        terms = np.empty((4, len(x)))
        terms[0], terms[1], terms[2], terms[3] = 1.0, x, square, square * x
        weighted = terms * (seen / (1.0 + square / self._reach**2))
        normal = weighted @ terms.T + self._KNOWN
        _, _, self._fit, _ = dgesv(normal, weighted @ y + self._MEMORY * self._fit)  # numpy's solve, without its checks
        return self._fit

    def _may_hide(self, own: State, east: float, north: float, radius: float) -> bool:
        """Return whether a circle reaches into the half disc in which points are seen."""
        return math.hypot(east, north) < self._reach + radius and east * own.cos + north * own.sin > -radius


class LaneKeeping:
    """Steers along the middle of its lane at a constant speed: curvature ahead, and a PID on the lateral error.

    The wanted lateral acceleration is v^2 times the curvature that the lane has `preview` seconds
    ahead (this makes up for the lags) plus a PID on the offset from the middle. As a steering angle it
    passes a dead time and two lags and moves a kinematic single-track model.

    Args:
        rng: source of the sensor noise.
        set_speed: m/s.
        preview: time ahead at which the curvature is taken (s).
        p, i, d: gains on the offset (1/s^2), its integral (1/s^3) and its rate (1/s).
        lag_1, lag_2: time constants of the steering (s).
        delay: its dead time (s).
        left, right: points of the markings, `lane` apart; without any it goes straight on.
        obstacles: what hides them.
        lateral_max: limit of the wanted lateral acceleration (m/s^2).
        wheelbase: m.
    """

    def __init__(
        self, rng: np.random.Generator, set_speed: float, *, preview: float = 0.3, p: float = 0.2, i: float = 0.003,
        d: float = 0.9, lag_1: float = 0.15, lag_2: float = 0.01, delay: float = 0.05,
        left: np.ndarray | None = None, right: np.ndarray | None = None, lane: float = 3.5,
        obstacles: tuple[Obstacle, ...] = (), lateral_max: float = 6.0, wheelbase: float = 2.8,
    ):  # fmt: skip
        nothing = np.empty((0, 2))
        self.sensor = MarkingSensor(
            rng, nothing if left is None else left, nothing if right is None else right, lane=lane, obstacles=obstacles
        )
        self._speed, self._preview, self._gains, self._limit = set_speed, preview, (p, i, d), lateral_max
        self._model = SingleTrack(wheelbase)
        self._delay, self._lags = DeadTime(delay), (FirstOrderLag(lag_1), FirstOrderLag(lag_2))
        self._next = 0
        self._integral = self._wanted = self._steering = 0.0

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose at the end of the step, under the mean of the steering angles at its ends."""
        tick = int(t / _TICK + 1e-6)
        while tick >= self._next:
            self._next += 1
            self._wanted = self._steer(self.sensor(own))
        dt = own.step
        before, value = self._steering, self._delay(t, self._wanted)
        for lag in self._lags:
            value = lag(value, dt)
        self._steering = value
        pose = self._model.move(own.x, own.y, own.heading, 0.5 * (before + value), self._speed * dt)
        return Action(speed=self._speed, pose=pose)

    def _steer(self, lane: np.ndarray) -> float:
        """Return the steering angle that the lane ahead asks for."""
        c0, c1, c2, c3 = lane.tolist()
        p, i, d = self._gains
        self._integral += c0 * _TICK
        ahead = self._speed * self._preview
        slope = c1 + ahead * (2.0 * c2 + 3.0 * c3 * ahead)
        curvature = (2.0 * c2 + 6.0 * c3 * ahead) / (1.0 + slope * slope) ** 1.5
        rate = self._speed * math.sin(math.atan(c1) - self._model.slip(self._steering))  # of the offset
        wanted = self._speed**2 * curvature + p * c0 + i * self._integral + d * rate
        wanted = max(-self._limit, min(wanted, self._limit))
        return self._model.steering(wanted / self._speed**2)
