"""One run whose actors are in SUMO: reads and records their states, detects the end, and calls the controllers."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.metrics.geometry import contact_part
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace, Trace
from sbt.sumo.actors import KEEP, Action, Actor, Controller, Obstacle, Scene, State, view_of
from sbt.sumo.appearances import refuse_overlap_at_start
from sbt.sumo.contacts import CONFIRMED_WITHIN, collisions_of, unconfirmed_contact
from sbt.sumo.dead_ends import refuse_dead_ends
from sbt.sumo.dynamics import MAX_SPEED, next_speed
from sbt.sumo.insertion import LANE_REQUEST_DURATION, pose_setter
from sbt.sumo.overlaps import instant
from sbt.sumo.reading import ROW, Onlooker, observer, table
from sbt.sumo.scene_bodies import SceneBodies, may_meet
from sbt.sumo.scene_levels import SceneLevels
from sbt.sumo.scene_ways import SceneWays
from sbt.sumo.session import is_ballistic, unwrapped

__all__ = ["SumoRun"]

_SLACK = 1e-6
"""Below this distance (m) of two rectangles the quick separation tests do not decide, but the exact one."""
_Act = Callable[[float, State, tuple[State, ...]], Action]
_START_REMEDY = "change where the actors start, or keep the inputs apart by constraints"


class SumoRun:
    """One run after its actors have been inserted.

    Args:
        sumo: libsumo.
        scene: the actors and the end condition.
        dt: SUMO's step (s).
        duration: longest simulated time (s).
        prefix: of the names of the actors in SUMO.
        one_level: whether no road of the network is on another level than another one; None: to be found out.

    Attributes:
        advance: to be called after every step of SUMO: records the states and calls the controllers; returns
            True once the run is over. In the first step it checks that the ego is clear of all others.
        recorded: returns the number of recorded instants.
    """

    def __init__(self, sumo: Any, scene: Scene, dt: float, duration: float, prefix: str = "", *, one_level: bool | None = None):
        self._scene, self._dt = scene, float(dt)
        self._last = round(duration / self._dt)
        self._rows = bytearray((self._last + 1) * len(scene.actors) * ROW.size)
        self._signals: list[tuple[float, ...]] = []
        self._collisions: list[str] = []
        self._listed: dict[frozenset[str], float] = {}
        self._unconfirmed: tuple[str, ...] = ()
        self._onlooker: Onlooker | None = None
        self._ended = ""
        self._sumo, self._prefix = sumo, prefix
        self._levels = None if one_level else SceneLevels.of(sumo, scene.actors)
        self._bodies = SceneBodies.of(sumo, scene.actors, self._dt, prefix)
        self.advance, self.recorded = self._functions(sumo, prefix)

    def _functions(self, sumo: Any, prefix: str) -> tuple[Callable[[], bool], Callable[[], int]]:
        """Return `advance` and `recorded`, as closures over local variables because they run at every step."""
        scene, rows, dt, signals, last = self._scene, self._rows, self._dt, self._signals, self._last
        states = [State(a.name, float(a.type.length), float(a.type.width), dt) for a in scene.actors]
        for actor, state in zip(scene.actors, states, strict=True):
            state.steered = None if actor.pose is None else float(actor.speed)
        self._ways = SceneWays(sumo, scene.actors, states, prefix, self._bodies)
        until, probes = scene.until, tuple(scene.signals.values())
        control = _control(sumo, scene.actors, states, dt, prefix, self._levels)
        touching = _contact_test(states, rows, dt, self._bodies, self._levels)
        watch = None if self._bodies is None and self._levels is None else self._watch
        solid = [k for k, a in enumerate(scene.actors) if not a.person][1:]
        by_name: Mapping[str, State]
        if probes or any(a.driver is not None for a in scene.actors):  # they look at states
            by_name, look = {s.name: s for s in states}, None
            observe = observer(sumo, scene.actors, states, dt, prefix, rows)
        else:
            self._onlooker = by_name = look = Onlooker(sumo, scene.actors, states, dt, prefix, rows)
            observe = look.observe
        k = -1

        def advance() -> bool:
            nonlocal k
            k += 1
            t = k * dt
            observe(k)
            if watch is not None:
                watch(t, by_name)
            if k == 0:
                for state in states:
                    by_name[state.name]
                self._check_start(states)
            touched = touching(k, solid if look is None else look.near(k))
            if touched is not None:
                self._judge(sumo, prefix, t, touched)
            ended = "collision" if touched is not None else until(t, by_name) if until is not None else None
            if not ended:
                if k < last:
                    control(t)
                else:
                    ended = "duration"
            if probes:
                signals.append(tuple([float(probe()) for probe in probes]))
            if ended:
                self._ended = ended
                return True
            return False

        return advance, lambda: k + 1

    def _watch(self, t: float, states: Mapping[str, State]) -> None:
        """Note the long bodies and the levels of a step."""
        if self._bodies is not None:
            self._bodies.move(states)
        if self._levels is not None:
            self._levels.look(t, states)
            if gone := self._levels.gone:
                poses = np.array([(s.x, s.y, s.heading) for s in (states[a.name] for a in self._scene.actors)])
                self._ways.keep(gone, poses, np.full(len(poses), MAX_SPEED))

    def _check_start(self, states: list[State]) -> None:
        """Check that the ego starts clear of all on its level, and of all obstacles."""
        levels, bodies, others = self._levels, self._bodies, list(range(1, len(states)))
        there = [states[j] for j in (0, *(others if levels is None else levels.on_its(0, others)))]
        there += [_standing(obstacle) for obstacle in self._scene.obstacles if obstacle.solid]
        found = {s.name: instant(s) if bodies is None else bodies.bent(s.name, instant(s), 0) for s in there}
        own = found.pop(states[0].name)
        refuse_overlap_at_start(states[0].name, own, found, _START_REMEDY)

    def record_collision(self, collider: str, victim: str) -> None:
        """Record a collision that SUMO reports for the state that `advance` will read next."""
        t = self.recorded() * self._dt
        self._collisions.append(f"{collider}>{victim}@{t:.3f}")
        self._listed[frozenset((collider, victim))] = t

    def _judge(self, sumo: Any, prefix: str, t: float, touched: _Touch) -> None:
        """Tell what differs where SUMO does not list the contact of the ego, with which the run ends."""
        name, *rectangles = touched
        ego, moved = self._scene.actors[0].name, [a.name for a in self._scene.actors if a.pose is not None]
        listed = t - self._listed.get(frozenset((ego, name)), -np.inf) <= CONFIRMED_WITHIN
        if not listed and prefix + name not in collisions_of(sumo, prefix + ego):
            both = (rectangles[0], rectangles[1])
            self._unconfirmed = (unconfirmed_contact(sumo, ego, name, t, both, moved=moved, prefix=prefix),)

    def trace(self) -> Trace:
        """Return the recorded trace, with the obstacles as standing actors.

        Raises:
            RunError: SUMO stopped a vehicle dead where its lane does not go on.
        """
        scene, actors = self._scene, self._scene.actors
        seen = self._onlooker
        states = table(self._rows, 0, self.recorded(), len(actors)).copy() if seen is None else seen.table()
        sizes = [(a.type.length, a.type.width) for a in actors]
        names = [a.name for a in actors]
        there = range(len(actors)) if self._levels is None else self._levels.on_its(0, range(len(actors)))
        self._ways.keep(there, states[-1, :, :3], states[:, :, 3].max(axis=0))
        if scene.obstacles:
            standing = np.array([(*o.pose, 0.0, 0.0) for o in scene.obstacles])
            states = np.concatenate([states, np.broadcast_to(standing, (len(states), *standing.shape))], axis=1)
            sizes += [(o.length, o.width) for o in scene.obstacles]
            names += [o.name for o in scene.obstacles]
        refuse_dead_ends(self._sumo, actors, states[:, : len(actors), 3], self._dt, self._prefix)
        if self._levels is not None:
            for k, hidden in enumerate(self._levels.hidden):
                states[k, list(hidden)] = np.nan
        of_each = {a.name: states[:, k] for k, a in enumerate(actors)}
        x, y, heading, speed, acceleration = np.moveaxis(states, 2, 0)
        return Trace(
            np.arange(len(states), dtype=np.float64) * self._dt,
            tuple(names),
            x,
            y,
            heading,
            speed,
            acceleration,
            np.array([a for a, _ in sizes]),
            np.array([b for _, b in sizes]),
            self._ended,
            tuple(self._collisions),
            {name: np.array([row[k] for row in self._signals]) for k, name in enumerate(scene.signals)},
            ways=self._ways.whole,
            parts={} if self._bodies is None else self._bodies.parts(of_each, self._ways.parts),
            unconfirmed=(*self._unconfirmed, *(() if self._levels is None else self._levels.notes)),
            ballistic=is_ballistic(self._sumo),
            flat=tuple(o.name for o in scene.obstacles if not o.solid),
            view=view_of(actors[0].driver, float(actors[0].type.length), float(actors[0].type.width)),
        )


def _standing(obstacle: Obstacle) -> State:
    """Return an obstacle as a standing road user."""
    state = State(obstacle.name, float(obstacle.length), float(obstacle.width))
    state.x, state.y, state.heading = map(float, obstacle.pose)
    state.cos, state.sin = math.cos(state.heading), math.sin(state.heading)
    return state


def _control(
    sumo: Any, actors: tuple[Actor, ...], states: list[State], dt: float, prefix: str, levels: SceneLevels | None
) -> Callable[[float], None]:
    """Return the function that calls every controller, with those on its level, and passes its action on to SUMO."""
    set_speed = unwrapped(sumo, "vehicle", "setSpeed")
    pose_setters = {prefix + a.name: pose_setter(sumo, a, prefix) for a in actors}
    driven = [
        (a, s, _acting(a.driver, k, states, levels), tuple(o for o in states if o is not s), prefix + a.name)
        for k, (a, s) in enumerate(zip(actors, states, strict=True))
        if a.driver is not None
    ]

    def apply_pose(own: State, name: str, action: Action, speed: float | None) -> None:
        if action.pose is None:
            raise RunError(Status.FAILED, f"{own.name} moves by pose, but its controller gave {action}")
        own.steered = own.speed if speed is None else float(speed)
        pose_setters[name](action.pose)

    def control(t: float) -> None:
        for actor, own, act, others, name in driven:
            action = act(t, own, others)
            if action is KEEP:
                continue
            acceleration, speed, lane, pose = action
            if acceleration is not None:
                speed = next_speed(own.speed, acceleration, speed, dt)
            if speed is not None:
                if not -MAX_SPEED < speed < MAX_SPEED:
                    raise RunError(Status.FAILED, f"the controller of {actor.name} must give finite numbers, but gave {action}")
                if not actor.person:
                    set_speed(name, float(speed))
            if lane is not None:
                _change_lane(sumo, actor, name, lane)
            if pose is not None or own.steered is not None:
                apply_pose(own, name, action, speed)

    return control


def _acting(driver: Controller, k: int, states: list[State], levels: SceneLevels | None) -> _Act:
    """Return what the controller of actor k does, which sees nobody on another level."""
    if levels is None:
        return driver.act
    return lambda t, own, others: driver.act(t, own, tuple(states[j] for j in levels.on_its(k, range(len(states))) if j != k))


def _change_lane(sumo: Any, actor: Actor, name: str, lane: int) -> None:
    """Start a lane change; SUMO would silently ignore a lane that the edge does not have."""
    edge = sumo.vehicle.getRoadID(name)
    lanes = range(sumo.edge.getLaneNumber(edge)) if edge and not edge.startswith(":") else None  # unchecked inside junctions
    if lanes is not None and lane not in lanes:
        raise RunError(
            Status.FAILED, f"the controller of {actor.name} must give a lane of the edge, 0 to {len(lanes) - 1} on {edge}, "
            f"but gave {lane}",
        )  # fmt: skip
    sumo.vehicle.changeLane(name, int(lane), LANE_REQUEST_DURATION)


_Touch = tuple[str, ActorTrace, ActorTrace]
"""Who touched the ego, and the rectangles that touch: the ego's and the other's."""


def _contact_test(
    states: list[State], rows: bytearray, dt: float, bodies: SceneBodies | None, levels: SceneLevels | None
) -> Callable[[int, list[int]], _Touch | None]:
    """Return the function that tells which of some rectangles the first actor, the ego, touched in the step to row k, or None.

    The exact test is left to pairs that are neither far apart nor separated by an axis of the ego's rectangle. Of who was on
    another level in row k - 1 only row k is looked at.
    """
    ego, near = states[0], (2.0 if bodies is None else 3.0) * max(s.length for s in states)
    width, place = ROW.size * len(states), struct.Struct("=2d").unpack_from
    bends = [bodies is not None and (ego.name in bodies or s.name in bodies) for s in states]
    columns = [(s, j, ROW.size * j, bends[j]) for j, s in enumerate(states)]
    length, breadth = 0.5 * ego.length + _SLACK, 0.5 * ego.width + _SLACK

    def separate(before: int, other: State, column: int, dx: float, dy: float) -> bool:
        (x_0, y_0), (u_0, v_0) = place(rows, before), place(rows, before + column)
        cos, sin, dx_0, dy_0 = ego.cos, ego.sin, u_0 - x_0, v_0 - y_0
        turn_cos, turn_sin = abs(other.cos * cos + other.sin * sin), abs(other.sin * cos - other.cos * sin)
        along = length + 0.5 * (other.length * turn_cos + other.width * turn_sin)
        ahead, ahead_0 = dx * cos + dy * sin, dx_0 * cos + dy_0 * sin
        if (ahead > along and ahead_0 > along) or (ahead < -along and ahead_0 < -along):
            return True
        across = breadth + 0.5 * (other.length * turn_sin + other.width * turn_cos)
        left, left_0 = dy * cos - dx * sin, dy_0 * cos - dx_0 * sin
        return (left > across and left_0 > across) or (left < -across and left_0 < -across)

    def touching(k: int, others: list[int]) -> _Touch | None:
        x, y, speed = ego.x, ego.y, ego.speed
        if levels is not None:
            others = levels.on_its(0, others)
        for other, j, column, bent in [columns[j] for j in others]:
            dx, dy, reach = other.x - x, other.y - y, near + (speed + other.speed) * dt
            if -reach < dx < reach and -reach < dy < reach:
                if not bent and separate(max(k - 1, 0) * width, other, column, dx, dy):
                    continue
                first = max(k - 1, 0) if levels is None or levels.was_there(j) else k
                step = table(rows, first, k + 1, len(states))
                own, its = _track(step, 0, ego), _track(step, j, other)
                if bodies is not None:
                    own, its = bodies.bent(ego.name, own, first), bodies.bent(other.name, its, first)
                    if bent and not may_meet(own, its):
                        continue
                found = contact_part(own, its)
                if found is not None:
                    return other.name, found[1], found[2]
        return None

    return touching


def _track(rows: np.ndarray, k: int, state: State) -> ActorTrace:
    """Return the (t,) columns of one actor in (t, m, 5) states."""
    x, y, heading, speed, acceleration = rows[:, k].T
    return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width)
