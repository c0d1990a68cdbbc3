"""Watches a user's own traffic once, as it is, to choose a vehicle under test from its midst."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sbt.errors import InputError, RunError
from sbt.sumo.files import SumoFiles
from sbt.sumo.session import scratch_folder, session

__all__ = ["Observed", "Traffic", "candidates", "observe"]

_STEP = 1.0
"""Step while watching (s), where the files set no longer one: who drives where with whom does not need more."""
_SPAN = 600.0
"""Time that is watched, from the first departure on (s)."""
_VEHICLE_STEPS = 300_000
"""Vehicle-steps that are watched at most: some seconds of a computer's time."""
_CLOCK = 120.0
"""Wall-clock limit (s)."""
_NEAR = 50.0
"""Distance within which another vehicle counts as a neighbour (m)."""
_SAMPLING = 5
"""Steps between two counts of neighbours."""
_LONG_ENOUGH = 30.0
"""A vehicle that drives this long (s) is long enough in the traffic to meet others."""
_NO_ROAD = ("rail", "tram", "ship", "pedestrian", "wheelchair", "aircraft", "drone", "subway", "cable", "container")
"""Beginnings of vehicle classes that are no candidates."""
_SECOND_CHOICE = (
    "bicycle", "moped", "motorcycle", "scooter", "bus", "coach", "truck", "trailer", "emergency", "authority", "army", "vip",
)  # fmt: skip
"""Vehicle classes that are taken only where there is nothing else."""


@dataclass(frozen=True)
class Observed:
    """A vehicle as it drove while it was watched.

    Args:
        id, type, vclass: its id, and the id and vehicle class of its type.
        depart: when it entered (s).
        delay: how much later than it should (s).
        route: edges, as they were when it entered.
        lane_speed: that its first lane, and what its class wants, allow it at a speed factor of 1 (m/s).
        running: vehicles on the road when it entered.
        stay: how long it drove (s), so far if it was still there in the end.
        neighbours: mean number of others within 50 m.
        busiest: how long after its departure most others were that near (s).
    """

    id: str
    type: str
    vclass: str
    depart: float
    delay: float
    route: tuple[str, ...]
    lane_speed: float
    running: int
    stay: float = 0.0
    neighbours: float = 0.0
    busiest: float = 0.0


@dataclass(frozen=True)
class Traffic:
    """What was watched.

    Args:
        vehicles: in the order of their departure.
        most: most vehicles on the road at once.
        junctions: the junctions that each observed edge leads from and to.
        types: properties of the types of the vehicles, by type id: `tau`, `decel`, `emergencyDecel`, `maxSpeed`.
    """

    vehicles: tuple[Observed, ...]
    most: int
    junctions: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    types: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def get(self, name: str) -> Observed | None:
        """Return a vehicle by its id; None if it never entered."""
        return next((v for v in self.vehicles if v.id == name), None)

    def entering(self, edge: str) -> list[float]:
        """Return when vehicles entered on an edge (s)."""
        return [v.depart for v in self.vehicles if v.route[:1] == (edge,)]


def observe(files: SumoFiles, values: Mapping[str, float], wanted: str | None = None) -> Traffic:
    """Run the traffic once and return who drove in it.

    Args:
        files: the simulation.
        values: of its placeholders.
        wanted: a vehicle that is waited for however late it enters; None: watch ten minutes at most.

    Raises:
        InputError: SUMO does not run these files; the message has SUMO's.
    """
    own = files.step_length()
    step = max(_STEP, own) if own is not None else _STEP
    try:
        with session().run(files.launch(values, scratch_folder(), step), 0, "fresh") as sumo:
            return _watch(sumo, wanted)
    except RunError as error:
        raise InputError(f"SUMO must run {files.net.name} with its traffic, but: {error.reason}") from None


def _watch(sumo: Any, wanted: str | None) -> Traffic:
    found: dict[str, Observed] = {}
    gone: dict[str, float] = {}
    counts: dict[str, list[tuple[float, int]]] = {}
    first, most, steps, clock = None, 0, 0, time.monotonic() + _CLOCK
    while sumo.simulation.getMinExpectedNumber() > 0 and time.monotonic() < clock:
        sumo.simulationStep()
        now, running = float(sumo.simulation.getTime()), sumo.vehicle.getIDCount()
        for name in sumo.simulation.getDepartedIDList():
            if name in sumo.vehicle.getIDList() and name not in found:
                found[name] = _entered(sumo, name, running)
                first = now if first is None else first
        gone.update(dict.fromkeys(sumo.simulation.getArrivedIDList(), now))
        most, steps = max(most, running), steps + running
        if steps and int(now) % _SAMPLING == 0:
            _count_neighbours(sumo, counts)
        over = first is not None and (now - first > _SPAN or steps > _VEHICLE_STEPS)
        if over and (wanted is None or (wanted in found and now - found[wanted].depart > _LONG_ENOUGH)):
            break
    end = float(sumo.simulation.getTime())
    vehicles = tuple(
        _surrounded(replace(v, stay=gone.get(v.id, end) - v.depart), counts.get(v.id, [])) for v in found.values()
    )
    edges = {edge for v in vehicles for edge in v.route}
    junctions = {edge: (sumo.edge.getFromJunction(edge), sumo.edge.getToJunction(edge)) for edge in sorted(edges)}
    return Traffic(vehicles, most, junctions, {name: _properties(sumo, name) for name in sorted({v.type for v in vehicles})})


def _entered(sumo: Any, name: str, running: int) -> Observed:
    vehicle = sumo.vehicle
    allowed = vehicle.getAllowedSpeed(name) / vehicle.getSpeedFactor(name) if vehicle.getLaneID(name) else 0.0
    return Observed(
        name, vehicle.getTypeID(name), vehicle.getVehicleClass(name), float(vehicle.getDeparture(name)),
        float(vehicle.getDepartDelay(name)), tuple(vehicle.getRoute(name)), float(allowed),
        running,
    )  # fmt: skip


def _properties(sumo: Any, name: str) -> dict[str, float]:
    kind = sumo.vehicletype
    return {
        "tau": kind.getTau(name), "decel": kind.getDecel(name), "emergencyDecel": kind.getEmergencyDecel(name),
        "maxSpeed": kind.getMaxSpeed(name), "speedFactor": kind.getSpeedFactor(name),
    }  # fmt: skip


def _surrounded(vehicle: Observed, counts: list[tuple[float, int]]) -> Observed:
    """Return a vehicle with how many others were near, and when most of them."""
    if not counts:
        return vehicle
    time, _ = max(counts, key=lambda one: one[1])
    return replace(vehicle, neighbours=float(np.mean([n for _, n in counts])), busiest=time - vehicle.depart)


def _count_neighbours(sumo: Any, counts: dict[str, list[tuple[float, int]]]) -> None:
    """Append to the counts of every vehicle how many others are within 50 m now."""
    from scipy.spatial import KDTree

    names, now = sumo.vehicle.getIDList(), float(sumo.simulation.getTime())
    points = np.array([sumo.vehicle.getPosition(name) for name in names]).reshape(-1, 2)
    if len(points):
        near = KDTree(points).query_ball_point(points, _NEAR, return_length=True)
        for name, count in zip(names, near.tolist(), strict=True):
            counts.setdefault(name, []).append((now, count - 1))


def candidates(traffic: Traffic) -> list[Observed]:
    """Return vehicles that could be under test, the best ones first.

    The best is a car that enters without delay while the roads are filled, drives for half a minute or more, and has
    at least as many others around it as the average; among those the earliest, since every run begins with the
    traffic before it.
    """
    road = [v for v in traffic.vehicles if not v.vclass.startswith(_NO_ROAD) and v.lane_speed > 0 and v.route]
    typical = float(np.median([v.neighbours for v in road])) if road else 0.0

    def shortcomings(v: Observed) -> tuple[int, int, float, float]:
        missing = (
            v.stay < _LONG_ENOUGH,
            v.running < 0.5 * traffic.most,
            v.neighbours < max(typical, 0.5),
            v.delay > _STEP,
        )
        return int(v.vclass in _SECOND_CHOICE), sum(missing), -min(v.stay, _LONG_ENOUGH) if missing[0] else 0.0, v.depart

    return sorted(road, key=shortcomings)
