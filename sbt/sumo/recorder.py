"""Records the ego of a user's own simulation and the road users around it, and ends the run.

The recorder is called after every step of SUMO, made by the user's loop or by this package. The ego is a vehicle
id; from the step of its departure on, vehicles and persons within a radius are recorded (by a context
subscription, whose cost does not grow with the traffic elsewhere), and named ones at any distance. The states of a
road user that is not present are NaN in the trace.
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
from sbt.sumo.departures import DepartureMonitor, RequestedDeparture
from sbt.sumo.ego_vehicle import ControlStep, EgoVehicle
from sbt.sumo.session import INVALID_DOUBLE

__all__ = ["Recorder", "RecordingSettings", "RunEnded"]

_POSITION, _ANGLE, _SPEED, _VEHICLE = 0x39, 0x43, 0x40, 0xC3
"""TraCI variables: VAR_POSITION3D, VAR_ANGLE, VAR_SPEED, VAR_VEHICLE (the vehicle a person rides in)."""
_VEHICLES, _PERSONS = 0xA4, 0xAE
"""TraCI domains: CMD_GET_VEHICLE_VARIABLE, CMD_GET_PERSON_VARIABLE."""
_LEVEL_HEIGHT = 3.0
"""Difference in height above which two road users are on different levels, such as on and under a bridge (m)."""
_CLOCK_STEPS = 64
"""Steps between two looks at the wall clock."""


class RunEnded(BaseException):
    """Unwinds the user's loop when the run is over; not an `Exception`, so that `except Exception` lets it pass.

    Attributes:
        reason: `collision`, `duration` or `left`.
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class RecordingSettings:
    """Which road users are recorded, and for how long.

    Args:
        ego: the vehicle under test, and its driver.
        duration: time recorded, from the departure of the ego on (s).
        within: radius around the ego in which other road users are recorded (m).
        named: vehicles or persons that are recorded at any distance.
        wait: longest simulated time until the ego departs (s).

    Raises:
        InputError: a time or radius is not positive.
    """

    ego: EgoVehicle
    duration: float
    within: float = 100.0
    named: tuple[str, ...] = ()
    wait: float = 3600.0

    def __post_init__(self) -> None:
        for name in ("duration", "within", "wait"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be > 0 and finite, but got {getattr(self, name)}")


class Recorder:
    """Records one run.

    Args:
        sumo: libsumo or traci, started.
        settings: what to record.
        rng: for the controller of the ego.
        requested: requested departures by vehicle id.
        timeout: wall-clock limit (s); None: none.
    """

    def __init__(
        self, sumo: Any, settings: RecordingSettings, rng: np.random.Generator, requested: Mapping[str, RequestedDeparture],
        timeout: float | None,
    ):  # fmt: skip
        self._sumo, self._settings = sumo, settings
        self._ego = settings.ego.id
        self._rng = rng
        self._departures = DepartureMonitor(sumo, requested)
        self._departed = False
        self._start = sumo.simulation.getTime()
        self._dt = float(sumo.simulation.getDeltaT())
        self._states: dict[str, State] = {}
        self._centre_offsets: dict[str, float] = {}
        self._present: list[str] = []
        self._rows: list[dict[str, tuple[float, ...]]] = []
        self._control: ControlStep | None = None
        self._named_present: set[str] = set()
        self._collisions: list[str] = []
        self._given_speeds: Mapping[str, float] = {}
        self._ended: RunEnded | None = None
        self._steps = 0
        self._timeout = timeout
        self._deadline = math.inf if timeout is None else time.monotonic() + timeout

    @property
    def ended(self) -> str:
        """Why the run is over; "" while it goes on."""
        return "" if self._ended is None else self._ended.reason

    @property
    def scenario_time(self) -> float | None:
        """Time since the departure of the ego (s); None before it."""
        return self._t if self._departed else None

    def give_speeds(self, speeds: Mapping[str, float]) -> None:
        """Record these speeds (m/s) in the next step instead of SUMO's, of road users that are moved by position."""
        self._given_speeds = speeds

    def expect_departure(self, name: str, requested: RequestedDeparture) -> None:
        """Compare the departure of a vehicle that the loop adds with what it requests."""
        self._departures.expect(name, requested)

    def ignore_departure(self, name: str) -> None:
        """Do not compare the departure of a vehicle that the loop moves or removes."""
        self._departures.ignore(name)

    def before_step(self) -> None:
        """Let the controller of the ego act.

        Raises:
            RunEnded: the run is over, but the loop went on.
        """
        if self._ended is not None:
            raise self._ended
        if self._control is not None and self._departed:
            t = (len(self._rows) - 1) * self._dt
            others = tuple(self._states[name] for name in self._present if name != self._ego)
            self._control(t, self._states[self._ego], others)

    def after_step(self) -> None:
        """Record the step.

        Raises:
            RunEnded: the run is over.
            RunError: the ego is not where it should be, or the wall-clock limit is exceeded.
        """
        self._check_clock()
        simulation = self._sumo.simulation
        departed, arrived = frozenset(simulation.getDepartedIDList()), frozenset(simulation.getArrivedIDList())
        self._departures.after_step(departed)
        self._named_present = (self._named_present | departed.intersection(self._settings.named)) - arrived
        if not self._departed:
            if self._ego not in departed:
                self._check_waiting()
                return
            self._start_recording()
        elif self._ego in arrived:
            self._handle_arrival()
        if self._ego in simulation.getStartingTeleportIDList():
            raise RunError(Status.INVALID, f"the ego '{self._ego}' must stay on its way, but SUMO teleported it at {self._now()}")
        self._record_step()
        if simulation.getCollidingVehiclesNumber():
            self._collisions += [f"{c.collider}>{c.victim}@{self._t:.3f}" for c in simulation.getCollisions()]
        if self._ego_in_contact():
            self._end("collision")
        if self._t >= self._settings.duration - 0.5 * self._dt:
            self._end("duration")

    def _end(self, reason: str) -> NoReturn:
        self._ended = RunEnded(reason)
        raise self._ended

    def _check_clock(self) -> None:
        self._steps += 1
        if self._steps % _CLOCK_STEPS == 0 and time.monotonic() > self._deadline:
            raise RunError(Status.TIMEOUT, f"a run must take at most {self._timeout:g} s, but it was at {self._now()}")

    @property
    def _t(self) -> float:
        return (len(self._rows) - 1) * self._dt

    def _now(self) -> str:
        return f"t = {self._sumo.simulation.getTime():g} s"

    def _check_waiting(self) -> None:
        """Raise an error where the ego cannot depart any more."""
        simulation = self._sumo.simulation
        nobody = simulation.getMinExpectedNumber() == 0
        if nobody or simulation.getTime() - self._start > self._settings.wait:
            why = "no vehicle is left to depart" if nobody else self._departures.why_waiting(self._ego)
            rule = f"the ego '{self._ego}' must depart within {self._settings.wait:g} s"
            raise RunError(Status.INVALID, f"{rule}, but had not at {self._now()}; {why}")

    def _start_recording(self) -> None:
        """Subscribe to the surroundings of the ego, and give it its controller."""
        vehicle, radius = self._sumo.vehicle, self._settings.within
        self._departed = True
        vehicle.subscribeContext(self._ego, _VEHICLES, radius, [_POSITION, _ANGLE, _SPEED])
        vehicle.subscribeContext(self._ego, _PERSONS, radius, [_POSITION, _ANGLE, _SPEED, _VEHICLE])
        self._control = self._settings.ego.take_over(self._sumo, self._rng)

    def _handle_arrival(self) -> None:
        if self._settings.ego.may_leave:
            self._end("left")
        rule = f"the ego '{self._ego}' must stay for the duration of {self._settings.duration:g} s"
        remedy = "make the route longer or the duration shorter, or set may_leave: true"
        raise RunError(Status.FAILED, f"{rule}, but it left after {self._t + self._dt:g} s, at the end of its route: {remedy}")

    def _record_step(self) -> None:
        """Append the states of all road users that are present."""
        near = self._sumo.vehicle.getContextSubscriptionResults(self._ego)
        if self._ego not in near:
            raise RunError(Status.FAILED, f"the ego '{self._ego}' must stay on the road, but it was gone at {self._now()}")
        height = near[self._ego][_POSITION][2]
        row: dict[str, tuple[float, ...]] = {}
        self._record(row, self._ego, near[self._ego])
        for name in sorted(near):
            variables = near[name]
            if name != self._ego and not variables.get(_VEHICLE) and abs(variables[_POSITION][2] - height) < _LEVEL_HEIGHT:
                self._record(row, name, variables)
        for name in sorted(self._named_present - set(near)):
            vehicle = self._sumo.vehicle
            state = vehicle.getPosition3D(name), vehicle.getAngle(name), vehicle.getSpeed(name)
            self._record(row, name, dict(zip((_POSITION, _ANGLE, _SPEED), state, strict=True)))
        self._present = list(row)
        self._rows.append(row)

    def _record(self, row: dict[str, tuple[float, ...]], name: str, variables: Mapping[int, Any]) -> None:
        """Record one state; SUMO's position is the front of a vehicle and the centre of a person, ours is the centre."""
        x, y = variables[_POSITION][:2]
        if x == INVALID_DOUBLE:
            return
        state = self._states.get(name)
        if state is None:
            domain = self._sumo.person if _VEHICLE in variables else self._sumo.vehicle
            state = State(name, float(domain.getLength(name)), float(domain.getWidth(name)), self._dt)
            self._states[name] = state
            self._centre_offsets[name] = 0.0 if _VEHICLE in variables else 0.5 * state.length
        if variables[_ANGLE] != state.angle:
            state.turn(variables[_ANGLE])
        half, speed = self._centre_offsets[name], float(self._given_speeds.get(name, variables[_SPEED]))
        before = self._rows[-1].get(name) if self._rows else None
        state.acceleration = 0.0 if before is None else (speed - before[3]) / self._dt
        state.x, state.y, state.speed = x - half * state.cos, y - half * state.sin, speed
        row[name] = (state.x, state.y, state.heading, speed, state.acceleration)

    def _ego_in_contact(self) -> bool:
        """Return whether the ego has touched another road user since the last step."""
        ego, rows = self._states[self._ego], self._rows[-2:]
        for name in self._present:
            other = self._states[name]
            reach = ego.length + other.length + (ego.speed + other.speed) * self._dt
            if name == self._ego or abs(other.x - ego.x) > reach or abs(other.y - ego.y) > reach:
                continue
            both = [row for row in rows if name in row]
            if contact_index(_columns(both, ego), _columns(both, other)) is not None:
                return True
        return False

    def trace(self, ended: str) -> Trace:
        """Return the recorded trace; states of absent road users are NaN.

        Raises:
            RunError: the ego never departed.
        """
        if not self._rows:
            raise RunError(
                Status.INVALID, f"the ego '{self._ego}' must depart, but had not when the loop ended at {self._now()}"
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
            ended, tuple(self._collisions),
        )  # fmt: skip


def _columns(rows: list[dict[str, tuple[float, ...]]], state: State) -> ActorTrace:
    """Return the (t,) columns of one actor, which is present in all rows."""
    x, y, heading, speed, acceleration = np.array([row[state.name] for row in rows]).T
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)
