"""A vehicle under test in the midst of a user's traffic: with a vehicle type of its own, in a file of its own.

A vehicle or trip of the files is moved: it stands in the new file, and its own file is copied without it. The vehicles
of a flow cannot be told apart in their file, so a vehicle is added beside: on the same way, between two of the flow.
The type is a copy of the vehicle's own, so that its inputs change nobody else.
"""

from __future__ import annotations

import copy
import itertools
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sbt.sumo.departures import number_or_none
from sbt.sumo.editing import Changes, changed_copy, definitions
from sbt.sumo.files import SumoFiles
from sbt.sumo.observing import Observed, Traffic
from sbt.sumo.template import Template

__all__ = ["OwnEgo", "Suggestion", "own_ego"]

_DEFAULT_CLASSES = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_TAXITYPE": "taxi", "DEFAULT_RAILTYPE": "rail"}
"""Vehicle classes of the types that SUMO has without a definition."""
_MOST_FLOWS = 2
"""Flows that become inputs."""


@dataclass(frozen=True)
class Suggestion:
    """A suggested input: its name, range, unit and description."""

    name: str
    low: float
    high: float
    unit: str
    description: str
    integer: bool = False


@dataclass(frozen=True)
class OwnEgo:
    """What is to be written for a vehicle under test.

    Args:
        id: of the vehicle.
        xml: the route file with its type and itself.
        inputs: that stand as placeholders in the new files.
        copies: bytes of the new files by the path of the file that each replaces.
        how: in words, where it comes from.
    """

    id: str
    xml: str
    inputs: tuple[Suggestion, ...]
    copies: Mapping[Path, bytes] = field(default_factory=dict)
    how: str = ""


def own_ego(files: SumoFiles, traffic: Traffic, chosen: Observed, folder: Path, step: float) -> OwnEgo:
    """Return the vehicle under test that a chosen one becomes.

    Args:
        files: the user's.
        traffic: as it was watched.
        chosen: the vehicle, or one of a flow.
        folder: where the new files will be.
        step: of the simulation (s).
    """
    found = files.vehicle(chosen.id)
    source = found[1] if found is not None else None
    element = _element(source, chosen.id) if source is not None else None
    movable = element is not None and source is not None and source.path in (*files.routes, *files.additional)
    movable = movable and element is not None and number_or_none(element.get("depart")) is not None
    name = chosen.id if movable else _unused("ego", files.names())
    type_id = _unused("ego_type", [e.get("id", "") for t in _traffic_files(files) for e in definitions(t, "vType")])
    inputs = list(_of_vehicle(traffic, chosen, step))
    flows = dict(_crossing_flows(files, traffic, chosen))
    changes: dict[Path, Changes] = {}
    for template, flow, suggestion, attribute, text in flows.values():
        inputs.append(suggestion)
        old = changes.get(template.path, Changes()).attributes or {}
        changes[template.path] = Changes(attributes={**old, flow: {attribute: text}})
    if movable and element is not None and source is not None:
        vehicle = _moved(files, element, chosen)
        changes[source.path] = Changes(name, changes.get(source.path, Changes()).attributes)
        how = f"'{name}' of {source.path.name}: it stands in ego.rou.xml now, with a type of its own"
    else:
        vehicle = _added(element, traffic, chosen, name)
        how = f"a vehicle beside '{chosen.id}', on its way, with a type of its own: it stands in ego.rou.xml"
    vehicle.set("type", type_id)
    if any(s.name == "depart_speed" for s in inputs):
        vehicle.set("departSpeed", "${depart_speed}")
    root = ET.Element("routes")
    root.append(_own_type(files, chosen.type, type_id, {s.name for s in inputs}))
    root.append(vehicle)
    ET.indent(root, "    ")
    templates = {t.path: t for t in _traffic_files(files)}
    copies = {path: changed_copy(templates[path], change, folder) for path, change in changes.items()}
    return OwnEgo(name, ET.tostring(root, encoding="unicode") + "\n", tuple(inputs), copies, how)


def _traffic_files(files: SumoFiles) -> list[Template]:
    return [t for t in files.templates if t.root[0] != "net"]


def _unused(name: str, taken: list[str]) -> str:
    return next(n for n in itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2))) if n not in taken)


def _element(source: Template, name: str) -> ET.Element | None:
    """Return the vehicle, trip or flow with this id; None if there is only the flow that it belongs to."""
    return next((e for e in definitions(source, "vehicle", "trip") if e.get("id") == name), None)


def _moved(files: SumoFiles, element: ET.Element, chosen: Observed) -> ET.Element:
    """Return a copy of a vehicle that does not depend on routes that are defined elsewhere."""
    vehicle = copy.deepcopy(element)
    named = vehicle.attrib.pop("route", None)
    if named is not None:
        routes = (e for t in _traffic_files(files) for e in definitions(t, "route") if e.get("id") == named and e.get("edges"))
        route = copy.deepcopy(next(routes, ET.Element("route", {"edges": " ".join(chosen.route)})))
        route.attrib.pop("id", None)
        vehicle.insert(0, route)
    vehicle.tail = None
    return vehicle


def _added(element: ET.Element | None, traffic: Traffic, chosen: Observed, name: str) -> ET.Element:
    """Return a vehicle on the way of the chosen one, halfway between its departure and the next one on that edge."""
    later = [t for t in traffic.entering(chosen.route[0]) if t > chosen.depart]
    gap = min(later) - chosen.depart if later else 2.0 * _HALF_GAP
    depart = chosen.depart + min(0.5 * gap, _HALF_GAP)
    kept = {} if element is None else {k: v for k, v in element.attrib.items() if k.startswith(("depart", "arrival"))}
    vehicle = ET.Element("vehicle", {**kept, "id": name, "depart": f"{depart:.1f}"})
    vehicle.append(ET.Element("route", {"edges": " ".join(chosen.route)}))
    return vehicle


_HALF_GAP = 4.0
"""A vehicle is added at most so long after the one that it is beside (s)."""


def _own_type(files: SumoFiles, old: str, new: str, inputs: set[str]) -> ET.Element:
    """Return a copy of a vehicle type with placeholders."""
    found = next((e for t in _traffic_files(files) for e in definitions(t, "vType") if e.get("id") == old), None)
    kind = copy.deepcopy(found) if found is not None else ET.Element("vType")
    if found is None and old in _DEFAULT_CLASSES:
        kind.set("vClass", _DEFAULT_CLASSES[old])
    for name in ("probability", "scale"):
        kind.attrib.pop(name, None)
    kind.set("id", new)
    if "speed_factor" in inputs:
        kind.set("speedFactor", "${speed_factor}")
        kind.set("speedDev", "0")
    for name in inputs & {"tau", "decel"}:
        kind.set(name, f"${{{name}}}")
    kind.tail = None
    return kind


def _of_vehicle(traffic: Traffic, chosen: Observed, step: float) -> Iterator[Suggestion]:
    """Yield the inputs of the vehicle itself."""
    of_type = traffic.types[chosen.type]
    factor = of_type["speedFactor"]
    slowest = 0.8 * min(chosen.lane_speed * factor, of_type["maxSpeed"])
    yield Suggestion("depart_speed", round(0.2 * slowest, 1), round(slowest, 1), "m/s", "speed at which the ego enters")
    yield Suggestion(
        "speed_factor", round(0.8 * factor, 2), round(1.2 * factor, 2), "", "speed that the ego wants, by the allowed one"
    )
    low = max(0.5 * of_type["tau"], step)
    if low < 2.0 * of_type["tau"]:
        yield Suggestion("tau", low, 2.0 * of_type["tau"], "s", "time gap that the ego wants to the vehicle ahead")
    high = min(1.4 * of_type["decel"], of_type["emergencyDecel"])
    yield Suggestion("decel", round(0.6 * of_type["decel"], 2), round(high, 2), "m/s^2", "braking that the ego plans with")


def _crossing_flows(
    files: SumoFiles, traffic: Traffic, chosen: Observed
) -> Iterator[tuple[str, tuple[Template, str, Suggestion, str, str]]]:
    """Yield the busiest flows that come through a junction of the ego's way, each with its placeholder."""
    own = files.vehicle(chosen.id)
    junctions = {traffic.junctions[edge][1] for edge in chosen.route[:-1]}
    busy: dict[str, int] = {}
    for v in traffic.vehicles:
        name = v.id.rpartition(".")[0]
        if name and junctions & {traffic.junctions[edge][1] for edge in v.route[:-1]}:
            busy[name] = busy.get(name, 0) + 1
    taken = 0
    elements = {
        e.get("id", ""): (t, e) for t in _traffic_files(files) if t.path in (*files.routes, *files.additional)
        for e in definitions(t, "flow")
    }  # fmt: skip
    for name in sorted(busy, key=lambda n: -busy[n]):
        its_own = own is not None and own[0].tag == "flow" and chosen.id.startswith(f"{name}.")
        if name in elements and taken < _MOST_FLOWS and not its_own:
            template, element = elements[name]
            suggested = _flow_input(element, taken)
            if suggested is not None:
                taken += 1
                yield name, (template, name, *suggested)


def _flow_input(flow: ET.Element, number: int) -> tuple[Suggestion, str, str] | None:
    """Return the input that varies a flow by half, the attribute, and its new text; None where it is given otherwise."""
    name = flow.get("id", "")
    variable = f"flow_{number + 1}_{re.sub('[^A-Za-z0-9]+', '_', name)}".strip("_")
    units = {"vehsPerHour": "1/h", "perHour": "1/h", "probability": "1/s", "period": "s", "number": ""}
    for attribute, unit in units.items():
        text = flow.get(attribute)
        rate = re.fullmatch(r"exp\(([^()]+)\)", text or "") if attribute == "period" else None
        value = number_or_none(rate.group(1) if rate is not None else text)
        if value is None or value <= 0:
            continue
        low, high = 0.5 * value, 1.5 * value
        what = f"vehicles of the flow '{name}'"
        if attribute == "number":
            if value < 2:
                return None
            return Suggestion(variable, int(low), int(high), "", what, integer=True), attribute, f"${{{variable}}}"
        if rate is not None:
            return Suggestion(variable, low, high, "1/s", f"rate of the {what}"), attribute, f"exp(${{{variable}}})"
        if attribute == "probability":
            high = min(high, 1.0)
        what = f"time between two {what}" if attribute == "period" else f"rate of the {what}"
        return Suggestion(variable, float(f"{low:.3g}"), float(f"{high:.3g}"), unit, what), attribute, f"${{{variable}}}"
    return None
