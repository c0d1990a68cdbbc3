"""The figures that a campaign has data for, each with a caption that explains how to read it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.plain import unit_of
from sbt.problem.space import ParameterSpace
from sbt.report import curves, figures
from sbt.report.convergence import drawing_of_convergence
from sbt.report.modes import drawing_of_modes
from sbt.report.projection import Predict, log_probability, most_influential_pairs, probability_plane
from sbt.report.style import figure_style, new_figure, to_svg
from sbt.report.thinning import shown_runs
from sbt.report.words import Findings, requirement_words
from sbt.store.history import VALIDATION, History
from sbt.store.records import FitRecord

__all__ = ["DRAWN", "Drawing", "draw"]

DRAWN = frozenset(
    ("convergence", "modes", "runs", "probability", "precision_recall", "reliability", "validation", "metric", "progress")
)
"""Names of the figures, of which some may be there several times, numbered."""
_MOST_RUNS_ON_MAP = 800
_MOST_PANELS = 9
_FEW_HELD_OUT = 20
_NO_CHANCE, _SLIGHT = 1e-6, 1e-3


@dataclass(frozen=True)
class Drawing:
    """A figure as SVG; `wide` ones take the whole width of the page."""

    name: str
    title: str
    caption: str
    svg: str
    wide: bool = False


def draw(
    found: Findings,
    space: ParameterSpace,
    fits: Sequence[FitRecord],
    predict: Predict | None,
    weights: Vector,
) -> list[Drawing]:
    """Return every figure that the campaign has data for.

    Args:
        found: rows and requirement.
        space: the inputs.
        fits: scores of the metamodels so far.
        predict: the last metamodel, None where there is none.
        weights: (d,) importance of the inputs, to choose which are shown.
    """
    with figure_style():
        drawn = [Drawing("convergence", "The estimate over the runs", *parts) for parts in drawing_of_convergence(found)]
        drawn += _runs(found, space, predict, weights)
        drawn += [Drawing("modes", "Failure modes", *parts) for parts in drawing_of_modes(found, space, weights)]
        if predict is not None:
            drawn += [*_map(found, space, predict, weights), *_held_out(found, space, predict)]
        drawn += [*_validation(found, fits), *_counts(found)]
    return drawn


def _runs(found: Findings, space: ParameterSpace, predict: Predict | None, weights: Vector) -> Iterator[Drawing]:
    """Yield the runs in input space: the metric over one input, one plane, or the most influential pairs."""
    if len(found.history) == 0:
        return
    if space.dimension == 1:
        yield _runs_over_one(found, space, predict)
        return
    pairs = most_influential_pairs(weights)
    columns = min(len(pairs), 3)
    lines = -(-len(pairs) // columns)
    figure = new_figure(5.4 if columns == 1 else 11.0, 4.4 if columns == 1 else 0.35 + 3.3 * lines)
    grid = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    history, caption = _thinned(found)
    for ax, pair in zip(grid, pairs, strict=True):
        figures.plot_runs(history, found.requirement, space, ax, pair=pair)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=3 if columns == 1 else 5)
    caption += f" {_markers(found)}"
    if any(parameter.discrete for parameter in space.parameters):
        caption += " Runs of whole-number inputs and of choices are spread around their value."
    if columns > 1:
        told = bool(weights.any())
        some = "the pairs of the four most influential inputs" if told else "some pairs of inputs"
        chosen = "all pairs of inputs" if space.dimension == 3 else some
        first = ", most influential first" if told else ""
        caption += f" Shown are {chosen}{first}; the other inputs vary unseen, so that verdicts overlap."
    yield Drawing("runs", "Runs in input space", caption, to_svg(figure, "runs"), wide=columns > 1)


def _thinned(found: Findings) -> tuple[History, str]:
    """Return the runs that a figure shows, and in words which they are."""
    history = found.history
    keep = shown_runs(history.ok, found.critical, history.index)
    if keep.all():
        return history, "Every run."
    words = f"{int(keep.sum()):,} of {len(history):,} runs, evenly thinned within critical, failed and other ones"
    return history.where(keep), f"{words}: critical and failed ones are shown more often than they are."


def _markers(found: Findings) -> str:
    """Return what the markers mean, of those that are there."""
    ok, critical = found.history.ok, found.critical
    circles, triangles = ("light circles", "uncritical", ok & ~critical), ("dark triangles", "critical", critical)
    kinds = (circles, triangles, ("crosses", "failed", ~ok))
    there = [(marker, verdict) for marker, verdict, runs in kinds if runs.any()]
    said = ", ".join(f"{marker}{'' if k else ' are'} {verdict}" for k, (marker, verdict) in enumerate(there))
    return f"{said[:1].upper()}{said[1:]}{'; hollow markers are held out' if found.held_out.any() else ''}."


def _runs_over_one(found: Findings, space: ParameterSpace, predict: Predict | None) -> Drawing:
    figure = new_figure(5.4, 4.4)
    history, caption = _thinned(found)
    ax = figures.plot_metric(history, found.requirement, space, figure.subplots(), unit=found.unit)
    caption = f"The safety metric of runs; shaded where critical. {caption} {_markers(found)}"
    caption += "" if found.history.ok.all() else " Failed runs lie on the floor."
    if predict is not None:
        choices = space.parameters[0].choices
        u = (np.arange(len(choices))[:, None] + 0.5) / len(choices) if choices else np.linspace(0.0, 1.0, 401)[:, None]
        figures.plot_prediction(space.from_unit(u)[:, 0], predict(u), ax, choices=bool(choices))
        how = "Dots and bars" if choices else "Line and band"
        caption += f" {how}: the metamodel's mean and its 5 % to 95 % quantiles."
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return Drawing("runs", "Runs in input space", caption, to_svg(figure, "runs"))


def _map(found: Findings, space: ParameterSpace, predict: Predict, weights: Vector) -> Iterator[Drawing]:
    """Yield the map of P(critical) by the metamodel, one for each choice of the most influential input that has some."""
    numeric = [k for k, p in enumerate(space.parameters) if not p.choices]
    apart = [k for k, p in enumerate(space.parameters) if p.choices and len(p.choices) <= _MOST_PANELS]
    if apart and len(numeric) >= 2:
        yield _maps_by_choice(found, space, predict, weights, max(apart, key=lambda k: weights[k]), numeric)
        return
    pair = (0,) if space.dimension == 1 else (most_influential_pairs(weights)[0] if space.dimension > 2 else (0, 1))
    plane = probability_plane(predict, found.requirement.critical, space, pair)
    if float(np.nanmax(plane.probability)) < _NO_CHANCE or float(np.nanmin(plane.probability)) > 1 - _NO_CHANCE:
        return  # one shade, of which nothing can be read
    figure = new_figure(5.4, 4.4)
    ax = figures.plot_probability(plane, space, figure.subplots())
    caption = f"The metamodel's probability that a run is critical{_where_runs_fail(found)}."
    learned = found.history.where(found.history.stage != VALIDATION)
    if space.dimension == 2 and len(learned):
        shown = np.unique(np.linspace(0, len(learned) - 1, _MOST_RUNS_ON_MAP).round())
        figures.plot_runs(learned.where(np.isin(np.arange(len(learned)), shown)), found.requirement, space, ax, size=10.0)
        caption += " Markers: the runs it could learn from."
        if len(learned) > _MOST_RUNS_ON_MAP:
            caption = caption[:-1] + f", {_MOST_RUNS_ON_MAP:,} of them, evenly spaced over the campaign."
    if space.dimension > 2:
        caption += (
            f" Each value is the mean over {plane.averaged} Sobol points of the other"
            f" {f'{space.dimension - 2} inputs in their ranges' if space.dimension > 3 else 'input in its range'} (marginal P):"
            " a medium shade may mean uncertainty, or that the other inputs decide."
        )
    if len(pair) == 2:
        caption += _lines_of(plane.probability, whole=space.dimension == 2)
    yield Drawing("probability", "Where critical runs are expected", caption, to_svg(figure, "probability"))


def _meaning(found: Findings, metric: str) -> str:
    return f", {meaning}" if (meaning := found.meanings.get(metric)) else ""


def _where_runs_fail(found: Findings) -> str:
    return "" if found.history.ok.all() else ", if it gives a metric: of places where runs fail it says nothing"


def _lines_of(probability: Vector, *, whole: bool) -> str:
    """Return what the lines of a map mean, as far as there are any."""
    low, high = float(np.nanmin(probability)), float(np.nanmax(probability))
    solid, dashed = low < 0.5 < high, [level for level in (0.1, 0.9) if low < level < high]
    said = " Solid: P = 0.5" + (", the boundary as the metamodel sees it" if whole else "") if solid else ""
    if dashed:
        said += f"{';' if solid else ' Dashed:'}{' dashed:' if solid else ''} {' and '.join(f'{level:g}' for level in dashed)}"
    if not said:
        ends = (f"{low:.2g}", f"{high:.2g}")
        span = f"about {ends[0]}" if ends[0] == ends[1] else f"at most {ends[1]}" if low < _SLIGHT else f"{ends[0]} to {ends[1]}"
        return f" P is {span} all over: no line is drawn."
    return f"{said}." + (" The gap between the dashed lines is its uncertainty." if whole and len(dashed) == 2 else "")


def _maps_by_choice(
    found: Findings, space: ParameterSpace, predict: Predict, weights: Vector, which: int, numeric: list[int]
) -> Drawing:
    """Return a map of P(critical) over the two most influential other inputs, for each choice of input `which`."""
    choices, name = space.parameters[which].choices, space.parameters[which].name
    across, up = sorted(sorted(numeric, key=lambda k: (-weights[k], k))[:2])
    columns = 2 if len(choices) == 4 else min(len(choices), 3)
    lines = -(-len(choices) // columns)
    figure = new_figure(11.0, 0.35 + (3.5 if columns == 3 else 4.2) * lines)
    grid = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    learned = found.history.where(found.history.stage != VALIDATION)
    planes = [
        probability_plane(predict, found.requirement.critical, space, (across, up), fixed={which: float(k)})
        for k in range(len(choices))
    ]
    for k, (choice, plane, ax) in enumerate(zip(choices, planes, grid, strict=False)):
        figures.plot_probability(plane, space, ax, bar=(k + 1) % columns == 0 or k + 1 == len(choices))
        if space.dimension == 3:
            mine = learned.where(learned.x[:, which] == k)
            figures.plot_runs(mine, found.requirement, space, ax, pair=(across, up), size=10.0)
        ax.set_title(figures.escaped(f"{name} = {choice}"), fontsize="medium")
    for ax in grid[len(choices) :]:
        ax.set_visible(False)
    caption = f"The metamodel's probability that a run is critical, for each choice of {name}{_where_runs_fail(found)}."
    if space.dimension == 3:
        caption += " Markers: the runs it could learn from."
    else:
        caption += f" Each value is the mean over {planes[0].averaged} Sobol points of the other inputs (marginal P)."
    caption += _lines_of(np.concatenate([plane.probability.ravel() for plane in planes]), whole=False)
    return Drawing("probability", "Where critical runs are expected", caption, to_svg(figure, "probability"), wide=True)


def _held_out(found: Findings, space: ParameterSpace, predict: Predict) -> Iterator[Drawing]:
    """Yield the figures of the last metamodel on held-out runs."""
    mask = found.held_out
    if int(mask.sum()) < _FEW_HELD_OUT:
        return  # of a handful no curve can be read; a warning says so
    log_p, log_not = log_probability(predict, found.requirement.critical, space.to_unit(found.history.x[mask]))
    truth, n = found.critical[mask], int(mask.sum())
    if truth.any():
        figure = new_figure(5.4, 4.0)
        curves.plot_precision_recall(log_p - log_not, truth, figure.subplots())
        caption = (
            f"If every run above some P(critical) is flagged, how many critical ones are found (recall), and how many flags are"
            f" right (precision)? On {n:,} held-out runs, {int(truth.sum()):,} of them critical. Up and to the right is better;"
            " dashed: flagging everything."
        )
        yield Drawing("precision_recall", "Finding critical runs", caption, to_svg(figure, "precision_recall"))
    figure = new_figure(5.4, 4.0)
    curves.plot_reliability(np.exp(log_p), truth, figure.subplots())
    caption = (
        f"Of the held-out runs with a given P(critical), how many were critical? On the dashed line, P can be read as a"
        f" probability; below it the metamodel warns too often, above it too seldom. Bars: 95 % intervals; numbers on top: runs"
        f" in the bin, {n:,} in all."
    )
    yield Drawing("reliability", "Calibration", caption, to_svg(figure, "reliability"))


def _validation(found: Findings, fits: Sequence[FitRecord]) -> Iterator[Drawing]:
    """Yield the scores over the campaign."""
    panels = [
        panel for panel, lines in curves.PANELS.items()
        if any(sum(fit.score(key) is not None for fit in fits) > 1 for key, _ in lines)  # one point is no course
    ]  # fmt: skip
    if not panels:
        return
    figure = new_figure(11.0, 2.9)
    for panel, ax in zip(panels, np.atleast_1d(figure.subplots(1, len(panels))), strict=True):
        curves.plot_validation(fits, panel, ax, unit=found.unit)
    caption = (
        "Scores on held-out runs after each fit. Likelihood, average precision and precision should rise, RMSE and calibration"
        " error fall. Where curves still change at the right end, more runs would help."
    )
    yield Drawing("validation", "The metamodel over the campaign", caption, to_svg(figure, "validation"), wide=True)


def _counts(found: Findings) -> Iterator[Drawing]:
    """Yield the distribution of the metric and the critical runs found so far."""
    if not found.history.ok.any():
        return
    for k, part in enumerate(found.requirement.parts):
        unit = unit_of(found.units, part.metric, found.unit)
        figure = new_figure(5.4, 3.7)
        curves.plot_metric_histogram(found.history, part, figure.subplots(), unit=unit)
        caption = (
            f"The safety metric{_meaning(found, part.metric)}; shaded where critical ({requirement_words(part, unit)})."
            f"{' Held-out runs are random, the others were chosen.' if found.held_out.any() else ''}"
            " The outermost bins hold what lies beyond."
        )
        name = f"metric_{k + 1}" if k else "metric"
        yield Drawing(name, f"Distribution of {part.metric}", caption, to_svg(figure, name))
    if not found.critical.any():
        return
    figure = new_figure(5.4, 3.7)
    curves.plot_progress(found.history, found.requirement, figure.subplots())
    caption = "Critical runs found so far, by the stage that requested them."
    caption += " Coarse runs are not among them, nor counted." if found.configuration.get("fidelity") else ""
    if len(found.history.held_out):
        caption += (
            " Dashed: the number expected of as many random runs, from the share among the held-out ones (in brackets its 95 %"
            " interval). A steeper curve is the gain of choosing runs."
        )
    yield Drawing("progress", "Critical runs over the campaign", caption, to_svg(figure, "progress"))
