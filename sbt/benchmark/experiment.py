"""A whole benchmark: reference runs, then all cells that are not done, then the table and the figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from sbt.benchmark.cell import changes, is_done, run_cell
from sbt.benchmark.failing import cells_that_fail, lost_reference, reference_that_fails
from sbt.benchmark.reference import make_reference
from sbt.benchmark.table import write_table
from sbt.config.benchmark import Cell, LoadedBenchmark
from sbt.errors import InputError, SbtError
from sbt.execution.tasks import each
from sbt.loop.stages import Progress
from sbt.problem.plain import Json

__all__ = ["TABLE", "Listener", "run_benchmark"]

TABLE = "results.csv"


@dataclass(frozen=True)
class Listener:
    """Callbacks for the progress of a benchmark.

    Args:
        message: called with one line of text.
        progress: called after every reference run.
    """

    message: Callable[[str], None]
    progress: Callable[[Progress], None]


def run_benchmark(
    loaded: LoadedBenchmark, listener: Listener, *, reference: bool = True, cells: bool = True, figures: bool = True
) -> Json:
    """Run a benchmark, or resume it; finished cells are not run again.

    Args:
        loaded: a checked configuration.
        listener: callbacks for its progress.
        reference: make the reference runs that are missing.
        cells: run the cells that are not done.
        figures: write the table and the figures of what is done.

    Returns:
        What `benchmark --json` prints: store, references, cells, done, failed (name: error), failing (scenario: why, where too
        many runs failed), left_out (cells that no reference run can score), rows, table, figures.

    Raises:
        InputError: cells that are there were made with other settings.
    """
    config, all_cells = loaded.config, list(loaded.cells())
    store = Path(config.store)
    failed: dict[str, SbtError] = {}
    failing: dict[str, str] = {}
    others = [(cell, why) for cell in all_cells if (why := changes(cell))]
    if others:
        (cell, why), many = others[0], f"{len(others)} of its {len(all_cells)} cells"
        raise InputError(
            f"a cell belongs to one configuration, but {many} in {store} were made with another ({cell.name}: {why}); give the"
            " benchmark another store, a changed metamodel or scenario another name, or remove these folders"
        )
    references, made, left_out = dict(loaded.references()), [], 0
    todo = [cell for cell in all_cells if not is_done(cell)] if cells else []
    listener.message(f"{len(all_cells)} cells, {len(todo)} to do")
    groups = groupby(todo, lambda cell: (cell.seed, cell.scenario)) if cells else [(("", name), ()) for name in references]
    for (_, scenario), group in groups:
        if reference and scenario in references:  # made when it is needed: early cells give early results
            listener.message(f"{scenario}: reference runs")
            campaign = references.pop(scenario)
            made.append(folder := make_reference(campaign, config.workers, listener.progress))
            if folder is not None and (why := lost_reference(folder, campaign.config.budget)):
                failing[scenario] = why
                listener.message(f"{scenario}: {why}")
        if scenario in failing:
            left_out += len(list(group))
            continue
        for cell, error in each(run_cell, list(group), config.workers):
            listener.message(f"{cell.name}: {error or 'done'}")
            if error is not None:
                failed[cell.name] = error
    if reference:
        failing |= _failing(loaded, all_cells if cells else [], failing)
    result: Json = {
        "store": str(store), "references": [str(folder) for folder in made if folder is not None], "cells": len(all_cells),
        "done": sum(map(is_done, all_cells)), "failed": failed, "failing": failing, "left_out": left_out,
        "rows": 0, "table": None, "figures": [],
    }  # fmt: skip
    if figures:
        from sbt.benchmark.figures import write_figures

        store.mkdir(parents=True, exist_ok=True)
        result["rows"] = write_table(store / TABLE, all_cells)
        result["table"] = str(store / TABLE)
        if result["rows"]:
            result["figures"] = [str(path) for path in write_figures(loaded, store / TABLE, store / "figures")]
    return result


def _failing(loaded: LoadedBenchmark, cells: Sequence[Cell], known: Mapping[str, str]) -> dict[str, str]:
    """Return why too many runs of a scenario failed, by its name, where they did and that is not known."""
    found = {}
    for name, campaign in loaded.references():
        mine = [cell for cell in cells if cell.scenario == name]
        why = "" if name in known else reference_that_fails(Path(campaign.config.store)) or cells_that_fail(mine)
        if why:
            found[name] = why
    return found
