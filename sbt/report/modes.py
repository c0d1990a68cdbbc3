"""The failure modes of a falsification: a table, and where they lie among the runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sbt.campaigns.failures import FalsificationConclusion
from sbt.campaigns.modes import FailureMode
from sbt.campaigns.preventable import KNOWN_LIMITS, describe_judgements
from sbt.campaigns.wording import NOTHING, input_widths, number, percent, written_unit
from sbt.problem.arrays import Vector
from sbt.problem.plain import Value
from sbt.problem.space import ParameterSpace
from sbt.report.axes import drawn
from sbt.report.figures import whole_ticks
from sbt.report.style import label, new_figure, to_svg
from sbt.report.tables import Cell, Table
from sbt.report.words import Findings

__all__ = ["drawing_of_modes", "mode_table"]

_MOST_COLOURS = 8
_COLOURS = ("#c1272d", "#1f4e79", "#e08e0b", "#2e7d5b", "#7b4fa3", "#0e8fa0", "#8a5a2b", "#d1579a")
_JOINED = "Critical runs are one mode where the metamodel joins them by a segment with P(critical) > 0.5"
_ALIKE = " and the nearest road user was on the same side of ego and on the same course"
_NOTE = (
    "; the deepest mode first, of a noisy simulator the one that the search expects to fail most often. Confirmed: share of"
    " repetitions of the representative with fresh seeds that were critical again. What makes it safe: the change of inputs"
    " to the nearest run, in the unit cube, that is not critical. Most likely: the mode's run of largest density."
)


def mode_table(found: Findings, space: ParameterSpace) -> Table:
    """Return one row a failure mode; no rows where the campaign found none or does not look for them."""
    modes, several = _modes(found), found.requirement.combined
    rows, typed = [], any(mode.conflict for mode in modes)
    judged, widths = any(mode.preventable for mode in modes), input_widths(found.history)
    doubtful = any(mode.unconfirmed for mode in modes)
    for number_of, mode in enumerate(modes, 1):
        confirmed = NOTHING if mode.confirmed is None else f"{percent(mode.confirmed)} of {mode.came_back[1]}"
        confirmed += f", {mode.confirmations_lost} gave no metric" if mode.confirmations_lost else ""
        rows.append((
            Cell.of(number_of), Cell.of(mode.representative), Cell.of(mode.metric),
            *((Cell(violated_words(mode)),) if several else ()), Cell.of(mode.size), Cell(confirmed),
            *(() if not doubtful else (Cell.of(mode.unconfirmed),)),
            *(() if not typed else (Cell(mode.conflict or NOTHING),)),
            *(_input(mode, name, widths.get(name, math.inf)) for name in space.names), Cell(_change(mode, space)),
            *((Cell(describe_judgements(mode.preventable or ()) or NOTHING),) if judged else ()), Cell.of(mode.most_likely.run),
        ))  # fmt: skip
    metric = found.requirement.told_as
    who = ("other road user",) if typed else ()
    evidence = ("contacts SUMO does not list",) if doubtful else ()
    which = ("violates",) if several else ()
    columns = ("mode", "representative", metric, *which, "runs", "confirmed", *evidence, *who, *space.names, "what makes it safe",
               *(("avoided by",) if judged else ()), "most likely")  # fmt: skip
    note = _JOINED + (_ALIKE if typed else "") + _NOTE + (f" {KNOWN_LIMITS}" if judged else "")
    return Table(columns, tuple(rows), note if rows else "")


def _input(mode: FailureMode, name: str, width: float) -> Cell:
    """Return an input of the representative, with the other choices that the mode's runs have."""
    others = [choice for choice in (mode.choices or {}).get(name, ()) if choice != mode.inputs[name]]
    return Cell(f"{mode.inputs[name]}, also {', '.join(others)}") if others else Cell.of_input(mode.inputs[name], width)


def violated_words(mode: FailureMode) -> str:
    """Return the requirements that a mode's runs violate, with how many of them where not all do."""
    counts = mode.violates or {}
    return ", ".join(name if n == mode.size else f"{name} ({n} of {mode.size})" for name, n in counts.items()) or NOTHING


def _modes(found: Findings) -> Sequence[FailureMode]:
    """Return the failure modes of the conclusion."""
    return found.conclusion.failure_modes if isinstance(found.conclusion, FalsificationConclusion) else ()


def _change(mode: FailureMode, space: ParameterSpace) -> str:
    """Return the largest changes towards the nearest uncritical run, relative to the inputs' ranges."""
    safe = mode.nearest_safe
    if safe is None:
        return "no uncritical run"
    inputs = {p.name: p for p in space.parameters}
    units = {p.name: written_unit(p.unit) for p in space.parameters}

    def size(name: str, change: Value) -> float:
        if isinstance(change, str):  # another choice first
            return math.inf
        here = float(mode.inputs[name])
        first, second = inputs[name].to_unit(np.array([here, here + change]))
        return abs(float(second - first))

    sizes = {name: size(name, change) for name, change in safe.change.items()}
    ranked = sorted(safe.change.items(), key=lambda item: -sizes[item[0]])[:3]
    changes = ", ".join(
        f"{name} {change}" if isinstance(change, str) else f"{name} {change:+.3g} {units[name]}".strip()
        for name, change in ranked
    )
    rest = len(safe.change) - len(ranked)
    gave = "infinite" if safe.metric is None else number(safe.metric)
    return f"{changes or 'another seed'}{f' and {rest} more' if rest > 0 else ''}: {gave} (run {safe.run})"


def drawing_of_modes(found: Findings, space: ParameterSpace, weights: Vector) -> Iterator[tuple[str, str]]:
    """Yield the figure's caption and SVG; nothing without a mode.

    The two inputs are those of largest weight (d,); with one input the metric is drawn over it.
    """
    modes = _modes(found)
    if not modes:
        return
    history, y = found.history, drawn(found.requirement, found.history)
    order = np.argsort(-weights, kind="stable")[:2]
    across = int(min(order))
    up = int(max(order)) if space.dimension > 1 else None
    vertical = y if up is None else history.x[:, up]
    figure = new_figure(5.4, 4.4)
    ax = figure.subplots()
    ok = history.ok
    ax.scatter(history.x[ok, across], vertical[ok], s=9, color="#c3c9cf", linewidths=0, label="other runs", zorder=1)
    where = {int(index): row for row, index in enumerate(history.index)}
    arrows = False
    for k, mode in enumerate(modes[:_MOST_COLOURS]):
        rows = [where[run] for run in mode.runs if run in where]
        ax.scatter(
            history.x[rows, across], vertical[rows], s=20, color=_COLOURS[k], linewidths=0, zorder=2, label=f"mode {k + 1}"
        )
        at, safe = where[mode.representative], mode.nearest_safe
        ax.scatter(history.x[at, across], vertical[at], marker="*", s=150, color=_COLOURS[k], edgecolor="white", zorder=4)
        if safe is not None and safe.change and safe.run in where:
            to, arrows = where[safe.run], True
            ax.annotate(
                "", (history.x[to, across], vertical[to]), (history.x[at, across], vertical[at]), zorder=3,
                arrowprops={"arrowstyle": "->", "color": _COLOURS[k], "lw": 1.2},
            )  # fmt: skip
    names = [label(p.name, p.unit) for p in space.parameters]
    ax.set_xlabel(names[across])
    ax.set_ylabel(found.requirement.told_as if up is None else names[up])
    whole_ticks(ax, space.parameters[across], *(() if up is None else (space.parameters[up],)))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    arrow = "; arrow: to the nearest run that is not critical" if arrows else ""
    caption = f"Critical runs by failure mode; star: representative{arrow}."
    if space.dimension > 2:
        caption += " The two inputs of largest influence are shown; in the others the runs differ too."
    if len(modes) > _MOST_COLOURS:
        caption += f" The {_MOST_COLOURS} deepest of {len(modes)} modes."
    yield caption, to_svg(figure, "modes")
