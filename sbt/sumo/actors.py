"""Actors of a concrete scenario and the door for their controllers.

A controller is called once a step with the time, its own state and the other actors' states, and
returns an `Action`. States are rectangle centres in the network's plane (m, rad, m/s), the same as
in a `Trace`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from sbt.errors import InputError

__all__ = ["KEEP", "Action", "Actor", "Controller", "Obstacle", "Pose", "Scene", "State", "Until", "VehicleType"]

Pose = tuple[float, float, float]
"""x and y of the centre (m) and heading (rad)."""


class Action(NamedTuple):
    """What an actor does until the next step; None leaves it as commanded before.

    `acceleration` (m/s^2) over the step, or `speed` (m/s) at its end, or both: accelerate until that
    speed; `lane` starts a continuous change to that lane of the edge; `pose` (x, y, heading of the
    centre) puts the actor there, off the lanes too, `speed` with it says how fast it is.
    """

    acceleration: float | None = None
    speed: float | None = None
    lane: int | None = None
    pose: Pose | None = None


KEEP = Action()
"""Change nothing: SUMO holds the speed that was commanded last."""


class State:
    """State of one actor now; the object is updated in place, so copy what must be kept.

    Attributes:
        x, y: centre (m).
        heading: radians, counter-clockwise from +x; `cos` and `sin` are its direction.
        speed, acceleration: along the heading (m/s, m/s^2).
        length, width: of the rectangle (m).
        steered: the speed commanded with a pose (SUMO does not keep it), None for lane-bound actors.
        step: time until its controller is asked again (s).
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
        """Take over SUMO's angle (degrees clockwise from north)."""
        self.angle = angle
        self.heading = math.radians(90.0 - angle)
        self.cos, self.sin = math.cos(self.heading), math.sin(self.heading)


class Controller(Protocol):
    """Drives one actor through one run; may keep what it remembers."""

    def act(self, t: float, own: State, others: tuple[State, ...]) -> Action:
        """Return the action from `t` (s) to the next step."""
        ...


@dataclass(frozen=True)
class VehicleType:
    """A SUMO vehicle type: its rectangle, and any other vType attribute by SUMO's name.

    Raises:
        InputError: a length or width that is not positive.
    """

    length: float = 5.0
    width: float = 1.8
    attributes: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if not (self.length > 0 and self.width > 0):
            raise InputError(f"a vehicle needs length > 0 and width > 0, but got {self.length} m x {self.width} m")


@dataclass(frozen=True)
class Actor:
    """One vehicle or person and where it starts.

    Args:
        name: unique in the scene, also SUMO's id.
        route: edges, the first is where it starts.
        lane: index on that edge, 0 is the right one.
        position: of the front bumper on that lane (m).
        speed: at the start (m/s).
        driver: its controller; None lets SUMO's models drive it.
        type: its SUMO type.
        pose: where it starts instead, on or off the lanes; its controller then gives a pose at every
            step, and `lane` and `position` only say where SUMO lets it in.
        person: a SUMO person, round, `type.width` wide. With a pose its controller moves it; without one it
            walks along `route` at `speed` by SUMO's model, on the pavements and crossings of the network.
        lane_changes: SUMO changes its lanes (for its route, and safely) although a controller drives.

    Raises:
        InputError: numbers that are not finite, a pose without a controller, a controller of a person without one.
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
    """A rectangle that stands and hides what is behind it; shown in SUMO and in the trace, in nobody's way.

    Args:
        name: unique in the scene, also the id of SUMO's polygon.
        pose: of its centre.
        length, width: along and across its heading (m).
    """

    name: str
    pose: Pose
    length: float
    width: float

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """Four (x, y), counter-clockwise from the front left."""
        x, y, heading = map(float, self.pose)
        cos, sin, a, b = math.cos(heading), math.sin(heading), 0.5 * float(self.length), 0.5 * float(self.width)
        return tuple((x + u * cos - v * sin, y + u * sin + v * cos) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b)))


Until = Callable[[float, Mapping[str, State]], str | None]
"""Called every step; the word it returns ends the run and says why, None goes on."""


@dataclass(frozen=True)
class Scene:
    """One concrete scenario: who takes part, and when it is over (apart from collision and duration).

    Args:
        actors: the first one is the ego.
        until: ends the run.
        obstacles: what stands around.
        signals: name to a function that is read after every step's actions, into `Trace.signals`.
    """

    actors: tuple[Actor, ...]
    until: Until | None = None
    obstacles: tuple[Obstacle, ...] = ()
    signals: Mapping[str, Callable[[], float]] = field(default_factory=dict)
