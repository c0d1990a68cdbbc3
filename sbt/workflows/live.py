"""What the live view shows of a campaign while it runs: its explorer so far, and the film of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sbt.problem.plain import Json
from sbt.report.explorer import explorer_data, packed_library, scripts, styles
from sbt.report.projection import influence_from_runs
from sbt.report.reel import Reels
from sbt.report.words import Findings, conclusion_sentences
from sbt.store.database import DATABASE, Store
from sbt.store.history import PLANNED
from sbt.workflows.filming import film_runs
from sbt.workflows.study import RESOLVED, Study

__all__ = ["LiveCampaign", "check_resumable", "film_of", "first_look", "live_parts", "packed_library"]

_FIRST = 2000
"""Runs of a first look at a large store."""


class LiveCampaign:
    """A store that is open for reading: what was read once is not read again. Use it in one thread.

    Raises:
        StoreError: the folder holds no campaign, or a damaged one.
    """

    def __init__(self, folder: Path):
        """Open the store, which may be written meanwhile."""
        self._folder, self._file, self._store = folder, _file_of(folder), Store.read(folder, live=True)

    def _current(self) -> Store:
        """Return the store, opened again where the folder was emptied and another campaign begun in it."""
        if (file := _file_of(self._folder)) != self._file:
            opened = Store.read(self._folder, live=True)
            self._store.close()
            self._file, self._store = file, opened
        return self._store

    def critical(self) -> int:
        """Return how many of the runs so far are critical."""
        store = self._current()
        with store.one_moment():
            found = Study.from_store(store).scenario.requirement.critical_runs(store.history())
        return int(np.count_nonzero(found))

    def explorer(self) -> Json:
        """Return what the explorer shows of the runs so far; without a metamodel, which would take the workers' time."""
        store = self._current()
        with store.one_moment():
            study, ended = Study.from_store(store), store.conclusion
            conclusion = None if ended is None else study.conclusion(ended["conclusion"])
            found = Findings.of(store, study.scenario, conclusion)
        weights = influence_from_runs(found.history, study.scenario.requirement)
        data = explorer_data(found, study.scenario, None, np.nan_to_num(weights))
        return {**data, "sentences": conclusion_sentences(found) if ended else []}


def _file_of(folder: Path) -> tuple[int, int] | None:
    """Return which file a store's database is; None: there is none. A file that is open keeps its number."""
    try:
        found = (folder / DATABASE).stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def first_look(folder: Path) -> Json:
    """Return what the explorer shows of some runs, evenly spaced, with the sentences as they were concluded.

    Raises:
        StoreError: the folder holds no campaign, or a damaged one.
    """
    with Store.read(folder) as store:
        study, ended, counts = Study.from_store(store), store.conclusion, store.counts
        found = Findings.of(store, study.scenario, None, history=store.sample(_FIRST))
        data = explorer_data(found, study.scenario, None, np.nan_to_num(influence_from_runs(found.history, found.requirement)))
    done = sum(counts.values()) - counts.get(PLANNED, 0)
    return {**data, "total": done, "sentences": [] if ended is None else list(ended.get("sentences") or [])}


def live_parts() -> Json:
    """Return what a page with the explorer is made of, beside data and library: our own text, and whether that is there."""
    import markupsafe

    note = "How much of the rank of the metric each input explains alone in the runs, relative to the largest."
    own = {name: markupsafe.Markup(text) for name, text in (("styles", styles()), ("scripts", scripts()))}
    return {"explorer": {"library": bool(packed_library()), "note": note, **own}}


def film_of(folder: Path, run: int) -> Json:
    """Execute a run again and return its film and the lanes around, or in `note` why there is none.

    The code that the store names runs only where the user has approved it.
    """
    with Store.read(folder) as store:
        history = store.history()
        if run not in set(history.index.tolist()):
            return {"film": None, "lanes": [], "note": f"There is no run {run} that has ended."}
        films, note = film_runs(Study.from_store(store), history, {run: f"run {run}"})
    reels = Reels()
    data = reels.add(films[0]) if films else None
    return {"film": data, "lanes": reels.lanes, "note": note}


def check_resumable(folder: Path) -> Path:
    """Return the configuration by which `run` goes on with a campaign, whose code is at hand and approved by the user.

    Raises:
        UntrustedError: code that the store names is not approved.
        InputError: it is not at hand.
    """
    with Store.read(folder) as store:
        study = Study.from_store(store, live=True)
        with study.loaded.scope.naming():
            _ = study.runnable, study.campaign
    return folder / RESOLVED
