"""Lane keeping: a camera that detects the lane markings, and a steering controller that follows them."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dgesv

from sbt.problem.trace import FieldOfView
from sbt.sumo.actors import Action, Obstacle, State
from sbt.sumo.dynamics import DeadTime, FirstOrderLag, SingleTrack
from sbt.sumo.occlusion import Occluders

__all__ = ["LaneKeeping", "MarkingSensor"]

_TICK = 0.05
"""Period of the camera (s)."""
_FADE_LENGTH = 1.0
"""Length over which points fade at the edge of an obstacle or of the range (m): about the distance of two points, so that
the fit changes continuously as points come into view one by one."""
_NOISE_SLOTS = 64
"""Noise values per frame and marking: every 64th point shares one, and these points are never visible together."""


class MarkingSensor:
    """Detects the points of two lane markings that are ahead and not occluded, and fits the centre line of the lane.

    The centre line is a cubic in the vehicle's frame, y = c0 + c1 x + c2 x^2 + c3 x^3: offset, direction, half
    the curvature, and a sixth of its derivative. Every frame is a least-squares fit that is regularised towards
    the previous one, which therefore persists where few or no points are visible. Points have full weight in
    plain view, less within a metre of the edge of an obstacle or of the range, and none behind a metre of
    obstacle, so that the fit changes continuously as the vehicle moves.

    Args:
        rng: source of the noise.
        left: (n, 2) points of the left marking (m).
        right: (n, 2) points of the right marking (m).
        lane: distance of the two markings (m).
        obstacles: rectangles that may occlude them.
        reach: radius of the half disc ahead in which points are detected (m).
        noise: lateral standard deviation of a point (m).

    Attributes:
        reach: as given.
        seen: number of points of the left and of the right marking in the last frame, weighted by their visibility.
    """

    _PRIOR_WEIGHT = np.array([1.5, 60.0, 6e3, 6e6])
    """Information of the previous coefficients: small compared with two fully visible markings (40, 3e3, 8e5, 2e8),
    large compared with the few points in front of an obstacle, so that noise does not steer."""

    _PRIOR_INFORMATION = np.diag(_PRIOR_WEIGHT)

    def __init__(
        self, rng: np.random.Generator, left: np.ndarray, right: np.ndarray, *, lane: float,
        obstacles: tuple[Obstacle, ...] = (), reach: float = 20.0, noise: float = 0.05,
    ):  # fmt: skip
        self._rng, self.reach, self._noise = rng, reach, noise
        self._points = np.concatenate([left, right])
        self._x, self._y = np.ascontiguousarray(self._points.T)
        self._side = np.concatenate([np.full(len(left), 0.5 * lane), np.full(len(right), -0.5 * lane)])
        self._slot = np.concatenate([np.arange(len(left)) % _NOISE_SLOTS, _NOISE_SLOTS + np.arange(len(right)) % _NOISE_SLOTS])
        self._obstacles = [(o, math.hypot(0.5 * o.length, 0.5 * o.width)) for o in obstacles]
        self._occluders: dict[tuple[Obstacle, ...], Occluders] = {}
        self._fit = np.zeros(4)
        self.seen = (0.0, 0.0)

    def __call__(self, own: State) -> np.ndarray:
        """Return the (4,) coefficients of the centre line in the vehicle's frame."""
        noise = self._noise * self._rng.standard_normal(2 * _NOISE_SLOTS)
        eye = np.array([own.x, own.y])
        east, north = self._x - own.x, self._y - own.y
        (near,) = ((east * east + north * north < self.reach**2) & (east * own.cos + north * own.sin > 0.0)).nonzero()
        side, east, north = self._side[near], east[near], north[near]
        x = east * own.cos + north * own.sin
        y = north * own.cos - east * own.sin
        seen = np.minimum(np.minimum(x, self.reach - np.sqrt(x * x + y * y)) / _FADE_LENGTH, 1.0)
        around = tuple([o for o, radius in self._obstacles if self._may_hide(own, o.pose[0] - own.x, o.pose[1] - own.y, radius)])
        if around:
            if around not in self._occluders:
                self._occluders[around] = Occluders((*o.pose, o.length, o.width) for o in around)
            seen *= np.maximum(1.0 - self._occluders[around].blocked_length(eye, self._points[near]) / _FADE_LENGTH, 0.0)
        self.seen = (float(seen[side > 0].sum()), float(seen[side < 0].sum()))
        y += noise[self._slot[near]]
        _, c1, c2, c3 = self._fit
        turn = np.arctan(c1 + x * (2.0 * c2 + 3.0 * c3 * x))  # from the markings to the centre line, normal to the previous fit
        x, y = x + side * np.sin(turn), y - side * np.cos(turn)
        square = x * x
        terms = np.empty((4, len(x)))
        terms[0], terms[1], terms[2], terms[3] = 1.0, x, square, square * x
        weighted = terms * (seen / (1.0 + square / self.reach**2))
        normal = weighted @ terms.T + self._PRIOR_INFORMATION
        _, _, self._fit, _ = dgesv(normal, weighted @ y + self._PRIOR_WEIGHT * self._fit)  # np.linalg.solve without its checks
        return self._fit

    def _may_hide(self, own: State, east: float, north: float, radius: float) -> bool:
        """Return whether a circle overlaps the half disc in which points are detected."""
        return math.hypot(east, north) < self.reach + radius and east * own.cos + north * own.sin > -radius


class LaneKeeping:
    """Keeps its lane at a constant speed: feedforward of the curvature ahead and a PID controller on the lateral error.

    The desired lateral acceleration is v^2 times the curvature of the lane `preview` seconds ahead (which
    compensates the lags) plus a PID term on the offset from the centre line. The steering angle that results
    passes a dead time and two lags, and moves a kinematic single-track model.

    Args:
        rng: source of the sensor noise.
        set_speed: m/s.
        preview: look-ahead time of the curvature (s).
        p: gain on the offset (1/s^2).
        i: gain on its integral (1/s^3).
        d: gain on its rate (1/s).
        lag_1: time constant of the steering (s).
        lag_2: time constant of a second lag (s).
        delay: dead time of the steering (s).
        left: (n, 2) points of the left marking (m); without markings it goes straight ahead.
        right: (n, 2) points of the right marking (m).
        lane: distance of the two markings (m).
        obstacles: rectangles that may occlude the markings.
        lateral_max: limit of the desired lateral acceleration (m/s^2).
        wheelbase: of the single-track model (m).
    """

    def __init__(
        self, rng: np.random.Generator, set_speed: float, *, preview: float = 0.3, p: float = 0.2, i: float = 0.003,
        d: float = 0.9, lag_1: float = 0.15, lag_2: float = 0.01, delay: float = 0.05,
        left: np.ndarray | None = None, right: np.ndarray | None = None, lane: float = 3.5,
        obstacles: tuple[Obstacle, ...] = (), lateral_max: float = 6.0, wheelbase: float = 2.8,
    ):  # fmt: skip
        none = np.empty((0, 2))
        self.sensor = MarkingSensor(
            rng, none if left is None else left, none if right is None else right, lane=lane, obstacles=obstacles
        )
        self._view = FieldOfView(self.sensor.reach, hidden_by=tuple(o.name for o in obstacles))
        self._speed, self._preview, self._gains, self._limit = set_speed, preview, (p, i, d), lateral_max
        self._model = SingleTrack(wheelbase)
        self._delay, self._lags = DeadTime(delay), (FirstOrderLag(lag_1), FirstOrderLag(lag_2))
        self._next = 0
        self._integral = self._wanted = self._steering = 0.0

    def field_of_view(self, length: float, width: float) -> FieldOfView:
        """Return where the camera sees markings: from the middle of a vehicle of any size (m)."""
        return self._view

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the pose at the end of the step, driven with the mean of the steering angles at its ends."""
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
        """Return the steering angle (rad) for the lane ahead."""
        c0, c1, c2, c3 = lane.tolist()
        p, i, d = self._gains
        self._integral += c0 * _TICK
        ahead = self._speed * self._preview
        slope = c1 + ahead * (2.0 * c2 + 3.0 * c3 * ahead)
        curvature = (2.0 * c2 + 6.0 * c3 * ahead) / (1.0 + slope * slope) ** 1.5
        rate = self._speed * math.sin(math.atan(c1) - self._model.slip(self._steering))  # of the offset (m/s)
        wanted = self._speed**2 * curvature + p * c0 + i * self._integral + d * rate
        wanted = max(-self._limit, min(wanted, self._limit))
        return self._model.steering(wanted / self._speed**2)
