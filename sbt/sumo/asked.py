"""Whether SUMO put a vehicle of the user's files where the files ask for it, and in words why not.

SUMO delays a vehicle that its insertion checks find too close, silently: the concrete scenario that
runs is then another one. Compared are departure, position, speed and lane, as far as they are numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.files import SumoFiles
from sbt.sumo.template import fill

__all__ = ["Asked", "Insertions", "asked_of", "number_or_none"]

_TOLERANCE = 1e-3
_HINT = 'set insertionChecks="none" on the vehicle, or the option insertion-checks: none'


@dataclass(frozen=True)
class Asked:
    """What the files ask of one vehicle's start; None where that is SUMO's to choose.

    Attributes:
        place: `file:line:column: ` of the vehicle, "" where a loop adds it.
        depart: time (s).
        position: of the front bumper on its lane (m), from its end where negative.
        speed: m/s.
        lane: index.
    """

    place: str
    depart: float | None
    position: float | None
    speed: float | None
    lane: float | None


def asked_of(files: SumoFiles, values: Mapping[str, float], ego: str) -> dict[str, Asked]:
    """Return what is asked of the ego and of every vehicle that has a placeholder."""
    own = files.vehicle(ego)
    wanted = [(name, one) for one in files.templates for name in one.varying]
    if own is not None and ego in own[1].vehicles:
        wanted.append((ego, own[1]))
    found: dict[str, Asked] = {}
    for name, one in wanted:
        vehicle = one.vehicles[name]
        if vehicle.tag != "flow":
            place = f"{one.path}:{vehicle.place[0]}:{vehicle.place[1]}: "
            start = (vehicle.depart, vehicle.position, vehicle.speed, vehicle.lane)
            found[name] = Asked(place, *(number_or_none(fill(value or "", values, place)) for value in start))
    return found


def number_or_none(value: Any) -> float | None:
    """Return what SUMO would read as a number; None of words such as `max` or `best`."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


class Insertions:
    """Follows the vehicles until they have departed, and compares."""

    def __init__(self, sumo: Any, asked: Mapping[str, Asked]):
        self._sumo = sumo
        self._asked = dict(asked)
        self._meant: dict[str, str] = {}

    def expect(self, name: str, asked: Asked) -> None:
        """Follow one more vehicle."""
        self._asked[name] = asked

    def forget(self, name: str) -> None:
        """Follow a vehicle no more."""
        self._asked.pop(name, None)

    def after_step(self, departed: frozenset[str]) -> None:
        """Compare who departed in this step with what was asked.

        Raises:
            RunError: another start than the one asked for.
        """
        if not self._asked:
            return
        now, dt = self._sumo.simulation.getTime(), self._sumo.simulation.getDeltaT()
        for name in [name for name in self._asked if name in departed]:
            self._compare(name, self._asked.pop(name), dt)
        for name, asked in self._asked.items():
            if asked.depart is not None and asked.depart <= now - dt and name not in self._meant:
                self._meant[name] = self._behind(name, asked)

    def waiting(self, name: str) -> str:
        """Return in words why a vehicle is not there yet."""
        if name in self._sumo.simulation.getPendingVehicles():
            meant = self._meant.get(name, "")
            return f"SUMO holds it back since its departure{f', asked for {meant}' if meant else ''}: {_HINT}"
        return "SUMO has not loaded it: is its depart later, or the route file not sorted by depart (SUMO drops what comes late)?"

    def _compare(self, name: str, asked: Asked, dt: float) -> None:
        vehicle = self._sumo.vehicle
        departure = vehicle.getDeparture(name)
        if asked.depart is not None and departure - asked.depart > dt + _TOLERANCE:
            meant, got = self._meant.get(name, ""), self._behind(name, None)
            raise RunError(
                Status.INVALID, f"{asked.place}you asked for '{name}' at t = {asked.depart:g} s{f', {meant}' if meant else ''}; "
                f"SUMO inserted it at t = {departure:g} s{f', {got}' if got else ''}: {_HINT}",
            )  # fmt: skip
        position = asked.position
        if position is not None and position < 0:
            position += self._sumo.lane.getLength(vehicle.getLaneID(name))
        realised = (
            ("departPos", position, vehicle.getLanePosition(name), " m"),
            ("departSpeed", asked.speed, vehicle.getSpeed(name), " m/s"),
            ("departLane", asked.lane, vehicle.getLaneIndex(name), ""),
        )
        for what, wanted, got, unit in realised:
            if wanted is not None and abs(wanted - got) > _TOLERANCE:
                raise RunError(
                    Status.INVALID, f"{asked.place}you asked for '{name}' with {what} {wanted:g}{unit}, SUMO inserted it with "
                    f"{got:g}{unit}: {_HINT}",
                )  # fmt: skip

    def _behind(self, name: str, asked: Asked | None) -> str:
        """Return the gap to the one ahead on its lane in words: as asked, or (None) as it is; "" where there is none."""
        vehicle = self._sumo.vehicle
        if asked is None:
            lane, position = vehicle.getLaneID(name), vehicle.getLanePosition(name)
        else:
            if asked.position is None:
                return ""
            lane, position = f"{vehicle.getRoute(name)[0]}_{int(asked.lane or 0)}", asked.position
            position += self._sumo.lane.getLength(lane) if position < 0 else 0.0
        ahead = [
            (vehicle.getLanePosition(other) - vehicle.getLength(other) - position, other)
            for other in self._sumo.lane.getLastStepVehicleIDs(lane)
            if other != name and vehicle.getLanePosition(other) > position
        ]
        return "{:.3g} m behind '{}'".format(*min(ahead)) if ahead else ""
