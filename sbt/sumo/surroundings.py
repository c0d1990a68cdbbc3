"""The road users around the ego of a user's own simulation: their states at every step, and whether they touch it.

Vehicles and persons within a radius are read by a context subscription, whose cost does not grow with the traffic
elsewhere (`sbt.sumo.nearby`); named ones at any distance. Those on another level than the ego (a bridge) are left out. A
long vehicle is recorded with the parts that follow its front (`sbt.sumo.trailing`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.metrics.geometry import LANE_CHANGE, STEPPED, contact_part, farthest
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace, States, Trace
from sbt.sumo.actors import State
from sbt.sumo.arriving import LastStep
from sbt.sumo.ego_level import EgoLevel
from sbt.sumo.guided import Placed
from sbt.sumo.identity import check_sizes, refuse_twice
from sbt.sumo.junctions import Junctions
from sbt.sumo.lanes_behind import Lanes, trailing_body
from sbt.sumo.levels import is_known
from sbt.sumo.nearby import Nearby
from sbt.sumo.off_lanes import ANGLE, POSITION, SPEED, VEHICLE, off_lanes, parking, placed_variables, read
from sbt.sumo.overlaps import Rectangle, may_touch
from sbt.sumo.session import INVALID_DOUBLE, is_ballistic
from sbt.sumo.tables import table_of
from sbt.sumo.teleports import Teleports
from sbt.sumo.trailing import LONGEST_RIGID, TrailingBody, part_traces
from sbt.sumo.ways import LEFT_THE_ROAD, ways_ahead

__all__ = ["Surroundings"]

_BESIDE = 0.5
"""How far who parks, or leaves its place, is moved beside what it drives, from which on it has jumped there (m)."""

_FREE = 1.0
"""Moves within a step up to so far are not looked at (m)."""
_SIZED = 1.0
"""After how much simulated time sizes are looked at (s)."""

_Row = tuple[float, ...]


class Surroundings:
    """The ego and the road users around it, step by step.

    Args:
        sumo: libsumo or traci, started.
        ego: id of the vehicle under test.
        within: radius around its body in which the bodies of others are (m), where two do not drive more in a step.
        named: vehicles that are recorded at any distance.
        dt: step (s).

    Attributes:
        states: the last state of every road user seen so far; the ego first.
        present: names of those that are there now, the ego first.
        rigid: road users that are moved by poses; their bodies are rectangles, and their speeds those of their motion.
        placed: road users that are moved by position, as they are in the next step to be recorded.
        jumped: who was moved to another place in this step: left out at this instant, so that nothing takes it for motion.
    """

    def __init__(self, sumo: Any, ego: str, within: float, named: Iterable[str], dt: float):
        self._sumo, self._ego, self._dt = sumo, ego, dt
        self._nearby = Nearby(sumo, ego, within, dt)
        self._named = frozenset(named)
        self._named_present: set[str] = set()
        self._centre_offsets: dict[str, float] = {}
        self._bodies: dict[str, TrailingBody] = {}
        self._lanes = Lanes(sumo)
        self._rows, self._parts = list[dict[str, _Row]](), list[dict[str, int]]()
        self._last_poses: dict[tuple[str, int], np.ndarray] = {}
        self._arrived: frozenset[str] = frozenset()
        self._ways: dict[str, tuple[States, ...]] = {}
        self.states, self.present = dict[str, State](), list[str]()
        self.rigid: set[str] = set()
        self.placed: Mapping[str, Placed] = {}
        self.jumped: set[str] = set()
        self._farthest, self._recorded_at = float(farthest(dt)), 0.0
        self._teleports, self._junctions = Teleports(sumo.simulation, ego), Junctions(sumo)
        self._parking: Sequence[str] = ()
        self._left: Sequence[str] = ()
        self._leaving: Sequence[str] = ()
        self._unreacting, self._moved, self._put = set[str](), set[str](), set[str]()
        self._moved_before, self._moving = dict[str, bool](), dict[str, bool]()  # by poses: whether for the first time
        self._level = EgoLevel(sumo)
        self.follow(sumo.vehicle.getIDList())

    def __len__(self) -> int:
        """Number of recorded instants."""
        return len(self._rows)

    def is_person(self, name: str) -> bool:
        """Return whether a recorded road user is a person."""
        return self._centre_offsets.get(name) == 0.0

    def follow(self, departed: Iterable[str], arrived: Iterable[str] = ()) -> None:
        """Note who came and who left, near or far."""
        self._arrived = frozenset(arrived)
        for name in arrived:
            self._nearby.forget(name)
            self._named_present.discard(name)
        length = self._sumo.vehicle.getLength
        for name in departed:
            if self.is_person(name):
                refuse_twice(name)
            self._nearby.depart(name, length(name))
            if name in self._named:
                self._named_present.add(name)

    def place(self, placed: Mapping[str, Placed]) -> None:
        """Take the states of these road users as they are given: SUMO neither sees them off the lanes nor knows their speed."""
        self.placed = placed
        self.rigid.update(placed)
        self._unreacting.update(placed)

    def move(self, name: str) -> None:
        """Take a road user as one that the loop moves by poses, in the next step; it is still where it was."""
        self.rigid.add(name)
        self._moved.add(name)
        self._level.keep(name)

    def put(self, name: str) -> None:
        """Take a road user as one that the loop puts to another place of a lane, in the next step."""
        self._put.add(name)

    def subscribe(self, *, walks: bool = False) -> None:
        """Subscribe to the surroundings of the ego, which has just departed; walks: it is a person."""
        self._nearby.subscribe(walks=walks)

    def record(self) -> None:
        """Append the states of all road users that are present.

        Raises:
            RunError: the ego is not on the road.
        """
        ego, near = self._ego, self._nearby.subscribed()
        unseen = {ego, *self.rigid, *self.present} - near.keys() - self.placed.keys()
        off = off_lanes(self._sumo, ego, near, unseen, self.rigid) if unseen else {}
        self._nearby.around(near.get(ego) or off[ego])
        off = {name: variables for name, variables in off.items() if self._nearby.is_near(name, variables)}
        near = {**{name: one for name, one in near.items() if self._nearby.is_near(name, one)}, **off}
        self.rigid.update(off)
        self._moved.update(off)
        if near[ego].get(VEHICLE):
            rule = f"the ego '{ego}' must walk while it is recorded"
            raise RunError(Status.FAILED, f"{rule}, but it rides in '{near[ego][VEHICLE]}'")
        if self.placed:
            placed = placed_variables(self.placed)
            near.update((name, one) for name, one in placed.items() if name in self._named or self._nearby.is_near(name, one))
        row, parts = dict[str, _Row](), dict[str, int]()
        simulation, self.jumped = self._sumo.simulation, set()
        self._teleports.look()
        begins, ends = parking(simulation)
        self._parking, self._left, self._leaving = (*begins, *self._leaving), self._leaving, ends
        before = self._rows[-1] if self._rows else {}
        self._record(row, parts, before, ego, near[ego])
        self._level.enter(self.states[ego], near[ego][POSITION], off, len(self) * self._dt, person=self.is_person(ego))
        for name in self._around(near):
            variables = near[name] if name in near else read(self._sumo, name)
            if name == ego or variables.get(VEHICLE):
                continue
            long, placed_there = name in self._nearby.very_long, name in self.placed
            if not self._level.is_other(name, variables, long=long, placed=placed_there):
                self._record(row, parts, before, name, variables)
        for name in self.present:
            if name in self.jumped:
                self._ways.pop(name, None)
            elif name not in row:
                self._keep_way(name)
        if before:
            self._teleports.compare(before, row, len(self) * self._dt)
        self.present, self._recorded_at = list(row), simulation.getTime()
        self._rows.append(row)
        self._parts.append(parts)
        if len(self._rows) % max(round(_SIZED / self._dt), 1) == 0:
            check_sizes(self._sumo, self.states, row)
        self._moved_before, self._moving = self._moving, {}
        self._put.clear()
        self._moved = {name for name in self.rigid if self.is_person(name)}  # they keep the speed of the last step

    def _keep_way(self, name: str) -> None:
        """Keep where a vehicle goes on that is recorded no more: its rectangle, and the parts of a long one.

        Persons, and who is moved by poses or teleported, also out of the radius, have no known way.
        """
        self._ways.pop(name, None)
        if self.is_person(name) or name in self.rigid:
            return
        if name in self._arrived or not is_known(self._sumo, name):
            self._ways[name] = (LEFT_THE_ROAD,) * (1 + (self._bodies[name].count if name in self._bodies else 0))
            return
        state, now = self.states[name], self._sumo.vehicle.getPosition(name)
        moved = math.dist(now, (state.x + 0.5 * state.length * state.cos, state.y + 0.5 * state.length * state.sin))
        elapsed = max(self._sumo.simulation.getTime() - self._recorded_at, self._dt)  # a run is judged after its last instant
        if now[0] != INVALID_DOUBLE and moved > float(farthest(elapsed)):
            self._note_jump(name, moved, crossed=self._junctions.explain(name, moved, state.speed * elapsed))
            return
        poses, bends = self._poses(name, len(self._rows) - 1), name in self._parts[-1]
        if ways := ways_ahead(self._sumo, name, poses, state.length, bends=bends):
            self._ways[name] = ways

    def _around(self, near: Mapping[str, Any]) -> list[str]:
        """Return who is near, whose rear may be, and who is named; whom a loop has removed is forgotten."""
        very_long = self._nearby.very_long
        gone = [name for name, length in very_long.items() if not self._level.trails.note(name, length)]
        for name in (*gone, *(n for n in tuple(self._named_present) if not is_known(self._sumo, n))):
            very_long.pop(name, None)
            self._named_present.discard(name)
        around = sorted([*near, *self._nearby.far(near)] if very_long else near)
        return [*around, *sorted(self._named_present - set(around))]

    def _record(
        self, row: dict[str, _Row], parts: dict[str, int], before: dict[str, _Row], name: str,
        variables: Mapping[int, Any],
    ) -> None:  # fmt: skip
        """Record one state; SUMO's position is the front of a vehicle and the centre of a person, ours is the centre."""
        x, y = variables[POSITION][:2]
        if x == INVALID_DOUBLE:
            return
        state = self.states.get(name)
        if state is None:
            state = self._first_seen(name, variables)
        elif VEHICLE in variables and not self.is_person(name):
            refuse_twice(name)
        if variables[ANGLE] != state.angle:
            state.turn(variables[ANGLE])
        half, speed, last = self._centre_offsets[name], float(variables[SPEED]), before.get(name)
        state.x, state.y = x - half * state.cos, y - half * state.sin
        moved = 0.0 if last is None else math.hypot(state.x - last[0], state.y - last[1])
        if last is not None and half and moved > self._farthest:  # SUMO turns a long vehicle at once: where was its front?
            moved = min(moved, math.hypot(x - last[0] - half * math.cos(last[2]), y - last[1] - half * math.sin(last[2])))
        driven = 0.0 if last is None else (last[3] + speed) * self._dt
        parks = name in self._parking and moved > driven + _BESIDE
        if last is not None and (moved > _FREE or self._teleports.ending) and self._jumps(name, last, (x, y), moved, speed):
            return
        if parks and name != self._ego and (name not in self._left or self._is_far(state, moved)):
            self.jumped.add(name)
            return
        if name in self._moved and name not in self.placed:  # SUMO's speed is what its own driver would do
            if last is not None and name in self._moved_before:
                speed = ((state.x - last[0]) * state.cos + (state.y - last[1]) * state.sin) / self._dt
                if self._moved_before[name]:  # for the first time: where SUMO had it told nothing of its speed
                    before[name] = last = (*last[:3], speed, 0.0)
                self._moving[name] = False
            else:
                speed, self._moving[name] = speed if last is None else last[3], True
        state.speed, state.acceleration = speed, 0.0 if last is None else (speed - last[3]) / self._dt
        row[name] = (state.x, state.y, state.heading, speed, state.acceleration)
        if name in self._bodies and name not in self.rigid:
            lane = self._sumo.vehicle.getLaneID(name)
            parts[name] = self._bodies[name].move((x, y), state.cos, state.sin, lane, speed * self._dt)

    def _jumps(self, name: str, last: _Row, front: tuple[float, float], moved: float, speed: float) -> bool:
        """Return, and note, whether one was moved to another place, so far (m)."""
        put = name in self._teleports.ending or (name in self._put and moved > (last[3] + speed) * self._dt + LANE_CHANGE)
        crossed = False
        if not put and name not in self.rigid and name not in self._parking:
            heading, driven = self.states[name].heading, max(last[3], speed) * self._dt
            crossed = self._junctions.jumped(name, last, front, heading, self._centre_offsets[name], driven)
        if jumps := put or crossed or moved > self._farthest:
            self._note_jump(name, moved, crossed=crossed)
        return jumps

    def _is_far(self, state: State, moved: float) -> bool:
        """Return whether nobody who has just been moved so far (m) can have touched the ego meanwhile."""
        own = self.states[self._ego]
        return math.hypot(state.x - own.x, state.y - own.y) > own.length + state.length + moved

    def _note_jump(self, name: str, moved: float, *, crossed: bool) -> None:
        """Leave out a road user that was moved to another place, or over a junction; the ego must not be."""
        t, walks = len(self._rows) * self._dt, self.is_person(name)  # of the row that is being made
        self._teleports.jump(name, t, moved, crossed=crossed, walks=walks)
        self.jumped.add(name)

    def _first_seen(self, name: str, variables: Mapping[int, Any]) -> State:
        person = VEHICLE in variables
        if person and is_known(self._sumo, name):
            refuse_twice(name)
        domain = self._sumo.person if person else self._sumo.vehicle
        state = self.states[name] = State(name, float(domain.getLength(name)), float(domain.getWidth(name)), self._dt)
        self._centre_offsets[name] = 0.0 if person else 0.5 * state.length
        if not person and state.length > LONGEST_RIGID:
            self._bodies[name] = trailing_body(self._sumo, self._lanes, name, state.length)
        return state

    def touching(self) -> list[tuple[str, ActorTrace, ActorTrace]]:
        """Return who has touched the ego since the last step, with the rectangles that touch: the ego's and the other's."""
        ego, found = self.states[self._ego], []
        x, y, reach_0, walks = ego.x, ego.y, 1.5 * ego.length, self.is_person(self._ego)
        for name in self.present:
            if name == self._ego:
                continue
            other = self.states[name]
            beside = STEPPED if walks or self.is_person(name) else 0.0
            reach = reach_0 + 1.5 * other.length + (ego.speed + other.speed) * self._dt + beside
            if abs(other.x - x) > reach or abs(other.y - y) > reach:
                continue
            touched = contact_part(self._step_of(self._ego, name), self._step_of(name, name)) if self._near(name) else None
            if touched is not None:
                found.append((name, *touched[1:]))
        return found

    def record_arrival(self, step: LastStep) -> None:
        """Append the step in which the ego arrives."""
        row, parts = {self._ego: step.own}, dict[str, int]()
        for name, variables in step.others.items():
            self._record(row, parts, self._rows[-1], name, variables)
        for name in (one for one in self.present if one not in row):
            self._keep_way(name)
        self.present = list(row)
        self._rows.append(row)
        self._parts.append(parts)

    def newcomers(self) -> list[str]:
        """Return who is recorded now and was not at the instant before, sorted; in the first instant, everybody else."""
        before = self._rows[-2].keys() if len(self._rows) > 1 else frozenset((self._ego,))
        return sorted(self._rows[-1].keys() - before)

    def body(self, name: str) -> ActorTrace:
        """Return the body of a road user that is present now, as a trace of one instant."""
        return self._track(name, [len(self._rows) - 1], [self._rows[-1][name]])

    def _near(self, name: str) -> bool:
        """Return whether no axis of a rectangle separates any of the ego's from the other's during the last step."""
        now, before = len(self._rows) - 1, max(len(self._rows) - 2, 0)
        before = before if name in self._rows[before] else now
        return may_touch(*(self._rectangles(who, k) for who in (self._ego, name) for k in (now, before)))

    def _rectangles(self, name: str, k: int) -> list[Rectangle]:
        """Return the rectangles of a road user at an instant."""
        state, poses = self.states[name], self._poses(name, k)
        return [(x, y, heading, state.length / len(poses), state.width) for x, y, heading in poses.tolist()]

    def _poses(self, name: str, k: int) -> np.ndarray:
        """Return x, y (m) and heading (rad) of the rectangles of a road user at an instant: (rectangles, 3)."""
        at = None if name in self.rigid else self._parts[k].get(name)
        if at is None:
            return np.array([self._rows[k][name][:3]])
        if (name, at) not in self._last_poses:
            self._last_poses = {key: value for key, value in self._last_poses.items() if key[0] != name or key[1] == at - 1}
            self._last_poses[name, at] = self._bodies[name].poses([at])[0]
        return self._last_poses[name, at]

    def _step_of(self, name: str, other: str) -> ActorTrace:
        """Return the last two instants of a road user, or the last one if the other was not there before."""
        at = [k for k in (len(self._rows) - 2, len(self._rows) - 1) if k >= 0 and other in self._rows[k]]
        return self._track(name, at, [self._rows[k][name] for k in at])

    def _track(self, name: str, at: Sequence[int], rows: Sequence[_Row]) -> ActorTrace:
        """Return the columns of one road user at some instants, at which it is present."""
        state = self.states[name]
        x, y, heading, speed, acceleration = np.array(rows).T
        parts: tuple[ActorTrace, ...] = ()
        if name in self._bodies and name not in self.rigid:
            poses = self._bodies[name].poses([self._parts[k][name] for k in at])
            parts = part_traces(poses, speed, acceleration, self._bodies[name].part_length, state.width)
        return ActorTrace(x, y, heading, speed, acceleration, state.length, state.width, parts)

    def trace(self, ended: str, reported: Sequence[str], unconfirmed: Sequence[str]) -> Trace:
        """Return the recorded trace; states of absent road users are NaN."""
        check_sizes(self._sumo, self.states, self.present)
        there = {*self._sumo.vehicle.getIDList(), *self._arrived}
        for name in self.present:
            if name in there:
                self._keep_way(name)
        names = tuple(self.states)
        column, table = {name: k for k, name in enumerate(names)}, table_of(self._rows, names)
        x, y, heading, speed, acceleration = np.moveaxis(table, 2, 0)
        return Trace(
            np.arange(len(table), dtype=np.float64) * self._dt, names, x, y, heading, speed, acceleration,
            np.array([self.states[n].length for n in names]), np.array([self.states[n].width for n in names]),
            ended, tuple(reported), ways={name: ways[0] for name, ways in self._ways.items()},
            parts={name: self._parts_of(name, table[:, column[name]]) for name in self._bent()},
            unconfirmed=(*unconfirmed, *self._level.notes, *self._teleports.notes),
            unreacting=tuple(n for n in names if n in self._unreacting), ballistic=is_ballistic(self._sumo),
        )  # fmt: skip

    def _bent(self) -> list[str]:
        """Return the long vehicles whose parts were recorded at every instant."""
        return [n for n in self._bodies if n not in self.rigid and any(n in parts for parts in self._parts)]

    def _parts_of(self, name: str, table: np.ndarray) -> tuple[ActorTrace, ...]:
        """Return the parts of a long vehicle over all instants, NaN where it is not there."""
        poses = self._bodies[name].poses_among([parts.get(name) for parts in self._parts])
        size, ways = (self._bodies[name].part_length, self.states[name].width), self._ways.get(name, ())[1:]
        return part_traces(poses, table[:, 3], table[:, 4], *size, ways)
