"""One cell of a benchmark: a campaign whose metamodel is scored on the reference runs after every batch."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sbt.benchmark.reference import reference_rows
from sbt.benchmark.stores import SIMULATED, changes_in, open_store
from sbt.campaigns.settings import Acquisition, PlainConclusion
from sbt.campaigns.wording import failed_words
from sbt.config.assemble import assemble
from sbt.config.benchmark import Cell
from sbt.errors import FailedRunsError
from sbt.execution.protocol import SerialExecutor
from sbt.files import write_atomically
from sbt.loop.learner import FittedMetamodel, Learner
from sbt.loop.running import run_stages
from sbt.loop.stages import Batch, Campaign, Log, Progress
from sbt.metamodels.ended import ended
from sbt.problem.arrays import Points, Vector
from sbt.problem.outcome import Job, Outcome, Status
from sbt.problem.plain import Json, Value
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.pool import PoolSequence
from sbt.samplers.roi import RoiDraw, rejection
from sbt.samplers.sobol import SobolSequence
from sbt.store.database import PlannedRun, Store
from sbt.store.history import History

__all__ = ["PREDICTIONS", "CellProposal", "changes", "is_done", "run_cell"]

PREDICTIONS = "predictions.npz"
"""In the folder of a finished cell: y, mu, sigma and log odds of P(critical) at the reference runs."""
_CHUNK = 4096


def is_done(cell: Cell) -> bool:
    """Return whether a cell was run to its end, as it is configured now."""
    if not (cell.folder / PREDICTIONS).is_file() or changes(cell):
        return False
    with Store.read(cell.folder) as store:
        ended = store.conclusion
        whole = ended is not None and ended["runs"] == len(store.history())  # else it was to grow
        return ended is not None and whole and (ended["iterations"] == cell.iterations or ended["stopped"] == "no rows left")


def changes(cell: Cell) -> str:
    """Return in words how a cell that is there was made otherwise than it is configured; "" where it was not, or is not there."""
    if not Store.begun(cell.folder):
        return ""
    with Store.read(cell.folder) as store:
        return changes_in(store, cell.loaded, _fixed(cell))


def _fixed(cell: Cell) -> Json:
    """Return the settings of a cell, beside its configuration, that must not change: it may get more batches, not fewer."""
    fixed: Json = {"reference": cell.reference_runs, "max_candidates": cell.max_candidates}
    if Store.begun(cell.folder):
        with Store.read(cell.folder) as store:
            if store.configuration["budget"] > (asked := cell.loaded.config.budget):
                fixed["budget"] = asked
    return fixed


def run_cell(cell: Cell, progress: Callable[[Progress], None] | None = None) -> None:
    """Run one cell to its end, or go on where it was stopped.

    Args:
        cell: which one.
        progress: called after every run.

    Raises:
        InputError: the reference runs are missing, or the store was made with other settings.
        FailedRunsError: fewer than two of its runs went well.
        StoreError: it cannot be written.
    """
    parts, n = assemble(cell.loaded), cell.reference_runs
    scenario, config = parts.scenario, cell.loaded.config
    if parts.metamodel is None or parts.acquisition is None:
        raise ValueError(f"a cell needs a metamodel and an acquisition, but {cell.name} has none")
    rows = None if scenario.pool is not None else reference_rows(cell.reference, scenario, n)
    learner = _ReferenceLearner(scenario, parts.metamodel, config.seed, target_aware=cell.acquisition != "even", rows=rows)
    acquisition = parts.acquisition if cell.acquisition != "even" else None
    stage = _BenchmarkStage(scenario, learner, acquisition, config.seed, cell.iterations, cell.batch, cell.max_candidates)

    def conclude(log: Log) -> tuple[PlainConclusion, FittedMetamodel]:
        fitted = learner.fit(log.history)
        if fitted is None:
            why = failed_words(log.history) or f"there are {len(log.history)}"
            raise FailedRunsError(f"a metamodel needs two runs that went well, but {why}")
        _write_predictions(cell.folder, learner, fitted, log.history)
        return PlainConclusion({}), fitted

    with open_store(cell.folder, cell.loaded, scenario, **_fixed(cell)) as store:
        limit = None if config.executor.timeout == float("inf") else config.executor.timeout
        with _Recalling(SerialExecutor(parts.spec, limit), _known_runs(cell)) as executor:
            finished = run_stages(
                Campaign((stage,), conclude, recorded=scenario.pool, space=scenario.space), store, executor, seed=config.seed,
                budget=config.budget, requirement=scenario.requirement, versions="", listener=progress or (lambda _: None),
            )  # fmt: skip
        history = store.history()
        critical = scenario.requirement.critical_runs(history)
        store.conclude({
            "campaign": config.campaign, "scenario": config.scenario, "store": str(cell.folder), "runs": len(history),
            "ok": int(history.ok.sum()), "failed": int((~history.ok).sum()), "critical": int(critical.sum()),
            "iterations": len(store.iterations()), "stopped": finished.stopped, "seconds": dict(finished.seconds),
            "conclusion": {},
        })  # fmt: skip


@dataclass(frozen=True)
class CellProposal:
    """How a batch of a cell was chosen.

    Attributes:
        method: rejection, or pool where too few candidates were accepted.
        next_position: in the Sobol sequence.
        candidates: points that were scored.
        acceptance: share of them that rejection accepted.
        sampling_seconds: the choice took.
    """

    method: str
    next_position: int
    candidates: int
    acceptance: float | None
    sampling_seconds: float


@dataclass(frozen=True)
class _ReferenceLearner(Learner):
    """Scores on the reference runs; for a recorded table, on the rows that were not chosen."""

    rows: tuple[Points, Vector] | None = None

    def unseen(self, history: History) -> tuple[Points, Vector]:
        """Return x (n, d) and y (n,) that score."""
        return super().unseen(history) if self.rows is None else self.rows

    def fit(self, history: History) -> FittedMetamodel | None:
        """Return the fitted metamodel, with the seconds of fit and scoring in its record."""
        start = time.perf_counter()
        fitted = super().fit(history)
        if fitted is None:
            return None
        scoring = time.perf_counter() - start - fitted.seconds
        return replace(fitted, record=replace(fitted.record, fit_seconds=fitted.seconds, scoring_seconds=scoring))


@dataclass(frozen=True)
class _BenchmarkStage:
    """Batches of equal size: the first one even, the others from the acquisition, or even as well.

    Source:
        Winkelmann et al. (2022), sections IV-B and V-A.
    """

    scenario: LogicalScenario
    learner: _ReferenceLearner
    acquisition: Acquisition | None
    seed: int
    iterations: int
    batch: int
    max_candidates: int
    name: str = "benchmark"

    def stop(self, log: Log) -> str | None:
        """Return `iterations` when all batches were run."""
        pool = self.scenario.pool
        if pool is not None and len(log.history) >= len(pool.x):
            return "no rows left"
        return "iterations" if log.iteration >= self.iterations else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch, and the scores of the metamodel that chose it."""
        fitted = self.learner.fit(log.history) if log.iteration > 0 else None
        start = time.perf_counter()
        draw, x = self._draw(fitted, log)
        runs = tuple(PlannedRun(self.name, self.scenario.space.named(row)) for row in x)
        seconds = time.perf_counter() - start
        proposal = CellProposal(draw.method, draw.next_position, draw.candidates, draw.acceptance, seconds)
        return Batch(runs, proposal, fitted)

    def _draw(self, fitted: FittedMetamodel | None, log: Log) -> tuple[RoiDraw, Points]:
        """Return the draw and its points in the inputs' units, exactly as recorded where they are."""
        space, critical = self.scenario.space, self.scenario.requirement.critical
        acquisition = self.acquisition

        def score(u: Points) -> Vector:
            if fitted is None or acquisition is None:
                return np.zeros(len(u))
            return acquisition(fitted.predict(u), critical, space.log_density_in_cube(u))

        admissible = (lambda u: space.feasible(space.from_unit(u))) if space.constraints else None
        if self.scenario.pool is not None:
            u = np.clip(space.to_unit(self.scenario.pool.x), 0.0, 1.0)
            pool = PoolSequence(u, self.scenario.pool.taken(log.history.x), self.seed)
            n = min(self.batch, len(pool))
            draw = rejection(score, pool, n, start=0, seed=self.seed, label=log.iteration, max_candidates=len(pool))
            return draw, self.scenario.pool.x[pool.rows[draw.positions]]
        last = log.last(CellProposal)
        draws = partial(
            rejection, score, SobolSequence(space.dimension, self.seed), self.batch,
            start=0 if last is None else last.next_position, seed=self.seed, label=log.iteration,
            max_candidates=max(self.max_candidates, self.batch), accept_filter=admissible,
        )  # fmt: skip
        screen = fitted.log_ambiguity_bound if fitted is not None and acquisition is not None else None  # a_BI, the only one
        draw = draws(bound=screen, fill=False)
        if draw.method == "short":
            draw = draws()  # the pool ranks what was rejected, so all of it has to be scored
        return draw, space.from_unit(draw.u)


class _Recalling:
    """An executor that takes the outcomes of runs with the same inputs and seed from other cells of the scenario."""

    def __init__(self, executor: SerialExecutor, known: Mapping[tuple[int, tuple[Value, ...]], Outcome]):
        self._executor, self._known = executor, known

    def __enter__(self) -> _Recalling:
        """Start the executor."""
        self._executor.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        """Stop it."""
        self._executor.__exit__(*error)

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Yield one outcome a job."""
        new = []
        for job in jobs:
            known = self._known.get((job.seed, tuple(job.inputs.values())))
            if known is None:
                new.append(job)
            else:
                yield replace(known, index=job.index)
        yield from self._executor.run(new)


def _known_runs(cell: Cell) -> dict[tuple[int, tuple[Value, ...]], Outcome]:
    """Return the runs that went well in the even cells of this scenario and seed."""
    known = {}
    for folder in sorted(cell.folder.parents[2].glob(f"*/even/{cell.seed}")):
        if folder != cell.folder and Store.begun(folder):
            with Store.read(folder) as store:
                if changes_in(store, cell.loaded, {}, SIMULATED):
                    continue
                for r in store.history().training.records:
                    outcome = Outcome(r.index, Status(r.status), r.metrics, r.reason, r.seconds, r.collisions, r.unconfirmed)
                    known[r.seed, tuple(r.inputs.values())] = outcome
    return known


def _write_predictions(folder: Path, learner: _ReferenceLearner, fitted: FittedMetamodel, history: History) -> None:
    """Write the predictions of the last metamodel for the reference runs, for the figures."""
    x, y = learner.unseen(history)
    u, critical = learner.scenario.space.to_unit(x), learner.scenario.requirement.critical
    columns = []
    for k in range(0, len(u), _CHUNK):
        part = fitted.predict(u[k : k + _CHUNK])
        log_p, log_not = part.log_probability(critical)
        told = ended(part)
        columns.append(np.stack([told.mu, told.sigma, np.exp(log_p), log_p - log_not]))
    mu, sigma, p, odds = np.concatenate(columns, axis=1)
    ends = [critical.low, critical.high]
    content = io.BytesIO()
    np.savez_compressed(content, y=y, mu=mu, sigma=sigma, p=p, odds=odds, critical=critical.contains(y), requirement=ends)
    write_atomically(folder / PREDICTIONS, content.getvalue())
