"""Writes the runs of a store as a table."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sbt.campaigns.counting import NOMINAL, RANDOM
from sbt.campaigns.failures import FILLING
from sbt.campaigns.preventable import with_judgements
from sbt.campaigns.records import CONFIRM
from sbt.errors import InputError, did_you_mean, must_be
from sbt.files import as_cell, write_atomically
from sbt.plugins import Objects
from sbt.store.database import Store
from sbt.store.history import History, named_columns
from sbt.workflows.status import read_status
from sbt.workflows.study import Study

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FORMS", "export_store", "limits_of"]


def export_store(folder: Path, form: str = "csv", *, objects: Objects | None = None) -> Path:
    """Write the runs of a store as a table into its folder `exports`.

    Args:
        folder: of the store.
        form: of `FORMS`: csv and parquet, a row a run with its verdict; dsiod, the layout of the public data set; boundary,
            points where the metamodel's P(critical) is 0.5.
        objects: what was given in Python when the store was made.

    Raises:
        InputError: an unknown form, a library that is not installed, or (boundary) no metamodel, or no boundary.
        StoreError: the folder holds no campaign.
    """
    must_be("the format must be text", form, str)
    if form not in FORMS:
        raise InputError(f"the format must be {', '.join(FORMS)}, but got '{form}'{did_you_mean(form, FORMS)}")
    if form == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise InputError("parquet needs pyarrow: pip install 'sumo-sbt[parquet]', or choose csv")
    with Store.read(folder) as store:
        return FORMS[form](store, Study.from_store(store, objects=objects))


def _frame(store: Store, study: Study) -> pd.DataFrame:
    """Return a row a run, with its verdict, and what reference drivers made of it where they were asked.

    Coarse runs have a row and a level, but no verdict: they are none of the scenario's.
    """
    frame = with_judgements(store.history(level=None).to_frame(study.scenario.requirement), store.judgements)
    frame.loc[frame["level"] > 0, "critical"] = None
    return frame


def _as_csv(store: Store, study: Study) -> Path:
    """Write one row a run."""
    frame = _cells(_frame(store, study))
    return write_atomically(store.folder / "exports" / "runs.csv", lambda part: frame.to_csv(part, index=False))


def limits_of(folder: Path, form: str) -> list[str]:
    """Return in sentences what a reader of an exported file must know: that runs are missing, or were not chosen for it."""
    found = read_status(folder)
    kind, runs = found["campaign"], found["done"]
    so_far = f"the campaign has not concluded: these are the runs so far, at least {runs:,}"
    said = [] if found["state"] == "finished" else [so_far]
    if form == "boundary" and kind != "boundary":
        said.append(f"the runs of this campaign ({kind}) were not chosen to find the boundary, which may lie elsewhere")
    return said


def _cells(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table for spreadsheets: no text and no name of a column is a formula."""
    texts = {name: frame[name].map(as_cell) for name in frame.columns if frame[name].dtype.kind not in "biufcM"}
    return frame.assign(**texts).rename(columns=as_cell)


def _as_parquet(store: Store, study: Study) -> Path:
    """Write one row a run."""
    frame = _frame(store, study)
    return write_atomically(store.folder / "exports" / "runs.parquet", lambda part: frame.to_parquet(part, index=False))


def _as_boundary(store: Store, study: Study) -> Path:
    """Write points of the inputs' space where the metamodel says P(critical) = 0.5."""
    import pandas as pd

    from sbt.campaigns.boundary import boundary_points

    space = study.scenario.space
    found = boundary_points(study.settings, store.history())
    if len(found) == 0:
        share = study.scenario.requirement.critical_runs(store.history()).sum()
        rule = "a boundary needs places where the metamodel's P(critical) is 0.5, but it finds none"
        raise InputError(f"{rule} (of {len(store.history())} runs {share} are critical); no file is written")
    points = _cells(pd.DataFrame(named_columns(found, space.names, space.choices)))
    return write_atomically(store.folder / "exports" / "boundary.csv", lambda part: points.to_csv(part, index=False))


def _as_data_set(store: Store, study: Study) -> Path:
    """Write the runs in the layout of the public data set, which `table:FOLDER` reads."""
    from sbt.store.tables import to_folder

    history = store.history()
    filled = _fill_space(history, study)
    return to_folder(history, study.scenario, store.folder / "exports" / "dsiod", spread_evenly=filled)


def _fill_space(history: History, study: Study) -> bool:
    """Return whether all runs were chosen to fill the parameter space, whatever the results."""
    fill = set(FILLING)
    if study.config.acquisition.kind == "even":
        fill |= set(history.stage.tolist()) - {CONFIRM}
    if all(parameter.distribution is None for parameter in study.scenario.space.parameters):
        fill |= {NOMINAL, RANDOM}
    return fill.issuperset(history.stage.tolist())


FORMS: Mapping[str, Callable[[Store, Study], Path]] = {
    "csv": _as_csv, "parquet": _as_parquet, "dsiod": _as_data_set, "boundary": _as_boundary,
}  # fmt: skip
"""What `export` can write."""
