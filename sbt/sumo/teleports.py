"""Who near the ego is moved to another place, by SUMO (a teleport) or by a loop, and what is told of it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import CROSSED, TELEPORTED, Status
from sbt.sumo.junctions import why_jumped

__all__ = ["Teleports"]


class Teleports:
    """What is told of road users that were moved to another place, each once.

    Args:
        simulation: of libsumo or traci.
        ego: id of the vehicle under test, which must not be moved.

    Attributes:
        ending: whom SUMO puts to another place in this step.
    """

    def __init__(self, simulation: Any, ego: str = ""):
        self._simulation, self._ego = simulation, ego
        self._begun: Sequence[str] = ()
        self.ending: Sequence[str] = ()
        self._notes: dict[str, str] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """The doubts of a run, as `Outcome.unconfirmed` has them."""
        return tuple(self._notes.values())

    def look(self) -> None:
        """Ask SUMO whom it teleports in this step: it may take a vehicle off the road and put it there steps later."""
        of = self._simulation
        self._begun = of.getStartingTeleportIDList() if of.getStartingTeleportNumber() else ()
        self.ending = of.getEndingTeleportIDList() if of.getEndingTeleportNumber() else ()

    def jump(self, name: str, t: float, moved: float, *, crossed: bool = False, walks: bool = False) -> None:
        """Note one who was moved that far (m) within the step to t (s); crossed: over a junction without lanes inside.

        Raises:
            RunError: it is the ego.
        """
        if name == self._ego:
            how = f"was moved by {moved:.0f} m within a step at {t:.3f} s{why_jumped(walks=walks) if crossed else ''}"
            raise RunError(Status.INVALID, f"the ego '{name}' must stay on its way, but {how}")
        self._note(name, t, f"it was moved by {moved:.0f} m, and its track is interrupted", CROSSED if crossed else TELEPORTED)

    def compare(self, before: Collection[str], now: Collection[str], t: float) -> None:
        """Note whom SUMO has taken off the road next to the ego, or put there: those recorded before and now, at t (s)."""
        for name in self._begun:
            if name in before and name not in now:
                self._note(name, t, "SUMO took it off the road, and its track is interrupted")
        for name in self.ending:
            if name in now and name not in before:
                self._note(name, t, "SUMO put it there")

    def _note(self, name: str, t: float, what: str, how: str = TELEPORTED) -> None:
        self._notes.setdefault(name, f"{how}'{name}' at {t:.3f} s: {what}")
