"""Who is on another level than the ego, such as on a bridge above it, in one step after another."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sbt.metrics.heights import LEVEL_HEIGHT
from sbt.problem.outcome import OTHER_LEVEL
from sbt.sumo.actors import State
from sbt.sumo.ground import Ground, Place, Trails
from sbt.sumo.levels import is_known, levels_of, road_of
from sbt.sumo.off_lanes import POSITION, VEHICLE
from sbt.sumo.overlaps import deepest_overlap, instant, state_in_sumo

__all__ = ["EgoLevel"]

_LONGEST = 30.0
"""Length up to which others on another level are compared with the ego (m)."""


class EgoLevel:
    """The level of the ego. Who is on no lane is on that of its last one: SUMO knows neither road nor height there.

    Args:
        sumo: libsumo or traci, started.

    Attributes:
        trails: of very long vehicles.
    """

    def __init__(self, sumo: Any):
        self._sumo = sumo
        self._levels, self.trails = levels_of(sumo), Trails(sumo)
        self._several = self._levels.several
        self._last: dict[str, tuple[str, float]] = {}
        self._notes: dict[tuple[str, str], str] = {}
        self._off: Collection[str] = ()
        self._road = ""
        self._apart: Collection[str] | None = None
        self._ground: Ground | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Contacts in the plane that are none, as roads of a network without heights are taken for bridges."""
        return tuple(self._notes.values())

    def of_another(self) -> EgoLevel:
        """Return the level of another road user, which knows the trails and last roads that this one does."""
        other = copy.copy(self)
        other._notes = {}
        return other

    def begin(self, name: str, road: str, z: float) -> None:
        """Take a road to be the last one of somebody who begins off the lanes, and its height there (m)."""
        self._last[name] = road, z

    def keep(self, name: str) -> None:
        """Remember the road and the height of a vehicle that is about to be moved, if it is on a lane."""
        if self._several and is_known(self._sumo, name):
            self._keep(name, self._sumo.vehicle.getPosition3D(name), person=False)

    def stays(self, name: str) -> bool:
        """Remember the road of a vehicle that is moved by poses; return whether SUMO has it on one of its level.

        SUMO puts who is moved onto the nearest lane in the plane, whatever its height.
        """
        at = self._sumo.vehicle.getPosition3D(name)
        if abs(_height(at) - self._last[name][1]) >= LEVEL_HEIGHT:
            return False
        return self._keep(name, at, person=False) != ""

    def _keep(self, name: str, at: Place, *, person: bool) -> str:
        road = road_of(self._sumo, name, person=person)
        if road:
            self._last[name] = road, at[2]
        return road

    def _at_last(self, name: str, at: Place) -> tuple[Place, str]:
        """Return a place (x, y, z) with the height of the last road, and that road; "" where it is not known."""
        road, z = self._last.get(name, ("", _height(at)))
        return (at[0], at[1], z), road

    def enter(self, ego: State, at: Place, off: Collection[str], t: float, *, person: bool) -> None:
        """Take the ego to be at (x, y, z) in the step at t (s) of the trace; off: who is on no lane."""
        if not self._several:
            return
        self._off, self._ego, self._t = off, ego, t
        self._at, self._road = self._at_last(ego.name, at) if ego.name in off else (at, self._keep(ego.name, at, person=person))
        self._apart = self._levels.apart.get(self._road)
        domain, gone = self._sumo.person if person else self._sumo.vehicle, ego.name in off
        self._ground = Ground.under(self._sumo, domain, ego.name, self._at, off=gone) if self._levels.stacked else None

    def is_other(self, name: str, variables: Mapping[int, Any], *, long: bool, placed: bool = False) -> bool:
        """Return whether a road user is on another level.

        Args:
            name: its id.
            variables: of it in this step.
            long: it is very long: the place that its body covers next to the ego decides, as that of a very long ego's body.
            placed: it was put there, at this height, which alone decides; not known (NaN): on the ego's level.
        """
        if not self._several:
            return False
        stretched = self._ego.name in self.trails and self._ego.name not in self._off
        if self._ground is None and self._apart is None and not stretched:
            return False
        person, off = VEHICLE in variables, name in self._off
        place: Place = variables[POSITION]
        road = ""
        if off:
            place, road = self._at_last(name, place)
        elif long and not placed:
            place, road = self.trails.closest(name, self._ego.name) if stretched else self.trails.nearest(name, self._at)
        elif not placed and (stretched or self._apart is not None):
            road = road_of(self._sumo, name, person=person)
        ground, own_road, apart = self._ground, self._road, self._apart
        if stretched:
            at, own_road = self.trails.nearest(self._ego.name, place)
            ground, apart = None if ground is None else replace(ground, place=at), self._levels.apart.get(own_road)
        if placed:
            return ground is not None and self._is_placed_below(ground, name, variables)
        if (road or not off) and ground is not None and ground.is_below(name, place, person=person, off=off):
            return True
        if apart is None or road not in apart:
            return False
        roads = own_road, road
        if roads not in self._notes and not self._levels.stacked:
            self._note(roads, name, variables, person=person)
        return True

    def _is_placed_below(self, ground: Ground, name: str, variables: Mapping[int, Any]) -> bool:
        """Return whether who was put somewhere is on another level; SUMO may have it on a lane of another one."""
        person, place = VEHICLE in variables, variables[POSITION]
        if math.isnan(place[2]):
            return False
        astray = not person and abs(_height(self._sumo.vehicle.getPosition3D(name)) - place[2]) >= LEVEL_HEIGHT
        return ground.is_below(name, place, person=person, off=astray or not road_of(self._sumo, name, person=person))

    def _note(self, roads: tuple[str, str], name: str, variables: Mapping[int, Any], *, person: bool) -> None:
        if math.dist(self._at[:2], variables[POSITION][:2]) > self._ego.length + _LONGEST:
            return
        state = state_in_sumo(self._sumo.person if person else self._sumo.vehicle, name, person=person)
        found = deepest_overlap(instant(self._ego), {name: instant(state)})
        if found is not None:
            at = f"'{name}' at {self._t:.3f} s"
            both = f"'{roads[0]}' and '{roads[1]}'"
            why = f"{both} cross without a junction and are taken for a bridge: heights (z) of nodes decide it"
            self._notes[roads] = f"{OTHER_LEVEL}{at}: bodies overlap by {found[1]:.2f} m in the plane, but {why}"


def _height(at: Sequence[float]) -> float:
    """Return z (m) of a place, which SUMO leaves out, for NaN here, far outside the network."""
    return at[2] if len(at) > 2 else math.nan
