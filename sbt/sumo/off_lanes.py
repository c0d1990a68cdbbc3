"""Road users off the lanes: those that are moved by poses, whom SUMO's subscriptions do not see, and those who park."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.guided import Placed
from sbt.sumo.leaving import why_gone
from sbt.sumo.levels import is_known
from sbt.sumo.session import INVALID_DOUBLE

__all__ = ["ANGLE", "POSITION", "SPEED", "VEHICLE", "off_lanes", "parking", "placed_variables", "read"]

POSITION, ANGLE, SPEED, VEHICLE = 0x39, 0x43, 0x40, 0xC3
"""TraCI variables: VAR_POSITION3D, VAR_ANGLE, VAR_SPEED, VAR_VEHICLE (the vehicle a person rides in)."""


def read(sumo: Any, vehicle: str) -> dict[int, Any]:
    """Return the variables of a vehicle as a subscription gives them."""
    of = sumo.vehicle
    return {POSITION: of.getPosition3D(vehicle), ANGLE: of.getAngle(vehicle), SPEED: of.getSpeed(vehicle)}


def off_lanes(
    sumo: Any, ego: str, near: Mapping[str, Any], unseen: Iterable[str], rigid: Container[str]
) -> dict[str, dict[int, Any]]:  # fmt: skip
    """Return the variables of those who are on no lane, the ego among them, near or far. Who parks is beside the road.

    Args:
        sumo: libsumo or traci.
        ego: id.
        near: whom the ego's subscription sees, on lanes.
        unseen: who was there before, or was moved by poses, and is not among them.
        rigid: who was moved by poses.

    Raises:
        RunError: the ego is not there.
    """
    found = {name: read(sumo, name) for name in unseen if is_known(sumo, name) and _on_no_lane(sumo, name)}
    found = {name: one for name, one in found.items() if one[POSITION][0] != INVALID_DOUBLE}
    if ego not in near and ego not in found:
        status, moved = (Status.FAILED, True) if ego in rigid else (Status.INVALID, False)
        when = f"was gone at t = {sumo.simulation.getTime():g} s: {why_gone(sumo, moved=moved)}"
        raise RunError(status, f"the ego '{ego}' must stay on the road, but it {when}")
    return found


def _on_no_lane(sumo: Any, vehicle: str) -> bool:
    return not sumo.vehicle.getLaneID(vehicle) and not sumo.vehicle.isStoppedParking(vehicle)


def placed_variables(placed: Mapping[str, Placed]) -> dict[str, dict[int, Any]]:
    """Return the variables of the placed road users."""
    return {
        name: {POSITION: (s.x, s.y, s.z), ANGLE: s.angle, SPEED: s.speed, **({VEHICLE: ""} if s.person else {})}
        for name, s in placed.items()
    }


def parking(simulation: Any) -> tuple[Sequence[str], Sequence[str]]:
    """Return the vehicles that SUMO moves into a parking place in this step, and out of one in the next."""
    begins = simulation.getParkingStartingVehiclesIDList() if simulation.getParkingStartingVehiclesNumber() else ()
    ends = simulation.getParkingEndingVehiclesIDList() if simulation.getParkingEndingVehiclesNumber() else ()
    return begins, ends
