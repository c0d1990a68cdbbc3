"""How much of the simulator is kept from run to run, as it was decided for a campaign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from sbt.problem.plain import Json, JsonMapping
    from sbt.problem.scenario import Simulate
    from sbt.problem.space import ParameterSpace

__all__ = ["SNAPSHOT", "Isolation", "Warmable", "warm_ups"]

SNAPSHOT = "snapshot"
"""Level of runs that begin with traffic which was warmed up once."""

_RUNS_EACH, _MOST, _OF_ESTIMATE = 50, 8, 20
"""Runs for which one more warm-up pays, most warm-ups of a search, and those of an estimate, whose interval rests on them."""


def warm_ups(budget: int, *, estimating: bool) -> int:
    """Return the number of warm-ups of a campaign that states none.

    >>> warm_ups(100, estimating=False), warm_ups(500, estimating=False), warm_ups(500, estimating=True)
    (2, 8, 20)
    """
    return _OF_ESTIMATE if estimating else min(_MOST, max(1, budget // _RUNS_EACH))


@dataclass(frozen=True)
class Isolation:
    """The isolation level of a campaign, and what it rests on.

    Args:
        level: fresh, or snapshot: a run begins with the state at `until`, of the warm-up that its seed chooses.
        until: simulated time at which warm-ups end (s).
        seeds: number of warm-ups; a run begins with that of its seed modulo this number.
        states: folder in which the warmed states are kept; "": a temporary one of each process.
        why: why the level is not snapshot; "" where nothing stands against it.
        forking: a run is a child of the process that has loaded the network, where the system offers that; False: a run loads
            the network itself. Both give the same run.
    """

    level: str = "fresh"
    until: float = 0.0
    seeds: int = 0
    states: str = ""
    why: str = ""
    forking: bool = True

    @property
    def warm(self) -> bool:
        """Whether runs begin with warmed traffic."""
        return self.level == SNAPSHOT

    def described(self) -> Json:
        """Return what a store remembers of it."""
        return {"level": self.level, "until": self.until, "seeds": self.seeds} if self.warm else {"level": self.level}

    @classmethod
    def read(cls, data: JsonMapping, states: str = "") -> Isolation:
        """Return what a store remembers."""
        return cls(str(data["level"]), float(data.get("until", 0.0)), int(data.get("seeds", 0)), states)


@runtime_checkable
class Warmable(Protocol):
    """A `Simulate` whose traffic can be warmed up once for many runs."""

    @property
    def isolation(self) -> Isolation:
        """The isolation of its runs."""
        ...

    def isolation_in(self, space: ParameterSpace, seeds: int) -> Isolation:
        """Return the level at which it runs the scenarios of a space; `seeds`: number of warm-ups where none is stated.

        Raises:
            InputError: a warm-up is asked for, but impossible; the message says why and where.
        """
        ...

    def isolated(self, isolation: Isolation) -> Simulate:
        """Return a copy that runs at this level."""
        ...

    def warm_up(self, snapshot: int) -> None:
        """Make the state of one warm-up, from 0 on, where it is not there yet."""
        ...

    def warmed_up(self, snapshot: int) -> bool:
        """Return whether the state of a warm-up is there."""
        ...
