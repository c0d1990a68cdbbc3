"""Puts a scene into SUMO exactly as asked, and verifies that SUMO did."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor, Pose, Scene
from sbt.sumo.formatting import format_number
from sbt.sumo.session import ABSENT, direct, session

__all__ = ["insert", "mover", "type_name", "verify"]

_TOLERANCE = 1e-6
_FREE = 2
"""keepRoute of moveToXY that keeps a pose to the last bit, off the lanes too."""
_COLOR = (90, 90, 90, 255)
_FOREVER = 1e6
_END = -1.0
"""Position that is the end of the last edge."""


def type_name(actor: Actor) -> str:
    """Return an id for the actor's type that is the same in every run."""
    extra = zlib.crc32(repr(actor.type.attributes).encode()) if actor.type.attributes else 0
    return f"type_{format_number(actor.type.length)}_{format_number(actor.type.width)}_{extra:x}"


def insert(sumo: Any, scene: Scene, prefix: str = "") -> None:
    """Ask SUMO to put every actor on the road in the next step, with its own checks off.

    Args:
        sumo: libsumo.
        scene: what to insert.
        prefix: of the network's copy that it goes to; of names and edges.
    """
    here = session()
    add, set_speed = direct(sumo, "vehicle", "add"), direct(sumo, "vehicle", "setSpeed")
    for actor in scene.actors:
        name, position, speed = prefix + actor.name, float(actor.position), float(actor.speed)
        if actor.person:
            sumo.person.add(name, prefix + actor.route[0], position, typeID=type_name(actor))
            here.inserted(name, "person")
            if actor.pose is None:
                sumo.person.appendWalkingStage(name, [prefix + edge for edge in actor.route], _END, speed=speed)
            else:
                sumo.person.appendWaitingStage(name, _FOREVER)
        else:
            route = here.route(tuple([prefix + edge for edge in actor.route]))
            add(name, route, type_name(actor), "now", str(actor.lane), repr(position), repr(speed))
            here.inserted(name)
            if actor.driver is not None:
                sumo.vehicle.setSpeedMode(name, 32)
                if not actor.lane_changes:
                    sumo.vehicle.setLaneChangeMode(name, 0)
                set_speed(name, speed)  # until its driver says otherwise; SUMO would accelerate
        if actor.pose is not None:
            mover(sumo, actor, prefix)(actor.pose)
    for obstacle in scene.obstacles:
        sumo.polygon.add(prefix + obstacle.name, list(obstacle.corners), _COLOR, True, "obstacle")
        here.inserted(prefix + obstacle.name, "polygon")


def mover(sumo: Any, actor: Actor, prefix: str = "") -> Callable[[Pose], None]:
    """Return what puts the centre of an actor on a pose, off the lanes too, in SUMO's next step.

    Raises:
        RunError: (the returned function) the pose is not finite.
    """
    name, half = prefix + actor.name, _front(actor)
    move = direct(sumo, "person" if actor.person else "vehicle", "moveToXY")
    lane = () if actor.person else (-1,)

    def place(pose: Pose) -> None:
        x, y, heading = map(float, pose)
        front_x, front_y = x + half * math.cos(heading), y + half * math.sin(heading)
        if not (math.isfinite(front_x) and math.isfinite(front_y)):
            raise RunError(Status.FAILED, f"the controller of {actor.name} must give finite numbers, but gave pose {pose}")
        move(name, "", *lane, front_x, front_y, (90.0 - math.degrees(heading)) % 360.0, _FREE)

    return place


def verify(sumo: Any, scene: Scene, prefix: str = "") -> None:
    """Compare what SUMO realised with what was asked for.

    Raises:
        RunError: an actor is not on the road, or not as asked.
    """
    for actor in scene.actors:
        name, domain = prefix + actor.name, sumo.person if actor.person else sumo.vehicle
        if actor.person and name not in domain.getIDList():
            raise RunError(Status.INVALID, f"{actor.name} must be there at the start, but SUMO did not insert it")
        position = domain.getPosition(name) if actor.pose is not None else domain.getLanePosition(name)
        if ABSENT in (position, position[0] if isinstance(position, tuple) else position):
            raise RunError(Status.INVALID, f"{actor.name} must be on the road at the start, but SUMO did not insert it")
        for what, (asked, got, unit) in _realised(domain, actor, name, position).items():
            if abs(asked - got) > _TOLERANCE:
                raise RunError(
                    Status.INVALID, f"{actor.name} must start with {what} {asked:.6g} {unit}, but SUMO gave {got:.6g} {unit}"
                )


def _realised(domain: Any, actor: Actor, name: str, position: Any) -> dict[str, tuple[float, float, str]]:
    """Return what was asked of an actor, what SUMO made of it, and the unit."""
    if actor.pose is not None:
        x, y, heading = map(float, actor.pose)
        half = _front(actor)
        return {
            "x": (x + half * math.cos(heading), position[0], "m"),
            "y": (y + half * math.sin(heading), position[1], "m"),
        }
    if actor.person:  # SUMO chooses the pavement and lets it walk in the step that inserts it
        return {"position": (float(actor.position), position, "m")}
    return {
        "position": (float(actor.position), position, "m"),
        "speed": (float(actor.speed), domain.getSpeed(name), "m/s"),
        "lane": (actor.lane, domain.getLaneIndex(name), ""),
    }


def _front(actor: Actor) -> float:
    """Return how far ahead of the centre SUMO's position of the actor is: a vehicle's is its front bumper."""
    return 0.0 if actor.person else 0.5 * float(actor.type.length)
