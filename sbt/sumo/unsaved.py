"""What SUMO's saved states lack, of files, options and traffic: a run that begins with one is then not what goes on from there.

Measured with SUMO 1.28.0 and the options of `sbt.sumo.warming`: simulations that go on from a state are compared with ones that
never stopped. What goes on as it would (batteries, rerouting, taxis, stops, actuated lights) is in no list.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from sbt.plugins import kept
from sbt.sumo.demand import Piece, seconds_of, texts_of
from sbt.sumo.template import Template

__all__ = ["lost_by_option", "lost_in_file", "lost_in_traffic"]

_FORBIDDEN = {
    "load-state": "", "mesosim": "false", "threads": "1", "device.rerouting.threads": "0", "pedestrian.model": "striping",
}  # fmt: skip
"""Options with the one value that a snapshot takes; "": none."""
_TAKE_OVER = "SUMO cannot load a state of vehicles that have a device for taking over (toc)"
_BLUETOOTH = "SUMO cannot load a state of vehicles that have a device for Bluetooth"
_DEVICES = {
    "toc": _TAKE_OVER,
    "glosa": "a saved state does not hold the speed that a device for green lights (glosa) gives back: who is slow stays slow",
    "bluelight": "a saved state does not hold who makes way for a blue light (bluelight), and would do so for ever",
    "driverstate": "a saved state does not hold the errors of drivers (driverstate), and all would begin with none",
    "stationfinder": "SUMO cannot load every state of vehicles that look for charging stations (stationfinder)",
    "elechybrid": "a saved state does not hold the batteries of trolleybuses (elechybrid)",
    "btsender": _BLUETOOTH,
    "btreceiver": _BLUETOOTH,
}
"""Devices that go on otherwise, or not at all."""
_LIGHTS = re.compile(rb"<tlLogic\b[^>]*\stype\s*=\s*[\"'](?!(?:static|actuated)[\"'])([^\"']*)")
_IN_FILES: Mapping[bytes, str] = {
    b"parkingBadges": "a saved state does not hold the parking badges of vehicle types",
    b"has.toc.device": _TAKE_OVER,
    b"<neigh ": "SUMO cannot load a state in which somebody overtakes on an opposite lane, as the network allows (neigh)",
}
_RED = "a saved state does not hold since when lights are red: whoever may drive after red (jmDriveAfterRedTime) would at once"
_DELAY = "a saved state does not hold who has yet to start (startupDelay): a queue would start at once"
_CROSSING = "a saved state does not hold that level crossings are closed (rail_crossing), and '{}' may be a train"
_HOW_IT_WALKS = re.compile(rb"<(walk|personTrip)\b[^>]*\b(speed|duration)=")
_PARAMETER = re.compile(rb"<param\b[^>]*>")
_KEY = re.compile(rb"\bkey\s*=\s*[\"'](?:has\.(\w+)\.device|device\.(\w+)\.probability)[\"']")
_VALUE = re.compile(rb"\bvalue\s*=\s*[\"']([^\"']*)")
_NOBODY = re.compile(rb"\s*(?:false|no|off|f|x|-?[0.]+|-[\d.]+)?\s*", re.IGNORECASE)
"""A value that equips nobody."""
_RUNS_RED = re.compile(rb"\bjmDriveAfterRedTime\s*=\s*[\"'](?!-)")
_STARTS_LATE = re.compile(rb"\bstartupDelay\s*=\s*[\"'](?!0*\.?0*[\"'])")
_ON_RAILS = re.compile(rb"\bvClass\s*=\s*[\"'](?:rail|tram|subway)|[\"']DEFAULT_RAILTYPE[\"']")


def lost_by_option(name: str, value: str) -> str:
    """Return why no run of an option can begin with a saved state; "" where one can."""
    if name in _FORBIDDEN and value != _FORBIDDEN[name]:
        return f"runs with the option {name} {value} load their traffic"
    device, _, what = name.removeprefix("device.").partition(".") if name.startswith("device.") else ("", "", "")
    equips = (what == "probability" and not _NOBODY.fullmatch(value.encode())) or (what == "explicit" and value != "")
    if device in _DEVICES and equips:
        return f"{_DEVICES[device]}, as the option {name} has it"
    if name == "lanechange.duration" and seconds_of(value) != 0.0:
        return f"a saved state does not hold lane changes that take time (lanechange.duration {value})"
    return ""


@kept
def lost_in_file(file: Template) -> str:
    """Return what states lack of what is in a file, whoever drives there; "" where nothing of the kind is known."""
    with file.opened() as opened:
        text = opened.read()
    for word, why in _IN_FILES.items():
        if word in text:
            return why
    light = _LIGHTS.search(text)
    return f"a saved state does not hold what traffic lights of type {light[1].decode()} have done" if light else ""


@kept
def _has_crossing(file: Template) -> bool:
    with file.opened() as opened:
        return b'"rail_crossing"' in opened.read()


def lost_in_traffic(before: Iterable[Piece], definitions: Iterable[Piece], net: Template) -> str:
    """Return what states lack of traffic that begins before them, with its place; "" where nothing of the kind is known.

    Args:
        before: the traffic.
        definitions: types and routes, of which only what the traffic names is looked at.
        net: the network.
    """
    named: dict[str, list[Piece]] = {}
    for piece in definitions:
        for name in piece.defines:
            named.setdefault(name, []).append(piece)
    found = dict.fromkeys(before)
    following = list(found)
    while following:
        names = {name for piece in following for name in piece.names}
        following = [piece for name in sorted(names) for piece in named.pop(name, ())]
        found.update(dict.fromkeys(following))
    for piece, text in texts_of(found):
        if why := _lost_of(piece, text):
            return f"{piece.place}: {why}"
        if _ON_RAILS.search(text) and _has_crossing(net):
            return f"{piece.place}: {_CROSSING.format(piece.id)}"
    return ""


def _lost_of(piece: Piece, text: bytes) -> str:
    """Return what a state lacks of one element: over which edges it drives, with what, and what its driver remembers."""
    for parameter in _PARAMETER.findall(text):
        key, value = _KEY.search(parameter), _VALUE.search(parameter)
        device = (key[1] or key[2]).decode() if key else ""
        if device in _DEVICES and not (value and _NOBODY.fullmatch(value[1])):
            return _DEVICES[device]
    if _RUNS_RED.search(text):
        return _RED
    if _STARTS_LATE.search(text):
        return _DELAY
    if not piece.is_traffic:
        return ""
    flow, head = piece.tag.lower().endswith("flow"), text.partition(b">")[0]
    lost = (
        "via" if b" via=" in head else
        "parameters" if flow and b"<param" in text else
        "speed or duration of walks" if piece.tag == "personFlow" and _HOW_IT_WALKS.search(text) else ""
    )  # fmt: skip
    return f"a saved state does not hold the {lost} of '{piece.id}', which begins before t0" if lost else ""
