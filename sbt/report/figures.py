"""Figures of the inputs: where the runs lie, and where the metamodel expects critical ones.

Every function draws data on the axes that it is given, and returns them. Marker and lightness both show
the verdict, so that a print in grey shows it too: light circles are uncritical, dark triangles critical,
crosses failed; hollow ones are held out.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Mask, Vector
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.report.axes import drawn, padded, reach, shade
from sbt.report.projection import Plane
from sbt.report.style import CRITICAL, FAILED, HELD_OUT, MODEL, UNCRITICAL, label
from sbt.store.history import VALIDATION, History

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["escaped", "plot_metric", "plot_prediction", "plot_probability", "plot_runs", "whole_ticks"]

_RASTER = 1500
"""More markers than this become an image inside the SVG, which keeps the file small."""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence, which fills a square evenly."""


def plot_runs(
    history: History,
    requirement: Requirement,
    space: ParameterSpace,
    ax: Axes,
    *,
    pair: tuple[int, int] = (0, 1),
    size: float | None = None,
) -> Axes:
    """Scatter the runs over two inputs; the axes show the whole range, also where no run lies.

    Runs of whole-number inputs and choices are spread around their value, so that runs do not hide each other.

    Args:
        history: finished runs.
        requirement: what makes them critical.
        space: the inputs.
        ax: where.
        pair: positions of the inputs on the abscissa and the ordinate.
        size: area of a marker in square points; None: by the number of runs.
    """
    across, up = (space.parameters[k] for k in pair)
    x, y = (_spread(history, space, k, step) for k, step in zip(pair, _R2, strict=True))
    _scatter(history, requirement, x, y, ax, size)
    ax.set(xlabel=label(across.name, across.unit), ylabel=label(up.name, up.unit))
    ax.set(xlim=_limits(across, x), ylim=_limits(up, y))
    whole_ticks(ax, across, up)
    return ax


def plot_metric(
    history: History,
    requirement: Requirement,
    space: ParameterSpace,
    ax: Axes,
    *,
    unit: str = "",
    column: int = 0,
) -> Axes:
    """Scatter the safety metric over one input, the critical interval shaded; failed runs on the floor."""
    parameter, y = space.parameters[column], drawn(requirement, history)
    known = np.isfinite(y)
    floor, top = reach(y[known], requirement.critical)
    shade(requirement.critical, (floor, top), ax, along="y")
    _scatter(history, requirement, history.x[:, column], np.where(known, y, floor), ax)
    ax.set(xlabel=label(parameter.name, parameter.unit), ylabel=label(requirement.told_as, unit))
    ax.set(xlim=_limits(parameter, history.x[:, column]), ylim=padded(floor, top))
    whole_ticks(ax, parameter)
    return ax


def plot_prediction(x: Vector, prediction: Prediction, ax: Axes, *, choices: bool = False) -> Axes:
    """Draw the metamodel's mean of the metric over one input, and the band (bars at choices) of its 5 % to 95 % quantiles."""
    low, high = prediction.quantile(0.05), prediction.quantile(0.95)
    if choices:
        ax.errorbar(x, prediction.mu, (prediction.mu - low, high - prediction.mu), fmt="o", color=MODEL, capsize=4, zorder=2,
                    label="metamodel, mean and 5 % to 95 %")  # fmt: skip
        return ax
    band = ax.fill_between(x, low, high, color=MODEL, alpha=0.18, linewidth=0, zorder=1.5)
    band.set_label("metamodel, 5 % to 95 %")
    ax.plot(x, prediction.mu, color=MODEL, linewidth=1.4, zorder=2, label="metamodel, mean")
    return ax


def plot_probability(plane: Plane, space: ParameterSpace, ax: Axes, *, bar: bool = True) -> Axes:
    """Draw P(critical): over two inputs as shade with contours, over one as curve.

    The solid line is P = 0.5, the boundary as the metamodel sees it; dashed lines are 0.1 and 0.9. There are no lines
    between choices. `bar` adds the scale of the shades.
    """
    from matplotlib.patheffects import withStroke

    inputs = [space.parameters[k] for k in plane.pair]
    ax.set(xlabel=label(inputs[0].name, inputs[0].unit), xlim=_limits(inputs[0], np.empty(0)))
    if len(inputs) == 1:
        ax.plot(plane.axes[0], plane.probability, "o" if inputs[0].choices else "-", color=MODEL)
        whole_ticks(ax, *inputs)
        ax.axhline(0.5, color="#777777", linewidth=0.9, linestyle="--")
        ax.set(ylabel="P(critical)", ylim=(-0.03, 1.03))
        return ax
    smooth = np.isfinite(plane.probability).all() and all(p.kind == "continuous" for p in inputs)
    shading: Any = "gouraud" if smooth else "nearest"
    mesh = ax.pcolormesh(
        *plane.axes,
        plane.probability,
        cmap=_heat(),
        vmin=0.0,
        vmax=1.0,
        shading=shading,
        rasterized=True,
        zorder=0,
    )
    levels = {0.1: "--", 0.5: "-", 0.9: "--"}
    low, high = np.nanmin(plane.probability, initial=1.0), np.nanmax(plane.probability, initial=0.0)
    inside = [level for level in levels if low < level < high and not any(p.choices for p in inputs)]
    if inside:
        styles, widths = (
            [levels[level] for level in inside],
            [1.8 if level == 0.5 else 1.0 for level in inside],
        )
        lines = ax.contour(
            *plane.axes,
            plane.probability,
            inside,
            colors="#111111",
            linestyles=styles,
            linewidths=widths,
            zorder=9,
        )
        lines.set_path_effects([withStroke(linewidth=3.2, foreground="white", alpha=0.7)])
    if bar:
        scale = ax.figure.colorbar(mesh, ax=ax, pad=0.02, fraction=0.05, ticks=[0, 0.1, 0.5, 0.9, 1])
        scale.set_label("P(critical)")
        scale.outline.set_visible(False)
    ax.set(ylabel=label(inputs[1].name, inputs[1].unit), ylim=_limits(inputs[1], np.empty(0)))
    whole_ticks(ax, *inputs)
    ax.grid(visible=False)
    return ax


def _heat() -> Any:
    """Return a map whose darkest end still lets dark markers stand out."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("critical", ["#fbfbfb", "#fbe3d6", "#f3b89a", "#e58d6c", "#d96f50"])


def _scatter(history: History, requirement: Requirement, x: Vector, y: Vector, ax: Axes, size: float | None = None) -> None:
    """Draw the runs by verdict, the rare kinds on top."""
    critical, held = requirement.critical_runs(history), history.stage == VALIDATION
    rim = 1.0 if size is not None else 1.0 + min(1e-4 * len(history), 1.0)  # hollow markers stand out among many filled ones
    size = float(np.clip(9000 / max(len(history), 1), 7, 30)) if size is None else size
    kinds: list[tuple[str, Mask, dict[str, Any]]] = [
        ("uncritical, held out", history.ok & ~critical & held, _hollow("o", HELD_OUT, 0.6 * rim)),
        ("critical, held out", history.ok & critical & held, _hollow("^", CRITICAL, 0.9 * rim)),
        ("uncritical", history.ok & ~critical & ~held, _filled("o", UNCRITICAL, 1.4)),
        ("critical", history.ok & critical & ~held, _filled("^", CRITICAL, 1.7)),
        ("failed", ~history.ok, {"marker": "x", "color": FAILED, "linewidths": 1.2, "s": 1.1}),
    ]
    for order, (name, mask, look) in enumerate(kinds):
        if mask.any():
            look["s"] *= size
            raster = bool(mask.sum() > _RASTER)
            if size < 8 and "x" not in look["marker"] and not held[mask].any():
                look["linewidths"] = 0.0  # white rims would hide small markers
            ax.scatter(x[mask], y[mask], label=f"{name}: {mask.sum():,}", zorder=3 + order, rasterized=raster, **look)


def _filled(marker: str, colour: str, scale: float) -> dict[str, Any]:
    return {"marker": marker, "facecolors": colour, "edgecolors": "white", "linewidths": 0.3, "s": scale}


def _hollow(marker: str, colour: str, scale: float) -> dict[str, Any]:
    return {"marker": marker, "facecolors": "none", "edgecolors": colour, "linewidths": 0.9, "s": scale}


def whole_ticks(ax: Axes, *inputs: Parameter) -> None:
    """Let the axes of integer inputs have whole ticks only, those with choices the choices, those over decades logarithms."""
    from matplotlib.ticker import MaxNLocator

    for axis, parameter in zip((ax.xaxis, ax.yaxis), inputs, strict=False):
        if parameter.choices:
            axis.set_ticks(range(len(parameter.choices)), [escaped(choice) for choice in parameter.choices])
        if parameter.logarithmic:
            ax.set(**{"xscale" if axis is ax.xaxis else "yscale": "log"})
        if parameter.kind == "integer":
            axis.set_major_locator(MaxNLocator("auto", integer=True))


def _spread(history: History, space: ParameterSpace, column: int, step: float) -> Vector:
    """Return (n,) places of the runs; whole numbers and choices are moved by up to 0.3, evenly by the run's index."""
    x = history.x[:, column]
    if not space.parameters[column].discrete:
        return x
    moved: Vector = x + 0.6 * ((history.index * step) % 1.0 - 0.5)
    return moved


def _limits(parameter: Parameter, x: Vector) -> tuple[float, float]:
    """Return the axis of an input: its range, and runs beyond it where the range is infinite."""
    low, high = parameter.bounds
    if parameter.choices:
        return low - 0.5, high + 0.5
    low, high = float(np.min(x, initial=low)), float(np.max(x, initial=high))
    if parameter.logarithmic:
        low, high = padded(math.log(low), math.log(high))
        return math.exp(low), math.exp(high)
    return padded(low, high)


def escaped(text: str) -> str:
    """Return a text as it is drawn: a dollar sign would begin a formula."""
    return text.replace("$", r"\$")
