"""The figures of a benchmark, one to one with the paper's, from the table and the predictions of the cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.benchmark.cell import PREDICTIONS
from sbt.benchmark.panels import plot_reliability_of_recall, plot_residual_risk
from sbt.benchmark.table import read_table
from sbt.config.benchmark import Cell, LoadedBenchmark
from sbt.metamodels.scores import precision_recall
from sbt.problem.arrays import Vector
from sbt.report.style import figure_style, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Results", "write_figures"]

Row = dict[str, Any]
GREY = "#b5b5b5"
COLOURS = ("#1f4e79", "#c0392b", "#2e8b57", "#d98c1f", "#7d4fa3", "#4d4d4d", "#17a2b8", "#a0522d")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_DPI = 110


@dataclass(frozen=True)
class Results:
    """The results of a benchmark so far.

    Attributes:
        rows: of the table.
        cells: all of the benchmark, done or not.
        scenarios, metamodels: names that have rows, in the order of the configuration.
    """

    rows: tuple[Row, ...]
    cells: tuple[Cell, ...]
    scenarios: tuple[str, ...]
    metamodels: tuple[str, ...]

    @classmethod
    def of(cls, loaded: LoadedBenchmark, table: Path) -> Results:
        """Return the results in a table."""
        rows, cells = tuple(read_table(table)), tuple(loaded.cells())
        scenarios, metamodels = (
            tuple(name for name in dict.fromkeys(getattr(cell, key) for cell in cells) if name in {row[key] for row in rows})
            for key in ("scenario", "metamodel")
        )
        return cls(rows, cells, scenarios, metamodels)

    def curve(self, scenario: str, metamodel: str, acquisition: str, key: str) -> tuple[Vector, Vector, Vector]:
        """Return (m,) runs learned from (mean over the seeds), (m,) means and (m,) standard deviations of one column."""
        wanted = (scenario, metamodel, acquisition)
        rows = [r for r in self.rows if (r["scenario"], r["metamodel"], r["acquisition"]) == wanted and math.isfinite(r[key])]
        groups = _of_each_size(rows)
        found = [[row[key] for row in group] for group in groups]
        return _learned(groups), np.array([np.mean(each) for each in found]), np.array([np.std(each) for each in found])

    def median_cell(self, scenario: str, metamodel: str, acquisition: str) -> Cell | None:
        """Return the finished cell whose last likelihood is closest to the median over the seeds, as the paper does."""
        wanted = (scenario, metamodel, acquisition)
        cells = [c for c in self.cells if (c.scenario, c.metamodel, c.acquisition) == wanted]
        last = {row["seed"]: row["log_likelihood"] for row in self.rows
                if (row["scenario"], row["metamodel"], row["acquisition"]) == wanted}  # rows are in the order of the runs
        done = [c for c in cells if c.seed in last and (c.folder / PREDICTIONS).is_file()]
        if not done:
            return None
        middle = np.median([last[c.seed] for c in done])
        return min(done, key=lambda c: abs(last[c.seed] - middle))


def _of_each_size(rows: Sequence[Row]) -> list[list[Row]]:
    """Return the rows of equally many runs together, of the seeds or cells, in the order of how many were learned from."""
    groups: dict[float, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["runs"], []).append(row)
    return sorted(groups.values(), key=_learned_of)


def _learned(groups: Sequence[Sequence[Row]]) -> Vector:
    """Return (m,) how many runs each of these groups learned from in the mean."""
    return np.array([_learned_of(group) for group in groups])


def _learned_of(group: Sequence[Row]) -> float:
    return float(np.mean([row["learned"] for row in group]))  # runs that failed are none of them


def write_figures(loaded: LoadedBenchmark, table: Path, folder: Path) -> list[Path]:
    """Draw all figures of the results so far and return their files (PNG).

    Args:
        loaded: the benchmark.
        table: its table.
        folder: for the figures; created where it is missing.
    """
    results = Results.of(loaded, table)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with figure_style():
        for name, draw in _figures(results):
            figure = draw()
            if figure is not None:
                path = folder / f"{name}.png"
                figure.savefig(path, dpi=_DPI, metadata={"Software": None})
                written.append(path)
    return written


def _figures(results: Results) -> list[tuple[str, Callable[[], Figure | None]]]:
    """Return name and drawing of every figure."""
    figures: list[tuple[str, Callable[[], Figure | None]]] = [
        ("likelihood_even", lambda: _curves(results, "even", "log_likelihood", "log likelihood a run, all runs", None)),
        ("rmse_even", lambda: _curves(results, "even", "rmse", "RMSE, all runs", None)),
        (
            "likelihood_critical",
            lambda: _curves(results, "boundary", "log_likelihood_critical", "log likelihood a run, critical runs", "even"),
        ),
        ("rmse_critical", lambda: _curves(results, "boundary", "rmse_critical", "RMSE, critical runs", "even")),
        ("precision_recall", lambda: _grid(results, _precision_recall, "recall", "precision")),
        ("reliability", lambda: _grid(results, _reliability, "expected recall", "observed recall")),
        ("times", lambda: _times(results)),
    ]
    return figures + [(f"scatter_{s}", lambda s=s: _scatter(results, s)) for s in results.scenarios]


def _curves(results: Results, acquisition: str, key: str, title: str, behind: str | None) -> Figure | None:
    """Draw one column over the number of runs: a panel a scenario, a curve a metamodel; `behind` in grey."""
    figure, panels = _panels(len(results.scenarios))
    drawn = False
    for scenario, ax in zip(results.scenarios, panels, strict=True):
        own: list[float] = []
        for k, metamodel in enumerate(results.metamodels):
            if behind is not None:
                runs, mean, _ = results.curve(scenario, metamodel, behind, key)
                ax.plot(runs, mean, color=GREY, marker=MARKERS[k % 8], markersize=3, linewidth=1.0, zorder=1)
            runs, mean, deviation = results.curve(scenario, metamodel, acquisition, key)
            if len(runs):
                drawn = True
                own += [*(mean - deviation), *(mean + deviation)]
                look: dict[str, Any] = {"color": COLOURS[k % 8], "marker": MARKERS[k % 8], "markersize": 4}
                ax.errorbar(runs, mean, yerr=deviation, label=metamodel, linewidth=1.3, elinewidth=0.9, capsize=2, **look)
        ax.set(title=scenario, xlabel="runs learned from")
        if behind is not None and own:  # as in the paper, grey curves may leave the panel
            low, high = min(own), max(own)
            ax.set_ylim(low - 0.25 * (high - low) - 1e-9, high + 0.15 * (high - low) + 1e-9)
    return _finished(figure, panels, title) if drawn else None


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with this many panels, three a line."""
    columns = min(count, 3)
    lines = -(-count // columns)
    figure = new_figure(3.1 * columns + 0.4, 2.5 * lines + 0.6)
    return figure, [figure.add_subplot(lines, columns, k + 1) for k in range(count)]


def _finished(figure: Figure, panels: Sequence[Axes], title: str) -> Figure:
    """Put title and one legend above all panels."""
    handles: dict[str, Any] = {}
    for ax in panels:
        handles |= {name: handle for handle, name in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.suptitle(title)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 6))
    return figure


def _grid(results: Results, draw: Callable[[Axes, Cell, bool], None], across: str, up: str) -> Figure | None:
    """Draw a panel for each metamodel (lines) and scenario (columns): boundary in colour, even in grey behind."""
    metamodels = [m for m in results.metamodels if _any_done(results, results.scenarios, m)]
    lines, columns, drawn = max(len(metamodels), 1), len(results.scenarios), False
    figure = new_figure(1.75 * columns + 0.8, 1.65 * lines + 0.6)
    for i, metamodel in enumerate(metamodels):
        for j, scenario in enumerate(results.scenarios):
            ax = figure.add_subplot(lines, columns, i * columns + j + 1)
            for acquisition in ("even", "boundary"):
                cell = results.median_cell(scenario, metamodel, acquisition)
                if cell is not None:
                    draw(ax, cell, acquisition == "even")
                    drawn = True
            ax.set(xlim=(-0.03, 1.05), ylim=(-0.03, 1.05), xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
            ax.set_title(scenario if i == 0 else "")
            ax.set_xlabel(across if i == lines - 1 else "")
            ax.set_ylabel(f"{metamodel}\n{up}" if j == 0 else "")
    return figure if drawn else None


def _any_done(results: Results, scenarios: Sequence[str], metamodel: str) -> bool:
    """Return whether a cell of the metamodel is finished, so that it has predictions to draw."""
    return any(results.median_cell(s, metamodel, a) is not None for s in scenarios for a in ("even", "boundary"))


def _load(cell: Cell) -> dict[str, Any]:
    with np.load(cell.folder / PREDICTIONS, allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def _precision_recall(ax: Axes, cell: Cell, behind: bool) -> None:
    """Draw precision over recall, a star where all critical runs are found, the base rate as a line."""
    found = _load(cell)
    precision, recall, _ = precision_recall(found["odds"], found["critical"])
    if len(recall) == 0:
        ax.text(0.5, 0.5, "no critical run", ha="center", fontsize=7)
        return
    end = int(np.argmax(recall >= 1.0 - 1e-12)) + 1
    colour = GREY if behind else "#1f4e79"
    ax.plot(recall[:end], precision[:end], color=colour, linewidth=1.2, drawstyle="steps-pre")
    ax.plot([1.0], [precision[end - 1]], "*", color=GREY if behind else "#8c1515", markersize=8, clip_on=False, zorder=5)
    if not behind:
        ax.axhline(float(found["critical"].mean()), color="#777777", linewidth=0.9, linestyle="--")


def _reliability(ax: Axes, cell: Cell, behind: bool) -> None:
    found = _load(cell)
    ax.plot([0, 1], [0, 1], color="#cccccc", linewidth=0.9)
    plot_reliability_of_recall(found["p"], found["critical"], ax, colour=GREY if behind else "#1f4e79")


def _scatter(results: Results, scenario: str) -> Figure | None:
    """Draw predicted over true values of one scenario: even above, boundary below, a column a metamodel."""
    metamodels = [m for m in results.metamodels if _any_done(results, (scenario,), m)]
    columns, drawn = max(len(metamodels), 1), None
    figure = new_figure(2.1 * columns + 0.9, 4.6)
    axes = []
    for i, acquisition in enumerate(("even", "boundary")):
        for j, metamodel in enumerate(metamodels):
            ax = figure.add_subplot(2, columns, i * columns + j + 1)
            axes.append(ax)
            cell = results.median_cell(scenario, metamodel, acquisition)
            if cell is not None:
                found = _load(cell)
                drawn = plot_residual_risk(found["y"], found["mu"], found["sigma"], found["requirement"], ax)
            ax.set_title(metamodel if i == 0 else "")
            ax.set_ylabel(f"{'even' if i == 0 else 'a_BI'}\npredicted mean" if j == 0 else "")
            ax.set_xlabel("true metric" if i == 1 else "")
    if drawn is None:
        return None
    bar = figure.colorbar(drawn, ax=axes, pad=0.01, fraction=0.03, extend="min")
    bar.set_label("residual risk that covers the outcome")
    figure.suptitle(scenario)
    return figure


def _times(results: Results) -> Figure | None:
    """Draw the seconds of a fit over the runs, and of a sample drawn from a_BI in each scenario."""
    figure = new_figure(8.6, 3.4)
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    width = 0.8 / max(len(results.metamodels), 1)
    for k, metamodel in enumerate(results.metamodels):
        mine = [row for row in results.rows if row["metamodel"] == metamodel]
        groups = _of_each_size(mine)
        median = [np.median([row["fit_seconds"] for row in group]) for group in groups]
        look: dict[str, Any] = {"color": COLOURS[k % 8], "marker": MARKERS[k % 8], "markersize": 4, "linewidth": 1.2}
        left.plot(_learned(groups), median, label=metamodel, **look)
        for j, scenario in enumerate(results.scenarios):
            rows = [r for r in mine if (r["scenario"], r["acquisition"]) == (scenario, "boundary") and r["sampled"] > 0]
            if rows:
                seconds = sum(r["sampling_seconds"] for r in rows) / sum(r["sampled"] for r in rows)
                right.bar(j + (k + 0.5) * width - 0.4, 1e3 * seconds, width, color=COLOURS[k % 8])
    left.set(xlabel="runs learned from", ylabel="training (s, median of cells)", yscale="log")
    right.set(ylabel="a sample from a_BI (ms)", yscale="log")
    right.set_xticks(range(len(results.scenarios)), results.scenarios, rotation=30, ha="right")
    return _finished(figure, [left, right], "training and sampling times (wall clock)")
