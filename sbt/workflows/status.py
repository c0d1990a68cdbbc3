"""Says how far a campaign is, also while it runs."""

from __future__ import annotations

from pathlib import Path

from sbt.problem.plain import Json
from sbt.store.database import Store
from sbt.store.records import FitRecord
from sbt.store.rescue import Diagnosis, examine, save

__all__ = ["Diagnosis", "examine", "read_status", "save"]


def read_status(folder: Path) -> Json:
    """Return what `status --json` prints: counts, iterations, last validation and conclusion.

    Raises:
        StoreError: the folder holds no campaign.
    """
    with Store.read(folder) as store:
        iterations, fits = store.iterations(), store.fits()
        return {
            "store": str(folder),
            "runs": store.counts,
            "iterations": len(iterations),
            "stage": iterations[-1].stage if iterations else None,
            "validation": _validation(fits[-1]) if fits else None,
            "conclusion": store.conclusion,
        }


def _validation(fit: FitRecord) -> Json:
    """Return the numbers of the last fit."""
    shares = {name: getattr(fit, name) for name in ("critical_fraction", "expected_misclassified", "ambiguous_volume")}
    scores = {} if fit.validation is None else fit.validation.to_dict()
    return {"runs": fit.runs, "iteration": fit.iteration, "learned": fit.learned, **scores, **shares}
