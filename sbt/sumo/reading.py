"""Reads the states of actors from SUMO after every step.

Where SUMO alone drives, hardly anybody looks at a state while the run lasts: what SUMO says is kept as it is, states are computed
where somebody does look, and all the others at the end, as arrays. Both ways give the same numbers.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor, State
from sbt.sumo.session import INVALID_DOUBLE, unwrapped

__all__ = ["ROW", "Onlooker", "observer", "table"]

_COLUMNS = 5
ROW = struct.Struct(f"={_COLUMNS}d")
"""x, y, heading, speed, acceleration of one actor; lists of floats would take four times the memory."""
_DEGREE = math.pi / 180.0


def table(rows: bytearray, first: int, last: int, actors: int) -> np.ndarray:
    """Return a view of the (last - first, m, 5) states at some instants."""
    numbers = actors * _COLUMNS
    return np.frombuffer(rows, np.float64, (last - first) * numbers, first * numbers * 8).reshape(-1, actors, _COLUMNS)


def observer(
    sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str, rows: bytearray
) -> Callable[[int], None]:
    """Return the function that reads all actors from SUMO and writes their states as row k.

    SUMO's reference position is the front bumper of a vehicle and the centre of a person; ours is the centre.
    """
    read = [
        (s, prefix + s.name, 0.0 if a.person else 0.5 * s.length, _getters(sumo, a)) for a, s in zip(actors, states, strict=True)
    ]
    rate, size, write = 1.0 / dt, ROW.size, ROW.pack_into

    def observe(k: int) -> None:
        at = k * len(read) * size
        for state, name, half, (position, angle_of, speed_of) in read:
            try:
                x, y = position(name)
            except Exception as error:  # the class depends on the client: libsumo or traci
                if "is not known" in str(error):
                    raise _left(state, k * dt) from None
                raise
            if x == INVALID_DOUBLE:
                raise _left(state, k * dt)
            angle = angle_of(name)
            if angle != state.angle:
                state.turn(angle)
            speed = speed_of(name) if state.steered is None else state.steered
            state.x = x = x - half * state.cos
            state.y = y = y - half * state.sin
            state.acceleration = acceleration = (speed - state.speed) * rate if k else 0.0
            state.speed = speed
            write(rows, at, x, y, state.heading, speed, acceleration)
            at += size

    return observe


class Onlooker(Mapping[str, State]):
    """Reads actors that SUMO alone drives; a mapping of their names to their states, computed when they are looked at.

    Args:
        sumo: libsumo.
        actors: of the scene, none with a controller.
        states: of the actors.
        dt: SUMO's step (s).
        prefix: of the names of the actors in SUMO.
        rows: where the states that somebody has looked at are written.
    """

    def __init__(
        self, sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str, rows: bytearray
    ) -> None:
        getters = [(prefix + a.name, _getters(sumo, a)) for a in actors]
        self._positions, self._angles, self._speeds = ([(of[k], name) for name, of in getters] for k in range(3))
        self._states, self._dt, self._rows = states, dt, rows
        self._half = [0.0 if a.person else 0.5 * s.length for a, s in zip(actors, states, strict=True)]
        self._index = {state.name: k for k, state in enumerate(states)}
        self._read: list[tuple[list[tuple[float, float]], list[float], list[float]]] = []
        self._at = [-1] * len(states)
        self._reach = 2.0 * max(s.length for s in states) + 2.0 * max(self._half)

    def __getitem__(self, name: str) -> State:
        return self.look(len(self._read) - 1, self._index[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)

    def observe(self, k: int) -> None:
        """Read all actors after step k."""
        try:
            positions = [position(name) for position, name in self._positions]
        except Exception as error:  # the class depends on the client: libsumo or traci
            if "is not known" in str(error):
                raise self._missing(k) from None
            raise
        angles, speeds = [angle(name) for angle, name in self._angles], [speed(name) for speed, name in self._speeds]
        self._read.append((positions, angles, speeds))

    def near(self, k: int, solid: list[int]) -> list[int]:
        """Return which of some may have touched the first actor in the step to row k; their states and its are written."""
        positions, _, speeds = self._read[k]
        (x, y), reach = positions[0], self._reach + (speeds[0] + max(speeds)) * self._dt
        left, right = x - reach, x + reach
        found = [j for j in solid if left < positions[j][0] < right]
        found = [j for j in found if -reach < positions[j][1] - y < reach] if found else found
        if found:
            for j in (0, *found):
                if k and self._at[j] < k - 1:
                    self.look(k - 1, j)
                self.look(k, j)
        return found

    def look(self, k: int, j: int) -> State:
        """Return the state of an actor in row k, which is written."""
        state = self._states[j]
        if self._at[j] == k:
            return state
        positions, angles, speeds = self._read[k]
        if angles[j] != state.angle:
            state.turn(angles[j])
        (x, y), half = positions[j], self._half[j]
        state.x, state.y, state.speed = x - half * state.cos, y - half * state.sin, speeds[j]
        state.acceleration = (speeds[j] - self._read[k - 1][2][j]) * (1.0 / self._dt) if k else 0.0
        self._at[j] = k
        at = (k * len(self._states) + j) * ROW.size
        ROW.pack_into(self._rows, at, state.x, state.y, state.heading, state.speed, state.acceleration)
        return state

    def table(self) -> np.ndarray:
        """Return the (t, m, 5) states that were read.

        Raises:
            RunError: an actor was not on the road.
        """
        n, m = len(self._read), len(self._states)
        flat = chain.from_iterable
        places = np.fromiter(flat(flat(each[0] for each in self._read)), np.float64, 2 * n * m).reshape(n, m, 2)
        if (gone := np.argwhere(places[:, :, 0] == INVALID_DOUBLE)).size:
            raise _left(self._states[gone[0, 1]], float(gone[0, 0]) * self._dt)
        angles, speeds = (np.fromiter(flat(each[c] for each in self._read), np.float64, n * m).reshape(n, m) for c in (1, 2))
        states = np.empty((n, m, _COLUMNS))
        heading = (90.0 - angles) * _DEGREE
        half = np.array(self._half)
        directions = {h: (math.cos(h), math.sin(h)) for h in set(heading.ravel().tolist())}  # not numpy's: other last digits
        turned = np.fromiter(flat(map(directions.__getitem__, heading.ravel().tolist())), np.float64, 2 * n * m).reshape(n, m, 2)
        states[:, :, :2] = places - half[:, None] * turned
        states[:, :, 2], states[:, :, 3] = heading, speeds
        states[0, :, 4] = 0.0
        states[1:, :, 4] = (speeds[1:] - speeds[:-1]) * (1.0 / self._dt)
        return states

    def _missing(self, k: int) -> RunError:
        """Return the error that names who is not there any more."""
        for (position, name), state in zip(self._positions, self._states, strict=True):
            try:
                position(name)
            except Exception:
                return _left(state, k * self._dt)
        raise RuntimeError("everyone is there")


def _getters(sumo: Any, actor: Actor) -> tuple[Callable[[str], Any], ...]:
    """Return SUMO's functions that give position, angle and speed of an actor."""
    domain = "person" if actor.person else "vehicle"
    return tuple(unwrapped(sumo, domain, name) for name in ("getPosition", "getAngle", "getSpeed"))


def _left(state: State, t: float) -> RunError:
    reason = f"{state.name} must stay on the road, but it was gone at t = {t:g} s (its route ended, or SUMO took it away)"
    return RunError(Status.FAILED, reason)
