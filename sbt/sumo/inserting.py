"""Vehicles that a scenario inserts beside the traffic of its files: the route file that SUMO reads for them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sbt.sumo.places import stands_for
from sbt.sumo.session import scratch_folder

__all__ = ["InsertedVehicle", "inserted_file"]


@dataclass(frozen=True)
class InsertedVehicle:
    """A vehicle at its start; values are texts as SUMO reads them, with placeholders where they are inputs.

    Args:
        depart: when (s).
        edge: on which edge.
        lane: index of its lane, from the right.
        position: of its front bumper on the lane (m).
        speed: m/s.
        type: its vehicle type, of the files; "": SUMO's default.
        route: the edges that it drives, the first included; none: its own.
        known_route: False: the route is only the edge that it drives to.
    """

    depart: str
    edge: str
    lane: str
    position: str
    speed: str
    type: str = ""
    route: tuple[str, ...] = ()
    known_route: bool = True


def inserted_file(vehicles: Mapping[str, InsertedVehicle], places: Mapping[str, str]) -> Path:
    """Write the route file of some vehicles by id to a temporary folder of this process, and return it.

    Args:
        vehicles: by id.
        places: where the user wrote them, for messages.

    SUMO does not check the insertion, since it would delay it: where a start is not clear of others, the run is invalid.
    """
    lines = [_element(name, vehicle) for name, vehicle in vehicles.items()]
    text = "<routes>\n" + "\n".join(lines) + "\n</routes>\n"
    path = scratch_folder() / f"insert-{hashlib.blake2b((text + repr(places)).encode(), digest_size=8).hexdigest()}.rou.xml"
    stands_for(path, {line: places[name] for line, name in enumerate(vehicles, 2)})
    if not path.exists():
        path.write_text(text, encoding="utf-8")
    return path


def _element(name: str, vehicle: InsertedVehicle) -> str:
    attributes = {
        "id": name, "depart": vehicle.depart, "departLane": vehicle.lane, "departPos": vehicle.position,
        "departSpeed": vehicle.speed, "insertionChecks": "none", **({"type": vehicle.type} if vehicle.type else {}),
    }  # fmt: skip
    if not vehicle.known_route:
        return f"<trip {_written({**attributes, 'from': vehicle.edge, 'to': vehicle.route[0]})}/>"
    edges: Sequence[str] = vehicle.route or (vehicle.edge,)
    return f"<vehicle {_written(attributes)}><route edges={quoteattr(' '.join(edges))}/></vehicle>"


def _written(attributes: Mapping[str, str]) -> str:
    return " ".join(f"{key}={quoteattr(value)}" for key, value in attributes.items())
