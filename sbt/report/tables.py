"""The tables of a report: cells with a text and a key to sort by, without markup."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbt.campaigns.asking import Sensitivity
from sbt.campaigns.modes import worst_first
from sbt.campaigns.preventable import KNOWN_LIMITS, describe_judgements
from sbt.campaigns.wording import NOTHING, input_value, input_widths, mixture_shares, number, percent, written_unit
from sbt.problem.outcome import doubts
from sbt.problem.parameter import Parameter
from sbt.problem.plain import JsonMapping, Value
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.report.influence import Influence
from sbt.report.words import SCORES, distribution_words
from sbt.store.history import History, Record
from sbt.store.records import FitRecord, Iteration, Judgement

__all__ = [
    "Cell",
    "Table",
    "contact_table",
    "critical_table",
    "failed_table",
    "input_table",
    "iteration_table",
    "of_run",
    "sensitivity_table",
]

_MOST, _LEAST_ERROR = 200, 0.001
_RUN = re.compile(r"(?<=[ (])RUN(?=$|\)$| --gif RUN\.gif$|\.gif$)")  # as in explorer.js: not what a folder is called
_LIST_SCORES = ("log_likelihood", "rmse", "average_precision", "precision_at_recall_90", "calibration_error")


@dataclass(frozen=True)
class Cell:
    """`text` is read; `key` is sorted by and shown in full on hover; `code` opens on a click."""

    text: str
    key: str | float | None = None
    code: str = ""

    @classmethod
    def of(cls, value: Any, digits: int = 4) -> Cell:
        """Return the cell of a number or a text."""
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return cls(number(value, digits), value if is_number else None)

    @classmethod
    def of_input(cls, value: Value, width: float = math.inf) -> Cell:
        """Return the cell of an input's value, whose range is so wide."""
        return cls(input_value(value, width, 4), None if isinstance(value, str) else value)

    @property
    def numeric(self) -> bool:
        """The cell is right-aligned and sorted as a number."""
        return isinstance(self.key, (int, float))


@dataclass(frozen=True)
class Table:
    """Columns, rows and a note below."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Which columns hold numbers, in some row at least."""
        return tuple(any(cell.numeric for cell in column) for column in zip(*self.rows, strict=True))


def of_run(command: str, index: int) -> str:
    """Return a command with the index of a run in place of RUN, which the folder's name may have, too."""
    return _RUN.sub(str(index), command)


def input_table(scenario: LogicalScenario, influence: Influence | None) -> Table:
    """Return the inputs; with their influence on P(critical) where that is known."""
    columns = ["input", "range", "unit", "distribution", "description"]
    rows = [_input(parameter) for parameter in scenario.space.parameters]
    if influence is not None:
        columns.insert(4, "influence")
        shares = influence.total.tolist()
        rows = [(*row[:4], Cell(f"{share:.2f}", share), *row[4:]) for row, share in zip(rows, shares, strict=True)]
    notes = []
    if influence is not None:
        notes.append("Influence: total Sobol index of the metamodel's P(critical) over the ranges.")
    if scenario.space.constraints:
        notes.append("Constraints: " + "; ".join(text for text, _ in scenario.space.constraints) + ".")
    if scenario.space.correlation is not None:
        notes.append("The inputs are joined by a Gaussian copula.")
    if scenario.space.features:
        notes.append("Derived for the metamodel: " + ", ".join(name for name, _ in scenario.space.features) + ".")
    return Table(tuple(columns), tuple(rows), " ".join(notes))


def _input(parameter: Parameter) -> tuple[Cell, ...]:
    low, high = (input_value(float(end), parameter.high - parameter.low, 6) for end in (parameter.low, parameter.high))
    scale = ", whole numbers" if parameter.kind == "integer" else ", logarithmic" if parameter.logarithmic else ""
    return (
        Cell(parameter.name),
        Cell(", ".join(parameter.choices) or f"[{low}, {high}]{scale}"),
        Cell(written_unit(parameter.unit) or NOTHING),
        Cell(distribution_words(parameter)),
        Cell(parameter.description),
    )


def sensitivity_table(rows: Sequence[Sensitivity]) -> Table:
    """Return what each parameter of the distributions does to the probability P, that which matters most first."""
    columns = ("input", "parameter", "value", "dP / dvalue", "std. error", "elasticity", "change", "P, raised", "P, lowered")
    cells = tuple(
        (Cell(each.input), Cell(each.parameter), Cell.of_input(each.value), Cell.of(each.derivative, 3),
         Cell.of(each.std_error, 2), Cell.of(each.elasticity, 3), Cell.of(each.change, 3), Cell.of(each.raised, 3),
         Cell.of(each.lowered, 3))
        for each in rows
    )  # fmt: skip
    note = (
        "P is only as right as the distributions. Each line changes one number of them by 10 % (a mean of 0: by 10 % of the "
        "standard deviation), by weights of the same runs; elasticity: relative change of P for a relative change of the "
        "number; ends of ranges are not in the table. What the runs do not tell is left out: the derivative where an end of the "
        "distribution, at which it has a density, moves with the number; P where no draw was made. Other distributions: sumo-sbt "
        "estimate-again."
    )
    return Table(columns, cells, note)


def iteration_table(
    iterations: Sequence[Iteration],
    fits: Sequence[FitRecord],
    history: History,
    requirement: Requirement,
    coarse: History | None = None,
) -> Table:
    """Return how each batch was chosen, what it gave, and the scores of the metamodel then; `coarse`: runs that only teach."""
    critical, by_iteration = requirement.critical_runs(history), {fit.iteration: fit for fit in fits}
    chose = [by_iteration[batch.number] for batch in iterations if batch.number in by_iteration]
    scored = [key for key in _LIST_SCORES if any(fit.score(key) is not None for fit in chose)]
    mixes = any(fit.weights for fit in chose)
    rows = []
    for batch in iterations:
        mine, fit = history.iteration == batch.number, by_iteration.get(batch.number)
        weights = None if fit is None else fit.weights
        rows.append((
            Cell.of(batch.number), Cell(", ".join(dict.fromkeys(history.stage[mine].tolist())) or str(batch.stage)),
            Cell.of(int(mine.sum())),
            *([] if coarse is None else [Cell.of(int((coarse.iteration == batch.number).sum()))]),
            Cell.of(int((mine & critical).sum())), Cell.of(int((mine & ~history.ok).sum())),
            *(_score(key, None if fit is None else fit.score(key)) for key in scored),
            *([Cell(mixture_shares(weights or {}), "" if fit is None else fit.chosen_because)] if mixes else []),
            Cell(_listed(batch.proposal)),
        ))  # fmt: skip
    columns = (
        "iteration",
        "stage",
        "runs",
        *([] if coarse is None else ["coarse runs"]),
        "critical",
        "failed",
        *(SCORES[key] for key in scored),
        *(["mixture"] if mixes else []),
        "how it was chosen",
    )
    notes = ["Scores are those of the metamodel that chose the batch."] if scored else []
    notes += [] if coarse is None else ["Coarse runs only teach; critical and failed ones are among the scenario's own."]
    return Table(columns, tuple(rows), " ".join(notes))


def _score(key: str, value: float | None) -> Cell:
    """Return a score; errors of a probability have a thousandth as their least."""
    tiny = key == "calibration_error" and value is not None and value < _LEAST_ERROR
    return Cell(f"< {_LEAST_ERROR:g}", value) if tiny else Cell.of(value, 3)


def _listed(proposal: JsonMapping) -> str:
    """Return the keys and values of how a batch was chosen on one line; not its arrays, and what does not hold."""
    told = {key: f"({_listed(value)})" if isinstance(value, Mapping) else value for key, value in proposal.items()}
    given = {key: value for key, value in told.items() if not isinstance(value, list) and value not in (None, False, "()")}
    return ", ".join(f"{key.replace('_', ' ')}{'' if value is True else f' {number(value)}'}" for key, value in given.items())


def critical_table(history: History, requirement: Requirement, replay: str, judgements: Sequence[Judgement] = ()) -> Table:
    """Return the critical runs, the deepest in the critical interval first, at most 200, with who would have avoided them."""
    judged: dict[int, list[Judgement]] = {}
    for each in judgements:
        judged.setdefault(each.run, []).append(each)
    margin, told = requirement.depths(history), requirement.told(history)
    found = [int(k) for k in worst_first(history, margin) if margin[k] <= 0]
    metrics = sorted(history.metrics, key=lambda name: name not in [part.metric for part in requirement.parts])
    rows, widths = [], input_widths(history)
    for k in found[:_MOST]:
        record = history.record(k)
        rows.append((
            Cell.of(record.index), Cell.of(float(margin[k]) if np.isfinite(told[k]) else None),
            *((Cell(", ".join(requirement.violated(record.metrics))),) if requirement.combined else ()),
            *(Cell.of_input(record.inputs[name], widths[name]) for name in history.names),
            *(Cell.of(record.metrics.get(name)) for name in metrics), Cell(str(record.seed), record.seed),
            *((Cell(describe_judgements(judged.get(record.index, ())) or NOTHING),) if judged else ()),
            Cell("command", code=of_run(replay, record.index)),
        ))  # fmt: skip
    rest = len(found) - len(rows)
    note = f"{rest:,} more critical runs are in the store: sumo-sbt export lists all." if rest else ""
    violates = ("violates",) if requirement.combined else ()
    columns = ("run", "margin", *violates, *history.names, *metrics, "seed", *(("avoided by",) if judged else ()), "again")
    return Table(columns, tuple(rows), " ".join(filter(None, (note, KNOWN_LIMITS if judged and rows else ""))))


def contact_table(history: History, requirement: Requirement, replay: str) -> Table:
    """Return the runs with doubtful contacts, such as those that SUMO's own list does not have, critical ones first, at most 200.

    Args:
        history: finished runs.
        requirement: that tells which are critical.
        replay: command that opens a run as a film, with RUN where its index belongs.
    """
    critical, texts = requirement.critical_runs(history), history.columns["unconfirmed"]
    found = sorted(np.flatnonzero(texts != "").tolist(), key=lambda k: (not critical[k], k))
    rows = tuple(
        (Cell.of(int(history.index[k])), Cell("critical" if critical[k] else "not critical"),
         Cell(", ".join(doubts(str(texts[k])))),
         Cell(str(texts[k])), Cell("film", code=of_run(replay, int(history.index[k]))))
        for k in found[:_MOST]
    )  # fmt: skip
    rest = len(found) - len(rows)
    note = f"{rest:,} more are in the store: sumo-sbt export lists all (column unconfirmed)." if rest else ""
    return Table(("run", "verdict", "doubt", "what differs", "see it"), rows, note)


def failed_table(history: History, replay: str) -> Table:
    """Return the failed runs in order, at most 200, each with its reason."""
    failed = history.where(~history.ok).records
    rows = tuple(
        (Cell.of(record.index), Cell(record.stage), Cell(record.status), Cell(record.reason),
         Cell.of(record.seconds), Cell("command", code=of_run(replay, record.index)))
        for record in failed[:_MOST]
    )  # fmt: skip
    rest = len(failed) - len(rows)
    note = f"{rest:,} more failed runs are in the store." if rest else ""
    kinds = "" if not failed else " " + ", ".join(
        f"{status}: {count:,} of {len(history):,} runs ({percent(count / len(history))})" for status, count in _counted(failed)
    ) + "."  # fmt: skip
    return Table(("run", "stage", "status", "reason", "seconds", "again"), rows, (note + kinds).strip())


def _counted(records: Sequence[Record]) -> list[tuple[str, int]]:
    names, counts = np.unique([record.status for record in records], return_counts=True)
    return [(str(name), int(count)) for name, count in zip(names, counts, strict=True)]
