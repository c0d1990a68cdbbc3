"""What one run gave: metrics, or the reason why there are none."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from sbt.problem.plain import Values

__all__ = [
    "CROSSED", "DROVE_ON", "IMPOSSIBLE", "LISTED_ONLY", "OTHER_LEVEL", "STOPPED", "STRUCK", "TELEPORTED", "UNCONFIRMED", "Doubt",
    "Job", "Outcome", "Status", "doubts", "given", "reason_alone", "with_given",
]  # fmt: skip

UNCONFIRMED, LISTED_ONLY = "contact with ", "listed with "
"""How the text begins of a contact that SUMO's own list does not have, and of an entry of that list without a contact."""
STRUCK, OTHER_LEVEL = "hit from behind by ", "on another level: "
"""How the text begins of a contact with a recorded road user from behind, and of one on a road taken for a bridge."""
IMPOSSIBLE, STOPPED = "as no vehicle can: ", "stopped dead: "
"""How the text begins of a motion of the ego, and of another, that no tyre holds: commanded, or done by SUMO."""
TELEPORTED, CROSSED = "teleported: ", "moved over a junction: "
"""How the text begins of a road user near the ego that was moved to another place, and of one over a junction without lanes."""
DROVE_ON = "drove on after a collision: "
"""How the text begins of two others near the ego that drove into each other, and on."""

_GAVE = "; the run gave "
"""What stands in a reason before the metrics that a failed run gave beside the one that it did not."""


def with_given(reason: str, metrics: Mapping[str, float]) -> str:
    """Return the reason why a run failed, with the metrics that it gave."""
    return f"{reason}{_GAVE}{json.dumps(dict(metrics))}" if metrics else reason


def given(reason: str) -> dict[str, float]:
    """Return the metrics that a failed run gave, by its reason.

    >>> given(with_given("metric pet must be finite, inf or -inf, but got nan", {"collision": 1.0}))
    {'collision': 1.0}
    """
    if _GAVE not in reason:
        return {}
    try:
        return {name: float(value) for name, value in json.loads(reason.rpartition(_GAVE)[2]).items()}
    except (AttributeError, TypeError, ValueError):  # a text of somebody's own
        return {}


def reason_alone(reason: str) -> str:
    """Return why a run failed, without what it gave."""
    return reason.partition(_GAVE)[0]


class Doubt(StrEnum):
    """What is doubtful about a run, mostly its contacts, as a table says it."""

    UNCONFIRMED = "unconfirmed"
    """a contact that SUMO's own list does not have"""
    LISTED_ONLY = "listed only"
    """an entry of that list without a contact"""
    STRUCK = "hit from behind by one who does not react"
    """a recorded road user drove into the ego from behind"""
    OTHER_LEVEL = "taken for another level"
    """bodies overlap in the plane, on roads that are taken for bridges, since the network has no heights"""
    IMPOSSIBLE = "ego moves as no vehicle can"
    """it accelerates or brakes by more than tyres hold"""
    TELEPORTED = "somebody near the ego was teleported"
    """a road user was moved to another place, such as by SUMO out of a jam"""
    CROSSED = "somebody near the ego was moved over a junction"
    """within a step, as the network has no lanes, or no walking areas, inside junctions"""
    STOPPED = "another road user was stopped dead"
    """a road user brakes by more than tyres hold, such as SUMO lets one before a red light or where its lane ends"""
    DROVE_ON = "others near the ego collided and drove on"
    """two other road users drove into each other, and on: SUMO stops nobody"""


_BEGINNINGS = {
    UNCONFIRMED: Doubt.UNCONFIRMED, LISTED_ONLY: Doubt.LISTED_ONLY, STRUCK: Doubt.STRUCK, OTHER_LEVEL: Doubt.OTHER_LEVEL,
    IMPOSSIBLE: Doubt.IMPOSSIBLE, TELEPORTED: Doubt.TELEPORTED, CROSSED: Doubt.CROSSED, STOPPED: Doubt.STOPPED,
    DROVE_ON: Doubt.DROVE_ON,
}  # fmt: skip


def doubts(text: str) -> tuple[Doubt, ...]:
    """Return what is doubtful by the text of a run (`Outcome.unconfirmed`), each once."""
    found = (doubt for part in text.split(" | ") for words, doubt in _BEGINNINGS.items() if part.startswith(words))
    return tuple(dict.fromkeys(found))


class Status(StrEnum):
    """How a run ended: the run of the software, not the drive of the car."""

    OK = "ok"
    """metrics are finite and the realised initial state is the one asked for"""
    FAILED = "failed"
    """the simulation or a metric raised, or a metric is not finite"""
    TIMEOUT = "timeout"
    """longer than the allowed wall-clock time"""
    CRASHED = "crashed"
    """the worker process died, twice"""
    INVALID = "invalid"
    """SUMO did not realise the concrete scenario that was asked for"""


@dataclass(frozen=True)
class Job:
    """One concrete scenario to run: plain data, the same in every process."""

    index: int
    inputs: Values
    seed: int
    level: int = 0
    """of fidelity, 0 the scenario's own"""


@dataclass(frozen=True)
class Outcome:
    """The result of one run; `metrics` is empty unless `status` is OK."""

    index: int
    status: Status
    metrics: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""
    seconds: float = 0.0
    """wall-clock time in the worker (s)"""
    collisions: str = ""
    """SUMO's own collision list, as a cross-check of the geometric verdict"""
    unconfirmed: str = ""
    """contacts that SUMO's own list does not confirm and what differs, and other doubts about contacts (`doubts`)"""
    level: int = 0
    """of fidelity, as of the job"""
