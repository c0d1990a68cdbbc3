"""Watches the ego of somebody else's simulation: records it and who is near it, and ends the run.

Called after every step of SUMO, whoever makes it. The ego is a vehicle id; from the step in which it
departs on, vehicles and persons within a radius are recorded (a context subscription: the cost does not
grow with the traffic elsewhere), and named ones wherever they are. Who is not there is NaN in the trace.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from sbt.errors import InputError, RunError
from sbt.metrics.geometry import contact_index
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.actors import State
from sbt.sumo.asked import Asked, Insertions
from sbt.sumo.own_ego import OwnEgo, Pilot
from sbt.sumo.session import ABSENT

__all__ = ["Over", "Watch", "Watching"]

_POSITION, _ANGLE, _SPEED, _VEHICLE = 0x39, 0x43, 0x40, 0xC3
_OF_VEHICLES, _OF_PERSONS = 0xA4, 0xAE
"""SUMO's numbers of the 3D position, angle, speed, a person's vehicle, and of the two domains."""
_LEVEL = 3.0
"""Difference in height from which on two are on different levels, as on and below a bridge (m)."""
_CLOCK = 64
"""The wall clock is looked at once in so many steps."""


class Over(BaseException):
    """Ends the user's loop because the run is over; `ended` says why."""

    def __init__(self, ended: str):
        super().__init__(ended)
        self.ended = ended


@dataclass(frozen=True)
class Watching:
    """Whom to watch and how long.

    Args:
        ego: the vehicle under test, and who drives it.
        duration: from the ego's departure on (s).
        within: radius around the ego in which others are recorded (m).
        named: vehicles or persons recorded wherever they are.
        wait: longest simulated time until the ego departs (s).

    Raises:
        InputError: a time or radius that is not positive.
    """

    ego: OwnEgo
    duration: float
    within: float = 100.0
    named: tuple[str, ...] = ()
    wait: float = 3600.0

    def __post_init__(self) -> None:
        for name in ("duration", "within", "wait"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be > 0 and finite, but got {getattr(self, name)}")


class Watch:
    """One run under observation."""

    def __init__(
        self, sumo: Any, watching: Watching, rng: np.random.Generator, asked: Mapping[str, Asked], timeout: float | None
    ):
        self._sumo, self._watching = sumo, watching
        self._ego = watching.ego.id
        self._rng = rng
        self._insertions = Insertions(sumo, asked)
        self._begin: float | None = None
        self._first = sumo.simulation.getTime()
        self._dt = float(sumo.simulation.getDeltaT())
        self._states: dict[str, State] = {}
        self._centre: dict[str, float] = {}
        self._now: list[str] = []
        self._rows: list[dict[str, tuple[float, ...]]] = []
        self._pilot: Pilot | None = None
        self._elsewhere: set[str] = set()
        self._reported: list[str] = []
        self._over: Over | None = None
        self._steps = 0
        self._timeout = timeout
        self._deadline = math.inf if timeout is None else time.monotonic() + timeout

    @property
    def over(self) -> str:
        """Why the run is over, "" while it is not."""
        return "" if self._over is None else self._over.ended

    def expect(self, name: str, asked: Asked) -> None:
        """Compare the start of a vehicle that the loop adds with what it asks for."""
        self._insertions.expect(name, asked)

    def forget(self, name: str) -> None:
        """Do not compare the start of a vehicle that the loop moves."""
        self._insertions.forget(name)

    def before_step(self) -> None:
        """Let the ego's controller act.

        Raises:
            Over: the run is over already, and a loop goes on all the same.
        """
        if self._over is not None:
            raise self._over
        if self._pilot is not None and self._begin is not None:
            t = (len(self._rows) - 1) * self._dt
            others = tuple(self._states[name] for name in self._now if name != self._ego)
            self._pilot(t, self._states[self._ego], others)

    def after_step(self) -> None:
        """Record the step.

        Raises:
            Over: the run is over.
            RunError: the ego is not where it should be, or the wall clock has run out.
        """
        self._check_clock()
        simulation = self._sumo.simulation
        departed, arrived = frozenset(simulation.getDepartedIDList()), frozenset(simulation.getArrivedIDList())
        self._insertions.after_step(departed)
        self._elsewhere = (self._elsewhere | departed.intersection(self._watching.named)) - arrived
        if self._begin is None:
            if self._ego not in departed:
                self._check_waiting()
                return
            self._depart()
        elif self._ego in arrived:
            self._leave()
        if self._ego in simulation.getStartingTeleportIDList():
            raise RunError(Status.INVALID, f"the ego '{self._ego}' must stay on its way, but SUMO teleported it at {self._at()}")
        self._observe()
        if simulation.getCollidingVehiclesNumber():
            self._reported += [f"{c.collider}>{c.victim}@{self._t:.3f}" for c in simulation.getCollisions()]
        if self._touching():
            self._end("collision")
        if self._t >= self._watching.duration - 0.5 * self._dt:
            self._end("duration")

    def _end(self, why: str) -> NoReturn:
        self._over = Over(why)
        raise self._over

    def _check_clock(self) -> None:
        self._steps += 1
        if self._steps % _CLOCK == 0 and time.monotonic() > self._deadline:
            raise RunError(Status.TIMEOUT, f"a run must take at most {self._timeout:g} s, but it was at {self._at()}")

    @property
    def _t(self) -> float:
        return (len(self._rows) - 1) * self._dt

    def _at(self) -> str:
        return f"t = {self._sumo.simulation.getTime():g} s"

    def _check_waiting(self) -> None:
        """Raise where the ego will not come any more."""
        simulation = self._sumo.simulation
        nobody = simulation.getMinExpectedNumber() == 0
        if nobody or simulation.getTime() - self._first > self._watching.wait:
            why = "nobody is left to come" if nobody else self._insertions.waiting(self._ego)
            rule = f"the ego '{self._ego}' must depart within {self._watching.wait:g} s"
            raise RunError(Status.INVALID, f"{rule}, but had not at {self._at()}; {why}")

    def _depart(self) -> None:
        """Begin to watch."""
        vehicle, near = self._sumo.vehicle, self._watching.within
        self._begin = self._sumo.simulation.getTime()
        vehicle.subscribeContext(self._ego, _OF_VEHICLES, near, [_POSITION, _ANGLE, _SPEED])
        vehicle.subscribeContext(self._ego, _OF_PERSONS, near, [_POSITION, _ANGLE, _SPEED, _VEHICLE])
        self._pilot = self._watching.ego.take_over(self._sumo, self._rng)

    def _leave(self) -> None:
        if self._watching.ego.may_leave:
            self._end("left")
        rule = f"the ego '{self._ego}' must stay for the duration of {self._watching.duration:g} s"
        advice = "make the route longer or the duration shorter, or set may_leave: true"
        raise RunError(Status.FAILED, f"{rule}, but it left after {self._t + self._dt:g} s, at the end of its route: {advice}")

    def _observe(self) -> None:
        """Append the states of everybody who is there."""
        seen = self._sumo.vehicle.getContextSubscriptionResults(self._ego)
        if self._ego not in seen:
            raise RunError(Status.FAILED, f"the ego '{self._ego}' must stay on the road, but it was gone at {self._at()}")
        height = seen[self._ego][_POSITION][2]
        row: dict[str, tuple[float, ...]] = {}
        self._record(row, self._ego, seen[self._ego])
        for name in sorted(seen):
            found = seen[name]
            if name != self._ego and not found.get(_VEHICLE) and abs(found[_POSITION][2] - height) < _LEVEL:
                self._record(row, name, found)
        for name in sorted(self._elsewhere - set(seen)):
            vehicle = self._sumo.vehicle
            place = vehicle.getPosition3D(name), vehicle.getAngle(name), vehicle.getSpeed(name)
            self._record(row, name, dict(zip((_POSITION, _ANGLE, _SPEED), place, strict=True)))
        self._now = list(row)
        self._rows.append(row)

    def _record(self, row: dict[str, tuple[float, ...]], name: str, found: Mapping[int, Any]) -> None:
        """Note one state, with the centre of its rectangle; SUMO's position is a vehicle's front and a person's middle."""
        x, y = found[_POSITION][:2]
        if x == ABSENT:
            return
        state = self._states.get(name)
        if state is None:
            domain = self._sumo.person if _VEHICLE in found else self._sumo.vehicle
            state = State(name, float(domain.getLength(name)), float(domain.getWidth(name)), self._dt)
            self._states[name] = state
            self._centre[name] = 0.0 if _VEHICLE in found else 0.5 * state.length
        if found[_ANGLE] != state.angle:
            state.turn(found[_ANGLE])
        half, speed = self._centre[name], float(found[_SPEED])
        before = self._rows[-1].get(name) if self._rows else None
        state.acceleration = 0.0 if before is None else (speed - before[3]) / self._dt
        state.x, state.y, state.speed = x - half * state.cos, y - half * state.sin, speed
        row[name] = (state.x, state.y, state.heading, speed, state.acceleration)

    def _touching(self) -> bool:
        """Return whether the ego touched anybody since the last step."""
        ego, rows = self._states[self._ego], self._rows[-2:]
        for name in self._now:
            other = self._states[name]
            reach = ego.length + other.length + (ego.speed + other.speed) * self._dt
            if name == self._ego or abs(other.x - ego.x) > reach or abs(other.y - ego.y) > reach:
                continue
            both = [row for row in rows if name in row]
            if contact_index(_columns(both, ego), _columns(both, other)) is not None:
                return True
        return False

    def trace(self, ended: str) -> Trace:
        """Return what was recorded; who was not there is NaN.

        Raises:
            RunError: the ego never departed.
        """
        if not self._rows:
            raise RunError(
                Status.INVALID, f"the ego '{self._ego}' must depart, but had not when the loop ended at {self._at()}"
            )
        names = tuple(self._states)
        column = {name: k for k, name in enumerate(names)}
        table = np.full((len(self._rows), len(names), 5), np.nan)
        for i, row in enumerate(self._rows):
            for name, state in row.items():
                table[i, column[name]] = state
        x, y, heading, speed, acceleration = np.moveaxis(table, 2, 0)
        return Trace(
            np.arange(len(table), dtype=np.float64) * self._dt, names, x, y, heading, speed, acceleration,
            np.array([self._states[n].length for n in names]), np.array([self._states[n].width for n in names]),
            ended, tuple(self._reported),
        )  # fmt: skip


def _columns(rows: list[dict[str, tuple[float, ...]]], state: State) -> ActorTrace:
    """Return one actor's (t,) columns of rows in which it is."""
    x, y, heading, speed, acceleration = np.array([row[state.name] for row in rows]).T
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)
