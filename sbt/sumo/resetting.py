"""What SUMO keeps of a run when its actors are removed: where it is anything, the next run needs a simulation of its own.

Measured with SUMO 1.28.0: runs of one simulation, in any order, are compared bit by bit with runs that are loaded. Nothing is
left of simulated time (300,000 s), steps of action, lane changes under way, and who approached or waited at a junction.
"""

from __future__ import annotations

import re
import xml.parsers.expat
from collections.abc import Callable, Iterable
from functools import cache, wraps
from pathlib import Path
from typing import Any

from sbt.plugins import kept
from sbt.sumo.actors import Actor, VehicleType
from sbt.sumo.nets import opened

__all__ = ["changes_of", "why_fresh"]

_STATELESS = {
    "net", "location", "type", "restriction", "edge", "lane", "neigh", "stopOffset", "junction", "request", "connection",
    "roundabout", "param",
}  # fmt: skip
"""Elements of a network that have no state; all others may have one (lights, detectors, rerouters, stops)."""
_STATELESS_JUNCTIONS = {"priority", "priority_stop", "unregulated", "zipper", "dead_end", "internal"}
_DRAWING_JUNCTIONS = {"right_before_left", "left_before_right", "allway_stop"}
"""At which SUMO draws who goes first where vehicles wait for each other."""
_OPTION = re.compile(r"-[^\d.]")
_STATELESS_OPTIONS = re.compile(
    r"--(lateral-resolution|default\.action-step-length|time-to-impatience|ignore-junction-blocker|precision"
    r"|collision\..+|emergencydecel\..+|pedestrian\..+|[a-z-]+-output(\..+)?)"
)
_MODELS = {"Krauss", "KraussOrig1", "KraussPS", "IDM", "IDMM", "ACC", "CACC", "Daniel1"}
"""Car-following models that draw nothing by themselves."""
_DRAWING = {
    "sigma", "speedDev", "lcSigma", "lcOvertakeRight", "jmIgnoreFoeProb", "jmIgnoreJunctionFoeProb", "jmSigmaMinor",
}  # fmt: skip
"""Attributes of vehicle types with which SUMO draws random numbers unless they are 0."""
_ZERO = re.compile(r"\s*0*\.?0*\s*")
_CHANGES = re.compile("set|adapt|add|copy|swap|remove|update|override|load|clear")
_INSERTS = re.compile("add(Full|Legacy)?$")
"""Of vehicles and persons: what else is done to them ends with them."""


def why_fresh(net: str, options: tuple[str, ...], actors: Iterable[Actor]) -> str:
    """Return why a run in a simulation in which others ran may be another one than after a load; "" where it is the same.

    Args:
        net: network file.
        options: of SUMO, beside those of this package.
        actors: those of the run.
    """
    state, drawing = _state_of(net)
    for option in options:
        name = option.partition("=")[0]
        if _OPTION.match(name) and not _STATELESS_OPTIONS.fullmatch(name):
            return f"SUMO's option {name} may keep something from run to run"
    return state or next(filter(None, (_drawn(actor, drawing) for actor in actors)), "")


@kept
def _state_of(net: str) -> tuple[str, str]:
    """Return why a network has a state of its own, and why SUMO draws random numbers for those it drives there; "" for no."""
    states: list[str] = []
    draws: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag not in _STATELESS:
            states.append(f"the network has <{tag}>, whose state goes on from run to run")
        elif tag == "junction" and (kind := attributes.get("type", "")) not in _STATELESS_JUNCTIONS:
            at = f"the network has a junction '{attributes.get('id', '')}' of type {kind}"
            if kind in _DRAWING_JUNCTIONS:
                draws.append(f"{at}, at which SUMO draws who goes first")
            else:
                states.append(f"{at}, whose state goes on from run to run")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    with opened(Path(net)) as file:
        parser.ParseFile(file)
    return next(iter(states), ""), next(iter(draws), "")


def _drawn(actor: Actor, drawing: str) -> str:
    """Return why SUMO draws random numbers for an actor; "" where it draws none that change what the actor does."""
    if actor.person:
        return f"SUMO draws random numbers for '{actor.name}', who walks" if actor.pose is None else ""
    if actor.driver is not None and not actor.lane_changes:
        return ""
    attribute = _drawing_attribute(actor.type)
    if attribute:
        return f"SUMO draws random numbers for '{actor.name}' with {attribute}"
    return drawing if actor.driver is None else ""


def _drawing_attribute(kind: VehicleType) -> str:
    """Return the attribute of a vehicle type for which SUMO draws random numbers; "" where there is none."""
    draws = (
        f"{name} {value}" for name, value in kind.attributes
        if (name == "carFollowModel" and value not in _MODELS) or (name in _DRAWING and not _ZERO.fullmatch(value))
    )  # fmt: skip
    return next(draws, "")


@cache
def changes_of(sumo: Any) -> list[str]:
    """Return a list to which libsumo adds the name of every function by which code changes more than its own actors.

    Args:
        sumo: the module; what this package calls to insert and remove its own (`unwrapped`) adds nothing.
    """
    changes: list[str] = []
    for functions in sumo.DOMAINS:
        changing = _INSERTS if functions in (sumo.vehicle, sumo.person) else _CHANGES
        for name in filter(changing.match, list(vars(functions))):
            noting = _noting(getattr(functions, name), f"{functions.__name__}.{name}", changes)
            setattr(functions, name, staticmethod(noting))
    return changes


def _noting(function: Callable[..., Any], name: str, changes: list[str]) -> Callable[..., Any]:
    @wraps(function)
    def noting(*args: Any, **kwargs: Any) -> Any:
        changes.append(name)
        return function(*args, **kwargs)

    return noting
