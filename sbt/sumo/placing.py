"""Puts a scene into SUMO exactly as asked, and verifies that SUMO did."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor, Obstacle, Pose, Scene
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
    return f"type_{actor.type.length!r}_{actor.type.width!r}_{extra:x}"


def insert(sumo: Any, scene: Scene) -> None:
    """Ask SUMO to put every actor on the road in the next step, with its own checks off."""
    here = session()
    for actor in scene.actors:
        if actor.person:
            sumo.person.add(actor.name, actor.route[0], actor.position, typeID=type_name(actor))
            here.inserted(actor.name, "person")
            if actor.pose is None:
                sumo.person.appendWalkingStage(actor.name, list(actor.route), _END, speed=actor.speed)
            else:
                sumo.person.appendWaitingStage(actor.name, _FOREVER)
        else:
            sumo.vehicle.add(
                actor.name, here.route(actor.route), typeID=type_name(actor), depart="now",
                departLane=str(actor.lane), departPos=repr(actor.position), departSpeed=repr(actor.speed),
            )  # fmt: skip
            here.inserted(actor.name)
            if actor.driver is not None:
                sumo.vehicle.setSpeedMode(actor.name, 32)
                if not actor.lane_changes:
                    sumo.vehicle.setLaneChangeMode(actor.name, 0)
                sumo.vehicle.setSpeed(actor.name, actor.speed)  # until its driver says otherwise; SUMO would accelerate
        if actor.pose is not None:
            mover(sumo, actor)(actor.pose)
    for obstacle in scene.obstacles:
        _show(sumo, obstacle)


def mover(sumo: Any, actor: Actor) -> Callable[[Pose], None]:
    """Return what puts the centre of an actor on a pose, off the lanes too, in SUMO's next step.

    Raises:
        RunError: (the returned function) the pose is not finite.
    """
    name, half = actor.name, _front(actor)
    move = direct(sumo, "person" if actor.person else "vehicle", "moveToXY")
    lane = () if actor.person else (-1,)

    def place(pose: Pose) -> None:
        x, y, heading = pose
        front_x, front_y = x + half * math.cos(heading), y + half * math.sin(heading)
        if not (math.isfinite(front_x) and math.isfinite(front_y)):
            raise RunError(Status.FAILED, f"the controller of {name} must give finite numbers, but gave pose {pose}")
        move(name, "", *lane, front_x, front_y, (90.0 - math.degrees(heading)) % 360.0, _FREE)

    return place


def verify(sumo: Any, scene: Scene) -> None:
    """Compare what SUMO realised with what was asked for.

    Raises:
        RunError: an actor is not on the road, or not as asked.
    """
    for actor in scene.actors:
        domain = sumo.person if actor.person else sumo.vehicle
        if actor.person and actor.name not in domain.getIDList():
            raise RunError(Status.INVALID, f"{actor.name} must be there at the start, but SUMO did not insert it")
        position = domain.getPosition(actor.name) if actor.pose is not None else domain.getLanePosition(actor.name)
        if ABSENT in (position, position[0] if isinstance(position, tuple) else position):
            raise RunError(Status.INVALID, f"{actor.name} must be on the road at the start, but SUMO did not insert it")
        for what, (asked, got, unit) in _realised(domain, actor, position).items():
            if abs(asked - got) > _TOLERANCE:
                raise RunError(
                    Status.INVALID, f"{actor.name} must start with {what} {asked:.6g} {unit}, but SUMO gave {got:.6g} {unit}"
                )


def _realised(domain: Any, actor: Actor, position: Any) -> dict[str, tuple[float, float, str]]:
    """Return what was asked of an actor, what SUMO made of it, and the unit."""
    if actor.pose is not None:
        x, y, heading = actor.pose
        half = _front(actor)
        return {
            "x": (x + half * math.cos(heading), position[0], "m"),
            "y": (y + half * math.sin(heading), position[1], "m"),
        }
    if actor.person:  # SUMO chooses the pavement and lets it walk in the step that inserts it
        return {"position": (actor.position, position, "m")}
    return {
        "position": (actor.position, position, "m"),
        "speed": (actor.speed, domain.getSpeed(actor.name), "m/s"),
        "lane": (actor.lane, domain.getLaneIndex(actor.name), ""),
    }


def _front(actor: Actor) -> float:
    """Return how far ahead of the centre SUMO's position of the actor is: a vehicle's is its front bumper."""
    return 0.0 if actor.person else 0.5 * actor.type.length


def _show(sumo: Any, obstacle: Obstacle) -> None:
    """Draw an obstacle as a polygon."""
    sumo.polygon.add(obstacle.name, list(obstacle.corners), _COLOR, True, "obstacle")
    session().inserted(obstacle.name, "polygon")
