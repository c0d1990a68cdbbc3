"""Failed runs of a benchmark: in which scenarios there are too many of them, and why the first one failed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sbt.benchmark.cell import changes
from sbt.campaigns.wording import failed_words
from sbt.config.benchmark import Cell
from sbt.problem.outcome import Status
from sbt.store.database import Store
from sbt.store.history import PLANNED

__all__ = ["cells_that_fail", "lost_reference", "reference_that_fails"]

_LEAST = 2
"""Reference runs that went well and that score a metamodel, at least."""


def lost_reference(folder: Path, n: int) -> str:
    """Return why the first n reference runs score no metamodel, fewer than two of them having gone well; "" where they do."""
    if not any(_failed(folder)):
        return ""
    with Store.read(folder) as store:
        history = store.history()
    first = history.where(history.index < n)
    if first.ok.sum() >= _LEAST:
        return ""
    return f"two reference runs must go well, or nothing can be scored, but {failed_words(first)} (once mended, remove {folder})"


def reference_that_fails(folder: Path) -> str:
    """Return that more than half of the reference runs failed, and why the first did; "" where no more did."""
    failed, runs = _failed(folder)
    if 2 * failed <= runs:
        return ""
    with Store.read(folder) as store:
        return f"at most half of the reference runs may fail, but {failed_words(store.history())}"


def cells_that_fail(cells: Sequence[Cell]) -> str:
    """Return that more than half of the runs of these cells failed, and why the first did; "" where no more did."""
    counts = [_failed(cell.folder) if not changes(cell) else (0, 0) for cell in cells]
    failed, runs = sum(lost for lost, _ in counts), sum(n for _, n in counts)
    if 2 * failed <= runs:
        return ""
    first = next(cell for cell, (lost, _) in zip(cells, counts, strict=True) if lost)
    with Store.read(first.folder) as store:
        why = failed_words(store.history())
    return f"at most half of the runs of its cells may fail, but {failed:,} of {runs:,} did; {first.name}: {why}"


def _failed(folder: Path) -> tuple[int, int]:
    """Return how many runs of a store failed, and how many there are; none where it has not begun."""
    if not Store.begun(folder):
        return 0, 0
    with Store.read(folder) as store:
        counts = store.counts
    runs = sum(n for status, n in counts.items() if status != PLANNED)
    return runs - counts.get(str(Status.OK), 0), runs
