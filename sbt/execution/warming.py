"""Warms up the traffic of a campaign before its first run: no run pays for it, or is late because of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from sbt.errors import InputError
from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import each
from sbt.problem.isolation import Warmable
from sbt.processes import scratch

__all__ = ["keeping_states", "warm_up"]


def warm_up(spec: ScenarioSpec, workers: int, tell: Callable[[str], None] = lambda _: None) -> None:
    """Make the warmed states that runs begin with, where they are not there yet.

    Args:
        spec: the scenario, with the isolation that was decided.
        workers: processes that warm up at once.
        tell: is called with what is done.

    Raises:
        InputError: the traffic does not warm up.
    """
    isolation = spec.isolated
    if isolation is None or not isolation.warm:
        return
    missing: list[tuple[ScenarioSpec, int]] = []
    for level in spec.levels:  # a state is of its step: a coarse run begins with a coarse warm-up
        simulate = level.resolve().simulate
        if isinstance(simulate, Warmable):
            missing += [(level, k) for k in range(isolation.seeds) if not simulate.warmed_up(k)]
    if missing:
        tell(f"warming up the traffic, {isolation.seeds} times until t = {isolation.until:g} s")
    for last in (False, True):  # a process that dies costs a second attempt
        failed = []
        for task, problem in each(_warm_up, missing, min(workers, max(len(missing), 1))):
            if problem is not None and last:
                raise InputError(f"traffic must warm up until t = {isolation.until:g} s, but warm-up {task[1]} failed: {problem}")
            failed += [task] if problem is not None else []
        missing = failed


@contextmanager
def keeping_states(spec: ScenarioSpec) -> Iterator[ScenarioSpec]:
    """Provide the scenario with a temporary folder for warmed states, for all processes that run it."""
    simulate = spec.resolve().simulate
    if not isinstance(simulate, Warmable) or not simulate.isolation.warm:
        yield spec
        return
    with scratch("warm") as folder:
        yield replace(spec, isolated=replace(simulate.isolation, states=folder))


def _warm_up(task: tuple[ScenarioSpec, int]) -> None:
    """Make one warmed state."""
    spec, k = task
    simulate = spec.resolve().simulate
    if isinstance(simulate, Warmable):
        simulate.warm_up(k)
