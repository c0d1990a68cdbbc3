"""Whether an ego that is no longer there has arrived: SUMO's list of arrivals has those that it removed, too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from sbt.sumo.demand import seconds_of
from sbt.sumo.departures import number_or_none

__all__ = ["Leaving", "why_gone"]

_FASTER, _GAINED, _FURTHER = 1.3, 10.0, 1.0
"""How far a vehicle comes in a step: this times its speed, with an acceleration of so many m/s^2 more, and so far (m)."""


class Leaving:
    """Where an ego is on its route.

    Args:
        sumo: libsumo or traci, started.
        ego: id of a vehicle.
        arrival: its arrivalPos and arrivalEdge, None without the latter; None: neither is known.
    """

    def __init__(self, sumo: Any, ego: str, arrival: tuple[str, str | None] | None):
        self._sumo, self._ego = sumo, ego
        self._arrival = arrival
        self._somewhere, self._at_end = arrival is not None and arrival[1] is not None, arrival == ("max", None)
        self._patience = _patience(sumo.simulation.getOption)
        self._route, self._edges = "", tuple[str, ...]()
        self._index, self._position, self._waited, self._inside = 0, 0.0, 0.0, False

    def look(self) -> None:
        """Note where it is now."""
        of = self._sumo.vehicle
        route = of.getRouteID(self._ego)
        if route != self._route:
            self._route, self._edges = route, tuple(of.getRoute(self._ego))
        if math.isfinite(self._patience):
            self._waited = of.getWaitingTime(self._ego)
        self._index, self._position = of.getRouteIndex(self._ego), of.getLanePosition(self._ego)
        road = of.getRoadID(self._ego)
        self._inside = road.startswith(":")  # a junction, behind the edge
        if not self._inside and road != self._edges[self._index]:  # it overtakes on the opposite lane
            self._position = self._sumo.lane.getLength(of.getLaneID(self._ego)) - self._position

    def on_last_edge(self) -> tuple[str, float, float] | None:
        """Return the last edge of its route, where it was on it, and where it arrives (m); None where one is not known."""
        if self._arrival is None or self._somewhere or self._inside or self._index < len(self._edges) - 1:
            return None
        goal, length = self._edges[-1], self._sumo.lane.getLength(f"{self._edges[-1]}_0")
        end = length if self._at_end else number_or_none(self._arrival[0])
        return None if end is None else (goal, self._position, min(end + length if end < 0.0 else end, length))

    def why_removed(self, speed: float, dt: float) -> str:
        """Return why one that SUMO lists as arrived has not, as the end of a message; "" where it has.

        Args:
            speed: when it was last there (m/s).
            dt: step (s).
        """
        here, goal = self._edges[self._index], self._edges[-1]
        length, reach = self._sumo.lane.getLength, _FASTER * speed * dt + _GAINED * dt * dt + _FURTHER
        left = sum(length(f"{edge}_0") for edge in self._edges[self._index + self._inside : -1])  # up to its last edge
        left -= 0.0 if self._inside else self._position
        left += length(f"{goal}_0") if self._at_end else 0.0
        place = f"in the junction behind '{here}'" if self._inside else f"{self._position:.0f} m along '{here}'"
        if self._waited >= self._patience - 1.5 * dt:
            return f"SUMO removed it from a jam, {place} (option time-to-teleport.remove)"
        if left <= reach or self._somewhere:
            return ""
        if self._index < len(self._edges) - 1:
            return f"it was removed {place}, before the end of its route on '{goal}'"
        return f"its route was cut to end {place} (a rerouter, or the loop)"


def _patience(option: Callable[[str], str]) -> float:
    """Return how long a vehicle waits before SUMO removes it from a jam (s); inf: it does not."""
    if option("time-to-teleport.remove") != "true":
        return math.inf
    limits = [seconds_of(option(f"time-to-teleport{of}")) or 0.0 for of in ("", ".highways", ".disconnected")]
    return min((limit for limit in limits if limit > 0.0), default=math.inf)


def why_gone(sumo: Any, *, moved: bool) -> str:
    """Return what may have taken a vehicle off the road that has not arrived, as the end of a message.

    Args:
        sumo: libsumo or traci.
        moved: the loop has moved it by poses.
    """
    if moved:
        return "off the lanes SUMO keeps only whom the loop moves (moveToXY) in every step"
    if calibrators := sumo.calibrator.getIDList():
        return f"the loop has removed it, or SUMO, as calibrators do: the files have '{calibrators[0]}'"
    return "the loop, or SUMO, has removed it"
