"""What SUMO's own list of collisions says of a contact, and why it says less or more than geometry.

A contact is that of the bodies' rectangles. It is confirmed where SUMO lists the pair within one second. SUMO looks
along lanes, and in junctions at lanes that it knows to conflict; it never compares bodies side by side across the
border of lanes, nor a vehicle with a pedestrian on a normal edge (measured: libsumo 1.28). So a contact that it does
not list is told apart, with what differs, and so is a collision that it lists where no bodies touch.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sbt.metrics.geometry import contact_part, overlap_depth
from sbt.problem.outcome import LISTED_ONLY, UNCONFIRMED
from sbt.problem.trace import ActorTrace

__all__ = ["CONFIRMED_WITHIN", "collisions_of", "listed_only", "unconfirmed_contact"]

CONFIRMED_WITHIN = 1.0
"""Time between a contact and its entry in SUMO's list, before or after (s)."""
_CREEPING, _ASKEW = 2.0, 5.0
"""Speed (m/s) up to which, and angle to the lane (degrees) from which on, a vehicle is askew."""


@dataclass(frozen=True)
class _Place:
    """Where a road user is: its lane, the edges under its body, and the junctions at which they begin or end.

    `prefix` begins all ids in SUMO; the properties for people leave it out.
    """

    id: str
    raw_lane: str
    person: bool
    edges: frozenset[str]
    nodes: frozenset[str]
    prefix: str = ""

    def _plain(self, name: str) -> str:
        return name.replace(self.prefix, "", 1) if self.prefix else name

    @property
    def name(self) -> str:
        return self._plain(self.id)

    @property
    def lane(self) -> str:
        return self._plain(self.raw_lane)

    @property
    def edge(self) -> str:
        return self.lane.rpartition("_")[0]

    @property
    def raw_edge(self) -> str:
        return self.raw_lane.rpartition("_")[0]

    @property
    def junction(self) -> str:
        """The junction that it is in; "" on a normal edge."""
        return self.edge[1:].rpartition("_")[0] if self.raw_lane.startswith(":") else ""


def collisions_of(sumo: Any, name: str) -> set[str]:
    """Return who collides with a road user now, by SUMO's list."""
    pairs = [(c.collider, c.victim) for c in sumo.simulation.getCollisions()]
    return {b if a == name else a for a, b in pairs if name in (a, b)}


def unconfirmed_contact(
    sumo: Any, ego: str, other: str, t: float, rectangles: tuple[ActorTrace, ActorTrace], *,
    persons: Iterable[str] = (), moved: Iterable[str] = (), prefix: str = "",
) -> str:  # fmt: skip
    """Return what differs where SUMO does not list a contact.

    Args:
        sumo: libsumo or traci, at the step of the contact.
        ego: the road user under test.
        other: whom it touched.
        t: time of the contact in the trace (s).
        rectangles: of the ego and of the other that touch, at the last one or two instants.
        persons: which of the two are persons.
        moved: which of the two are moved by poses and not by SUMO.
        prefix: of all ids in SUMO, left out in the text.
    """
    a, b = (_place(sumo, name, prefix, person=name in set(persons)) for name in (ego, other))
    depth = float(overlap_depth(*rectangles)[-1])
    swung = [text for one, body in zip((a, b), rectangles, strict=True) if one.person and (text := _swung(one, body, rectangles))]
    size = f"bodies overlap by {depth:.2f} m" if depth > 0 else "bodies touch within the step and are apart at its end"
    return f"{UNCONFIRMED}'{other}' at {t:.3f} s: {'; '.join([_why(sumo, a, b, set(moved)), size, *swung])}"


def _swung(person: _Place, body: ActorTrace, both: tuple[ActorTrace, ActorTrace]) -> str:
    """Return by how much a person turned in the step of a contact that it would not have without; "" where it would."""
    if len(body.heading) < 2:
        return ""
    before = [replace(one, heading=np.full(2, one.heading[0])) if one is body else one for one in both]
    if contact_part(before[0], before[1]) is not None:
        return ""
    turned = abs(math.remainder(body.heading[1] - body.heading[0], math.tau))
    return f"'{person.name}' touches as it turns by {math.degrees(turned):.0f} degrees within a step, else not"


def listed_only(sumo: Any, ego: str, other: str, t: float, apart: float | None, *, persons: Iterable[str] = ()) -> str:
    """Return what differs where SUMO lists a collision, but the bodies do not touch.

    Args:
        sumo: libsumo or traci, at the step of the entry.
        ego: the road user under test.
        other: the one that SUMO names with it.
        t: time of the entry in the trace (s).
        apart: distance of their bodies (m); None where the other is not recorded.
        persons: which of the two are persons.
    """
    a, b = (_place(sumo, name, person=name in set(persons)) for name in (ego, other))
    gap = "the other is not recorded" if apart is None else f"bodies are {apart:.2f} m apart"
    if a.lane == b.lane != "" and not a.junction:
        why = f"on lane '{a.lane}' SUMO compares positions along the lane, not sideways"
    elif a.junction or b.junction:
        why = f"at junction '{a.junction or b.junction}' SUMO's shapes differ (rears as its lanes have them)"
    else:
        why = f"SUMO sees both on the lane of one ('{a.lane}', '{b.lane}'), such as during a change of lanes"
    return f"{LISTED_ONLY}'{other}' at {t:.3f} s: {gap}; {why}"


def _place(sumo: Any, name: str, prefix: str = "", *, person: bool) -> _Place:
    domain, name = sumo.person if person else sumo.vehicle, prefix + name
    lane = domain.getLaneID(name)
    edges = {lane.rpartition("_")[0]} - {""}
    if edges and not person and domain.getLanePosition(name) < domain.getLength(name):  # its rear is further back
        route, k = domain.getRoute(name), max(domain.getRouteIndex(name), 0)
        left, back = domain.getLength(name) - domain.getLanePosition(name), k if lane.startswith(":") else k - 1
        while back >= 0 and left > 0:
            edges.add(route[back])
            left, back = left - sumo.lane.getLength(f"{route[back]}_0"), back - 1
    ends = (node for edge in edges for node in (sumo.edge.getFromJunction(edge), sumo.edge.getToJunction(edge)))
    return _Place(name, lane, person, frozenset(edges), frozenset(ends), prefix)


def _why(sumo: Any, a: _Place, b: _Place, moved: set[str]) -> str:
    """Return why SUMO does not list this pair."""
    for one in (a, b):
        if one.name in moved:
            return f"'{one.name}' is moved by poses, and SUMO compares only what it moves along lanes"
        if not one.lane:
            return f"'{one.name}' is on no lane, and SUMO compares only what is on lanes"
    if a.person or b.person:
        return _why_person(*((a, b) if a.person else (b, a)))
    if a.lane == b.lane:
        return _why_lane(sumo, a, b)
    if a.edge == b.edge and not a.junction:
        askew = [text for one in (a, b) if (text := _askew(sumo, one))]
        how = f"; {' and '.join(askew)}, as SUMO's sublane model turns who moves sideways" if askew else _sublane(sumo)
        return f"side by side on lanes '{a.lane}' and '{b.lane}', and SUMO compares along one lane only{how}"
    if not a.nodes & b.nodes:
        return f"'{a.edge}' and '{b.edge}' overlap in the plane but share no junction, and SUMO never compares them"
    if a.junction and a.junction == b.junction:
        pairs = ((a.raw_lane, b.raw_lane), (b.raw_lane, a.raw_lane))
        foes = any(other in sumo.lane.getInternalFoes(lane) for lane, other in pairs)
        if foes:
            return f"in junction '{a.junction}' SUMO's shapes (cars with corners cut off, rears on their lanes) do not overlap"
        lanes = f"of lanes '{a.lane}' and '{b.lane}' in junction '{a.junction}'"
        return f"SUMO knows no conflict {lanes} (unregulated ones have none), and never compares them"
    if a.junction or b.junction:
        inside, outside = (a, b) if a.junction else (b, a)
        return (
            f"'{inside.name}' is in junction '{inside.junction}' and '{outside.name}' on lane '{outside.lane}' beside it,"
            " and SUMO compares a junction's own lanes only"
        )
    if a.edges & b.edges:
        return (
            f"the rear of one reaches back beside the other (lanes '{a.lane}' and '{b.lane}'), and SUMO compares along one lane"
        )
    opposite = sumo.edge.getFromJunction(a.raw_edge) == sumo.edge.getToJunction(b.raw_edge) and a.nodes == b.nodes
    how = "oncoming, across the middle of the road" if opposite else "on different roads at a junction"
    return f"{how} (lanes '{a.lane}' and '{b.lane}'), and SUMO compares along one lane only"


def _why_person(person: _Place, vehicle: _Place) -> str:
    if vehicle.person:
        return "SUMO does not compare pedestrians with each other"
    if not person.junction:
        return f"'{person.name}' walks on edge '{person.edge}', and SUMO compares pedestrians with vehicles only on crossings"
    if person.edge.rpartition("_")[2].startswith("w"):
        return (
            f"'{person.name}' is on the walking area '{person.edge}' beside lane '{vehicle.lane}', and SUMO compares pedestrians"
            " with vehicles only on crossings"
        )
    return (
        f"'{person.name}' is on '{person.edge}' and '{vehicle.name}' on lane '{vehicle.lane}': SUMO compares a crossing with the"
        " vehicles of lanes that cross it, by shapes with corners cut off"
    )


def _why_lane(sumo: Any, a: _Place, b: _Place) -> str:
    """Return how far apart SUMO sees two vehicles of one lane."""
    at = {one.id: sumo.vehicle.getLanePosition(one.id) for one in (a, b)}
    front = a if at[a.id] >= at[b.id] else b
    rear = b if front is a else a
    gap = at[front.id] - sumo.vehicle.getLength(front.id) - at[rear.id]
    if gap >= 0:
        return f"along lane '{a.lane}' SUMO sees a gap of {gap:.2f} m"
    sideways = abs(sumo.vehicle.getLateralLanePosition(a.id) - sumo.vehicle.getLateralLanePosition(b.id))
    return f"on lane '{a.lane}' SUMO sees them {-gap:.2f} m into each other and {sideways:.2f} m sideways{_sublane(sumo)}"


def _sublane(sumo: Any) -> str:
    """Return a hint where SUMO does not look sideways."""
    return "" if _has_sublanes(sumo) else " (no sublane model: lateral-resolution is not set)"


def _has_sublanes(sumo: Any) -> bool:
    resolution = float(sumo.simulation.getOption("lateral-resolution") or 0.0)
    return resolution > 0 and math.isfinite(resolution)


def _askew(sumo: Any, one: _Place) -> str:
    """Return by how much a vehicle that stands or creeps in the sublane model is turned out of its lane; "" where it is not."""
    vehicle, speed = sumo.vehicle, sumo.vehicle.getSpeed(one.id)
    if speed > _CREEPING or not _has_sublanes(sumo):
        return ""
    along = sumo.lane.getAngle(one.raw_lane, vehicle.getLanePosition(one.id))
    turned = (vehicle.getAngle(one.id) - along + 180.0) % 360.0 - 180.0
    return f"'{one.name}' is askew by {abs(turned):.0f} degrees at {speed:.2g} m/s" if abs(turned) > _ASKEW else ""
