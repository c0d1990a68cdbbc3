"""What a check of a scenario finds, and what it finds of recorded rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from sbt.loop.stages import notes_of
from sbt.problem.plain import Value
from sbt.problem.scenario import LogicalScenario

__all__ = ["Finding", "row_findings", "some_rows"]

_TRIED = 17
"""Rows of a table that are looked up, spread over it; it has no centre and no corners."""


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
