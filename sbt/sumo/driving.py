"""Drives one scene that SUMO holds: read every actor, record, look for the end, let the controllers act."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.metrics.geometry import contact_index
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.actors import KEEP, Action, Actor, Scene, State
from sbt.sumo.placing import mover
from sbt.sumo.session import ABSENT, direct

__all__ = ["Drive"]

_FASTEST = 1e4
_COLUMNS = 5
_SLACK = 1e-6
"""Rectangles so near to each other (m) are left to the exact test."""
_ROW = struct.Struct(f"={_COLUMNS}d")
"""x, y, heading, speed, acceleration: floats in a list would take four times the memory and the time to read them back"""


class Drive:
    """One run after its actors are on the road.

    Args:
        sumo: libsumo.
        scene: who drives, and when it is over.
        dt: SUMO's step (s).
        duration: longest time (s).
        prefix: what stands before the actors' names in SUMO.

    Attributes:
        advance: to be called after every step of SUMO: records, and lets the controllers act; True once the run is over.
        instants: returns how many states have been recorded.
    """

    def __init__(self, sumo: Any, scene: Scene, dt: float, duration: float, prefix: str = ""):
        self._scene, self._dt = scene, float(dt)
        self._last = round(duration / self._dt)
        self._rows = bytearray((self._last + 1) * len(scene.actors) * _ROW.size)
        self._heard: list[tuple[float, ...]] = []
        self._reported: list[str] = []
        self._ended = ""
        self.advance, self.instants = self._bound(sumo, prefix)

    def _bound(self, sumo: Any, prefix: str) -> tuple[Callable[[], bool], Callable[[], int]]:
        """Return `advance`, for which everything is bound beforehand because it runs at every step, and `instants`."""
        scene, rows, dt, heard, last = self._scene, self._rows, self._dt, self._heard, self._last
        states = [State(a.name, float(a.type.length), float(a.type.width), dt) for a in scene.actors]
        for actor, state in zip(scene.actors, states, strict=True):
            state.steered = None if actor.pose is None else float(actor.speed)
        by_name = {s.name: s for s in states}
        until, probes = scene.until, tuple(scene.signals.values())
        observe = _observer(sumo, scene.actors, states, dt, prefix, rows)
        control = _controls(sumo, scene.actors, states, dt, prefix)
        touching = _contact(states, [k for k, a in enumerate(scene.actors) if not a.person][1:], rows, dt)
        k = -1

        def advance() -> bool:
            nonlocal k
            k += 1
            t = k * dt
            observe(k)
            ended = "collision" if touching(k) else until(t, by_name) if until is not None else None
            if not ended:
                if k < last:
                    control(t)
                else:
                    ended = "duration"
            if probes:
                heard.append(tuple([float(probe()) for probe in probes]))
            if ended:
                self._ended = ended
                return True
            return False

        return advance, lambda: k + 1

    def heard_of(self, collider: str, victim: str) -> None:
        """Take down a collision that SUMO reports in the state that `advance` will read next."""
        self._reported.append(f"{collider}>{victim}@{self.instants() * self._dt:.3f}")

    def trace(self) -> Trace:
        """Return what was recorded, obstacles as actors that stand."""
        scene, actors = self._scene, self._scene.actors
        table = _table(self._rows, 0, self.instants(), len(actors)).copy()
        sizes = [(a.type.length, a.type.width) for a in actors]
        names = [a.name for a in actors]
        if scene.obstacles:
            standing = np.array([(*o.pose, 0.0, 0.0) for o in scene.obstacles])
            table = np.concatenate([table, np.broadcast_to(standing, (len(table), *standing.shape))], axis=1)
            sizes += [(o.length, o.width) for o in scene.obstacles]
            names += [o.name for o in scene.obstacles]
        x, y, heading, speed, acceleration = np.moveaxis(table, 2, 0)
        return Trace(
            np.arange(len(table), dtype=np.float64) * self._dt,
            tuple(names),
            x,
            y,
            heading,
            speed,
            acceleration,
            np.array([a for a, _ in sizes]),
            np.array([b for _, b in sizes]),
            self._ended,
            tuple(self._reported),
            {name: np.array([row[k] for row in self._heard]) for k, name in enumerate(scene.signals)},
        )


def _controls(sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str) -> Callable[[float], None]:
    """Return what asks every controller and passes its action on to SUMO."""
    set_speed = direct(sumo, "vehicle", "setSpeed")
    movers = {prefix + a.name: mover(sumo, a, prefix) for a in actors}
    driven = [
        (a, s, a.driver.act, tuple(o for o in states if o is not s), prefix + a.name)
        for a, s in zip(actors, states, strict=True)
        if a.driver is not None
    ]

    def put(own: State, name: str, action: Action, speed: float | None) -> None:
        if action.pose is None:
            raise RunError(Status.FAILED, f"{own.name} moves by pose, but its controller gave {action}")
        own.steered = own.speed if speed is None else float(speed)
        movers[name](action.pose)

    def control(t: float) -> None:
        for actor, own, act, others, name in driven:
            action = act(t, own, others)
            if action is KEEP:
                continue
            acceleration, speed, lane, pose = action
            if acceleration is not None:
                speed = _reached(own.speed, acceleration, speed, dt)
            if speed is not None:
                if not -_FASTEST < speed < _FASTEST:
                    raise RunError(Status.FAILED, f"the controller of {actor.name} must give finite numbers, but gave {action}")
                if not actor.person:
                    set_speed(name, float(speed))
            if lane is not None:
                _change_lane(sumo, actor, name, lane)
            if pose is not None or own.steered is not None:
                put(own, name, action, speed)

    return control


def _change_lane(sumo: Any, actor: Actor, name: str, lane: int) -> None:
    """Start the change to a lane; SUMO would say nothing where the edge has no such lane."""
    edge = sumo.vehicle.getRoadID(name)
    lanes = range(sumo.edge.getLaneNumber(edge)) if edge and not edge.startswith(":") else None  # of a junction's inside: any
    if lanes is not None and lane not in lanes:
        raise RunError(
            Status.FAILED, f"the controller of {actor.name} must give a lane of the edge, 0 to {len(lanes) - 1} on {edge}, "
            f"but gave {lane}",
        )  # fmt: skip
    sumo.vehicle.changeLane(name, int(lane), 3600.0)


def _reached(speed: float, acceleration: float, aim: float | None, dt: float) -> float:
    """Return the speed after a step of this acceleration, which ends at the aim."""
    reached = speed + acceleration * dt
    if aim is not None:
        reached = max(reached, aim) if acceleration < 0 else min(reached, aim)
    return 0.0 if reached < 0.0 else reached


def _observer(
    sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str, rows: bytearray
) -> Callable[[int], None]:
    """Return what reads every actor from SUMO and writes its x, y, heading, speed and acceleration as row k.

    SUMO's position is a vehicle's front bumper and a person's centre.
    """
    getters = {
        person: tuple(direct(sumo, "person" if person else "vehicle", name) for name in ("getPosition", "getAngle", "getSpeed"))
        for person in {a.person for a in actors}
    }
    watched = [
        (s, prefix + s.name, 0.0 if a.person else 0.5 * s.length, *getters[a.person]) for a, s in zip(actors, states, strict=True)
    ]
    rate, size, write = 1.0 / dt, _ROW.size, _ROW.pack_into

    def observe(k: int) -> None:
        at = k * len(watched) * size
        for state, name, half, position, angle_of, speed_of in watched:
            try:
                x, y = position(name)
            except Exception as error:  # of libsumo or of traci
                if "is not known" in str(error):
                    raise _gone(state, k * dt) from None
                raise
            if x == ABSENT:
                raise _gone(state, k * dt)
            angle = angle_of(name)
            if angle != state.angle:
                state.turn(angle)
            speed = speed_of(name) if state.steered is None else state.steered
            state.x = x = x - half * state.cos
            state.y = y = y - half * state.sin
            state.acceleration = acceleration = (speed - state.speed) * rate if k else 0.0
            state.speed = speed
            write(rows, at, x, y, state.heading, speed, acceleration)
            at += size

    return observe


def _gone(state: State, t: float) -> RunError:
    reason = f"{state.name} must stay on the road, but it was gone at t = {t:g} s (its route ended, or SUMO took it away)"
    return RunError(Status.FAILED, reason)


def _table(rows: bytearray, first: int, last: int, actors: int) -> np.ndarray:
    """Return the (last - first, m, 5) states of some instants, a view."""
    numbers = actors * _COLUMNS
    return np.frombuffer(rows, np.float64, (last - first) * numbers, first * numbers * 8).reshape(-1, actors, _COLUMNS)


def _contact(states: list[State], solid: list[int], rows: bytearray, dt: float) -> Callable[[int], bool]:
    """Return what says whether the first actor, the ego, touched another rectangle in the step to row k.

    Exact only when near: the others are too far away for it, however they are turned, or one side of ego's is between them.
    """
    ego, near = states[0], 2.0 * max(s.length for s in states)
    width, place = _ROW.size * len(states), struct.Struct("=2d").unpack_from
    others = [(s, j, _ROW.size * j) for j, s in ((j, states[j]) for j in solid)]
    length, breadth = 0.5 * ego.length + _SLACK, 0.5 * ego.width + _SLACK

    def touching(k: int) -> bool:
        x, y, speed = ego.x, ego.y, ego.speed
        for other, j, column in others:
            dx, dy, reach = other.x - x, other.y - y, near + (speed + other.speed) * dt
            if -reach < dx < reach and -reach < dy < reach:
                (x_0, y_0), (u_0, v_0) = place(rows, max(k - 1, 0) * width), place(rows, max(k - 1, 0) * width + column)
                cos, sin, dx_0, dy_0 = ego.cos, ego.sin, u_0 - x_0, v_0 - y_0
                turn_cos, turn_sin = abs(other.cos * cos + other.sin * sin), abs(other.sin * cos - other.cos * sin)
                along = length + 0.5 * (other.length * turn_cos + other.width * turn_sin)
                ahead, ahead_0 = dx * cos + dy * sin, dx_0 * cos + dy_0 * sin
                if (ahead > along and ahead_0 > along) or (ahead < -along and ahead_0 < -along):
                    continue
                across = breadth + 0.5 * (other.length * turn_sin + other.width * turn_cos)
                left, left_0 = dy * cos - dx * sin, dy_0 * cos - dx_0 * sin
                if (left > across and left_0 > across) or (left < -across and left_0 < -across):
                    continue
                step = _table(rows, max(k - 1, 0), k + 1, len(states))
                if contact_index(_track(step, 0, ego), _track(step, j, other)) is not None:
                    return True
        return False

    return touching


def _track(rows: np.ndarray, k: int, state: State) -> ActorTrace:
    """Return one actor's (t,) columns of (t, m, 5) rows."""
    x, y, heading, speed, acceleration = rows[:, k].T
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)
