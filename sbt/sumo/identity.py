"""What a recorded road user keeps: its id is its own, and its size is one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sbt.errors import RunError
from sbt.problem.outcome import Status
from sbt.sumo.actors import State
from sbt.sumo.levels import is_known

__all__ = ["check_sizes", "refuse_twice"]

_ALIKE = 0.01
"""Difference of two lengths or widths that are one (m)."""


def refuse_twice(name: str) -> None:
    """Refuse a vehicle with the id of a person: SUMO tells of both who is near by their ids alone.

    Raises:
        RunError: always.
    """
    raise RunError(Status.INVALID, f"no person may have the id of a vehicle, but there are both of '{name}': give persons others")


def check_sizes(sumo: Any, states: Mapping[str, State], names: Iterable[str]) -> None:
    """Refuse vehicles that have changed their size, by a new type, an id that was used again, or a train that has split.

    Metrics know one rectangle of each road user.

    Args:
        sumo: libsumo or traci.
        states: as recorded.
        names: of those who may be there; persons are left out.

    Raises:
        RunError: one has.
    """
    for name in names:
        if not is_known(sumo, name):
            continue
        state, size = states[name], (float(sumo.vehicle.getLength(name)), float(sumo.vehicle.getWidth(name)))
        if abs(size[0] - state.length) > _ALIKE or abs(size[1] - state.width) > _ALIKE:
            raise RunError(
                Status.INVALID,
                f"'{name}' must keep its size while it is recorded, but was {state.length:g} m by {state.width:g} m and is"
                f" {size[0]:g} m by {size[1]:g} m at t = {sumo.simulation.getTime():g} s: metrics know one size of everybody",
            )
