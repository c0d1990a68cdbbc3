"""What a check of a scenario finds, and what it finds of recorded rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from sbt.errors import SbtError
from sbt.loop.stages import notes_of
from sbt.problem.plain import Value, Values
from sbt.problem.scenario import LogicalScenario
from sbt.workflows.networks import net_of

__all__ = ["Finding", "net_findings", "row_findings", "some_rows"]

_TRIED = 17
"""Rows of a table that are looked up, spread over it; it has no centre and no corners."""
_MOST_NAMED = 5
"""Junctions that are named."""


@dataclass(frozen=True)
class Finding:
    """One rule of the contract, whether it holds, what was seen, and the same as numbers by name."""

    rule: str
    ok: bool
    detail: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_rule(self) -> bool:
        """Whether it can be broken; else it only informs."""
        return not self.rule.startswith("for information")

    def __str__(self) -> str:
        """Return a line: whether the rule holds, or that it only informs."""
        mark = "ok  " if self.is_rule else "note"
        return f"{mark if self.ok else 'FAIL'}  {self.rule}{': ' if self.detail else ''}{self.detail}"


def some_rows(scenario: LogicalScenario) -> list[dict[str, Value]]:
    """Return inputs of rows spread over a recorded table; none of a scenario that is run."""
    if scenario.pool is None:
        return []
    x = scenario.pool.x
    return [scenario.space.named(x[k]) for k in np.unique(np.linspace(0, len(x) - 1, _TRIED).astype(int))]


def row_findings(scenario: LogicalScenario) -> Iterator[Finding]:
    """Yield what is to be known of a recorded table; nothing of a scenario that is run."""
    if scenario.pool is not None:
        tried = f"{len(scenario.pool.x):,} rows; {len(some_rows(scenario))} of them are looked up for centre and corners."
        yield Finding("for information: recorded rows", ok=True, detail=" ".join([tried, *notes_of(scenario)]))


def net_findings(scenario: LogicalScenario, jobs: Sequence[tuple[Values, int]]) -> list[Finding]:
    """Return where nobody has right of way in the network of the first run; nothing of one that cannot be read: runs say why."""
    from sbt.sumo.nets import unregulated

    junctions: tuple[str, ...] = ()
    with suppress(SbtError, OSError):
        nets = [net_of(scenario, *job) for job in jobs[:1]]
        junctions = tuple(name for net in nets if net is not None for name in unregulated(net))
    if not junctions:
        return []
    more = f" and {len(junctions) - _MOST_NAMED} more" if len(junctions) > _MOST_NAMED else ""
    names = ", ".join(f"'{name}'" for name in junctions[:_MOST_NAMED])
    what = "SUMO lets crossing streams drive through each other there; another type (priority, by netconvert)"
    detail = f"{names}{more} {'is' if len(junctions) == 1 else 'are'} unregulated: {what} gives right of way"
    return [Finding("for information: junctions without right of way", ok=True, detail=detail)]
