"""Other samplers on the same scenario, requirement and budget, in a table that can be stopped and continued."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from sbt.benchmark.outside import OUTSIDE
from sbt.campaigns.falsification import METHODS
from sbt.campaigns.records import CONFIRM
from sbt.config.assemble import assemble, scenario_of
from sbt.config.load import Loaded
from sbt.errors import InputError
from sbt.execution.protocol import SerialExecutor
from sbt.files import scratch_in
from sbt.problem.arrays import Points, Vector
from sbt.problem.cube import CONTINUOUS
from sbt.problem.outcome import Job, Status
from sbt.problem.plain import Json, JsonMapping
from sbt.samplers.search import DEFLATION
from sbt.seeds import run_seed
from sbt.store.database import DATABASE, Store
from sbt.workflows.running import run_study
from sbt.workflows.study import Study

__all__ = ["SAMPLERS", "Cell", "compare", "table"]

SAMPLERS = (*(name for name in METHODS if name != "cma_es"), *OUTSIDE)
"""What can be compared: the campaign's own methods, and samplers of others."""


@dataclass(frozen=True)
class Cell:
    """One sampler with one seed.

    Args:
        scenario, sampler, seed, budget: what was run.
        runs: until it stopped, confirmations aside.
        runs_to_first: runs it took to the first critical one; None: there was none.
        critical: runs.
        distinct: critical runs that are farther than the deflation radius from all earlier ones so counted.
        seconds: wall clock.
        failed: runs without a metric; None: not known.
    """

    scenario: str
    sampler: str
    seed: int
    budget: int
    runs: int
    runs_to_first: int | None
    critical: int
    distinct: int
    seconds: float
    failed: int | None = None


def compare(
    loaded: Loaded, samplers: Sequence[str], seeds: int, folder: Path, listener: Callable[[Cell], None] = lambda _: None
) -> list[Cell]:
    """Return one cell a sampler and seed; cells that the folder already holds are not run again.

    Args:
        loaded: a falsification; where `stop.failures` is set, every sampler stops there.
        samplers: of `SAMPLERS`.
        seeds: the configuration's seed and the ones after it.
        folder: keeps `compare.jsonl`, a line a finished cell.
        listener: called after every cell.

    Raises:
        InputError: not a falsification, no or an unknown sampler, recorded rows, a combined requirement, a library that is not
            installed, or a folder that is the store of a campaign.
    """
    config = loaded.config
    if config.campaign != "falsification":
        raise InputError(f"compare needs campaign falsification, but got {config.campaign}")
    samplers = tuple(dict.fromkeys(samplers))
    for name in samplers or ("",):
        if name not in SAMPLERS:
            raise InputError(f"a sampler must be one of {', '.join(SAMPLERS)}, but got '{name}'")
        if name in OUTSIDE:  # what is not installed is found before the first run
            OUTSIDE[name](2, config.seed, config.initial, CONTINUOUS)
    if scenario_of(loaded).requirement.combined:
        raise InputError(f"compare needs a requirement on one metric, but got {scenario_of(loaded).requirement.metric}")
    if (folder / DATABASE).is_file():
        raise InputError(f"compare needs a folder of its own (--into), but {folder} is the store of a campaign")
    if scenario_of(loaded).pool is not None:
        raise InputError("compare needs a scenario that can be simulated, but got recorded rows")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "compare.jsonl"
    settings = _settings(loaded)
    finished = dict(_finished(path, settings))
    cells = []
    for seed in range(config.seed, config.seed + seeds):
        for name in samplers:
            cell = finished.get((name, seed))
            if cell is None:
                cell = _run(loaded, name, seed)
                with path.open("a") as file:
                    file.write(json.dumps({**vars(cell), "asked": settings}) + "\n")
                listener(cell)
            cells.append(cell)
    return cells


def _settings(loaded: Loaded) -> Json:
    """Return the settings that a cell depends on, beside sampler and seed."""
    settings = loaded.config.model_dump(mode="json", exclude={"seed", "store", "executor", "acquisition"})
    kinds = [choice.kind for choice in (loaded.config.ego, loaded.config.metamodel) if choice is not None]
    files = loaded.scope.prints([loaded.config.scenario, *kinds, *loaded.config.metrics])
    return json.loads(json.dumps({**settings, **({"files": files} if files else {})}))


def _finished(path: Path, settings: JsonMapping) -> Iterator[tuple[tuple[str, int], Cell]]:
    """Yield the finished cells with the same settings; an incomplete line, of a process that was killed, is skipped."""
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if row.pop("asked") == settings:
            yield (row["sampler"], row["seed"]), Cell(**row)


def _run(loaded: Loaded, name: str, seed: int) -> Cell:
    config, start = loaded.config, time.perf_counter()
    u, margin = (_outside if name in OUTSIDE else _own)(loaded, name, seed)
    hits, u = np.flatnonzero(margin <= 0), scenario_of(loaded).space.cube.embedded(u)
    first = int(hits[0]) + 1 if len(hits) else None
    return Cell(
        config.scenario, name, seed, config.budget, len(margin), first, len(hits), _distinct(u[hits]),
        round(time.perf_counter() - start, 3), int(np.isnan(margin).sum()),
    )  # fmt: skip


def _own(loaded: Loaded, name: str, seed: int) -> tuple[Points, Vector]:
    """Return points and margins of a campaign with one of its own methods, as `sumo-sbt run` runs it."""
    with scratch_in(None, "compare") as folder:
        store = str(Path(folder) / "store")
        acquisition = loaded.config.acquisition.model_copy(update={"kind": name})
        config = loaded.config.model_copy(update={"seed": seed, "store": store, "acquisition": acquisition, "judges": ()})
        run_study(Study(replace(loaded, config=config)), report=False)
        with Store.read(Path(store)) as opened:
            history = opened.history()
    runs = history.where(history.stage != CONFIRM)
    scenario = scenario_of(loaded)
    return scenario.space.to_unit(runs.x), scenario.requirement.margins(runs)


def _outside(loaded: Loaded, name: str, seed: int) -> tuple[Points, Vector]:
    """Return points and margins of another sampler, in batches of the configured size."""
    config, parts = loaded.config, assemble(loaded)
    space, requirement = parts.scenario.space, parts.scenario.requirement
    limit = None if config.executor.timeout == float("inf") else config.executor.timeout
    sampler = OUTSIDE[name](space.dimension, seed, config.initial, space.cube)
    points, margins, most = np.empty((0, space.dimension)), np.empty(0), config.stop.failures
    with SerialExecutor(parts.spec, limit) as executor:
        while len(margins) < config.budget and (most is None or (margins <= 0).sum() < most):
            u = sampler.ask(min(config.batch_size, config.budget - len(margins)))
            x, start = space.from_unit(u), len(margins)
            jobs = [Job(start + k, space.named(row), run_seed(seed, start + k)) for k, row in enumerate(x)]
            y = np.full(len(jobs), np.nan)
            for outcome in executor.run(jobs):
                if outcome.status == Status.OK:
                    y[outcome.index - start] = outcome.metrics[requirement.metric]
            margin = np.asarray(requirement.critical.margin(y))
            sampler.tell(margin)
            points, margins = np.vstack([points, u]), np.concatenate([margins, margin])
    return points, margins


def _distinct(u: Points) -> int:
    """Return how many critical runs are farther apart than the deflation radius, counted in order."""
    distinct = np.empty((0, u.shape[1]))
    for point in u:
        if len(distinct) == 0 or cdist(point[None], distinct, "chebyshev").min() > DEFLATION:
            distinct = np.vstack([distinct, point])
    return len(distinct)


def table(cells: Sequence[Cell]) -> str:
    """Return the cells as a Markdown table: a row a sampler; a seed without a critical run counts as infinite."""
    lines = [
        "| sampler | seeds | found | median runs to the first | 90th percentile | distinct failures | seconds | failed runs |",
        "|" + "---|" * 8,
    ]
    for name in dict.fromkeys(cell.sampler for cell in cells):
        mine = [cell for cell in cells if cell.sampler == name]
        budget = mine[0].budget
        first = np.array([1e9 if c.runs_to_first is None else c.runs_to_first for c in mine])
        shown = [f"{v:.1f}".removesuffix(".0") if v <= budget else f"> {budget}" for v in np.quantile(first, (0.5, 0.9))]
        found, distinct = np.mean(first <= budget), np.mean([c.distinct for c in mine])
        seconds = np.median([c.seconds for c in mine])
        told = f"{name} | {len(mine)} | {100 * found:.0f} % | {shown[0]} | {shown[1]} | {distinct:.1f} | {seconds:.2g}"
        lost = sum(c.failed or 0 for c in mine) / sum(c.runs for c in mine)
        lines.append(f"| {told} | {'not known' if any(c.failed is None for c in mine) else f'{100 * lost:.3g} %'} |")
    return "\n".join(lines)
