"""The rows of a campaign's log as columns: what stages, stop rules, metamodels and reports look at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sbt.errors import StoreError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.outcome import Doubt, Status, doubts
from sbt.problem.plain import Value
from sbt.problem.requirement import Requirement

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["PLANNED", "VALIDATION", "History", "Record", "Rows", "as_numbers", "named_columns"]

PLANNED = "planned"
"""Status of a run that was decided on and has no outcome yet."""
VALIDATION = "validation"
"""Stage of runs that are drawn at random to score the metamodel and never train it."""


@dataclass(frozen=True)
class Record:
    """One row of the store.

    Args:
        index: of the run in the campaign, from 0.
        stage: what asked for it.
        iteration: number of its batch, from 0.
        inputs: values by name, numbers in their units, choices as text.
        seed: of the run.
        status: a `Status`.
        metrics: by name, empty unless the status is ok.
        reason: why there are no metrics.
        log_q: log density that the inputs were drawn with; None: they were chosen.
        seconds: wall-clock time of the run.
        collisions: SUMO's own collision list.
        versions: of the software that ran it.
        seed_chosen: the seed was chosen by what it draws, not drawn at random.
        level: of fidelity, 0 the scenario's own.
        warm_up: number of the warm-up that the run started from; None: it ran from the beginning.
        unconfirmed: contacts that SUMO's own list does not confirm, and what differs.
    """

    index: int
    stage: str
    iteration: int
    inputs: Mapping[str, Value]
    seed: int
    status: str
    metrics: Mapping[str, float]
    reason: str = ""
    log_q: float | None = None
    seconds: float = 0.0
    collisions: str = ""
    versions: str = ""
    seed_chosen: bool = False
    level: int = 0
    warm_up: int | None = None
    unconfirmed: str = ""


_NUMBERS: Mapping[str, tuple[Any, Callable[[Any], Any]]] = {
    "index": (np.int64, int), "iteration": (np.int64, int), "seed": (np.int64, int), "level": (np.int64, int),
    "log_q": (np.float64, lambda v: np.nan if v is None else v), "seconds": (np.float64, float),
    "warm_up": (np.int64, lambda v: -1 if v is None else v), "seed_chosen": (np.bool_, bool),
}  # fmt: skip
_TEXTS = ("stage", "status", "reason", "collisions", "versions", "unconfirmed")
_MOSTLY_ALIKE = (*_TEXTS, "log_q", "level")
"""Columns that are kept as one value for as long as all rows have it: of a million runs most are."""


@dataclass
class Rows:
    """Columns that grow: a store appends what is new, and histories are views of what was there.

    Args:
        names: inputs, in the order of the columns of x.
        choices: of the inputs that have some, by name.
    """

    names: tuple[str, ...]
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    count: int = 0
    _columns: dict[str, NDArray[Any]] = field(default_factory=dict, repr=False)
    _texts: dict[str, str] = field(default_factory=dict, repr=False)
    _single: set[str] = field(default_factory=lambda: set(_MOSTLY_ALIKE), repr=False)

    def append(self, x: Points, columns: Mapping[str, Sequence[Any]], metrics: Sequence[Mapping[str, float]]) -> None:
        """Append rows: x (k, d), the other fields of a `Record` by name, and the metrics of each row."""
        k = len(x)
        self._put("x", x, np.nan)
        for name, (dtype, convert) in _NUMBERS.items():
            values = columns.get(name)
            if values is None:
                values = [None] * k if name in ("log_q", "warm_up") else [0] * k
            self._put(name, np.fromiter(map(convert, values), dtype, k), 0)
        for name in _TEXTS:
            values = columns.get(name, ())
            texts = np.empty(k, dtype=object)
            if not len(values) or all(v is values[0] or v == values[0] for v in values):  # of a million runs most are alike
                texts[:] = self._texts.setdefault(values[0], values[0]) if len(values) else ""
            else:
                texts[:] = [self._texts.setdefault(v, v) for v in values]  # equal texts are kept once
            self._put(name, texts, "")
        for name in dict.fromkeys(name for row in metrics for name in row):
            self._put(f"y.{name}", np.fromiter((row.get(name, np.nan) for row in metrics), np.float64, k), np.nan)
        for name in self._columns:
            if name.startswith("y.") and not any(name[2:] in row for row in metrics):
                self._put(name, np.full(k, np.nan), np.nan)
        self.count += k

    def _put(self, name: str, values: NDArray[Any], empty: Any) -> None:
        """Write values behind the rows there are; arrays that were handed out are never written again."""
        end = self.count + len(values)
        if name in self._single:
            one = self._columns.setdefault(name, values[:1].copy() if len(values) else np.array([empty], values.dtype))
            if _alike(values, one):
                return
            self._single.remove(name)
            self._columns[name] = np.repeat(one, self.count)
        there = self._columns.get(name)
        if there is None or len(there) < end:
            grown = np.empty((max(end, 64, int(1.5 * len(there)) if there is not None else 0), *values.shape[1:]), values.dtype)
            grown[: self.count] = empty if there is None else there[: self.count]
            self._columns[name] = there = grown
        there[self.count : end] = values

    def history(self, first: int | None = None) -> History:
        """Return the rows so far, or the first ones of them."""
        if not self._columns:
            self.append(np.empty((0, len(self.names))), {}, [])
        n = self.count if first is None else first
        columns = {name: np.broadcast_to(c, n) if name in self._single else c[:n] for name, c in self._columns.items()}
        return History(self.names, columns, self.choices)


@dataclass(frozen=True, eq=False)
class History:
    """Runs with an outcome, in the order of their index.

    Args:
        names: inputs, in the order of the columns of `x`.
        columns: (n, ...) arrays: `x`, `y.<metric>`, and the other fields of a `Record` by name.
        choices: of the inputs that have some, by name; `x` holds their positions.
    """

    names: tuple[str, ...]
    columns: Mapping[str, NDArray[Any]]
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, names: Sequence[str], records: Iterable[Record] = (), choices: Mapping[str, tuple[str, ...]] | None = None
    ) -> History:
        """Return the history of these records."""
        found, rows = tuple(records), Rows(tuple(names), choices or {})
        x = as_numbers([[r.inputs[name] for name in names] for r in found], rows.names, rows.choices)
        fields = {name: [getattr(r, name) for r in found] for name in (*_NUMBERS, *_TEXTS)}
        rows.append(x, fields, [r.metrics for r in found])
        return rows.history()

    def __len__(self) -> int:
        """Return the number of finished runs."""
        return len(self.columns["x"])

    @property
    def x(self) -> Points:
        """(n, d) inputs in their units."""
        return self.columns["x"]

    @property
    def index(self) -> NDArray[np.int64]:
        """(n,) index of each run in the campaign, from 0."""
        return self.columns["index"]

    @property
    def iteration(self) -> NDArray[Any]:
        """(n,) iteration of each run, from 0."""
        return self.columns["iteration"]

    @property
    def seed(self) -> NDArray[np.int64]:
        """(n,) seed of each run."""
        return self.columns["seed"]

    @property
    def seconds(self) -> Vector:
        """(n,) wall-clock time of each run."""
        return self.columns["seconds"]

    @property
    def log_q(self) -> Vector:
        """(n,) log density that the inputs were drawn with, NaN where they were chosen."""
        return self.columns["log_q"]

    @property
    def reason(self) -> NDArray[Any]:
        """(n,) why a run has no metrics, "" where it has."""
        return self.columns["reason"]

    @property
    def unconfirmed(self) -> NDArray[np.bool_]:
        """(n,) the run has a contact that SUMO's own list does not confirm; `columns["unconfirmed"]` says what differs."""
        return self.doubtful(Doubt.UNCONFIRMED)

    def doubtful(self, doubt: Doubt) -> NDArray[np.bool_]:
        """(n,) there is this doubt about the contacts of the run."""
        return np.array([text != "" and doubt in doubts(text) for text in self.columns["unconfirmed"]], dtype=bool)

    @property
    def versions(self) -> NDArray[Any]:
        """(n,) versions of the software that ran it."""
        return self.columns["versions"]

    @cached_property
    def stage(self) -> NDArray[np.str_]:
        """(n,) names of the stages that asked for the runs."""
        return self.columns["stage"].astype(np.str_)

    @cached_property
    def status(self) -> NDArray[np.str_]:
        """(n,) status of each run."""
        return self.columns["status"].astype(np.str_)

    @cached_property
    def ok(self) -> Mask:
        """(n,) the run gave metrics."""
        return np.asarray(self.status == str(Status.OK), dtype=bool)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics, in the order of the first run that has them."""
        return tuple(name[2:] for name in self.columns if name.startswith("y."))

    def y(self, metric: str) -> Vector:
        """Return (n,) values of a metric, NaN where the run has none."""
        found = self.columns.get(f"y.{metric}")
        return np.full(len(self), np.nan) if found is None else found

    def where(self, mask: Mask) -> History:
        """Return the runs where `mask` holds."""
        keep = np.asarray(mask, dtype=bool)
        return History(self.names, {name: column[keep] for name, column in self.columns.items()}, self.choices)

    def at_level(self, level: int) -> History:
        """Return the runs of a level of fidelity, 0 the scenario's own."""
        mine = self.columns["level"] == level
        return self if mine.all() else self.where(mine)

    def recoded(self, choices: Mapping[str, tuple[str, ...]]) -> History:
        """Return the runs with inputs among these choices, their positions counted in them."""
        if self.choices == choices:
            return self
        x, keep = self.x.copy(), np.ones(len(self), dtype=bool)
        for name, given in choices.items():
            k = self.names.index(name)
            position = np.array([given.index(c) if c in given else -1 for c in self.choices[name]])
            x[:, k] = position[x[:, k].astype(np.intp)]
            keep &= x[:, k] >= 0
        return History(self.names, {**self.columns, "x": x}, choices).where(keep)

    def extended(self, other: History) -> History:
        """Return these runs and, behind them, the others."""
        columns = {}
        for name in {**self.columns, **other.columns}:
            parts = [h.y(name[2:]) if name.startswith("y.") else h.columns[name] for h in (self, other)]
            columns[name] = np.concatenate(parts)
        return History(self.names, columns, self.choices)

    def record(self, row: int) -> Record:
        """Return one row, counted from 0 among these runs."""
        c = self.columns
        log_q, warm_up = float(c["log_q"][row]), int(c["warm_up"][row])
        return Record(
            int(c["index"][row]), str(c["stage"][row]), int(c["iteration"][row]), self.inputs(row), int(c["seed"][row]),
            str(c["status"][row]), self._metrics(row) if self.ok[row] else {},
            str(c["reason"][row]), None if np.isnan(log_q) else log_q, float(c["seconds"][row]), str(c["collisions"][row]),
            str(c["versions"][row]), bool(c["seed_chosen"][row]), int(c["level"][row]), None if warm_up < 0 else warm_up,
            str(c["unconfirmed"][row]),
        )  # fmt: skip

    def _metrics(self, row: int) -> dict[str, float]:
        """Return the metrics of one row by name; a coarse run may have fewer than others."""
        found = {name: float(self.y(name)[row]) for name in self.metrics}
        return {name: value for name, value in found.items() if not np.isnan(value)}

    def inputs(self, row: int) -> dict[str, Value]:
        """Return the inputs of one row by name, choices as text."""
        return {name: self._value(name, float(x)) for name, x in zip(self.names, self.x[row], strict=True)}

    def _value(self, name: str, x: float) -> Value:
        return self.choices[name][int(x)] if name in self.choices else x

    @property
    def records(self) -> tuple[Record, ...]:
        """All rows, one object each: for a few of them, or where every field is wanted."""
        return tuple(self.record(row) for row in range(len(self)))

    @property
    def training(self) -> History:
        """Runs that a metamodel of the inputs may learn from: finished well, not held out, of a seed that was drawn."""
        return self.where(self.ok & (self.stage != VALIDATION) & self.drawn)

    @property
    def drawn(self) -> Mask:
        """(n,) the seed was drawn without a look at what it draws: only such runs tell how often something happens."""
        return ~self.columns["seed_chosen"]

    @property
    def finished(self) -> History:
        """All runs of drawn seeds that finished well: what the final answer of a campaign learns from, after its scoring."""
        return self.where(self.ok & self.drawn)

    @property
    def held_out(self) -> History:
        """Runs that no metamodel learns from."""
        return self.where(self.ok & (self.stage == VALIDATION))

    def to_frame(self, requirement: Requirement | None = None) -> pd.DataFrame:
        """Return a tidy frame, a row a run.

        Args:
            requirement: gives the verdict: `critical` (nullable boolean, NA where a run has no metric), `margin`
                (in the metric's unit, <= 0 critical) and, of a combination, `violates`: the requirements that the run violates,
                joined by "; ".

        Returns:
            Columns index, stage, iteration, x.<input> (categorical where it has choices), y.<metric>, critical, margin, ...
        """
        import pandas as pd

        data: dict[str, Any] = {"index": self.index, "stage": self.columns["stage"], "iteration": self.iteration}
        data |= {f"x.{name}": column for name, column in named_columns(self.x, self.names, self.choices).items()}
        asked = () if requirement is None else (part.metric for part in requirement.parts)  # also while no run has them
        data |= {f"y.{name}": self.y(name) for name in dict.fromkeys((*self.metrics, *asked))}
        if requirement is not None:
            told = requirement.told(self)  # of infinite metrics margins are infinite, too
            data["critical"] = pd.arrays.BooleanArray(requirement.critical_runs(self), np.isnan(told))
            data["margin"] = told if requirement.combined else requirement.critical.margin(told)
            if requirement.combined:
                data["violates"] = violated_names(self, requirement)
        data["log_q"] = self.log_q
        for column in ("status", "reason", "seed", "collisions", "seconds", "versions"):
            data[column] = self.columns[column]
        warm_up = self.columns["warm_up"]
        data["seed_chosen"], data["level"] = self.columns["seed_chosen"], self.columns["level"]
        data["warm_up"] = pd.arrays.IntegerArray(warm_up, warm_up < 0)
        data["unconfirmed"] = self.columns["unconfirmed"]
        return pd.DataFrame(data)


def _alike(values: NDArray[Any], one: NDArray[Any]) -> bool:
    """Return whether all values are the single one of an array; NaN is NaN."""
    alike = values == one
    if values.dtype.kind == "f":
        alike |= np.isnan(values) & np.isnan(one)
    return bool(np.all(alike))


def violated_names(history: History, requirement: Requirement) -> list[str]:
    """Return for each run the names of the requirements of a combination that it violates, joined by "; "."""
    masks = [part.critical_runs(history) for part in requirement.parts]
    return ["; ".join(p.label for p, mask in zip(requirement.parts, masks, strict=True) if mask[k]) for k in range(len(history))]


def as_numbers(rows: Sequence[Sequence[Value]], names: Sequence[str], choices: Mapping[str, tuple[str, ...]]) -> Points:
    """Return (n, d) numbers of rows of values, a choice as its position.

    Raises:
        StoreError: a value is not among the choices of its input.
    """
    if not choices:
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    positions = [{c: float(k) for k, c in enumerate(choices[name])} if name in choices else None for name in names]
    try:
        numbers = [
            [float(v) if known is None else known[str(v)] for v, known in zip(row, positions, strict=True)] for row in rows
        ]
    except (KeyError, ValueError) as error:
        raise StoreError(f"a run's inputs must be numbers, or choices of its scenario, but one is not: {error}") from None
    return np.array(numbers, dtype=np.float64).reshape(len(rows), len(names))


def named_columns(x: Points, names: Sequence[str], choices: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    """Return the columns of x (n, d) by name for a frame: numbers, or pandas categoricals."""
    import pandas as pd

    return {
        name: pd.Categorical.from_codes(x[:, k].astype(np.int64), list(choices[name])) if name in choices else x[:, k]
        for k, name in enumerate(names)
    }
