"""The one tidy table of a benchmark: a row for each cell and iteration, read from the stores of the cells."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sbt.benchmark.cell import CellProposal, changes
from sbt.config.benchmark import Cell
from sbt.files import write_atomically
from sbt.store.database import Store

__all__ = ["COLUMNS", "read_table", "rows_of", "write_table"]

KEYS = ("scenario", "metamodel", "acquisition", "seed", "iteration", "runs", "learned")
SCORES = (
    "log_likelihood", "likelihood", "log_likelihood_mixture", "rmse", "crps", "log_likelihood_critical", "rmse_critical",
    "average_precision", "precision_at_recall_90", "f1", "calibration_error", "coverage_95", "base_rate", "n", "n_critical",
)  # fmt: skip
TIMES = ("fit_seconds", "scoring_seconds", "sampling_seconds", "sampled", "candidates", "method")
COLUMNS = (*KEYS, *SCORES, "critical_fraction", *TIMES)
"""Of the table. `sampling_seconds`, `sampled`, `candidates` and `method` describe the batch that was drawn
from the metamodel of this row; they are empty in the last iteration."""


def rows_of(cell: Cell) -> Iterator[dict[str, Any]]:
    """Yield one row for each finished iteration of a cell; none where it has not begun, or with other settings."""
    if not Store.begun(cell.folder) or changes(cell):
        return
    with Store.read(cell.folder) as store:
        history, drawn = store.history(), {batch.number: batch.read(CellProposal) for batch in store.iterations()}
        fits = store.fits()
    for fit in fits:
        k = fit.iteration
        batch = drawn.get(k)
        yield {
            "scenario": cell.scenario, "metamodel": cell.metamodel, "acquisition": cell.acquisition, "seed": cell.seed,
            "iteration": k, "runs": fit.runs, "learned": fit.learned,
            **{key: fit.score(key) for key in SCORES}, "critical_fraction": fit.critical_fraction,
            "fit_seconds": fit.fit_seconds, "scoring_seconds": fit.scoring_seconds,
            "sampling_seconds": None if batch is None else batch.sampling_seconds,
            "candidates": None if batch is None else batch.candidates,
            "sampled": None if batch is None else int((history.iteration == k).sum()),
            "method": None if batch is None else batch.method,
        }  # fmt: skip


def write_table(path: Path, cells: Iterable[Cell]) -> int:
    """Write the table of all cells as CSV, as a whole or not at all, and return the number of its rows."""
    count = 0

    def write(part: Path) -> None:
        nonlocal count
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            for cell in cells:
                for row in rows_of(cell):
                    writer.writerow(row)
                    count += 1

    write_atomically(path, write)
    return count


def read_table(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table: text for names, numbers for the rest, NaN where there is none."""
    names = ("scenario", "metamodel", "acquisition", "method")
    with path.open(newline="", encoding="utf-8") as file:
        return [{key: text if key in names else _number(text) for key, text in row.items()} for row in csv.DictReader(file)]


def _number(text: str) -> float:
    return float(text) if text else math.nan

