"""Compares the departures of vehicles with what the user's files or loop request.

SUMO silently delays a vehicle that fails its insertion checks; the run is then another concrete scenario
than the requested one. Time, position, speed and lane of the departure are compared where they are
numbers. A difference ends the run in the step in which it shows, and names the vehicle, the request, the cause
and the remedy.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.sumo.absence import why_absent, why_copied
from sbt.sumo.elements import person
from sbt.sumo.files import SumoFiles
from sbt.sumo.places import place_in, said_at
from sbt.sumo.template import fill
from sbt.sumo.waiting import why_held_back

__all__ = ["HELD_BACK", "DepartureMonitor", "RequestedDeparture", "WaitingEgo", "number_or_none", "requested_departures"]

HELD_BACK = "SUMO holds it back"
"""What is said of a vehicle that the traffic does not let in."""
_TOLERANCE = 1e-3
"""Difference that is accepted (m, m/s)."""


@dataclass(frozen=True)
class RequestedDeparture:
    """The requested departure of one vehicle; None for what SUMO is free to choose.

    Attributes:
        place: `file:line:column: ` of the vehicle, "" for one added by a loop.
        depart: time (s); of a flow that it begins.
        position: of the front bumper on its lane (m), from the end of the lane if negative.
        speed: m/s.
        lane: index.
        of_flow: SUMO generates the vehicle when it can; nothing else of its departure is known.
        on_foot: it is a person.
    """

    place: str
    depart: float | None
    position: float | None
    speed: float | None
    lane: float | None
    of_flow: bool = False
    on_foot: bool = False


@dataclass(frozen=True)
class WaitingEgo:
    """How long the ego may wait for its departure.

    Args:
        id: its id in SUMO.
        delay: longest time after its `depart` (s); None: not at all, or `wait` where it has no `depart` of its own.
        wait: longest time (s) from its `depart`, or from the beginning of its flow or of the simulation.
    """

    id: str
    delay: float | None
    wait: float


def requested_departures(files: SumoFiles, values: Values, ego: str) -> dict[str, RequestedDeparture]:
    """Return the requested departures of the ego and of every vehicle with a placeholder."""
    of_ego = files.vehicle(ego)
    compared = [(name, template) for template in files.templates for name in template.varying]
    compared += [(name, template) for template in files.templates for name in files.compared if name in template.vehicles]
    if of_ego is not None:
        compared.append((ego if ego in of_ego[1].vehicles else ego.rpartition(".")[0], of_ego[1]))
    requested: dict[str, RequestedDeparture] = {}
    walker = None if of_ego is not None else person(files.templates, ego)
    if walker is not None:
        texts = (walker.depart or "", walker.attributes.get("departPos", ""))
        depart, position = (number_or_none(fill(text, values, walker.place)) for text in texts)
        of_flow = walker.tag == "personFlow"
        requested[ego] = RequestedDeparture(walker.place, depart, position, None, None, of_flow=of_flow, on_foot=True)
    for name, template in compared:
        vehicle = template.vehicles[name]
        place = f"{place_in(template.path, *vehicle.place)}: "
        if vehicle.tag != "flow":
            start = (vehicle.depart, vehicle.position, vehicle.speed, vehicle.lane)
            depart, position, speed, lane = (number_or_none(fill(value or "", values, place)) for value in start)
            requested[name] = RequestedDeparture(place, depart, position, speed, lane)
        elif name == ego.rpartition(".")[0]:
            begin = number_or_none(fill(vehicle.begin or "", values, place))
            requested[ego] = RequestedDeparture(place, begin, None, None, None, of_flow=True)
    return requested


def number_or_none(value: Any) -> float | None:
    """Return the number that SUMO would read, or None for words such as `max` or `best`."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def _milliseconds(time: float) -> int:
    """Return a time (s) as SUMO counts it; its own rounding, so that what it takes for the next step is so here."""
    return int(time * 1000.0 + math.copysign(0.5, time))


class DepartureMonitor:
    """Compares each vehicle in the step in which it departs, or should.

    Args:
        sumo: libsumo or traci.
        ego: the vehicle under test.
        requested: departures by vehicle id.
        files: of the simulation, for the causes.
        values: of the inputs, likewise.

    Attributes:
        asked: all vehicles whose departures were requested.
        arrival: arrivalPos and arrivalEdge of an ego of the files; None: it is added otherwise.
    """

    def __init__(
        self, sumo: Any, ego: WaitingEgo, requested: Mapping[str, RequestedDeparture], files: SumoFiles,
        values: Values,
    ):  # fmt: skip
        self._sumo, self._ego, self._files, self._values = sumo, ego, files, values
        self._start = float(sumo.simulation.getTime())
        of_ego = files.vehicle(ego.id)
        self._in_files = of_ego is not None or person(files.templates, ego.id) is not None
        self.arrival = None if of_ego is None else (of_ego[0].arrival or "max", of_ego[0].arrival_edge)
        self._requested: dict[str, RequestedDeparture] = {}
        self._due: list[tuple[float, str]] = []
        self._places: dict[str, str] = {}
        self.asked: set[str] = set()
        for name, departure in requested.items():
            self.expect(name, departure)

    def expect(self, name: str, requested: RequestedDeparture) -> None:
        """Compare one more vehicle."""
        self._requested[name] = requested
        self._places[name] = requested.place
        self.asked.add(name)
        if self._deadline(name) < math.inf:
            heapq.heappush(self._due, (self._deadline(name), name))

    def ignore(self, name: str) -> None:
        """Do not compare this vehicle."""
        self._requested.pop(name, None)

    def place_of(self, name: str) -> str:
        """Return `file:line:column: ` of a vehicle whose departure was requested; "" of any other."""
        return self._places.get(name, "")

    def after_step(self, departed: frozenset[str]) -> None:
        """Compare the vehicles that departed in this step, or should have.

        Raises:
            RunError: one departed differently than requested, or has not departed in time.
        """
        if not self._requested:
            return
        dt = float(self._sumo.simulation.getDeltaT())
        for name in sorted(departed.intersection(self._requested)):
            self._compare(name, self._requested.pop(name), dt)
        simulated = float(self._sumo.simulation.getTime()) - dt
        while self._due and _milliseconds(self._due[0][0]) <= _milliseconds(simulated):
            at, name = heapq.heappop(self._due)
            if at == self._deadline(name):
                self._refuse(name)

    def await_ego(self) -> None:
        """Check an ego that has not departed, and whose `depart` is not known or not over.

        Raises:
            RunError: it cannot depart any more, or has waited too long.
        """
        name, now = self._ego.id, float(self._sumo.simulation.getTime())
        requested, limit = self._requested.get(name), self._ego.wait if self._ego.delay is None else self._ego.delay
        due = requested is None or requested.depart is None or requested.depart < now  # a state does not count what is to come
        if self._in_files and due and self._sumo.simulation.getMinExpectedNumber() == 0:
            self._refuse(name)
        if self._deadline(name) < math.inf:
            return
        waited = self._delay(name)
        if waited is not None and waited > limit:
            self._refuse(name)
        begin = self._start if requested is None or requested.depart is None else max(requested.depart, self._start)
        if now - begin > self._ego.wait:
            self._refuse(name)

    def _deadline(self, name: str, requested: RequestedDeparture | None = None) -> float:
        """Return until when a vehicle must have departed (s); inf where that is not known, or nothing is expected."""
        requested = self._requested.get(name) if requested is None else requested
        if requested is None or requested.depart is None or requested.of_flow:
            return math.inf
        return requested.depart + self._allowed(name)

    def _allowed(self, name: str) -> float:
        """Return how much later than its `depart` a vehicle may depart (s)."""
        return min(self._ego.delay or 0.0, self._ego.wait) if name == self._ego.id else 0.0

    def _delay(self, name: str) -> float | None:
        """Return how long SUMO has held back a vehicle (s); None if it does not know it."""
        try:
            return float(self._sumo.vehicle.getDepartDelay(name))
        except Exception as error:  # the class depends on the client: libsumo or traci
            if "is not known" in str(error):
                return None
            raise

    def _refuse(self, name: str) -> None:
        """Raise the error for a vehicle that has not departed in time, with the cause."""
        requested, is_ego = self._requested.get(name, RequestedDeparture("", None, None, None, None)), name == self._ego.id
        if not is_ego and self._delay(name) is None and self._left_out(requested):
            self.ignore(name)
            return
        rule = f"{requested.place}'{name}' must depart{self._when(name, requested)}"
        if self._delay(name) is None:
            cause = why_absent(self._files, self._values, name, requested.depart, self._start, added=not requested.place)
            raise RunError(Status.INVALID, f"{rule}, but {cause}")
        gap, why, remedy = why_held_back(self._sumo, name, requested, self._files)
        longer = " longer" if self._ego.delay or requested.of_flow else ""
        tolerance = f", or let it wait{longer}: ego: {{delay: SECONDS}}" if is_ego else ""
        held = f"but {HELD_BACK}, as {why}: {said_at(requested.place, remedy)}{tolerance}"
        raise RunError(Status.INVALID, f"{rule}{f', {gap}' if gap else ''}, {held}")

    def _refuse_copy(self, name: str, place: str) -> None:
        """Refuse a vehicle of which SUMO drives copies, as the option `scale` asks for."""
        copy = f"{name}.1"
        if "scale" not in self._files.options or self._delay(copy) is None or copy in self._files.names():
            return
        if cause := why_copied(self._files, self._values, name):  # reads the files again
            raise RunError(Status.INVALID, f"{place}'{name}' must be one vehicle, but there is '{copy}' too, as {cause}")

    def _left_out(self, requested: RequestedDeparture) -> bool:
        """Return whether options ask for leaving out a vehicle of the traffic: a part of it, or what departs too early."""
        return "scale" in self._files.options or (requested.depart is not None and requested.depart < self._start)

    def _when(self, name: str, requested: RequestedDeparture) -> str:
        """Return until when a vehicle must depart, as text."""
        if self._deadline(name, requested) < math.inf:
            delay = self._allowed(name)
            return f" at t = {requested.depart:g} s" if not delay else f" within {delay:g} s of t = {requested.depart:g} s"
        limit = self._ego.wait if self._ego.delay is None else self._ego.delay
        return f" within {limit:g} s"

    def _compare(self, name: str, requested: RequestedDeparture, dt: float) -> None:
        if requested.on_foot:
            self._compare_person(name, requested, dt)
            return
        vehicle = self._sumo.vehicle
        if name == self._ego.id and not requested.of_flow:
            self._refuse_copy(name, requested.place)
        departure = vehicle.getDeparture(name)
        if self._deadline(name, requested) < math.inf and self._late(departure, self._deadline(name, requested), dt):
            rule = f"{requested.place}'{name}' must depart{self._when(name, requested)}"
            raise RunError(Status.INVALID, f"{rule}, but SUMO inserted it at t = {departure:g} s")
        lane = vehicle.getLaneID(name)
        if not lane:  # a loop has moved it off the lanes, by SUMO's own client
            return
        length = self._sumo.lane.getLength(lane)
        position = requested.position
        if position is not None and position < 0:
            position += length
        compared = (
            ("departPos", position, vehicle.getLanePosition(name), " m", f"lane {lane} is {length:g} m long"),
            ("departSpeed", requested.speed, vehicle.getSpeed(name), " m/s", "its type and its lane must allow that speed"),
            ("departLane", requested.lane, vehicle.getLaneIndex(name), "", "the edge must have that lane for its vehicle class"),
        )
        for attribute, expected, actual, unit, remedy in compared:
            if expected is not None and abs(expected - actual) > _TOLERANCE:
                rule = f"must depart with {said_at(requested.place, attribute)} {expected:g}{unit}"
                raise RunError(
                    Status.INVALID,
                    f"{requested.place}'{name}' {rule}, but SUMO inserted it with {actual:g}{unit}: {remedy}",
                )

    @staticmethod
    def _late(departure: float, deadline: float, dt: float) -> bool:
        """Return whether a departure (s) is a step (s) or more behind its deadline (s)."""
        return _milliseconds(departure) - _milliseconds(deadline) >= _milliseconds(dt)

    def _compare_person(self, name: str, requested: RequestedDeparture, dt: float) -> None:
        """Compare time and position of a person in the step in which it begins to walk."""
        departure = float(self._sumo.simulation.getTime()) - dt
        if requested.depart is not None and not requested.of_flow and self._late(departure, requested.depart, dt):
            rule = f"{requested.place}'{name}' must depart{self._when(name, requested)}"
            raise RunError(Status.INVALID, f"{rule}, but SUMO inserted it at t = {departure:g} s")
        domain = self._sumo.person
        edge, expected, actual = domain.getRoadID(name), requested.position, domain.getLanePosition(name)
        if expected is not None and expected < 0:
            expected += self._sumo.lane.getLength(f"{edge}_0")
        if expected is not None and abs(expected - actual) > _TOLERANCE:
            rule = f"{requested.place}'{name}' must depart with departPos {expected:g} m, but SUMO inserted it with {actual:g} m"
            raise RunError(Status.INVALID, f"{rule}: edge {edge} must be that long, and the walk begin there")
