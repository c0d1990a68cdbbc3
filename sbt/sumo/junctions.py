"""Networks without lanes, or walking areas, inside junctions, over which SUMO moves road users within a step."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from sbt.metrics.geometry import FASTER, STEPPED

__all__ = ["Junctions", "told_of_junctions", "why_jumped"]

_FURTHER = 1.0
"""How far (m) nobody gets without a jump, beside what its speed explains."""
_PAVEMENT = {"pedestrian", "wheelchair"}
_WALKING_AREA = re.compile(r":.*_w\d+")
_REMEDY = "make it, and run SUMO, without no-internal-links"
_WALKING_REMEDY = "make it with netconvert's crossings.guess or walkingareas"


def why_jumped(*, walks: bool) -> str:
    """Return the end of a message about an ego that was moved over a junction within a step."""
    if walks:
        return f", as the network has no walking area there: {_WALKING_REMEDY}"
    return f", as the network has no lanes inside junctions: {_REMEDY}"


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

    @cached_property
    def lack_walking_areas(self) -> bool:
        """Whether the network that SUMO has loaded has no walking areas: walkers are put onto the next pavement."""
        return not any(map(_WALKING_AREA.fullmatch, self._sumo.edge.getIDList()))

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
        if walks:
            beside = _FURTHER if self.lack_walking_areas else STEPPED
            return moved > FASTER * driven + beside
        most = FASTER * driven + _FURTHER
        if moved <= most or not self.lack_lanes:
            return False
        return 0.0 <= self._sumo.vehicle.getLanePosition(name) <= most  # has just entered its edge


def told_of_junctions(sumo: Any) -> str:
    """Return in words that SUMO's network has junctions of some width, and no lanes inside them, or no walking areas."""
    junctions, said = Junctions(sumo), []
    if junctions.lack_lanes:
        said.append(("lanes inside junctions", "road users", "an ego", _REMEDY))
    allowed = (set(sumo.lane.getAllowed(lane)) for lane in sumo.lane.getIDList())
    if junctions.lack_walking_areas and any(who and who <= _PAVEMENT for who in allowed):
        said.append(("walking areas at junctions of its pavements", "walkers", "an ego on foot", _WALKING_REMEDY))
    return "; ".join(
        f"the network has no {lacks}, so that SUMO moves {who} over one within a step: {ego} there makes its run"
        f" invalid, and the tracks of others are interrupted there; {remedy}" for lacks, who, ego, remedy in said
    )  # fmt: skip


def _ends_before_next(lanes: Any, lane: str) -> bool:
    """Return whether there is a gap between a lane and one that follows it."""
    end = lanes.getShape(lane)[-1]
    return any(math.dist(end, lanes.getShape(link[0])[0]) > _FURTHER for link in lanes.getLinks(lane))
