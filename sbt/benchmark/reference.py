"""Reference runs: random concrete scenarios that no metamodel learns from and every cell is scored on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sbt.benchmark.stores import open_store
from sbt.campaigns.settings import PlainConclusion
from sbt.config.assemble import assemble
from sbt.config.load import Loaded
from sbt.errors import InputError
from sbt.execution.local import LocalExecutor
from sbt.execution.protocol import Executor, SerialExecutor
from sbt.loop.running import run_stages
from sbt.loop.stages import Batch, Campaign, Log, Progress
from sbt.problem.arrays import Points, Vector
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import stream
from sbt.store.database import PlannedRun, Store
from sbt.store.history import VALIDATION

__all__ = ["make_reference", "reference_rows"]

_CHUNK = 5000
"""Runs planned at a time."""


@dataclass(frozen=True)
class _RandomStage:
    """Uniform random runs of the box, a few thousand at a time."""

    scenario: LogicalScenario
    seed: int
    n: int
    name: str = VALIDATION

    def stop(self, log: Log) -> str | None:
        """Return `budget` once all runs are done."""
        return "budget" if len(log.history) >= self.n else None

    def propose(self, log: Log) -> Batch:
        """Return the next chunk; run k does not depend on how many are requested."""
        start, space = len(log.history), self.scenario.space
        stop = min(start - start % _CHUNK + _CHUNK, self.n)
        rng = stream(self.seed, "reference", start // _CHUNK)
        points: list[Points] = []
        missing = stop - (start - start % _CHUNK)
        while missing > 0:
            u = rng.random((_CHUNK, space.dimension))
            u = u[space.feasible(space.from_unit(u))] if space.constraints else u
            points.append(u[:missing])
            missing -= len(points[-1])
        x = space.from_unit(np.concatenate(points))[start % _CHUNK :]
        named = [space.named(row) for row in x]
        return Batch(tuple(PlannedRun(VALIDATION, inputs) for inputs in named), {"method": "random"})


def make_reference(loaded: Loaded, workers: int, progress: Callable[[Progress], None] | None = None) -> Path | None:
    """Make the reference runs of one scenario, or those that are missing.

    Args:
        loaded: the campaign of them; its budget is their number.
        workers: processes.
        progress: called after every run.

    Returns:
        The folder of their store; None for a recorded table, whose rows are their own reference.

    Raises:
        InputError: a combined requirement.
    """
    config, parts = loaded.config, assemble(loaded)
    if parts.scenario.requirement.combined:
        raise InputError(f"a benchmark needs requirements on one metric, but got {parts.scenario.requirement.metric}")
    if parts.scenario.pool is not None:
        return None
    folder = Path(config.store)
    with open_store(folder, loaded, parts.scenario) as store:
        done = store.counts
        if sum(done.values()) - done.get("planned", 0) >= config.budget and not done.get("planned", 0):
            return folder
        stage = _RandomStage(parts.scenario, config.seed, config.budget)
        limit = None if config.executor.timeout == float("inf") else config.executor.timeout
        executor: Executor = SerialExecutor(parts.spec, limit) if workers == 1 else LocalExecutor(parts.spec, workers, limit)
        with executor:
            run_stages(
                Campaign((stage,), lambda log: (PlainConclusion({}), None), space=parts.scenario.space), store, executor,
                seed=config.seed, budget=config.budget, requirement=parts.scenario.requirement, versions="",
                listener=progress or (lambda _: None),
            )  # fmt: skip
    return folder


def reference_rows(folder: Path, scenario: LogicalScenario, n: int) -> tuple[Points, Vector]:
    """Return x (m, d) and y (m,) of the first n reference runs, m <= n: without those that failed.

    Raises:
        InputError: the store has fewer than n runs.
    """
    with Store.read(folder) as store:
        history = store.history()
    if len(history) < n:
        raise InputError(f"{folder} must hold {n} reference runs, but has {len(history)}: make them with --reference-only")
    first = history.where(history.index < n)
    return first.held_out.x, first.held_out.y(scenario.requirement.metric)
