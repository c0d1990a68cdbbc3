"""Refuses runs in which somebody appears inside another: an artefact of the insertion, not a collision.

Without insertion checks SUMO puts a vehicle wherever it is asked to, also into another one. Contact at the instant in
which one of the two appears says nothing about driving. Nor does an accident that nobody can avoid because a vehicle of
the traffic has appeared right before or behind the ego in the middle of a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.problem.trace import ActorTrace
from sbt.sumo.actors import State
from sbt.sumo.off_lanes import parking
from sbt.sumo.overlaps import deepest_overlap, is_behind, required_braking
from sbt.sumo.places import inserted_at, said_at

__all__ = ["AppearanceMonitor", "refuse_overlap_at_start"]

_MAX_BRAKING = 9.0
"""Deceleration that tyres allow on a dry road (m/s^2); SUMO's default `emergencyDecel` too."""
_REMEDY = (
    "let it depart (or a loop move it) elsewhere or more slowly, and leave SUMO's insertion checks on (neither it nor an option "
    "sets them to none)"
)


class _Departures(Protocol):
    """What is read of the requested departures."""

    asked: set[str]

    def place_of(self, name: str) -> str: ...


class _Surroundings(Protocol):
    """What is read of the recorded road users."""

    states: dict[str, State]
    jumped: set[str]

    def __len__(self) -> int: ...
    def newcomers(self) -> list[str]: ...
    def body(self, name: str) -> ActorTrace: ...


def refuse_overlap_at_start(
    ego: str, body: ActorTrace, others: Mapping[str, ActorTrace], remedy: str, place: str = ""
) -> None:  # fmt: skip
    """Check that the ego starts clear of all others.

    Args:
        ego: its id.
        body: its body at its start.
        others: bodies of all that are present then, by name.
        remedy: what to change.
        place: `file:line:column: ` of the ego, or "".

    Raises:
        RunError: it overlaps or touches one of them.
    """
    found = deepest_overlap(body, others)
    if found is not None:
        raise RunError(
            Status.INVALID,
            f"{place}'{ego}' must start clear of all others, but its place is taken by '{found[0]}' (they overlap by "
            f"{found[1]:.2g} m), which is no collision: {said_at(place, remedy)}",
        )


class AppearanceMonitor:
    """Checks who appears on the road: the ego at its departure, and others near it from then on.

    Args:
        sumo: libsumo or traci.
        ego: its id.
        departures: those that the user has requested one by one.
    """

    def __init__(self, sumo: Any, ego: str, departures: _Departures):
        self._sumo, self._ego, self._departures = sumo, ego, departures
        self._unparked: frozenset[str] = frozenset()
        self._unparked_before: frozenset[str] = frozenset()
        self._parked: frozenset[str] = frozenset()
        self._jumped: frozenset[str] = frozenset()

    def after_step(self, near: _Surroundings, departed: frozenset[str]) -> None:
        """Check a step that has been recorded.

        Args:
            near: the road users around the ego.
            departed: vehicles that departed in this step.

        Raises:
            RunError: the ego appears inside another road user, or another one inside or right before it.
        """
        simulation = self._sumo.simulation
        self._unparked_before = self._unparked
        moved, self._jumped = self._jumped, frozenset(near.jumped)
        self._parked, self._unparked = map(frozenset, parking(simulation))
        new = near.newcomers()
        if len(near) == 1:
            remedy = "change its departPos or depart, or keep the inputs apart by constraints"
            place = self._departures.place_of(self._ego)
            bodies = {name: near.body(name) for name in new}
            refuse_overlap_at_start(self._ego, near.body(self._ego), bodies, remedy, place)
            if inserted_at(place):  # a place among traffic, which is drawn: not the scenario that anybody meant
                self._refuse_close(near, [name for name in new if name not in self._departures.asked], place, remedy)
        elif new:
            persons = frozenset(simulation.getDepartedPersonIDList())
            appeared = departed | persons | moved | frozenset(simulation.getEndingTeleportIDList())
            self._check(near, [name for name in new if name in appeared])

    def refuse_contact(self, name: str) -> None:
        """Check a contact of the ego: who parks, or leaves its place, jumps there within a step, through all others.

        Raises:
            RunError: it is with a vehicle that leaves its place, or the ego itself jumps, in that step.
        """
        if self._ego in self._parked | self._unparked | self._unparked_before:
            raise RunError(
                Status.INVALID,
                f"the ego '{self._ego}' must park, and leave its parking place, where nobody is, but SUMO has moved it through"
                f" '{name}' at {self._now()}: let it stop elsewhere, or keep '{name}' away from there",
            )
        if name in self._unparked | self._unparked_before:
            raise RunError(
                Status.INVALID,
                f"'{name}' must leave its parking place where nobody is, but SUMO has moved it onto the ego at {self._now()}: "
                f"{_REMEDY}",
            )

    def _ability(self, follower: str) -> tuple[float, float]:
        """Return how hard one behind the ego can brake (m/s^2), and how much later than in the next step it may act (s)."""
        vehicle = self._sumo.vehicle
        if follower not in vehicle.getIDList():
            return _MAX_BRAKING, 0.0
        able = max(vehicle.getDecel(follower), vehicle.getEmergencyDecel(follower))
        late = vehicle.getActionStepLength(follower) - self._sumo.simulation.getDeltaT()
        return min(able, _MAX_BRAKING), max(late, 0.0)

    def _now(self) -> str:
        return f"t = {self._sumo.simulation.getTime():g} s"

    def _check(self, near: _Surroundings, appeared: Sequence[str]) -> None:
        found = deepest_overlap(near.body(self._ego), {name: near.body(name) for name in appeared})
        if found is not None:
            raise RunError(
                Status.INVALID,
                f"{self._departures.place_of(found[0])}'{found[0]}' must appear clear of the ego, but overlaps it by "
                f"{found[1]:.2g} m at {self._now()}, which is no collision: {_REMEDY}",
            )
        drawn = [name for name in appeared if name not in self._departures.asked]
        self._refuse_close(near, drawn, "", _REMEDY)

    def _refuse_close(self, near: _Surroundings, names: Sequence[str], place: str, remedy: str) -> None:
        """Refuse others so close to the ego that nobody could react; `place`: of the ego, where it is the one who appears."""
        for name in names:
            limit = self._needed(near.states[self._ego], near.states[name])
            if limit:
                who, whom = (self._ego, f"'{name}'") if place else (name, "the ego")
                raise RunError(
                    Status.INVALID,
                    f"{place}'{who}' must appear where drivers can react, but at {self._now()} it is so close to {whom} "
                    f"that only {limit}: {said_at(place, remedy)}",
                )

    def _needed(self, ego: State, other: State) -> str:
        """Return which braking would keep the ego and another apart, if the one behind cannot brake so; else ""."""
        braking, able, late = required_braking(ego, other), _MAX_BRAKING, 0.0
        if 0.0 < braking <= able and is_behind(ego, other):
            able, late = self._ability(other.name)
            braking = required_braking(ego, other, late)
        if braking <= able:
            return ""
        after = f" of '{other.name}', which may act {late:.3g} s late," if late > 0.0 else ""
        what = f"tyres allow about {able:g}" if able == _MAX_BRAKING else f"'{other.name}' can do {able:g}"
        return f"{braking:.3g} m/s^2 of braking{after} would keep them apart ({what})"
