"""Recorded outcomes as a scenario: `table:FOLDER`, in the layout of the public DSIOD data set.

The folder holds `config.yml` (inputs with type, unit, min, max and explanation; outputs with unit; beyond the data set's own
keys, `requirement` as in a configuration, `logarithmic` of an input, and `spread_evenly: false` where rows were not chosen to
fill the space) and one table of rows, parquet or csv. A campaign on it chooses among the recorded rows instead of simulating,
and is scored on all rows that it has not chosen.

Source:
    Driving Scenario Input Output Dataset, Winkelmann et al. (2022), appendix of
    doi 10.1109/TITS.2022.3206882.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbt.errors import InputError, RunError, UnwritableError
from sbt.problem.arrays import Vector
from sbt.problem.distribution import Distribution
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.pool import Pool
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.history import History, named_columns
from sbt.store.stated import stated_requirement, written_requirement

__all__ = ["from_folder", "to_folder"]

_SUFFIXES = (".parquet", ".csv")
_ROUNDING = 1e-6
"""How far a row may lie outside of its range, of the range: it was written with fewer digits."""
_SEED = "seed"
"""Column that tells repeats of inputs from copies of a row, where it is no input and no output."""


def from_folder(name: str, folder: Path) -> LogicalScenario:
    """Return the scenario of a folder with recorded outcomes.

    Args:
        name: path of the folder, relative to `folder`; `PATH/FILE.parquet` picks one of several tables.
        folder: where relative paths start.

    Returns:
        A scenario with the folder's requirement; where it states none, the first output is critical up to 0, and the pool's
        notes say that this is assumed. A configuration replaces either.

    Raises:
        InputError: no config.yml, no or several tables, columns missing, values outside the ranges, or a wrong requirement.
    """
    path = (Path(folder) / name).resolve()
    table = _table_of(path)
    described = _described(table.parent / "config.yml")
    inputs, outputs = described.get("inputs", {}), described.get("outputs", {})
    choices = {name: entry["choices"] for name, entry in inputs.items() if _has_choices(entry)}
    rows = _read(table, choices)
    _told_apart(inputs, outputs, f"{table.parent / 'config.yml'}: ")
    missing = [column for column in [*inputs, *outputs] if column not in rows]
    if missing or not inputs or not outputs:
        absent = ", ".join(missing) or "all"
        raise InputError(f"{table}: every input and output of config.yml must be a column, but missing: {absent}")
    kept, notes = _kept(rows, [*inputs], [*outputs])
    x = np.column_stack([rows[column] for column in inputs])[kept]
    if len(x) < 2:
        raise InputError(f"{table}: a table needs at least two complete rows, but got {len(x)}")
    read = [_parameter(key, entry, x[:, k]) for k, (key, entry) in enumerate(inputs.items())]
    space = ParameterSpace(tuple(parameter for parameter, _ in read))
    notes = (*notes, *(note for _, note in read if note))
    assumed = Requirement(next(iter(outputs)), high=0.0) if described.get("requirement") is None else None
    need = assumed or stated_requirement(described["requirement"], outputs, table.parent / "config.yml")
    even = described.get("spread_evenly")
    if even not in (None, True, False):
        raise InputError(f"{table.parent / 'config.yml'}: spread_evenly must be true or false, but got {even!r}")
    pool = Pool(x, {column: rows[column][kept] for column in outputs}, notes, assumed, even=even)
    title, text = str(described.get("title", path.name)), str(described.get("logical_scenario", ""))
    return LogicalScenario(
        name=f"table:{name}", space=space, requirement=need,
        evaluate=_Lookup(space, pool), metric_names=tuple(outputs), description=f"{title} (recorded)\n{text}", pool=pool,
    )  # fmt: skip


def _kept(rows: Mapping[str, Vector], inputs: list[str], outputs: list[str]) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Return the rows that are runs, and in a sentence how many are none.

    A run has finite inputs and all outputs, which may be infinite. Rows of the same inputs are copies of one run where they
    have the same seed and outputs, or, of a table without seeds, where nowhere the same inputs have other outputs.
    """
    x, y = (np.column_stack([rows[column] for column in columns]) + 0.0 for columns in (inputs, outputs))  # zero has no sign
    complete = np.flatnonzero(np.isfinite(x).all(axis=1) & ~np.isnan(y).any(axis=1))
    x, y = x[complete], y[complete]
    seeded = _SEED in rows and _SEED not in [*inputs, *outputs]
    same = np.column_stack([x, y, rows[_SEED][complete]]) if seeded else x
    drawn = not seeded and len(np.unique(np.column_stack([x, y]), axis=0)) > len(np.unique(x, axis=0))
    kept = complete if drawn else complete[np.sort(np.unique(same, axis=0, return_index=True)[1])]
    every = len(rows[inputs[0]])
    why = [f"{n:,} {what}" for n, what in (
        (every - len(complete), "without a number in some column"), (len(complete) - len(kept), "the same as another one"),
    ) if n]  # fmt: skip
    said = f"{every - len(kept):,} of {every:,} rows are left out: {', '.join(why)}."
    return kept, (said,) if why else ()


class _Lookup:
    """Gives the recorded outcome of exactly these inputs; of several, the seed says which."""

    def __init__(self, space: ParameterSpace, pool: Pool):
        self._space, self._pool = space, pool

    def __call__(self, values: Values, seed: int) -> dict[str, float]:
        row = self._pool.row(self._space.numbers(values), seed)
        if row is None:
            raise RunError(Status.INVALID, f"a recorded table has only its own rows, but none with {dict(values)}")
        return {name: float(column[row]) for name, column in self._pool.metrics.items()}


def _told_apart(inputs: Iterable[str], outputs: Iterable[str], where: str = "") -> None:
    """Raise where a name is that of an input and of an output: the table has but one column of it."""
    both = [name for name in inputs if name in set(outputs)]
    if both:
        rule = "a table of the data set's layout must tell inputs from outputs by name"
        raise InputError(f"{where}{rule}, but both have '{both[0]}': rename one of them")


def to_folder(
    history: History, scenario: LogicalScenario, folder: Path, suffix: str = ".csv", *, spread_evenly: bool = True
) -> Path:
    """Write the finished runs in the data set's layout: `config.yml` and one table.

    Args:
        history: runs; those without metrics are left out.
        scenario: describes inputs and outputs.
        folder: is made where it is missing.
        suffix: `.csv`, or `.parquet` where pyarrow is installed.
        spread_evenly: no run was chosen otherwise than to fill the parameter space.

    Returns:
        The table's file; `from_folder` reads the folder back to the same rows. Its column `seed` tells repeats of inputs from
        copies of a row; it is left out where an input or a metric has that name.

    Raises:
        InputError: an input has the name of a metric.
    """
    import pandas as pd
    from ruamel.yaml import YAML

    done = history.where(history.ok)
    _told_apart(done.names, done.metrics)
    units = {metric.name: metric.unit for metric in scenario.metrics}
    title, _, text = scenario.description.partition("\n")
    described = {
        "title": title or scenario.name, "introduction": "", "functional_scenario": title, "logical_scenario": text,
        "concrete_scenarios": f"runs of a campaign on {scenario.name}",
        "inputs": {p.name: {
            "type": p.kind, "unit": p.unit,
            **({"choices": _choices(p)} if p.choices else {"min": p.bounds[0], "max": p.bounds[1]}),
            **({} if p.discrete else {"logarithmic": p.logarithmic}), "explanation": p.description,
        } for p in scenario.space.parameters},
        "outputs": {name: {"type": "continuous", "unit": units.get(name, "")} for name in done.metrics},
        "requirement": written_requirement(scenario.requirement),
        **({} if spread_evenly and not scenario.uneven else {"spread_evenly": False}),
    }  # fmt: skip
    path = folder / f"runs{suffix}"
    columns = named_columns(done.x, done.names, done.choices) | {name: done.y(name) for name in done.metrics}
    columns = columns | ({} if _SEED in columns else {_SEED: done.seed})
    frame = pd.DataFrame(columns)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        YAML().dump(described, folder / "config.yml")
        frame.to_csv(path, index=False) if suffix == ".csv" else frame.to_parquet(path, index=False)
    except OSError as error:
        raise UnwritableError(error.errno, error.strerror or str(error), str(folder)) from error
    return path


def _table_of(path: Path) -> Path:
    """Return the one table that is meant."""
    if path.is_file() and path.suffix in _SUFFIXES:
        return path
    if not path.is_dir():
        raise InputError(f"table: needs a folder with config.yml and a parquet or csv file, but got '{path}'")
    found = sorted(p for p in path.iterdir() if p.suffix in _SUFFIXES)
    if len(found) != 1:
        names = ", ".join(p.name for p in found) or "none"
        raise InputError(f"table:{path} needs one table, or one of several by name (table:FOLDER/FILE), but there are: {names}")
    return found[0]


def _described(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        loaded = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"a table needs {path}, but: {error.strerror}") from None
    except YAMLError as error:
        raise InputError(f"{path} must be YAML, but: {error}") from None
    if not isinstance(loaded, dict):
        raise InputError(f"{path} must be a mapping with inputs and outputs, but got {type(loaded).__name__}")
    return loaded


def _has_choices(entry: Mapping[str, Any]) -> bool:
    return entry.get("type") == "categorical" and bool(entry.get("choices"))


def _choices(parameter: Parameter) -> list[str] | dict[str, float]:
    """Return choices as a configuration has them."""
    likely = zip(parameter.choices, map(float, parameter.probabilities), strict=False)
    return dict(likely) or list(parameter.choices)


def _read(path: Path, choices: Mapping[str, Iterable[str]]) -> dict[str, Any]:
    """Return the columns as float64, choices as their positions."""
    import pandas as pd

    try:
        frame = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
        if path.suffix == ".csv" and choices:  # of which "NA" and "1" are what they are
            texts = pd.read_csv(path, usecols=lambda name: name in choices, dtype=str, keep_default_na=False)
            frame = frame.assign(**texts)
    except ImportError:
        raise InputError(f"{path.name} needs pyarrow (pip install 'sumo-sbt[parquet]'); or save it as csv") from None
    except Exception as error:  # pandas and pyarrow raise whatever they like about a broken file
        raise InputError(f"{path} must be a readable table, but: {error}") from None
    found = {}
    for name in map(str, frame):
        if name in choices:
            position = {choice: float(k) for k, choice in enumerate(choices[name])}
            unknown = sorted(set(map(str, frame[name])) - set(position))
            if unknown:
                raise InputError(f"{path}: {name} must be one of {', '.join(position)}, but some row has '{unknown[0]}'")
            found[name] = np.array([position[str(value)] for value in frame[name]])
        else:
            found[name] = pd.to_numeric(frame[name], errors="coerce").to_numpy(np.float64)
    return found


def _parameter(name: str, entry: Mapping[str, Any], column: Vector) -> tuple[Parameter, str]:
    """Return an input, and what its reader must know; min may exceed max in the data set, and rows may lie a rounding outside."""
    if _has_choices(entry):
        unit, text = str(entry.get("unit", "")), str(entry.get("explanation", ""))
        return Parameter(name, unit=unit, description=text, choices=entry["choices"]), ""
    low, high = sorted((float(entry.get("min", column.min())), float(entry.get("max", column.max()))))
    least, most = float(column.min()), float(column.max())
    if max(low - least, most - high) > _ROUNDING * max(high - low, abs(low), abs(high)):
        rule = f"input {name}: all rows must lie between min and max of config.yml, {low:g} to {high:g}"
        raise InputError(f"{rule}, but some lie from {least:g} to {most:g}: mend the rows, or the range")
    low, high = min(low, least), max(high, most)
    whole = str(entry.get("type", "continuous")) in ("integer", "discrete") and bool((column % 1 == 0).all())
    found = Parameter(
        name, low, high, str(entry.get("unit", "")), kind="integer" if whole else "continuous",
        description=str(entry.get("explanation", "")),
    )  # fmt: skip
    return (found, "") if whole else _spread(found, entry.get("logarithmic"), column)


def _spread(linear: Parameter, stated: object, column: Vector) -> tuple[Parameter, str]:
    """Return an input as even in its logarithm where that is stated, or where the rows are so, and what is to be said of it.

    Rows are where `Parameter.logarithmic` would be of a distribution: half of them in the lowest tenth of two decades or more.
    """
    name, low, high = linear.name, linear.low, linear.high
    share = float((column <= low + 0.1 * (high - low)).mean())
    if stated is False or (stated is None and share < 0.5):
        return linear, ""
    even = None
    if low > 0.0 and math.isfinite(high / low):
        even = replace(linear, distribution=Distribution.of("scipy", name="loguniform", a=low, b=high))
    if stated is True and even is not None and even.logarithmic:
        return even, ""
    if stated is not None:
        rule = "logarithmic must be true or false, true only with 0 < min and max at least a hundred times it"
        raise InputError(f"input {name}: {rule}, but got {stated} with {linear.range}")
    here = f"{100.0 * share:.0f} % of the rows lie in the lowest tenth of the range of {name}"
    if even is not None and even.logarithmic:
        return even, f"{here}: {name} is shared out evenly in its logarithm (logarithmic: false in config.yml undoes it)."
    return linear, f"{here}, which is shared out evenly: shares of the parameter space are none of the rows."
