"""Inserts the actors of a scene into SUMO exactly as specified, and verifies the initial state."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import Actor, Pose, Scene
from sbt.sumo.formatting import format_number
from sbt.sumo.grip import limit_to_friction
from sbt.sumo.session import INVALID_DOUBLE, session, unwrapped

__all__ = ["LANE_REQUEST_DURATION", "SPEED_MODE", "insert", "pose_setter", "type_name", "verify"]

SPEED_MODE = 32
"""SUMO's speed mode in which commanded speeds are followed exactly. The modes that respect traffic lights do not fit
controllers: 24, 28 and 30 stop at a red light within one step (78 m/s^2), 31 also brakes for other vehicles."""
LANE_REQUEST_DURATION = 3600.0
"""How long SUMO keeps to a requested lane (s): longer than any run."""
_TOLERANCE = 1e-6
_KEEP_ROUTE = 2
"""keepRoute of moveToXY that keeps the pose exactly, on or off the lanes."""
_OBSTACLE_COLOR = (90, 90, 90, 255)
_WAITING_TIME = 1e6
"""Duration of the waiting stage of a person that its controller moves (s): longer than any run."""
_NOW = -3
"""SUMO's departure in the next step."""
_END_OF_EDGE = -1.0
"""Arrival position at the end of the last edge."""


def type_name(actor: Actor) -> str:
    """Return an id for the vehicle type of an actor that depends on its values only, and is the same in every run."""
    extra = zlib.crc32(repr(actor.type.attributes).encode()) if actor.type.attributes else 0
    return f"type_{format_number(actor.type.length)}_{format_number(actor.type.width)}_{extra:x}"


def insert(sumo: Any, scene: Scene, prefix: str = "") -> None:
    """Insert all actors in the next step, without SUMO's insertion checks.

    Args:
        sumo: libsumo.
        scene: what to insert.
        prefix: of names and edges: the replica of the network that the scene is inserted into.
    """
    registry = session()
    add, set_speed = unwrapped(sumo, "vehicle", "add"), unwrapped(sumo, "vehicle", "setSpeed")
    for actor in scene.actors:
        name, position, speed = prefix + actor.name, float(actor.position), float(actor.speed)
        if actor.person:
            unwrapped(sumo, "person", "add")(name, prefix + actor.route[0], position, _NOW, type_name(actor))
            registry.inserted(name, "person")
            if actor.pose is None:
                sumo.person.appendWalkingStage(name, [prefix + edge for edge in actor.route], _END_OF_EDGE, speed=speed)
            else:
                sumo.person.appendWaitingStage(name, _WAITING_TIME)
        else:
            route = registry.route(tuple([prefix + edge for edge in actor.route]))
            add(name, route, type_name(actor), "now", str(actor.lane), repr(position), repr(speed))
            registry.inserted(name)
            if not actor.lane_changes:
                sumo.vehicle.setLaneChangeMode(name, 0)
            if actor.driver is not None:
                sumo.vehicle.setSpeedMode(name, SPEED_MODE)
                set_speed(name, speed)  # SUMO would accelerate until the first command of the controller
            if scene.friction is not None and actor.pose is None:
                limit_to_friction(sumo, name, scene.friction)
        if actor.pose is not None:
            pose_setter(sumo, actor, prefix)(actor.pose)
    draw = unwrapped(sumo, "polygon", "add")
    for obstacle in scene.obstacles:
        draw(prefix + obstacle.name, list(obstacle.corners), _OBSTACLE_COLOR, True, "obstacle")
        registry.inserted(prefix + obstacle.name, "polygon")


def pose_setter(sumo: Any, actor: Actor, prefix: str = "") -> Callable[[Pose], None]:
    """Return a function that moves the centre of an actor to a pose, on or off the lanes, in SUMO's next step.

    Raises:
        RunError: (the returned function) the pose is not finite.
    """
    name, half = prefix + actor.name, _front_offset(actor)
    move = unwrapped(sumo, "person" if actor.person else "vehicle", "moveToXY")
    lane = () if actor.person else (-1,)

    def set_pose(pose: Pose) -> None:
        x, y, heading = map(float, pose)
        front_x, front_y = x + half * math.cos(heading), y + half * math.sin(heading)
        if not (math.isfinite(front_x) and math.isfinite(front_y)):
            raise RunError(Status.FAILED, f"the controller of {actor.name} must give finite numbers, but gave pose {pose}")
        move(name, "", *lane, front_x, front_y, (90.0 - math.degrees(heading)) % 360.0, _KEEP_ROUTE)

    return set_pose


def verify(sumo: Any, scene: Scene, prefix: str = "") -> None:
    """Compare the initial state in SUMO with the specified one.

    Raises:
        RunError: an actor is not on the road, or its state differs.
    """
    for actor in scene.actors:
        name, domain = prefix + actor.name, sumo.person if actor.person else sumo.vehicle
        if actor.person and name not in domain.getIDList():
            raise RunError(Status.INVALID, f"{actor.name} must be present at the start, but SUMO did not insert it")
        position = domain.getPosition(name) if actor.pose is not None else domain.getLanePosition(name)
        if INVALID_DOUBLE in (position, position[0] if isinstance(position, tuple) else position):
            raise RunError(Status.INVALID, f"{actor.name} must be on the road at the start, but SUMO did not insert it")
        for quantity, (expected, actual, unit) in _compared(domain, actor, name, position).items():
            if abs(expected - actual) > _TOLERANCE:
                raise RunError(
                    Status.INVALID,
                    f"{actor.name} must start with {quantity} {expected:.6g} {unit}, but SUMO gave {actual:.6g} {unit}",
                )


def _compared(domain: Any, actor: Actor, name: str, position: Any) -> dict[str, tuple[float, float, str]]:
    """Return the expected value, the value in SUMO and the unit of every quantity of an initial state."""
    if actor.pose is not None:
        x, y, heading = map(float, actor.pose)
        half = _front_offset(actor)
        return {
            "x": (x + half * math.cos(heading), position[0], "m"),
            "y": (y + half * math.sin(heading), position[1], "m"),
        }
    if actor.person:  # SUMO chooses the pavement, and the person walks already in the step of its insertion
        return {"position": (float(actor.position), position, "m")}
    return {
        "position": (float(actor.position), position, "m"),
        "speed": (float(actor.speed), domain.getSpeed(name), "m/s"),
        "lane": (actor.lane, domain.getLaneIndex(name), ""),
    }


def _front_offset(actor: Actor) -> float:
    """Return how far SUMO's reference position is ahead of the centre (m): it is the front bumper of a vehicle."""
    return 0.0 if actor.person else 0.5 * float(actor.type.length)
