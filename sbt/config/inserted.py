"""`insert` of a `scenario.yaml` to the route file that SUMO reads: every wrong name is told at its key."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path

from sbt.config.recorded import is_number
from sbt.config.scenario_model import InsertEntry, ScenarioModel
from sbt.config.source import Key, Problems
from sbt.errors import did_you_mean
from sbt.sumo.demand import seconds_of
from sbt.sumo.elements import elements
from sbt.sumo.files import SumoFiles
from sbt.sumo.inserting import InsertedVehicle, inserted_file
from sbt.sumo.nets import Roads, roads
from sbt.sumo.template import tried

__all__ = ["insertion_file"]

_TYPES = ("DEFAULT_VEHTYPE", "DEFAULT_BIKETYPE", "DEFAULT_TAXITYPE", "DEFAULT_RAILTYPE")
"""Vehicle types that SUMO knows by itself."""
_WORDS = {
    "position": ("random", "random_free", "random_location", "free", "base", "last", "stop", "splitFront"),
    "speed": ("random", "max", "desired", "speedLimit", "last", "avg"),
    "lane": ("random", "free", "allowed", "best", "best_prob", "first"),
    "at": ("triggered", "containerTriggered", "now", "begin", "split"),
}
"""What SUMO takes for a number of a vehicle's start."""
_SHOWN = 8
_STEP, _TOLERANCE = 0.1, 1e-6
"""Step where neither the scenario nor its files have one, and how near a time must be to a step (s)."""


def insertion_file(model: ScenarioModel, files: SumoFiles, problems: Problems) -> Path | None:
    """Return the route file of the vehicles that a scenario inserts; None without any.

    Args:
        model: the scenario.
        files: its own files, which the vehicles must fit.
        problems: what is wrong is added.
    """
    if not model.insert:
        return None
    net = roads(files.net)
    types = {one.attributes["id"] for one in elements(files) if one.tag in ("vType", "vTypeDistribution")}
    for name, entry in model.insert.items():
        path = ("insert", name)
        found = files.vehicle(name)
        if found is not None and (found[0].tag != "flow" or name not in found[1].vehicles):
            place = f"{found[1].path.name}:{found[0].place[0]}:{found[0].place[1]}"
            problems.add(path, f"an inserted vehicle must have an id of its own, but '{name}' is in {place} already", at_key=True)
        _check_names(entry, net, types, path, problems)
        _check_numbers(entry, path, problems)
        _check_time(entry.at, files, model.step_length, (*path, "at"), problems)
    vehicles = {name: _vehicle(name, entry, model, problems) for name, entry in model.insert.items()}
    places = {name: problems.source.located(("insert", name), "").rstrip(": ") for name in vehicles}
    return inserted_file(vehicles, places)


def _vehicle(name: str, entry: InsertEntry, model: ScenarioModel, problems: Problems) -> InsertedVehicle:
    """Return the vehicle of an entry, also where its keys contradict each other: its id and placeholders are there."""
    at = entry.at if entry.at is not None or model.warm_up is None else model.warm_up.end
    path = ("insert", name)
    if at is None:
        problems.add(path, "a vehicle must have a time: at (s), or warm_up: {until: SECONDS}")
    elif entry.to is not None and entry.route:
        problems.add(path, "a vehicle must have to or route, but got both")
    elif entry.route and entry.route[0] != entry.edge:
        rule = f"a route must begin with the edge on which the vehicle starts, '{entry.edge}'"
        problems.add((*path, "route"), f"{rule}, but begins with '{entry.route[0]}'")
    return InsertedVehicle(
        str(at), entry.edge, str(entry.lane), str(entry.position), str(entry.speed), entry.type or "",
        (entry.to,) if entry.to is not None else entry.route, known_route=entry.to is None,
    )  # fmt: skip


def _check_numbers(entry: InsertEntry, path: Key, problems: Problems) -> None:
    """Refuse what SUMO takes for no start in any run."""
    for key, words in _WORDS.items():
        value = getattr(entry, key)
        if value is None or value in words:
            continue
        time = seconds_of(tried(str(value))) if key == "at" else None
        number = float(tried(str(value))) if is_number(str(value)) else time
        if number is None or not math.isfinite(number):
            rule = f"{key} must be a number, a placeholder, or one of SUMO's words ({', '.join(words)})"
            problems.add((*path, key), f"{rule}, but got '{value}'")
        elif number < 0 and key != "position" and "${" not in str(value):
            problems.add((*path, key), f"{key} must be at least 0, but got {value}")


def _check_time(at: float | str | None, files: SumoFiles, step: float | None, path: Key, problems: Problems) -> None:
    """Refuse a time within a step: SUMO would insert the vehicle in a later one, at the place that is meant for this time."""
    begin = seconds_of(files.options.get("begin", "0"))
    time = seconds_of(str(at))
    step = step or files.step_length() or _STEP
    if time is None or begin is None or not math.isfinite(time):  # an input, or none
        return
    if abs(round((time - begin) / step) * step - (time - begin)) > _TOLERANCE:
        problems.add(path, f"a start must be whole steps of {step:g} s after {begin:g} s, but is {time:.10g} s")


def _check_names(entry: InsertEntry, net: Roads, types: Collection[str], path: Key, problems: Problems) -> None:
    """Compare the names of an entry with the network and the files; placeholders are known in a run only."""
    named: list[tuple[str, Key]] = [(entry.edge, (*path, "edge"))]
    named += [] if entry.to is None else [(entry.to, (*path, "to"))]
    named += [(edge, (*path, "route", k)) for k, edge in enumerate(entry.route) if edge != entry.edge]
    for edge, key in named:
        if edge not in net.lengths and "${" not in edge:
            rule = _one_of("an edge", net.lengths, "the network")
            problems.add(key, f"{rule}, but got '{edge}'{did_you_mean(edge, list(net.lengths))}")
    for k, pair in enumerate(zip(entry.route, entry.route[1:], strict=False)):
        if set(pair) <= net.lengths.keys() and pair not in net.connected:
            problems.add((*path, "route", k + 1), f"a route must be connected, but no lane of '{pair[0]}' leads to '{pair[1]}'")
    if entry.type is not None and entry.type not in (*types, *_TYPES) and "${" not in entry.type:
        rule = _one_of("a vehicle type", types, "the files")
        problems.add((*path, "type"), f"{rule}, but got '{entry.type}'{did_you_mean(entry.type, list(types))}")
    lanes = net.lengths.get(entry.edge)
    lane = int(entry.lane) if str(entry.lane).isdigit() else None
    if not lanes or lane is None:
        return
    if lane >= len(lanes):
        problems.add((*path, "lane"), f"a lane of '{entry.edge}' must be 0 to {len(lanes) - 1}, but got {lane}")
    elif not isinstance(entry.position, str) and abs(entry.position) > lanes[lane]:
        rule = f"a position on lane {lane} of '{entry.edge}' must be at most {lanes[lane]:g} m"
        problems.add((*path, "position"), f"{rule}, but got {entry.position:g} m")


def _one_of(what: str, known: Collection[str], where: str) -> str:
    shown = sorted(known)[:_SHOWN]
    names = ", ".join(shown) + (", ..." if len(known) > len(shown) else "") if shown else "none"
    return f"{what} must be one of {where} ({names})"
