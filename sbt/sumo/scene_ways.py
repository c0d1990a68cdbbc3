"""Where the actors of a scene go on when they are seen for the last time (`sbt.sumo.ways`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sbt.metrics.paths import HORIZON
from sbt.problem.arrays import Vector
from sbt.problem.trace import States
from sbt.sumo.actors import Actor, State
from sbt.sumo.scene_bodies import SceneBodies
from sbt.sumo.ways import goes_straight, ways_ahead

__all__ = ["SceneWays"]

_BEYOND = 2.0
"""How much farther ways lead than metrics look (m)."""


class SceneWays:
    """The ways of the actors that SUMO moves along lanes. Persons, and who is moved by poses, have none: they go straight on.

    Args:
        sumo: libsumo or traci.
        actors: of the scene.
        states: of the actors, as they are now.
        prefix: of the names of the actors in SUMO.
        bodies: of those that bend; None: nobody does.
    """

    def __init__(
        self, sumo: Any, actors: Sequence[Actor], states: Sequence[State], prefix: str, bodies: SceneBodies | None
    ) -> None:
        self._sumo, self._actors, self._states, self._prefix, self._bodies = sumo, actors, states, prefix, bodies
        self._found: dict[str, tuple[States, ...]] = {}

    @property
    def whole(self) -> dict[str, States]:
        """Name to the way of a rectangle; those without one go straight on."""
        return {name: ways[0] for name, ways in self._found.items()}

    @property
    def parts(self) -> dict[str, tuple[States, ...]]:
        """Name to the ways of the parts of who bends."""
        return {name: ways[1:] for name, ways in self._found.items()}

    def keep(self, last: Iterable[int], poses: States, top_speeds: Vector) -> None:
        """Keep where some actors go on from here. Whom the lanes lead straight on as far as metrics look needs no way.

        Args:
            last: which actors.
            poses: (m, 3) of all actors now.
            top_speeds: (m,) of their runs (m/s).
        """
        for k in last:
            actor, name = self._actors[k], self._prefix + self._actors[k].name
            self._found.pop(actor.name, None)
            if actor.person or self._states[k].steered is not None:
                continue
            bends, reach = self._bodies is not None and actor.name in self._bodies, HORIZON * float(top_speeds[k])
            if bends or not goes_straight(self._sumo, name, float(poses[k, 2]), reach):
                body = self._bodies.poses(actor.name) if self._bodies is not None and bends else poses[k : k + 1]
                length = float(actor.type.length)
                if ways := ways_ahead(self._sumo, name, body, length, bends=bends, reach=reach + _BEYOND):
                    self._found[actor.name] = ways
