"""Compares the departures of vehicles with what the user's files or loop request.

SUMO silently delays a vehicle that fails its insertion checks; the run is then another concrete scenario
than the requested one. Time, position, speed and lane of the departure are compared where they are
numbers. A difference ends the run and names the vehicle, the request and the remedy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.sumo.files import SumoFiles
from sbt.sumo.template import fill

__all__ = ["DepartureMonitor", "RequestedDeparture", "number_or_none", "requested_departures"]

_TOLERANCE = 1e-3
"""Difference that is accepted (s, m, m/s): SUMO counts time in milliseconds."""
_REMEDY = 'set insertionChecks="none" on the vehicle, or the option insertion-checks: none'


@dataclass(frozen=True)
class RequestedDeparture:
    """The requested departure of one vehicle; None for what SUMO is free to choose.

    Attributes:
        place: `file:line:column: ` of the vehicle, "" for one added by a loop.
        depart: time (s).
        position: of the front bumper on its lane (m), from the end of the lane if negative.
        speed: m/s.
        lane: index.
    """

    place: str
    depart: float | None
    position: float | None
    speed: float | None
    lane: float | None


def requested_departures(files: SumoFiles, values: Values, ego: str) -> dict[str, RequestedDeparture]:
    """Return the requested departures of the ego and of every vehicle with a placeholder."""
    of_ego = files.vehicle(ego)
    compared = [(name, template) for template in files.templates for name in template.varying]
    if of_ego is not None and ego in of_ego[1].vehicles:
        compared.append((ego, of_ego[1]))
    requested: dict[str, RequestedDeparture] = {}
    for name, template in compared:
        vehicle = template.vehicles[name]
        if vehicle.tag != "flow":
            place = f"{template.path}:{vehicle.place[0]}:{vehicle.place[1]}: "
            start = (vehicle.depart, vehicle.position, vehicle.speed, vehicle.lane)
            requested[name] = RequestedDeparture(place, *(number_or_none(fill(value or "", values, place)) for value in start))
    return requested


def number_or_none(value: Any) -> float | None:
    """Return the number that SUMO would read, or None for words such as `max` or `best`."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


class DepartureMonitor:
    """Compares each vehicle in the step in which it departs.

    Args:
        sumo: libsumo or traci.
        requested: departures by vehicle id.
    """

    def __init__(self, sumo: Any, requested: Mapping[str, RequestedDeparture]):
        self._sumo = sumo
        self._requested = dict(requested)
        self._requested_gap: dict[str, str] = {}

    def expect(self, name: str, requested: RequestedDeparture) -> None:
        """Compare one more vehicle."""
        self._requested[name] = requested

    def ignore(self, name: str) -> None:
        """Do not compare this vehicle."""
        self._requested.pop(name, None)

    def after_step(self, departed: frozenset[str]) -> None:
        """Compare the vehicles that departed in this step.

        Raises:
            RunError: one departed differently than requested.
        """
        if not self._requested:
            return
        now, dt = self._sumo.simulation.getTime(), self._sumo.simulation.getDeltaT()
        for name in [name for name in self._requested if name in departed]:
            self._compare(name, self._requested.pop(name), dt)
        for name, requested in self._requested.items():
            if requested.depart is not None and requested.depart <= now - dt and name not in self._requested_gap:
                self._requested_gap[name] = self._gap_ahead(name, requested)

    def why_waiting(self, name: str) -> str:
        """Return the reason why a vehicle has not departed yet."""
        if name in self._sumo.simulation.getPendingVehicles():
            gap = self._requested_gap.get(name, "")
            return f"SUMO holds it back since its departure{f', requested {gap}' if gap else ''}: {_REMEDY}"
        return "SUMO has not loaded it: is its depart later, or the route file not sorted by depart (SUMO drops what comes late)?"

    def _compare(self, name: str, requested: RequestedDeparture, dt: float) -> None:
        vehicle = self._sumo.vehicle
        departure = vehicle.getDeparture(name)
        if requested.depart is not None and departure - requested.depart > dt + _TOLERANCE:
            gap, found = self._requested_gap.get(name, ""), self._gap_ahead(name, None)
            raise RunError(
                Status.INVALID,
                f"{requested.place}'{name}' must depart at t = {requested.depart:g} s{f', {gap}' if gap else ''}, "
                f"but SUMO inserted it at t = {departure:g} s{f', {found}' if found else ''}: {_REMEDY}",
            )
        position = requested.position
        if position is not None and position < 0:
            position += self._sumo.lane.getLength(vehicle.getLaneID(name))
        compared = (
            ("departPos", position, vehicle.getLanePosition(name), " m"),
            ("departSpeed", requested.speed, vehicle.getSpeed(name), " m/s"),
            ("departLane", requested.lane, vehicle.getLaneIndex(name), ""),
        )
        for attribute, expected, actual, unit in compared:
            if expected is not None and abs(expected - actual) > _TOLERANCE:
                raise RunError(
                    Status.INVALID,
                    f"{requested.place}'{name}' must depart with {attribute} {expected:g}{unit}, "
                    f"but SUMO inserted it with {actual:g}{unit}: {_REMEDY}",
                )

    def _gap_ahead(self, name: str, requested: RequestedDeparture | None) -> str:
        """Return the gap to the leader as text: the requested one, or with None the actual one; "" without a leader."""
        vehicle = self._sumo.vehicle
        if requested is None:
            lane, position = vehicle.getLaneID(name), vehicle.getLanePosition(name)
        else:
            if requested.position is None:
                return ""
            lane, position = f"{vehicle.getRoute(name)[0]}_{int(requested.lane or 0)}", requested.position
            position += self._sumo.lane.getLength(lane) if position < 0 else 0.0
        ahead = [
            (vehicle.getLanePosition(other) - vehicle.getLength(other) - position, other)
            for other in self._sumo.lane.getLastStepVehicleIDs(lane)
            if other != name and vehicle.getLanePosition(other) > position
        ]
        return "{:.3g} m behind '{}'".format(*min(ahead)) if ahead else ""
