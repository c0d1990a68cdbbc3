"""Networks without lanes inside junctions, over which SUMO moves road users within a step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

__all__ = ["WHY_JUMPED", "Junctions", "told_of_junctions"]

_FASTER, _FURTHER = 1.3, 1.0
"""How far nobody gets without a jump: this times its speed, as outer lanes of a bend are longer, and so far (m) beside that."""
_REMEDY = "make it, and run SUMO, without no-internal-links"
WHY_JUMPED = f", as the network has no lanes inside junctions: {_REMEDY}"
"""The end of a message about an ego that was moved over a junction within a step."""


class Junctions:
    """Tells who was moved over a junction within a step: there is no road for it in between.

    Args:
        sumo: libsumo or traci, started.
    """

    def __init__(self, sumo: Any):
        self._sumo = sumo

    @cached_property
    def lack_lanes(self) -> bool:
        """Whether the network that SUMO has loaded has no lanes inside junctions of some width, or SUMO leaves them out."""
        left_out = self._sumo.simulation.getOption("no-internal-links") == "true"
        if not left_out and any(edge.startswith(":") for edge in self._sumo.edge.getIDList()):
            return False
        return any(_ends_before_next(self._sumo.lane, lane) for lane in self._sumo.lane.getIDList())

    def jumped(
        self, name: str, last: Sequence[float], at: tuple[float, float], heading: float, half: float, driven: float
    ) -> bool:  # fmt: skip
        """Return whether a road user was moved over a junction in a step; what it changes lanes by is none of it.

        Args:
            name: id.
            last: where its centre was before, x and y (m), and its heading (rad).
            at: where its front is now; of a person, its centre (m).
            heading: its heading now (rad).
            half: of its length (m), 0 for a person.
            driven: how far it can have come, by its speed (m).
        """
        dx, dy = at[0] - last[0] - half * math.cos(last[2]), at[1] - last[1] - half * math.sin(last[2])
        middle = last[2] + 0.5 * math.remainder(heading - last[2], math.tau)
        ahead = dx * math.cos(middle) + dy * math.sin(middle) if half else math.hypot(dx, dy)
        return self.explain(name, abs(ahead), driven, walks=not half)

    def explain(self, name: str, moved: float, driven: float, *, walks: bool = False) -> bool:
        """Return whether a junction explains that one was moved so far (m), further than it can have driven (m)."""
        most = _FASTER * driven + _FURTHER
        if moved <= most or not self.lack_lanes:
            return False
        return walks or 0.0 <= self._sumo.vehicle.getLanePosition(name) <= most  # has just entered its edge


def told_of_junctions(sumo: Any) -> str:
    """Return in words that SUMO's network has junctions of some width, and no lanes inside them; "" elsewhere."""
    if not Junctions(sumo).lack_lanes:
        return ""
    return (
        "the network has no lanes inside junctions, so that SUMO moves road users over one within a step: an ego there"
        f" makes its run invalid, and the tracks of others are interrupted there; {_REMEDY}"
    )


def _ends_before_next(lanes: Any, lane: str) -> bool:
    """Return whether there is a gap between a lane and one that follows it."""
    end = lanes.getShape(lane)[-1]
    return any(math.dist(end, lanes.getShape(link[0])[0]) > _FURTHER for link in lanes.getLinks(lane))
