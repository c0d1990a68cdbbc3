"""What the metamodel of a finished or running campaign predicts about concrete scenarios that nobody ran.

The fitted metamodel is kept beside the store, under a key of the runs that it learned from, so that
asking again does not fit again.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.files import as_cell
from sbt.loop.learner import Learner
from sbt.metamodels.base import Predictor, predicted
from sbt.metamodels.ended import ended
from sbt.metamodels.joint import JointPrediction
from sbt.metamodels.persistence import load, read_info, save
from sbt.plugins import Objects
from sbt.problem.arrays import Points, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Json, Value, written
from sbt.problem.space import ParameterSpace
from sbt.store.database import Store
from sbt.store.history import History
from sbt.workflows.study import Study

__all__ = ["MODEL", "Table", "inputs_from", "predict_inputs", "predict_rows", "read_inputs"]

MODEL = "metamodel.sbtmodel"
"""In the folder of a store: the metamodel that was fitted last by `predict`."""
_CHUNK = 4096
_TOLERANCE = 1e-9
_PREDICTIONS = ("mu", "sigma", "epistemic", "noise", "p_critical", "p_fails")
_MOST_TOLD = 5
"""Wrong cells of a table that are told, each on a line."""


@dataclass(frozen=True)
class Table:
    """Predictions for rows of inputs.

    Attributes:
        space: the inputs.
        x: (n, d) their numbers.
        columns: (n,) mu, sigma, epistemic, noise (unit of the metric) and p_critical; of a combination those of its margin, and
            p_critical.NAME for each requirement; p_fails, P(a run gives no metric), where some gave none.
        metric: the safety metric.
        metamodel: kind, as configured.
        learned: runs that it learned from.
        source: "loaded", "fitted", or "fitted, not kept: ..." where it cannot be saved.
        ignored: columns of the file that are no inputs.
    """

    space: ParameterSpace
    x: Points
    columns: Mapping[str, Vector]
    metric: str
    metamodel: str
    learned: int
    source: str
    ignored: tuple[str, ...]

    def rows(self) -> list[dict[str, Value]]:
        """Return one mapping a row: inputs, choices as text, then predictions."""
        values = np.column_stack(list(self.columns.values()))
        return [
            {**dict(zip(self.inputs, self.space.named(x).values(), strict=True)),
             **dict(zip(self.columns, map(float, row), strict=True))}
            for x, row in zip(self.x, values, strict=True)
        ]  # fmt: skip

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs; all are `x.NAME` where one has the name of a prediction, be it made or not."""
        names = self.space.names
        return names if {*_PREDICTIONS, *self.columns}.isdisjoint(names) else tuple(f"x.{name}" for name in names)


def predict_rows(folder: Path, inputs: Path, device: str | None = None) -> Table:
    """Return what a campaign's metamodel predicts for the rows of a CSV file; see `predict_inputs`.

    Args:
        folder: of a store.
        inputs: CSV with a column for each input, named as the input or as in exports (`x.<input>`).
        device: auto, cpu or cuda, where a metamodel that was kept predicts; None: where it was fitted.
    """
    return predict_inputs(folder, lambda space: read_inputs(inputs, space), device=device)


def predict_inputs(
    folder: Path, read: Callable[[ParameterSpace], tuple[Points, tuple[str, ...]]], *, device: str | None = None,
    objects: Objects | None = None,
) -> Table:  # fmt: skip
    """Return what a campaign's metamodel predicts about concrete scenarios.

    It learns from all runs that finished well. The campaign's validation scores are those of the same
    metamodel without the held-out runs, and so rather too low.

    Args:
        folder: of a store.
        read: the parameter space to x (n, d), checked, and the names of what was ignored.
        device: auto, cpu or cuda, where a metamodel that was kept predicts; None: where it was fitted.
        objects: what was given in Python when the store was made.

    Raises:
        InputError: the campaign has no metamodel or fewer than two runs to learn from, or the inputs are
            no such table: columns missing, values that are no numbers, outside of the range or of the constraints.
        StoreError: the folder holds no campaign.
    """
    with Store.read(folder) as store:
        study, history = Study.from_store(store, objects=objects), store.history()
    learner, choice = study.learner, study.config.metamodel
    if learner is None or choice is None:
        raise InputError(f"predict needs a campaign with a metamodel, but of {folder} {_why_none(study)}")
    space, requirement = study.scenario.space, study.scenario.requirement.in_units_of(history)
    x, ignored = read(space)
    learner, training = learner.telling(history), history.finished
    if len(training) < 2:
        raise InputError(f"predict needs two runs to learn from, but {folder} has {len(training)}")
    predictor, source = _predictor(folder, learner, history, json.dumps(choice.model_dump(mode="json"), sort_keys=True), device)
    u, predict, parts = learner.inputs(space.to_unit(x)), learner.told(predictor, history, training), []
    for k in range(0, len(u), _CHUNK):
        p = predicted(predict, u[k : k + _CHUNK])
        each = p.parts if isinstance(p, JointPrediction) else ()
        single = [one.probability(need.critical) for one, need in zip(each, requirement.parts, strict=False)]
        told = ended(p)
        parts.append([told.mu, told.sigma, told.epistemic, told.noise, p.probability(requirement.critical), *single])
    each_of = requirement.parts if requirement.combined else ()
    names = (*_PREDICTIONS[:5], *(f"p_critical.{part.label}" for part in each_of))
    columns = dict(zip(names, np.concatenate(parts, axis=1), strict=True)) if parts else {n: np.empty(0) for n in names}
    if (success := learner.success(history)) is not None:
        columns["p_fails"] = -np.expm1(success(space.to_unit(x)))
    return Table(space, x, columns, requirement.told_as, choice.kind, len(training), source, ignored)


def _why_none(study: Study) -> str:
    """Return in words why a campaign has no metamodel, and what would give one."""
    method = study.config.acquisition.kind
    if method in study.kind.metamodel_free:
        return f"acquisition {method} learns none (a boundary with warm_start learns from its runs)"
    return "it has none (add metamodel: {kind: auto})"


def inputs_from(given: Any, space: ParameterSpace) -> tuple[Points, tuple[str, ...]]:
    """Return x (n, d) of a table in memory, and the names of its other columns.

    Args:
        given: a DataFrame or a mapping with a column (or one value) for each input, named as the input or `x.<input>`, of
            numbers or of choices as text; a row of one, a list of mappings; or an array (n, d) in their order.
        space: the inputs.

    Raises:
        InputError: columns missing, values that are no numbers or outside of the range; the message names row and column.
    """
    given = _table_of(given)
    if not hasattr(given, "keys"):
        try:
            x = _numbers_of(given, space)
        except (TypeError, ValueError) as error:
            raise InputError(f"inputs must be a table of numbers, for {', '.join(space.names)}, but {error}") from None
        if x.ndim != 2 or x.shape[1] != space.dimension:
            names = ", ".join(space.names)
            raise InputError(f"an array of inputs must be (n, {space.dimension}), for {names}, but got {x.shape}")
        return _within(x, space), ()
    head = [str(name) for name in given]
    where = _of_runs(space.names, head) or [_column(name, head) for name in space.names]
    columns = []
    for name, key in zip(space.names, where, strict=True):
        try:
            columns.append(_column_of(given[key], space.parameters[space.names.index(name)]))
        except InputError as error:
            raise InputError(f"column {key}: {error}") from None
        except (TypeError, ValueError) as error:
            raise InputError(f"column {key} must hold numbers, for input {name}, but {error}") from None
    sizes = {len(column) for column in columns}
    if len(sizes - {1}) == 1:  # one number stands for a column
        columns = [np.resize(column, max(sizes)) if len(column) == 1 and 0 not in sizes else column for column in columns]
        sizes = {len(column) for column in columns}
    if len(sizes) > 1:
        raise InputError(f"columns of inputs must have one length, but got {', '.join(map(str, sorted(sizes)))}")
    return _within(np.column_stack(columns), space), tuple(name for name in head if name not in where)


def _table_of(given: Any) -> Any:
    """Return a row of a DataFrame as a mapping, and a list of rows as one of columns; all else as it is."""
    if _is_row(given):
        return dict(given.items())
    if not isinstance(given, list | tuple) or not given or not all(map(_is_row, given)):
        return given
    names = list(given[0].keys())
    for k, row in enumerate(given):
        if set(row.keys()) != set(names):
            first, other = (", ".join(map(str, keys)) for keys in (names, row.keys()))
            raise InputError(f"all rows must have the same inputs, but row 0 has {first}, row {k} {other}")
    return {name: [row[name] for row in given] for name in names}


def _is_row(given: Any) -> bool:
    """Return whether it is a mapping, or a row of a DataFrame, and no DataFrame."""
    return isinstance(given, Mapping) or (hasattr(given, "keys") and getattr(given, "ndim", 2) == 1)


def _column_of(given: Any, parameter: Parameter) -> Vector:
    """Return a column (n,) as numbers; one value is a column of one."""
    if not parameter.choices:
        values = np.atleast_1d(np.asarray(given))
        plain = [] if values.dtype.kind in "iuf" else values.ravel().tolist()
        wrong = [value for value in plain if type(value) is bool or not isinstance(value, Real)]
        if values.ndim > 1 or wrong:
            raise ValueError(f"got {wrong[0]!r}" if wrong else f"it has {values.ndim} dimensions")
        return values.astype(np.float64)
    return np.array([parameter.number(value) for value in np.atleast_1d(np.asarray(given, dtype=object))])


def _numbers_of(given: Any, space: ParameterSpace) -> Points:
    """Return rows in the order of the inputs as numbers."""
    if not space.choices:
        return np.atleast_2d(np.asarray(given, dtype=np.float64))
    rows = np.atleast_2d(np.asarray(given, dtype=object))
    if rows.shape[-1] != space.dimension:
        return np.empty(rows.shape)
    return np.column_stack([_column_of(rows[:, k], p) for k, p in enumerate(space.parameters)])


def _of_runs(names: Sequence[str], head: Sequence[str]) -> list[str]:
    """Return x.NAME of all inputs where a table, as one of runs, has these: its NAME may be another thing (margin)."""
    ours = [f"x.{name}" for name in names]
    return ours if all(head.count(name) == 1 for name in ours) else []


def _column(name: str, head: list[str]) -> str:
    """Return the column of an input."""
    found = [key for key in (name, f"x.{name}") if key in head]
    if len(found) > 1 or head.count(name) > 1:
        raise InputError(f"an input must be one column, but {name} is more: {', '.join(head)}")
    if not found:
        short = [key.removeprefix("x.") for key in head]
        raise InputError(f"every input must be a column, but {name} is missing{did_you_mean(name, short)}; got {', '.join(head)}")
    return found[0]


def _within(x: Points, space: ParameterSpace) -> Points:
    """Return x with rounding at the ends of the ranges mended; refuse what lies outside, or breaks the constraints."""
    low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("low", "high"))
    with np.errstate(invalid="ignore"):
        size = np.where(np.isfinite(low) & np.isfinite(high), _TOLERANCE * np.maximum(np.abs(low), np.abs(high)), 0.0)
        outside = ~((x >= low - size) & (x <= high + size))
        broken = outside | ((x % 1 != 0) & np.array([p.discrete for p in space.parameters]))
    cells = np.argwhere(broken).tolist()
    _refuse([
        f"row {row}: {(p := space.parameters[k]).name} must be {'' if outside[row, k] else 'a whole number '}in {p.range},"
        f" but got {x[row, k]:g}" for row, k in cells[:_MOST_TOLD]
    ], len(cells))  # fmt: skip
    x = np.clip(x, low, high)
    _refuse_infeasible(x, space, "row {}".format)
    return x


def _refuse(problems: Sequence[str], total: int) -> None:
    """Raise the first problems of a table on a line each, with how many more there are; nothing without any."""
    if problems:
        more = [f"and {total - len(problems):,} more"] if total > len(problems) else []
        raise InputError("\n".join([*problems, *more]))


def _refuse_infeasible(x: Points, space: ParameterSpace, place: Callable[[int], str]) -> None:
    """Raise where rows (n, d) break the constraints of the inputs: no run is made there, and nothing was learned."""
    rows = np.flatnonzero(~space.feasible(x)).tolist()
    rules = " and ".join(text for text, _ in space.constraints)
    told = rows[:_MOST_TOLD]
    _refuse([f"{place(row)}: inputs must satisfy '{rules}', but got {written(space.named(x[row]))}" for row in told], len(rows))


def _predictor(folder: Path, learner: Learner, history: History, settings: str, device: str | None) -> tuple[Predictor, str]:
    """Return the fitted metamodel, from the file beside the store where that has learned from the same runs."""
    training = history.finished
    path, key = folder / MODEL, _key(learner, training, settings)
    if device is not None:
        from sbt.metamodels.torch_tools import device_of

        device_of(device)  # refuses one that is not there
    if path.is_file():
        try:
            if read_info(path).get("key") == key:
                return load(path, device), "loaded"
        except InputError:  # damaged or of another version: it is only a copy, and is made again
            pass
    predictor, _ = learner.over_traffic(learner.train(training), history)
    info: Json = {
        "key": key, "inputs": list(training.names), "metric": learner.scenario.requirement.metric, "runs": len(training),
    }  # fmt: skip
    try:
        save(predictor, path, info)
    except (InputError, OSError) as error:  # somebody's own metamodel, or a folder that may only be read
        return predictor, f"fitted, not kept: {error}"
    return predictor if device is None else load(path, device), "fitted"


def _key(learner: Learner, training: History, settings: str) -> str:
    """Return a key of all that decides a fit: the rows, the settings, the seed, the space, the version."""
    space, critical = learner.scenario.space, learner.scenario.requirement.critical
    features, kept = [name for name, _ in space.features], None if learner.traffic is None else learner.traffic.kept
    fit = settings, type(learner.metamodel).__name__, learner.target_aware, learner.seed
    decisive = (*fit, repr(critical), repr(space.parameters), features, version("sumo-sbt"), kept)
    digest = hashlib.blake2b(json.dumps([str(part) for part in decisive]).encode(), digest_size=16)
    digest.update(np.ascontiguousarray(training.x).tobytes())
    digest.update(np.ascontiguousarray(learner.inputs(space.to_unit(training.x))).tobytes())  # features, too
    digest.update(np.ascontiguousarray(learner.scenario.requirement.values(training)).tobytes())
    return digest.hexdigest()


def read_inputs(path: Path, space: ParameterSpace) -> tuple[Points, tuple[str, ...]]:
    """Return x (n, d) of a CSV file, and the names of its other columns.

    Raises:
        InputError: as `predict_rows`; the message has file and line.
    """
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"--inputs must be a readable CSV file, but {path}: {error}") from None
    if not lines or not any(lines[0]):
        raise InputError(f"{path}:1: the first line must name the columns, but it is empty")
    head = [name.strip() for name in lines[0]]
    ours = _of_runs(space.names, head)
    short = [name.removeprefix("x.") if not ours or name in ours else "" for name in head]
    doubled = next((name for name in space.names if short.count(name) > 1), None)
    if doubled is not None:
        raise InputError(f"{path}:1: a column must stand once, but '{doubled}' stands {short.count(doubled)} times")
    missing = [name for name in space.names if name not in short]
    if missing:
        named = ", ".join(name + did_you_mean(name, head) for name in missing)
        hint = "; commas separate columns" if len(head) == 1 and any(mark in head[0] for mark in ";\t") else ""
        raise InputError(f"{path}:1: every input must be a column, but missing: {named}{hint}")
    where = [short.index(name) for name in space.names]
    numbered = [(number, line) for number, line in enumerate(lines[1:], 2) if line]
    x, problems = np.empty((len(numbered), space.dimension)), []
    for row, (number, line) in enumerate(numbered):
        if len(line) > len(head):
            rule = f"a row must have {len(head)} fields, as the first line has"
            problems.append(f"{path}:{number}: {rule}, but has {len(line)} (numbers have points, no commas)")
            continue
        for k, (column, parameter) in enumerate(zip(where, space.parameters, strict=True)):
            try:
                x[row, k] = _value(path, number, line, column, parameter)
            except InputError as error:
                problems.append(str(error))
    _refuse(problems[:_MOST_TOLD], len(problems))
    _refuse_infeasible(x, space, lambda row: f"{path}:{numbered[row][0]}")
    return x, tuple(name for k, name in enumerate(head) if k not in where)


def _value(path: Path, number: int, line: list[str], column: int, parameter: Parameter) -> float:
    """Return one checked value of a line."""
    text = line[column].strip() if column < len(line) else ""
    if parameter.choices:
        if text not in parameter.choices and text[1:] in parameter.choices and as_cell(text[1:]) == text:
            text = text[1:]  # as tables for spreadsheets have it
        try:
            return parameter.number(text)
        except InputError as error:
            raise InputError(f"{path}:{number}: {error}") from None
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{path}:{number}: {parameter.name} must be a number, but got '{text}'") from None
    low, high = parameter.low, parameter.high
    room = _TOLERANCE * max(abs(low), abs(high)) if np.isfinite([low, high]).all() else 0.0
    if not low - room <= value <= high + room:  # also NaN
        raise InputError(f"{path}:{number}: {parameter.name} must be in {parameter.range}, but got {text}")
    if parameter.discrete and value % 1 != 0:
        raise InputError(f"{path}:{number}: {parameter.name} must be a whole number in {parameter.range}, but got {text}")
    return min(max(value, low), high)
