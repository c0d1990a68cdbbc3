"""The bodies of a scene's long vehicles, which bend with their paths (`sbt.sumo.trailing`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sbt.problem.trace import ActorTrace, States
from sbt.sumo.actors import Actor, State
from sbt.sumo.lanes_behind import Lanes, trailing_body
from sbt.sumo.overlaps import may_touch
from sbt.sumo.session import unwrapped
from sbt.sumo.trailing import LONGEST_RIGID, part_traces

__all__ = ["SceneBodies", "may_meet"]


class SceneBodies:
    """The bodies of the long actors, step by step. Who is moved by poses stays a rectangle.

    Args:
        sumo: libsumo or traci.
        actors: those that bend.
        dt: step (s).
        prefix: of the names of the actors in SUMO.
    """

    def __init__(self, sumo: Any, actors: Sequence[Actor], dt: float, prefix: str):
        lanes, self._prefix, self._dt = Lanes(sumo), prefix, dt
        self._front, self._lane = unwrapped(sumo, "vehicle", "getPosition"), unwrapped(sumo, "vehicle", "getLaneID")
        self._bodies = {a.name: trailing_body(sumo, lanes, prefix + a.name, float(a.type.length)) for a in actors}
        self._widths = {a.name: float(a.type.width) for a in actors}
        self._steps: dict[str, list[int]] = {name: [] for name in self._bodies}

    @classmethod
    def of(cls, sumo: Any, actors: Sequence[Actor], dt: float, prefix: str) -> SceneBodies | None:
        """Return the bodies of a scene; None where no actor bends."""
        long = [actor for actor in actors if actor.type.length > LONGEST_RIGID and actor.pose is None and not actor.person]
        return cls(sumo, long, dt, prefix) if long else None

    def __contains__(self, name: str) -> bool:
        """Return whether an actor bends."""
        return name in self._bodies

    def move(self, states: Mapping[str, State]) -> None:
        """Note where everybody is in a step."""
        for name, body in self._bodies.items():
            state, id = states[name], self._prefix + name
            step = body.move(tuple(self._front(id)), state.cos, state.sin, self._lane(id), state.speed * self._dt)
            self._steps[name].append(step)

    def bent(self, name: str, track: ActorTrace, first: int) -> ActorTrace:
        """Return the track of an actor from row `first` on, with its parts if it bends."""
        if name not in self._bodies:
            return track
        body = self._bodies[name]
        poses = body.poses(self._steps[name][first : first + len(track.x)])
        return replace(track, parts=part_traces(poses, track.speed, track.acceleration, body.part_length, track.width))

    def poses(self, name: str) -> States:
        """Return the (n, 3) poses of the parts of one that bends, now."""
        found: States = self._bodies[name].poses(self._steps[name][-1:])[0]
        return found

    def parts(
        self, states: Mapping[str, np.ndarray], ways: Mapping[str, tuple[States, ...]]
    ) -> dict[str, tuple[ActorTrace, ...]]:
        """Return the parts of all that bend over all rows, NaN where their (t, 5) states, given by name, are, with their ways."""
        found = {}
        for name, body in self._bodies.items():
            poses, speed, acceleration = body.poses(self._steps[name]), states[name][:, 3], states[name][:, 4]
            poses[np.isnan(speed)] = np.nan
            size = body.part_length, self._widths[name]
            found[name] = part_traces(poses, speed, acceleration, *size, ways.get(name, ()))
        return found


def may_meet(a: ActorTrace, b: ActorTrace) -> bool:
    """Return whether two bodies over one or two instants may touch, as a quick test of their rectangles says."""
    ends = [(one, k) for one in (a, b) for k in (-1, 0)]
    return may_touch(*([(p.x[k], p.y[k], p.heading[k], p.length, p.width) for p in one.parts or (one,)] for one, k in ends))
