"""What `check` proves of covariates: they are known before the run, finite, and the same whatever has been run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from sbt.errors import SbtError
from sbt.problem.arrays import Points
from sbt.problem.covariates import Covariates
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import stream
from sbt.workflows.findings import Finding

__all__ = ["Told", "covariates_first"]

_RULE = "covariates are known before the run"
_SPREAD = 200
"""Further pairs, drawn from the inputs' distribution, of which they must be finite: what few seeds draw would stop a
campaign."""


Told = Callable[[], Covariates | None]
"""Gives what a campaign looks at of what seeds draw; None: nothing."""


def covariates_first(
    scenario: LogicalScenario, jobs: Sequence[tuple[Values, int]], told: Told | None = None
) -> Callable[[], list[Finding]]:
    """Compute the covariates of runs that are still to be executed; what is returned computes them again, and compares.

    Args:
        scenario: as configured.
        jobs: values and seed of each run.
        told: its covariates, where a campaign asks for others than its own.
    """
    told = partial(Covariates.of, scenario) if told is None else told
    before, names, problem = _computed(told, jobs)

    def afterwards() -> list[Finding]:
        if problem:
            return [Finding(_RULE, ok=False, detail=problem)]
        if before is None:
            return []
        after, _, failed = _computed(told, jobs)
        if failed or after is None:
            return [Finding(_RULE, ok=False, detail=f"after the runs: {failed or 'there are none'}")]
        differ = [name for k, name in enumerate(names) if (before[:, k] != after[:, k]).any()]
        if differ:
            return [Finding(_RULE, ok=False, detail=f"after the runs, {', '.join(differ)} of the same pairs differ")]
        return [Finding(_RULE, ok=True, detail=f"{len(names)} covariates of {len(jobs)} pairs, the same before and after them")]

    return afterwards


def _computed(told: Told, jobs: Sequence[tuple[Values, int]]) -> tuple[Points | None, tuple[str, ...], str]:
    """Return the covariates (n, c) of these pairs and their names, or why there are none; None: the scenario tells none."""
    try:
        found = told()
        if found is None:
            return None, (), ""
        space = found.scenario.space
        x = np.array([[p.number(values[p.name]) for p in space.parameters] for values, _ in jobs])
        found.at(space.sample(_SPREAD, stream(0, "covariates")), range(_SPREAD), keep=False)
        return found.at(x, [seed for _, seed in jobs], keep=False), found.names, ""
    except SbtError as error:
        return None, (), str(error)
