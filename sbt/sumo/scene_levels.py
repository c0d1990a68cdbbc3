"""Who is on another level, such as on a bridge, than the actors of a scene that look at the others: the ego and controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sbt.sumo.actors import Actor, State
from sbt.sumo.ego_level import EgoLevel
from sbt.sumo.levels import levels_of
from sbt.sumo.nearby import VERY_LONG
from sbt.sumo.off_lanes import POSITION, VEHICLE

__all__ = ["SceneLevels"]

class SceneLevels:
    """The levels of a scene, step by step. An actor that begins by a pose is on the level of the lane that it names.

    Args:
        sumo: libsumo or traci, started.
        actors: of the scene, the ego first.
    """

    def __init__(self, sumo: Any, actors: Sequence[Actor]):
        self._actors, own = actors, EgoLevel(sumo)
        self._domains = [sumo.person if actor.person else sumo.vehicle for actor in actors]
        self._posed = [actor.name for actor in actors if actor.pose is not None and not actor.person]
        self._long = {a.name: float(a.type.length) for a in actors if a.type.length > VERY_LONG and not a.person}
        for actor in actors:
            if actor.pose is not None:
                road, position = actor.route[0], max(float(actor.position), 0.0)
                position = min(position, sumo.lane.getLength(f"{road}_{actor.lane}"))
                own.begin(actor.name, road, sumo.simulation.convert3D(road, position, actor.lane)[2])
        driven = [k for k, actor in enumerate(actors) if k and actor.driver is not None]
        self._levels = {0: own, **{k: own.of_another() for k in driven}}
        self._elsewhere: dict[int, frozenset[int]] = {}
        self.hidden = list[frozenset[int]]()
        """Of every step, who is on another level than the ego."""

    @classmethod
    def of(cls, sumo: Any, actors: Sequence[Actor]) -> SceneLevels | None:
        """Return the levels of a scene; None where its network has one."""
        return cls(sumo, actors) if levels_of(sumo).several else None

    @property
    def notes(self) -> tuple[str, ...]:
        """Contacts of the ego in the plane that are none, as roads of a network without heights are taken for bridges."""
        return self._levels[0].notes

    @property
    def gone(self) -> frozenset[int]:
        """Who has left the level of the ego since the step before."""
        return self.hidden[-1] - self.hidden[-2] if len(self.hidden) > 1 else frozenset()

    def look(self, t: float, states: Mapping[str, State]) -> None:
        """Look where everybody is at t (s)."""
        own, actors = self._levels[0], self._actors
        seen: list[dict[int, Any]] = []
        for actor, domain in zip(actors, self._domains, strict=True):
            seen.append({POSITION: domain.getPosition3D(actor.name), **({VEHICLE: ""} if actor.person else {})})
        off = [name for name in self._posed if not own.stays(name)]
        for name, length in self._long.items():
            own.trails.note(name, length)
        for k, level in self._levels.items():
            level.enter(states[actors[k].name], seen[k][POSITION], off, t, person=actors[k].person)
            self._elsewhere[k] = frozenset(
                j for j, actor in enumerate(actors)
                if j != k and level.is_other(actor.name, seen[j], long=actor.name in self._long)
            )  # fmt: skip
        self.hidden.append(self._elsewhere[0])

    def on_its(self, k: int, others: Sequence[int]) -> list[int]:
        """Return those of some actors who are on the level of actor k, now."""
        return [j for j in others if j not in self._elsewhere[k]]

    def was_there(self, j: int) -> bool:
        """Return whether actor j was on the ego's level in the step before."""
        return len(self.hidden) < 2 or j not in self.hidden[-2]
