"""Says how far a campaign is, also while it runs."""

from __future__ import annotations

import re
import time
from pathlib import Path

from sbt.errors import InputError
from sbt.loop.stages import Shard
from sbt.problem.plain import Json, JsonMapping
from sbt.store import rescue
from sbt.store.database import Store
from sbt.store.history import PLANNED
from sbt.store.records import FitRecord
from sbt.store.rescue import Diagnosis, examine
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
    writer, alive = _at_work(folder)  # before the store: who was at work then may have concluded since, never the reverse
    with Store.read(folder) as store:
        iterations, fits, counts, conclusion = store.iterations(), store.fits(), store.counts, store.conclusion
        kept = store.configuration
        done, budget = sum(counts.values()) - counts.get(PLANNED, 0), _budget(kept)
        coarse = store.coarse
        return {
            "store": str(folder),
            "campaign": kept.get("campaign"),
            "scenario": kept.get("scenario"),
            **_progress(writer, alive, done, budget, coarse, finished=conclusion is not None),
            "runs": counts,
            **({"coarse_runs": coarse} if coarse else {}),
            "iterations": len(iterations),
            "stage": iterations[-1].stage if iterations else None,
            "validation": _validation(fits[-1]) if fits else None,
            "conclusion": conclusion,
        }


def save(folder: Path, target: Path) -> tuple[int, int]:
    """Write a new store of what is whole, from which `run` goes on; as `sbt.store.rescue.save`.

    A damaged configuration is taken from the `config.resolved.yaml` beside the store, where there is one.
    """
    lost = not examine(folder).configuration
    return rescue.save(folder, target, _configuration_beside(Path(folder)) if lost else None)


def _configuration_beside(folder: Path) -> Json | None:
    """Return what a store remembered of the configuration in the YAML beside it; None where there is none.

    Where its relative names start is lost with the store: they are tried from the working directory, and from the folders
    above the store. Code that it names runs only where the user has approved it.

    Raises:
        InputError: the configuration names what is not there, or code that is not approved.
    """
    from sbt.config.load import parse, read_text
    from sbt.workflows.study import RESOLVED, Study

    path, shard = folder / RESOLVED, re.fullmatch(r"shard-(\d+)-of-(\d+)", folder.resolve().name)
    if not path.is_file():
        return None
    problem: InputError | None = None
    for start in (Path.cwd(), *list(folder.resolve().parents)[:3]):
        try:
            study = Study(parse(read_text(path), name=str(path), folder=start, store=folder))
            return study.snapshot(None if shard is None else Shard(int(shard[1]), int(shard[2])))
        except InputError as error:
            problem = problem or error
    raise problem or InputError(f"{path} must be the configuration of a campaign")


def _budget(configuration: JsonMapping) -> int | None:
    """Return the number of runs, those included that only score; None where none is stated."""
    budget = configuration.get("budget")
    return None if budget is None else int(budget) + int((configuration.get("validation") or {}).get("reference") or 0)


def _at_work(folder: Path) -> tuple[Writer | None, bool | None]:
    """Return who writes a store or was killed while it did, and whether it is alive; None: that cannot be known from here."""
    writer = writer_of(folder)
    alive = False if writer is None else writer.alive
    if writer is None or alive is not False or writer_of(folder) == writer:
        return writer, alive
    return None, False  # it ended in order meanwhile: only one that was killed is still named


def _progress(
    writer: Writer | None, alive: bool | None, done: int, budget: int | None, coarse: int, *, finished: bool
) -> Json:  # fmt: skip
    """Return the state of a campaign with so many runs done, how fast it is and how long it takes; coarse runs have no budget."""
    state = "elsewhere" if alive is None else "dead" if writer is not None else "interrupted"
    if alive or finished:
        state = "running" if alive else "finished"
    rate = remaining = None
    if alive and writer is not None and done + coarse > writer.finished and time.monotonic() > writer.since:
        rate = (done + coarse - writer.finished) / (time.monotonic() - writer.since)
        remaining = None if budget is None or coarse else max(budget - done, 0) / rate
    return {"state": state, "done": done, "budget": budget, "rate": rate, "remaining": remaining}


def _validation(fit: FitRecord) -> Json:
    """Return the numbers of the last fit."""
    shares = {name: getattr(fit, name) for name in ("critical_fraction", "expected_misclassified", "ambiguous_volume")}
    scores = {} if fit.validation is None else fit.validation.to_dict()
    return {"runs": fit.runs, "iteration": fit.iteration, "learned": fit.learned, **scores, **shares}
