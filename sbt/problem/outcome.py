"""What one run gave: metrics, or the reason why there are none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from sbt.problem.plain import Values

__all__ = ["LISTED_ONLY", "UNCONFIRMED", "Job", "Outcome", "Status", "has_unconfirmed_contact"]

UNCONFIRMED, LISTED_ONLY = "contact with ", "listed with "
"""How the text begins of a contact that SUMO's own list does not have, and of an entry of that list without a contact."""


def has_unconfirmed_contact(text: str) -> bool:
    """Return whether what differs (`Outcome.unconfirmed`) holds a contact that SUMO does not list."""
    return any(part.startswith(UNCONFIRMED) for part in text.split(" | "))


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
    """contacts that SUMO's own list does not confirm, entries of it without a contact, and what differs"""
