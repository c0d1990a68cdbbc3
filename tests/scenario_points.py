"""Points of a scenario's parameter space, for the tests that simulate."""

from __future__ import annotations

from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence

__all__ = ["centre", "sobol"]


def centre(scenario: LogicalScenario, **changes: float) -> dict[str, float]:
    """Return the centre of all ranges, with these changes."""
    return {p.name: p.centre for p in scenario.space.parameters} | changes


def sobol(scenario: LogicalScenario, n: int, seed: int = 11, *, close: bool = False) -> list[dict[str, float]]:
    """Return n low-discrepancy points; `close`: with time gaps in the lowest third of their range, where something happens."""
    u = SobolSequence(scenario.space.dimension, seed).points(0, n)
    if close and "d_t" in scenario.space.names:
        u[:, scenario.space.names.index("d_t")] *= 0.3
    return [dict(zip(scenario.space.names, row.tolist(), strict=True)) for row in scenario.space.from_unit(u)]
