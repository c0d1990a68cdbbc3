"""Records the ego of a user's own simulation and the road users around it, and ends the run.

The recorder is called after every step of SUMO, made by the user's loop or by this package. The ego is a vehicle
id; from the step of its departure on, the road users around it are recorded (`sbt.sumo.surroundings`). The states of a
road user that is not present are NaN in the trace. A contact of the ego ends the run, and is compared with SUMO's own
list of collisions (`sbt.sumo.contacts`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np

from sbt.errors import InputError, RunError
from sbt.metrics.conflict_types import from_behind
from sbt.metrics.geometry import rectangle_distance
from sbt.problem.outcome import STRUCK, Status
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.actors import view_of
from sbt.sumo.appearances import AppearanceMonitor
from sbt.sumo.arriving import last_step, unknown_end, way_to
from sbt.sumo.contacts import CONFIRMED_WITHIN, collisions_of, listed_only, unconfirmed_contact
from sbt.sumo.departures import DepartureMonitor, RequestedDeparture
from sbt.sumo.ego import Ego
from sbt.sumo.ego_vehicle import EgoControl, EgoVehicle
from sbt.sumo.guided import Placed
from sbt.sumo.leaving import Leaving
from sbt.sumo.surroundings import Surroundings
from sbt.sumo.trailing import LONGEST_RIGID

__all__ = ["Recorder", "RecordingSettings", "RunEnded"]

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
        within: radius around the ego's body in which the bodies of other road users are recorded (m).
        named: vehicles that are recorded at any distance.
        wait: longest simulated time from the ego's `depart` until it departs; from the beginning where it has none (s).
        further: more vehicles under test (`sbt.sumo.several`).

    Raises:
        InputError: a time or radius is not positive.
    """

    ego: EgoVehicle
    duration: float
    within: float = 100.0
    named: tuple[str, ...] = ()
    wait: float = 3600.0
    further: tuple[EgoVehicle, ...] = ()

    def __post_init__(self) -> None:
        for name in ("duration", "within", "wait"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be > 0 and finite, but got {getattr(self, name)}")

    @property
    def inputs(self) -> tuple[Parameter, ...]:
        """The settings of drivers that are inputs of the scenario, each once.

        Raises:
            InputError: two vehicles under test have different ranges of one setting.
        """
        found: dict[str, Parameter] = {}
        for parameter in (p for one in (self.ego, *self.further) if one.driver is not None for p in one.driver.inputs):
            if found.setdefault(parameter.name, parameter) != parameter:
                raise InputError(f"vehicles under test must have one range of a setting, but {parameter.name} has several")
        return tuple(found.values())

    def with_driver(self, driver: Ego) -> RecordingSettings:
        """Return the settings with this driver of all vehicles under test."""
        return replace(self, ego=self.ego.with_driver(driver), further=tuple(one.with_driver(driver) for one in self.further))

    def bound(self, values: Values) -> RecordingSettings:
        """Return the settings of one run, with the values of what is an input."""
        return replace(self, ego=self.ego.bound(values), further=tuple(one.bound(values) for one in self.further))


class Recorder:
    """Records one run.

    Args:
        sumo: libsumo or traci, started.
        settings: what to record.
        rng: for the controller of the ego.
        departures: compares them with what is requested.
        timeout: wall-clock limit (s); None: none.
    """

    def __init__(
        self, sumo: Any, settings: RecordingSettings, rng: np.random.Generator, departures: DepartureMonitor,
        timeout: float | None,
    ):  # fmt: skip
        self._sumo, self._settings = sumo, settings
        self._ego = settings.ego.id
        self._rng = rng
        self._departures = departures
        self._leaving = Leaving(sumo, self._ego, departures.arrival)
        self._appearances = AppearanceMonitor(sumo, self._ego, departures)
        self._departed = False
        self._walks: bool | None = None
        self.began: int | None = None
        """Number of the step in which the ego departed; None before."""
        self._dt = float(sumo.simulation.getDeltaT())
        self._surroundings = Surroundings(sumo, self._ego, settings.within, settings.named, self._dt)
        self._control: EgoControl | None = None
        self._collisions: list[str] = []
        self._listed: dict[str, float] = {}
        self._differing: dict[str, str] = {}
        self._struck: list[str] = []
        self._touched: list[tuple[str, ActorTrace, ActorTrace]] = []
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

    def place(self, placed: Mapping[str, Placed]) -> None:
        """Record these road users, which are moved by position, as they are given: SUMO does not know all about them."""
        self._surroundings.place(placed)

    def expect_departure(self, name: str, requested: RequestedDeparture) -> None:
        """Compare the departure of a vehicle that the loop adds with what it requests."""
        self._departures.expect(name, requested)

    def ignore_departure(self, name: str) -> None:
        """Do not compare the departure of a vehicle that the loop moves or removes."""
        self._departures.ignore(name)

    def subscribe_again(self, name: str) -> None:
        """Subscribe once more to the surroundings of the ego, if it is this road user: the loop has ended all subscriptions."""
        if self._departed and name == self._ego:
            self._surroundings.subscribe(walks=self._walks is True)

    def take_as_rigid(self, name: str) -> None:
        """Take the body of a vehicle that the loop moves by poses as a rectangle, however long it is."""
        self._surroundings.move(name)

    def take_as_put(self, name: str) -> None:
        """Take a road user as one that the loop puts to another place of a lane: what is between is no way that it drives."""
        self._surroundings.put(name)

    def before_step(self) -> None:
        """Let the controller of the ego act.

        Raises:
            RunEnded: the run is over, but the loop went on.
        """
        if self._ended is not None:
            raise self._ended.with_traceback(None)  # a loop that catches it again and again would lengthen it
        if self._control is not None and self._departed:
            near = self._surroundings
            others = tuple(near.states[name] for name in near.present if name != self._ego)
            self._control.step(self._t, near.states[self._ego], others)

    def after_step(self) -> None:
        """Record the step, and judge it.

        Raises:
            RunEnded: the run is over.
            RunError: the ego is not where it should be, or the wall-clock limit is exceeded.
        """
        self.record_step()
        self.judge_step()

    def record_step(self) -> None:
        """Record the states, SUMO's list of collisions, and who touches the ego.

        Raises:
            RunEnded: the ego has left, maybe in a contact.
            RunError: the ego is not where it should be, or the wall-clock limit is exceeded.
        """
        self._touched = []
        self._check_clock()
        simulation = self._sumo.simulation
        departed, arrived = frozenset(simulation.getDepartedIDList()), frozenset(simulation.getArrivedIDList())
        self._surroundings.follow(departed, arrived)
        if self._walks is not False:  # a person, or not known yet
            departed, arrived = self._with_ego_on_foot(departed, arrived)
        self._departures.after_step(departed)
        if not self._departed:
            if self._ego not in departed:
                self._departures.await_ego()
                return
            self._start_recording()
        if simulation.getStartingTeleportNumber() and self._ego in simulation.getStartingTeleportIDList():
            raise RunError(Status.INVALID, f"the ego '{self._ego}' must stay on its way, but SUMO teleported it at {self._now()}")
        if self._ego in arrived and len(self._surroundings):
            self._handle_arrival()
        near = self._surroundings
        near.record()
        if not self._walks and self._ego not in near.rigid:
            self._leaving.look()
        self._appearances.after_step(near, departed)
        self._touched = near.touching()
        if simulation.getCollidingVehiclesNumber():
            self._record_collisions({name for name, *_ in self._touched})

    def judge_step(self) -> None:
        """End the run at a contact of the ego, which takes further steps of SUMO, or when its time is over.

        Raises:
            RunEnded: the run is over.
            RunError: the contact is that of one who has just been moved there.
        """
        if self._touched:
            self._appearances.refuse_contact(self._touched[0][0])
            self._judge(self._touched)
            self._end("collision")
        if self._t >= self._settings.duration - 0.5 * self._dt:
            self._end("duration")

    def _with_ego_on_foot(self, departed: frozenset[str], arrived: frozenset[str]) -> tuple[frozenset[str], frozenset[str]]:
        """Return who departed and arrived in this step, with the ego if it is a person."""
        simulation, ego = self._sumo.simulation, frozenset((self._ego,))
        if self._walks is None and self._ego in departed:
            self._walks = False
        elif self._walks is None and self._ego in simulation.getDepartedPersonIDList():
            self._walks = True
            return departed | ego, arrived
        elif self._walks and self._ego in simulation.getArrivedPersonIDList():
            return departed, arrived | ego
        return departed, arrived

    def _end(self, reason: str) -> NoReturn:
        self._ended = RunEnded(reason)
        raise self._ended

    def _check_clock(self) -> None:
        self._steps += 1
        if self._steps % _CLOCK_STEPS == 0 and time.monotonic() > self._deadline:
            raise RunError(Status.TIMEOUT, f"a run must take at most {self._timeout:g} s, but it was at {self._now()}")

    @property
    def _t(self) -> float:
        return (len(self._surroundings) - 1) * self._dt

    def _now(self) -> str:
        return f"t = {self._sumo.simulation.getTime():g} s"

    def _start_recording(self) -> None:
        """Subscribe to the surroundings of the ego, and give it its controller."""
        self._departed, self.began = True, self._steps
        self._surroundings.subscribe(walks=self._walks is True)
        self._control = self._settings.ego.take_over(self._sumo, self._rng, walks=self._walks is True)

    def _handle_arrival(self) -> None:
        near = self._surroundings
        if not self._walks and self._ego not in near.rigid:
            removed = self._leaving.why_removed(near.states[self._ego].speed, self._dt)
            if removed:
                raise RunError(Status.INVALID, f"the ego '{self._ego}' must stay on its way, but at {self._now()} {removed}")
            self._end_at_contact()
        if self._settings.ego.may_leave:
            self._end("left")
        rule = f"the ego '{self._ego}' must stay for the duration of {self._settings.duration:g} s"
        remedy = "make the route longer or the duration shorter, or set may_leave: true"
        raise RunError(Status.FAILED, f"{rule}, but it left after {self._t + self._dt:g} s, at the end of its route: {remedy}")

    def _end_at_contact(self) -> None:
        """End the run at a contact that the ego has before it arrives, as far as its way until then is known."""
        near, there = self._surroundings, self._leaving.on_last_edge()
        own = near.states[self._ego]
        way = None if there is None or own.length > LONGEST_RIGID else way_to(self._sumo, *there, own)
        found = None if way is None else last_step(self._sumo, near, self._ego, way, self._dt)
        if found is None:
            return
        near.record_arrival(found)
        listed = collisions_of(self._sumo, self._ego)
        self._collisions += [f"{self._ego}>{name}@{self._t:.3f}" for name in sorted(listed)]
        if found.other not in listed and self._t - self._listed.get(found.other, -math.inf) > CONFIRMED_WITHIN:
            self._differing[found.other] = unknown_end(found.other, self._t)
        self._note_struck([one for one in near.touching() if one[0] == found.other])
        self._end("collision")

    def _record_collisions(self, touched: set[str]) -> None:
        """Record what SUMO lists in this step, and what differs where the bodies of a listed pair do not touch."""
        listed = [(c.collider, c.victim) for c in self._sumo.simulation.getCollisions()]
        self._collisions += [f"{collider}>{victim}@{self._t:.3f}" for collider, victim in listed]
        for other in {b if a == self._ego else a for a, b in listed if self._ego in (a, b)} - touched:
            if self._t - self._listed.get(other, -math.inf) > CONFIRMED_WITHIN:
                persons = [name for name in (self._ego, other) if self._surroundings.is_person(name)]
                near = self._surroundings
                there = other in near.present
                apart = float(rectangle_distance(near.body(self._ego), near.body(other))[0]) if there else None
                self._differing[other] = listed_only(self._sumo, self._ego, other, self._t, apart, persons=persons)
            self._listed[other] = self._t

    def _judge(self, touched: list[tuple[str, ActorTrace, ActorTrace]]) -> None:
        """Tell apart the contacts that SUMO's list does not confirm; it may list them some steps later."""
        sumo, near = self._sumo, self._surroundings
        texts = {}
        for name, *rectangles in touched:
            persons = [one for one in (self._ego, name) if near.is_person(one)]
            texts[name] = unconfirmed_contact(
                sumo, self._ego, name, self._t, (rectangles[0], rectangles[1]), persons=persons, moved=near.rigid
            )
        listed = {name for name, t in self._listed.items() if self._t - t <= CONFIRMED_WITHIN} | collisions_of(sumo, self._ego)
        moving = texts.keys() - near.placed.keys()  # nobody moves the others in the steps to come
        for k in range(1, math.ceil(CONFIRMED_WITHIN / self._dt) + 1):
            if moving <= listed or self._ego not in (sumo.person if self._walks else sumo.vehicle).getIDList():
                break
            sumo.simulationStep()
            found = collisions_of(sumo, self._ego) & moving - listed
            self._collisions += [f"{self._ego}>{name}@{self._t + k * self._dt:.3f}" for name in sorted(found)]
            listed |= found
        for name in listed:
            self._differing.pop(name, None)
        self._differing |= {name: text for name, text in texts.items() if name not in listed}
        self._note_struck(touched)

    def _note_struck(self, touched: list[tuple[str, ActorTrace, ActorTrace]]) -> None:
        """Tell apart who drives as it was recorded, into the ego from behind."""
        self._struck = [
            f"{STRUCK}'{name}' at {self._t:.3f} s: it drives as it was recorded, whatever the ego does"
            for name, own, other in touched if name in self._surroundings.placed and from_behind(own, other)
        ]  # fmt: skip

    def trace(self, ended: str) -> Trace:
        """Return the recorded trace; states of absent road users are NaN.

        Raises:
            RunError: the ego never departed.
        """
        if not len(self._surroundings):
            raise RunError(Status.INVALID, f"the ego '{self._ego}' must depart, but had not when the loop ended at {self._now()}")
        found = self._surroundings.trace(ended, self._collisions, [*self._differing.values(), *self._struck])
        own = self._surroundings.states[self._ego]
        view = None if self._control is None else view_of(self._control.driver, own.length, own.width)
        return found if view is None else replace(found, view=view)
