"""Actors of a concrete scenario and the interface of their controllers.

A controller is called once per step with the time, its own state and the states of the other actors, and
returns an `Action`. States refer to the centre of an actor's rectangle in the coordinates of the network
(m, rad, m/s), as in a `Trace`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from sbt.errors import InputError
from sbt.problem.trace import FieldOfView

__all__ = [
    "KEEP", "Action", "Actor", "Controller", "EndCondition", "Obstacle", "Pose", "Scene", "State", "VehicleType", "view_of",
]  # fmt: skip

Pose = tuple[float, float, float]
"""x and y of the centre (m) and heading (rad)."""


class Action(NamedTuple):
    """Command of a controller until the next step; None leaves a quantity as commanded before.

    Attributes:
        acceleration: over the step (m/s^2); together with `speed`, until that speed is reached: braking below
            it goes on, and whoever is faster does not accelerate.
        speed: at the end of the step (m/s); together with `pose`, the speed to record.
        lane: index on the current edge; starts a continuous lane change.
        pose: x, y (m) and heading (rad) of the centre at the end of the step, on or off the lanes.
    """

    acceleration: float | None = None
    speed: float | None = None
    lane: int | None = None
    pose: Pose | None = None


KEEP = Action()
"""Changes nothing: SUMO keeps the speed that was commanded last."""


class State:
    """Current state of one actor; updated in place, so a controller must copy what it wants to remember.

    Attributes:
        x, y: centre (m).
        heading: radians, counter-clockwise from +x.
        cos, sin: of the heading.
        angle: heading as SUMO gives it (degrees, clockwise from north).
        speed, acceleration: along the heading (m/s, m/s^2).
        length, width: of the rectangle (m).
        steered: speed commanded together with a pose, which SUMO does not report; None for lane-bound actors.
        step: time until the controller is called again (s).
    """

    __slots__ = (
        "acceleration", "angle", "cos", "heading", "length", "name", "sin", "speed", "steered", "step", "width", "x", "y",
    )  # fmt: skip

    def __init__(self, name: str, length: float, width: float, step: float = 0.05):
        self.name = name
        self.step = step
        self.length = length
        self.width = width
        self.x = self.y = self.heading = self.speed = self.acceleration = 0.0
        self.cos, self.sin = 1.0, 0.0
        self.angle = 90.0
        self.steered: float | None = None

    def turn(self, angle: float) -> None:
        """Set the heading from SUMO's angle (degrees, clockwise from north)."""
        self.angle = angle
        self.heading = math.radians(90.0 - angle)
        self.cos, self.sin = math.cos(self.heading), math.sin(self.heading)


class Controller(Protocol):
    """Controls one actor during one run; may have internal state.

    With a method `field_of_view(length, width)` of the size of its vehicle (m), which returns the `FieldOfView` of its sensor,
    films show what it can see.
    """

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the action from time `t` (s) until the next step."""
        ...


def view_of(driver: object, length: float, width: float) -> FieldOfView | None:
    """Return where the sensor of a controller in a vehicle of this size (m) sees something; None where it does not tell."""
    tell = getattr(driver, "field_of_view", None)
    found = tell(length, width) if callable(tell) else None
    return found if isinstance(found, FieldOfView) else None


@dataclass(frozen=True)
class VehicleType:
    """A SUMO vehicle type.

    Args:
        length: of the rectangle (m).
        width: of the rectangle (m).
        attributes: other vType attributes, (SUMO's name, value) pairs.

    Raises:
        InputError: a length or width is not positive.
    """

    length: float = 5.0
    width: float = 1.8
    attributes: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if not (self.length > 0 and self.width > 0):
            raise InputError(f"a vehicle needs length > 0 and width > 0, but got {self.length} m x {self.width} m")


@dataclass(frozen=True)
class Actor:
    """One vehicle or person and its initial state.

    Args:
        name: unique in the scene, also its id in SUMO.
        route: edges; the actor starts on the first one.
        lane: index on that edge, 0 is the rightmost one.
        position: of the front bumper on that lane (m).
        speed: at the start (m/s).
        driver: its controller; None: SUMO's own models drive it.
        type: its vehicle type.
        pose: initial x, y (m) and heading (rad) of the centre, on or off the lanes. The controller must then
            return a pose at every step; `lane` and `position` only tell SUMO where to insert the actor.
        person: a SUMO person, a circle of diameter `type.width`. With a pose its controller moves it; without
            one it walks along `route` at `speed` by SUMO's pedestrian model, on pavements and crossings.
        lane_changes: let SUMO's lane-change model change lanes, also where a controller sets the speed; otherwise the actor
            stays in its lane, except where its controller asks for another.

    Raises:
        InputError: a number is not finite, a pose is given without a controller, or a person has a
            controller but no pose.
    """

    name: str
    route: tuple[str, ...]
    lane: int
    position: float
    speed: float
    driver: Controller | None = None
    type: VehicleType = field(default_factory=VehicleType)
    pose: Pose | None = None
    person: bool = False
    lane_changes: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.position) and math.isfinite(self.speed) and self.speed >= 0):
            raise InputError(
                f"actor {self.name}: position must be finite and speed >= 0, but got {self.position} m, {self.speed} m/s"
            )
        if self.pose is not None and not all(math.isfinite(v) for v in self.pose):
            raise InputError(f"actor {self.name}: a pose must be finite, but got {self.pose}")
        if self.person and self.pose is None and self.driver is not None:
            raise InputError(f"actor {self.name}: a person with a controller must have a pose, but got none")
        if self.pose is not None and self.driver is None:
            raise InputError(f"actor {self.name}: a pose needs a controller that goes on from it, but SUMO would drive")


@dataclass(frozen=True)
class Obstacle:
    """A static rectangle that blocks the line of sight; part of the trace, but never collided with.

    Args:
        name: unique in the scene, also the id of the polygon in SUMO.
        pose: of its centre.
        length, width: along and across its heading (m).
        solid: it is something to drive into; else it is driven over, and metrics do not see it.
    """

    name: str
    pose: Pose
    length: float
    width: float
    solid: bool = True

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """The four corners (x, y) in m, counter-clockwise from the front left."""
        x, y, heading = map(float, self.pose)
        cos, sin, a, b = math.cos(heading), math.sin(heading), 0.5 * float(self.length), 0.5 * float(self.width)
        return tuple((x + u * cos - v * sin, y + u * sin + v * cos) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b)))


EndCondition = Callable[[float, Mapping[str, State]], str | None]
"""Called every step with the time (s) and the states by name; returns why the run ends, or None to go on."""


@dataclass(frozen=True)
class Scene:
    """A concrete scenario: its actors and the end of the run (besides a collision and the duration).

    Args:
        actors: the first one is the ego.
        until: end condition of the run; None: only collision and duration.
        obstacles: static rectangles.
        signals: name to a function that is sampled after the actions of every step, recorded in `Trace.signals`.
        friction: coefficient of the road, which bounds accelerations of vehicles on lanes by mu g; None: no bound.
    """

    actors: tuple[Actor, ...]
    until: EndCondition | None = None
    obstacles: tuple[Obstacle, ...] = ()
    signals: Mapping[str, Callable[[], float]] = field(default_factory=dict)
    friction: float | None = None
