"""Says how far a campaign is, also while it runs."""

from __future__ import annotations

import time
from pathlib import Path

from sbt.problem.plain import Json, JsonMapping
from sbt.store.database import Store
from sbt.store.history import PLANNED
from sbt.store.records import FitRecord
from sbt.store.rescue import Diagnosis, examine, save
from sbt.store.writer import Writer, writer_of

__all__ = ["Diagnosis", "Writer", "examine", "read_status", "save", "writer_of"]


def read_status(folder: Path) -> Json:
    """Return what `status --json` prints: state, counts, budget, rate, iterations, last validation and conclusion.

    `state` is running, finished, interrupted (it was ended in order), dead (its process was killed) or elsewhere (another
    machine writes it, or did when it was killed); `rate` (runs a second since its process began) and `remaining` (s) are
    those of a running one, None where nothing is known of them yet.

    Raises:
        StoreError: the folder holds no campaign.
    """
    with Store.read(folder) as store:
        iterations, fits, counts = store.iterations(), store.fits(), store.counts
        writer, conclusion = writer_of(folder), store.conclusion
        kept = store.configuration
        done, budget = sum(counts.values()) - counts.get(PLANNED, 0), _budget(kept)
        return {
            "store": str(folder),
            "campaign": kept.get("campaign"),
            "scenario": kept.get("scenario"),
            **_progress(writer, done, budget, finished=conclusion is not None),
            "runs": counts,
            "iterations": len(iterations),
            "stage": iterations[-1].stage if iterations else None,
            "validation": _validation(fits[-1]) if fits else None,
            "conclusion": conclusion,
        }


def _budget(configuration: JsonMapping) -> int | None:
    """Return the number of runs, those included that only score; None where none is stated."""
    budget = configuration.get("budget")
    return None if budget is None else int(budget) + int((configuration.get("validation") or {}).get("reference") or 0)


def _progress(writer: Writer | None, done: int, budget: int | None, *, finished: bool) -> Json:
    """Return the state of a campaign with so many runs done, how fast it is and how long it takes."""
    alive = False if writer is None else writer.alive
    state = "elsewhere" if alive is None else "dead" if writer is not None else "interrupted"
    if alive or finished:
        state = "running" if alive else "finished"
    rate = remaining = None
    if alive and writer is not None and done > writer.finished and time.monotonic() > writer.since:
        rate = (done - writer.finished) / (time.monotonic() - writer.since)
        remaining = None if budget is None else max(budget - done, 0) / rate
    return {"state": state, "done": done, "budget": budget, "rate": rate, "remaining": remaining}


def _validation(fit: FitRecord) -> Json:
    """Return the numbers of the last fit."""
    shares = {name: getattr(fit, name) for name in ("critical_fraction", "expected_misclassified", "ambiguous_volume")}
    scores = {} if fit.validation is None else fit.validation.to_dict()
    return {"runs": fit.runs, "iteration": fit.iteration, "learned": fit.learned, **scores, **shares}
