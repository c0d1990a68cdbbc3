"""Why SUMO holds a vehicle back at its departure, and what lets it in."""

from __future__ import annotations

from typing import Any, Protocol

from sbt.sumo.actors import State
from sbt.sumo.elements import element
from sbt.sumo.files import SumoFiles
from sbt.sumo.overlaps import deepest_overlap, instant, state_in_sumo
from sbt.sumo.session import INVALID_DOUBLE

__all__ = ["why_held_back"]

_BASE_MARGIN = 0.1
"""How far behind the rear bumper `departPos="base"` begins, as in SUMO (m)."""
_DEPARTING = ("vehicle", "trip", "flow")
_TRIGGERS = ("triggered", "containerTriggered", "split")
"""Words for departures that others cause."""


class _Requested(Protocol):
    """What is read of a requested departure."""

    @property
    def place(self) -> str: ...
    @property
    def position(self) -> float | None: ...
    @property
    def lane(self) -> float | None: ...


def why_held_back(sumo: Any, name: str, requested: _Requested, files: SumoFiles) -> tuple[str, str, str]:
    """Return the requested gap to the leader ("" without one), the cause and the remedy, as texts.

    In the order in which the causes hide each other: a departure that SUMO has moved, one ahead in the queue of the edge
    (SUMO tries no further vehicle of an edge, unless `eager-insert` is set), the largest number of vehicles, an occupied
    place, an unsafe gap.
    """
    found = element(files, name, _DEPARTING)
    checks = found.attributes.get("insertionChecks") if found is not None else None
    checks = checks if checks is not None else files.options.get("insertion-checks", "all")
    state = _requested_state(sumo, name, requested, found.attributes if found is not None else {})
    gap = _gap_ahead(sumo, name, requested)
    if found is not None and found.depart in _TRIGGERS:
        return gap, f'its depart="{found.depart}" waits for somebody who rides in it', "give it a depart in seconds"
    offset = files.options.get("random-depart-offset", "0")
    if offset not in ("0", "0.0") and name not in sumo.simulation.getPendingVehicles():
        return gap, f"the option random-depart-offset: {offset} lets it depart later", "set it to 0"
    own_flow = f"{found.attributes['id']}." if found is not None and found.tag == "flow" else None
    queue = _queue_before(sumo, name)
    if queue and not (own_flow and queue.startswith(own_flow)) and files.options.get("eager-insert") not in ("true", "1"):
        why = f"'{queue}' waits before it to depart on the same edge, and SUMO tries no other one there"
        return gap, why, "set the option eager-insert: true"
    limit = files.options.get("max-num-vehicles", "")
    if limit.isdigit() and int(limit) <= sumo.vehicle.getIDCount():
        return gap, "no more vehicles may be on the road", f"raise the option max-num-vehicles from {limit}"
    taken = None if state is None else deepest_overlap(instant(state), {one.name: instant(one) for one in _others(sumo, name)})
    if taken is not None:
        why = f"its place is taken by '{taken[0]}' (they would overlap by {taken[1]:.2g} m)"
        return gap, why, "move its departPos, or let it depart at another time"
    if checks == "none":
        return gap, "SUMO finds no place for it", "move its departPos, departLane or depart"
    why = "its insertion checks find that unsafe"
    if found is None:
        return gap, why, "start SUMO with the option insertion-checks: none, which lets in every vehicle unchecked"
    if own_flow:
        why = f"the vehicles of its flow '{own_flow[:-1]}' wait for a safe gap one after the other"
        return gap, why, 'give it a <vehicle> of its own with insertionChecks="none", or let fewer depart'
    return gap, why, 'set insertionChecks="none" on the vehicle'


def _queue_before(sumo: Any, name: str) -> str:
    """Return the first vehicle that waits before this one on the same edge, "" if there is none."""
    pending = list(sumo.simulation.getPendingVehicles())
    if name not in pending:
        return ""
    edge = sumo.vehicle.getRoute(name)[0]
    return next((str(other) for other in pending[: pending.index(name)] if sumo.vehicle.getRoute(other)[0] == edge), "")


def _requested_state(sumo: Any, name: str, requested: _Requested, attributes: Any) -> State | None:
    """Return where the vehicle would be; None where SUMO is free to choose."""
    position, lane = requested.position, requested.lane
    if lane is None and sumo.edge.getLaneNumber(sumo.vehicle.getRoute(name)[0]) > 1:
        return None
    length, width = float(sumo.vehicle.getLength(name)), float(sumo.vehicle.getWidth(name))
    if position is None and attributes.get("departPos", "base") != "base":
        return None
    edge, index = sumo.vehicle.getRoute(name)[0], int(lane or 0)
    end = float(sumo.lane.getLength(f"{edge}_{index}"))
    at = min(length + _BASE_MARGIN, end) if position is None else position + (end if position < 0 else 0.0)
    at = min(max(at, 0.0), end)
    state = State(name, length, width)
    state.turn(float(sumo.lane.getAngle(f"{edge}_{index}", at)))
    x, y = sumo.simulation.convert2D(edge, at, index)
    state.x, state.y = x - 0.5 * length * state.cos, y - 0.5 * length * state.sin
    return state


def _others(sumo: Any, name: str) -> list[State]:
    """Return the states of all vehicles and persons on the road."""
    vehicles = [state_in_sumo(sumo.vehicle, other) for other in sumo.vehicle.getIDList() if other != name]
    walking = [other for other in sumo.person.getIDList() if not sumo.person.getVehicle(other)]
    persons = [state_in_sumo(sumo.person, other, person=True) for other in walking]
    return [state for state in (*vehicles, *persons) if state.x != INVALID_DOUBLE]


def _gap_ahead(sumo: Any, name: str, requested: _Requested) -> str:
    """Return the requested gap to the leader as text; "" without one, or where SUMO is free to choose the place."""
    if requested.position is None:
        return ""
    vehicle, position = sumo.vehicle, requested.position
    lane = f"{vehicle.getRoute(name)[0]}_{int(requested.lane or 0)}"
    position += sumo.lane.getLength(lane) if position < 0 else 0.0
    ahead = [
        (vehicle.getLanePosition(other) - vehicle.getLength(other) - position, other)
        for other in sumo.lane.getLastStepVehicleIDs(lane)
        if other != name and vehicle.getLanePosition(other) > position
    ]
    nearest = min(ahead, default=(-1.0, ""))
    return f"{nearest[0]:.3g} m behind '{nearest[1]}'" if nearest[0] >= 0.0 else ""
