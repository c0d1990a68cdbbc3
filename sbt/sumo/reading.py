"""Reads the states of actors from SUMO after every step.

Where SUMO alone drives, hardly anybody looks at a state while the run lasts: what SUMO says is kept as it is, states are computed
where somebody does look, and all the others at the end, as arrays. Both ways give the same numbers.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor, State
from sbt.sumo.session import INVALID_DOUBLE, unwrapped

__all__ = ["ROW", "Onlooker", "observer", "table"]

_Getters = tuple[Callable[[str], tuple[float, float]], Callable[[str], float], Callable[[str], float]]
"""SUMO's functions that give position (m), angle (degrees) and speed (m/s)."""
_COLUMNS = 5
ROW = struct.Struct(f"={_COLUMNS}d")
"""x, y, heading, speed, acceleration of one actor; lists of floats would take four times the memory."""


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
        rows: where the states of those who are near each other are written.
    """

    def __init__(
        self, sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str, rows: bytearray
    ) -> None:
        self._order = sorted(range(len(actors)), key=lambda j: actors[j].person)
        self._slots = [self._order.index(j) for j in range(len(actors))]
        self._groups: list[tuple[_Getters, list[str]]] = []
        for _, group in groupby(self._order, key=lambda j: actors[j].person):
            some = list(group)
            self._groups.append((_getters(sumo, actors[some[0]]), [prefix + actors[j].name for j in some]))
        self._solid = [slot for slot, j in enumerate(self._order) if j and not actors[j].person]
        self._states, self._dt, self._rows = states, dt, rows
        self._half = [0.0 if a.person else 0.5 * s.length for a, s in zip(actors, states, strict=True)]
        self._index = {state.name: k for k, state in enumerate(states)}
        self._places: list[tuple[float, float]] = []  # of all actors in row 0, in row 1, ...
        self._angles: list[float] = []
        self._speeds: list[float] = []
        self._at, self._written = [-1] * len(states), [-1] * len(states)
        self._reach = 2.0 * max(s.length for s in states) + 2.0 * max(self._half)
        self._far = 0.0

    def __getitem__(self, name: str) -> State:
        return self.look(len(self._places) // len(self._states) - 1, self._index[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)

    def observe(self, k: int) -> None:
        """Read all actors after step k."""
        places, angles, speeds = self._places, self._angles, self._speeds
        try:
            for (position, angle, speed), names in self._groups:
                places += map(position, names)
                angles += map(angle, names)
                speeds += map(speed, names)
        except Exception as error:  # the class depends on the client: libsumo or traci
            if "is not known" in str(error):
                raise _left(self._states[self._order[len(places) - k * len(self._states)]], k * self._dt) from None
            raise

    def near(self, k: int) -> list[int]:
        """Return which vehicles may have touched the first actor in the step to row k; their states and its are written.

        Nobody is looked for while all of them together cannot have come near since they were looked for the last time.
        """
        m = len(self._states)
        speeds = self._speeds[k * m : (k + 1) * m]
        own = self._slots[0]
        moved = (speeds[own] + max(speeds)) * self._dt
        self._far -= 2.0 * moved  # twice what it is at a constant speed
        if self._far > 0.0:
            return []
        positions = self._places[k * m : (k + 1) * m]
        (x, y), reach = positions[own], self._reach + moved
        left, right, below, above = x - reach, x + reach, y - reach, y + reach
        found = [s for s in self._solid if left < positions[s][0] < right and below < positions[s][1] < above]
        if not found:
            others = [positions[s] for s in self._solid]
            self._far = min((max(abs(u - x), abs(v - y)) for u, v in others), default=math.inf) - reach
            return []
        found = [self._order[s] for s in found]
        for j in (0, *found):
            for row in (k - 1, k) if k and self._written[j] < k - 1 else (k,):
                state = self.look(row, j)
                at = (row * m + j) * ROW.size
                ROW.pack_into(self._rows, at, state.x, state.y, state.heading, state.speed, state.acceleration)
            self._written[j] = k
        return found

    def look(self, k: int, j: int) -> State:
        """Return the state of an actor in row k."""
        state = self._states[j]
        if self._at[j] == k:
            return state
        m, half = len(self._states), self._half[j]
        at = k * m + self._slots[j]
        if self._angles[at] != state.angle:
            state.turn(self._angles[at])
        x, y = self._places[at]
        state.x, state.y, state.speed = x - half * state.cos, y - half * state.sin, self._speeds[at]
        state.acceleration = (state.speed - self._speeds[at - m]) * (1.0 / self._dt) if k else 0.0
        self._at[j] = k
        return state

    def table(self) -> np.ndarray:
        """Return the (t, m, 5) states that were read.

        Raises:
            RunError: an actor was not on the road.
        """
        m = len(self._states)
        columns = [x for x, _ in self._places], [y for _, y in self._places], self._angles, self._speeds
        x, y, angles, speeds = (np.fromiter(each, np.float64, len(each)).reshape(-1, m)[:, self._slots] for each in columns)
        if (gone := np.argwhere(x == INVALID_DOUBLE)).size:
            raise _left(self._states[gone[0, 1]], float(gone[0, 0]) * self._dt)
        heading, cos, sin = _directions(angles)
        half = np.array(self._half)
        states = np.empty((*x.shape, _COLUMNS))
        states[:, :, 0], states[:, :, 1] = x - half * cos, y - half * sin
        states[:, :, 2], states[:, :, 3] = heading, speeds
        states[0, :, 4] = 0.0
        states[1:, :, 4] = (speeds[1:] - speeds[:-1]) * (1.0 / self._dt)
        return states


def _directions(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return headings (rad), their cosines and sines (t, m) of SUMO's angles, by the functions that `State.turn` uses.

    numpy's have other last digits. Most angles are those of the step before.
    """
    new = np.ones(angles.shape, dtype=bool)
    new[1:] = angles[1:] != angles[:-1]
    at = np.maximum.accumulate(np.where(new, np.arange(len(angles))[:, None], 0), axis=0)
    headings = [math.radians(90.0 - angle) for angle in angles[new].tolist()]
    found = []
    for values in (headings, map(math.cos, headings), map(math.sin, headings)):
        whole = np.empty(angles.shape)
        whole[new] = list(values)
        found.append(np.take_along_axis(whole, at, axis=0))
    heading, cos, sin = found
    return heading, cos, sin


def _getters(sumo: Any, actor: Actor) -> _Getters:
    """Return SUMO's functions that give position, angle and speed of an actor."""
    domain = "person" if actor.person else "vehicle"
    return unwrapped(sumo, domain, "getPosition"), unwrapped(sumo, domain, "getAngle"), unwrapped(sumo, domain, "getSpeed")


def _left(state: State, t: float) -> RunError:
    reason = f"{state.name} must stay on the road, but it was gone at t = {t:g} s (its route ended, or SUMO took it away)"
    return RunError(Status.FAILED, reason)
