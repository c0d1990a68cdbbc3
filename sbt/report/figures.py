"""The figures of a campaign. Every function draws data on axes that it is given, and returns them.

Marker and shade both tell the verdict, so that a grey print loses nothing: light circles are
uncritical, dark triangles critical, crosses failed; hollow ones are held out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import betaincinv

from sbt.arrays import Mask, Vector
from sbt.history import VALIDATION, History
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.space import ParameterSpace
from sbt.report.projection import Plane
from sbt.report.style import CRITICAL, FAILED, MODEL, REGION, UNCRITICAL, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "PANELS",
    "binomial_interval",
    "plot_metric",
    "plot_metric_histogram",
    "plot_precision_recall",
    "plot_probability",
    "plot_progress",
    "plot_reliability",
    "plot_runs",
    "plot_validation",
]

PANELS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "log likelihood of held-out runs": (("log_likelihood", "all"), ("log_likelihood_critical", "critical ones")),
    "RMSE of held-out runs": (("rmse", ""),),
    "finding critical runs": (
        ("average_precision", "average precision"),
        ("precision_at_recall_90", "precision at 90 % recall"),
    ),
    "calibration error": (("calibration_error", ""),),
}
"""The panels of `plot_validation`: label of the ordinate, and (key of a fit, name of the curve) pairs."""
_RASTER = 1500
"""More markers than this become an image inside the SVG, which keeps the file small."""
_CURVE = 400
"""A curve over the runs is drawn at no more places than this."""


def binomial_interval(hits: Vector, n: Vector, confidence: float = 0.95) -> tuple[Vector, Vector]:
    """Return (m,) lower and (m,) upper ends of the Clopper-Pearson interval of hits/n, n >= 1.

    >>> low, high = binomial_interval(np.array([0.0]), np.array([100.0]))
    >>> low.tolist(), high.round(4).tolist()
    ([0.0], [0.0362])
    """
    hits, n, tail = np.asarray(hits, float), np.asarray(n, float), (1 - confidence) / 2
    low = np.where(hits > 0, betaincinv(np.maximum(hits, 0.5), n - hits + 1, tail), 0.0)
    high = np.where(hits < n, betaincinv(hits + 1, np.maximum(n - hits, 0.5), 1 - tail), 1.0)
    return low, high


def plot_runs(
    history: History, requirement: Requirement, space: ParameterSpace, ax: Axes, *, pair: tuple[int, int] = (0, 1)
) -> Axes:
    """Scatter the runs over two inputs; the axes show the whole range, also where no run lies."""
    across, up = (space.parameters[k] for k in pair)
    _scatter(history, requirement, history.x[:, pair[0]], history.x[:, pair[1]], ax)
    ax.set(xlabel=label(across.name, across.unit), ylabel=label(up.name, up.unit))
    ax.set(xlim=_padded(*across.bounds), ylim=_padded(*up.bounds))
    return ax


def plot_metric(
    history: History, requirement: Requirement, space: ParameterSpace, ax: Axes, *, unit: str = "", column: int = 0
) -> Axes:
    """Scatter the safety metric over one input, the critical interval shaded; failed runs on the floor."""
    parameter, y = space.parameters[column], history.y(requirement.metric)
    known = np.isfinite(y)
    floor, top = _reach(y[known], requirement.critical)
    _shade(requirement.critical, (floor, top), ax, along="y")
    _scatter(history, requirement, history.x[:, column], np.where(known, y, floor), ax)
    ax.set(xlabel=label(parameter.name, parameter.unit), ylabel=label(requirement.metric, unit))
    ax.set(xlim=_padded(*parameter.bounds), ylim=_padded(floor, top))
    return ax


def _scatter(history: History, requirement: Requirement, x: Vector, y: Vector, ax: Axes) -> None:
    """Draw the runs by verdict, the rare kinds on top."""
    critical, held = requirement.critical.contains(history.y(requirement.metric)), history.stage == VALIDATION
    size = float(np.clip(9000 / max(len(history), 1), 7, 30))
    kinds: list[tuple[str, Mask, dict[str, Any]]] = [
        ("uncritical", history.ok & ~critical & ~held, _filled("o", UNCRITICAL, 0.8)),
        ("critical", history.ok & critical & ~held, _filled("^", CRITICAL, 1.25)),
        ("uncritical, held out", history.ok & ~critical & held, _hollow("o", "#3f76a8", 0.8)),
        ("critical, held out", history.ok & critical & held, _hollow("^", CRITICAL, 1.25)),
        ("failed", ~history.ok, {"marker": "x", "color": FAILED, "linewidths": 1.2, "s": 1.1}),
    ]
    for order, (name, mask, look) in enumerate(kinds):
        if mask.any():
            look["s"] *= size
            raster = bool(mask.sum() > _RASTER)
            ax.scatter(x[mask], y[mask], label=f"{name}: {mask.sum():,}", zorder=3 + order, rasterized=raster, **look)


def _filled(marker: str, colour: str, scale: float) -> dict[str, Any]:
    return {"marker": marker, "facecolors": colour, "edgecolors": "white", "linewidths": 0.4, "s": scale}


def _hollow(marker: str, colour: str, scale: float) -> dict[str, Any]:
    return {"marker": marker, "facecolors": "none", "edgecolors": colour, "linewidths": 0.9, "s": scale}


def plot_probability(plane: Plane, space: ParameterSpace, ax: Axes) -> Axes:
    """Draw P(critical): over two inputs as shade with contours, over one as curve.

    The solid line is P = 0.5, the boundary as the metamodel sees it; dashed lines are 0.1 and 0.9.
    """
    inputs = [space.parameters[k] for k in plane.pair]
    ax.set(xlabel=label(inputs[0].name, inputs[0].unit), xlim=_padded(*inputs[0].bounds))
    if len(inputs) == 1:
        ax.plot(plane.axes[0], plane.probability, color=MODEL)
        ax.axhline(0.5, color="#777777", linewidth=0.9, linestyle="--")
        ax.set(ylabel="P(critical)", ylim=(-0.03, 1.03))
        return ax
    mesh = ax.pcolormesh(
        *plane.axes, plane.probability, cmap=_heat(), vmin=0.0, vmax=1.0, shading="nearest", rasterized=True, zorder=0
    )
    levels = {0.1: "--", 0.5: "-", 0.9: "--"}
    low, high = np.nanmin(plane.probability, initial=1.0), np.nanmax(plane.probability, initial=0.0)
    inside = [level for level in levels if low < level < high]
    if inside:
        styles, widths = [levels[level] for level in inside], [1.8 if level == 0.5 else 1.0 for level in inside]
        ax.contour(*plane.axes, plane.probability, inside, colors="#222222", linestyles=styles, linewidths=widths, zorder=2)
    bar = ax.figure.colorbar(mesh, ax=ax, pad=0.02, fraction=0.05, ticks=[0, 0.1, 0.5, 0.9, 1])
    bar.set_label("P(critical)")
    bar.outline.set_visible(False)  # type: ignore[operator]
    ax.set(ylabel=label(inputs[1].name, inputs[1].unit), ylim=_padded(*inputs[1].bounds))
    ax.grid(visible=False)
    return ax


def _heat() -> Any:
    """Return a map whose darkest end still lets dark markers stand out."""
    from matplotlib.colors import LinearSegmentedColormap  # noqa: PLC0415

    return LinearSegmentedColormap.from_list("critical", ["#fbfbfb", "#fbe3d6", "#f3b89a", "#e58d6c", "#d96f50"])


def plot_validation(fits: Sequence[Mapping[str, Any]], panel: str, ax: Axes, *, unit: str = "") -> Axes:
    """Draw one of `PANELS` over the number of runs; fits without the score leave a gap."""
    runs = np.array([fit["runs"] for fit in fits], dtype=np.float64)
    for (key, name), look in zip(PANELS[panel], ("o-", "s--"), strict=False):
        values = np.array([np.nan if fit.get(key) is None else fit[key] for fit in fits], dtype=np.float64)
        if np.isfinite(values).any():
            colour = MODEL if look == "o-" else CRITICAL
            ax.plot(runs, values, look, color=colour, markersize=3.5, linewidth=1.4, label=name or None)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best")
    ax.set(xlabel="number of runs", ylabel=label(panel, unit if "RMSE" in panel else ""))
    if "RMSE" in panel or "error" in panel:
        ax.set_ylim(bottom=0.0)
    elif "finding" in panel:
        ax.set_ylim(-0.03, 1.03)
    return ax


def plot_precision_recall(p: Vector, critical: Mask, ax: Axes) -> Axes:
    """Draw precision against recall on held-out runs, a star at full recall, the base rate as line.

    Args:
        p: (n,) P(critical) by the metamodel.
        critical: (n,) the truth, at least one run critical.
        ax: where.
    """
    from sbt.metamodels.scores import precision_recall  # noqa: PLC0415

    precision, recall, _ = precision_recall(p, critical)
    base = float(np.mean(critical))
    full = float(np.max(precision[recall >= 1.0 - 1e-12], initial=base))
    order = np.lexsort((-precision, recall))
    ax.plot(recall[order], precision[order], drawstyle="steps-pre", color=MODEL)
    ax.axhline(base, color="#777777", linestyle="--", linewidth=1.0, label=f"base rate {base:.3g}")
    ax.plot([1.0], [full], "*", color=CRITICAL, markersize=13, clip_on=False, zorder=5, label=f"all critical runs found: precision {full:.2f}")
    ax.set(xlabel="recall (share of the critical runs found)", ylabel="precision (share critical of those flagged)")
    ax.set(xlim=(0.0, 1.03), ylim=(0.0, 1.03))
    ax.legend(loc="lower left")
    return ax


def plot_reliability(p: Vector, critical: Mask, ax: Axes, *, bins: int = 10) -> Axes:
    """Draw how often runs are critical against the probability that the metamodel gave them.

    Bars are 95 % Clopper-Pearson intervals of the frequency; the number beside a point counts its runs.
    """
    from sbt.metamodels.scores import reliability  # noqa: PLC0415

    mean, frequency, count = (np.asarray(column, dtype=np.float64) for column in reliability(p, critical, bins))
    some = count > 0
    mean, frequency, count = mean[some], frequency[some], count[some]
    low, high = binomial_interval(np.round(frequency * count), count)
    ax.plot([0, 1], [0, 1], color="#777777", linestyle="--", linewidth=1.0, label="perfect calibration")
    bars = np.stack([np.maximum(frequency - low, 0.0), np.maximum(high - frequency, 0.0)])
    ax.errorbar(mean, frequency, yerr=bars, fmt="o-", color=MODEL, markersize=5, linewidth=1.2, elinewidth=1.0, capsize=2.5, label="held-out runs")
    for x, y, n in zip(mean, frequency, count, strict=True):
        right = x < 0.85
        ax.annotate(
            f"{int(n):,}", (x, y), xytext=(5 if right else -5, -3 if y > 0.06 else 3), textcoords="offset points",
            ha="left" if right else "right", va="top" if y > 0.06 else "bottom", fontsize=7.5, color="#444444",
        )  # fmt: skip
    ax.set(xlabel="P(critical) by the metamodel", ylabel="share of runs that were critical")
    ax.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    ax.legend(loc="upper left")
    return ax


def plot_metric_histogram(history: History, requirement: Requirement, ax: Axes, *, unit: str = "") -> Axes:
    """Draw the distribution of the safety metric, the critical interval shaded, held-out runs outlined.

    The middle 99 % of the values and the ends of the critical interval set the range; the outermost
    bins hold what lies beyond.
    """
    chosen, held = history.training.y(requirement.metric), history.held_out.y(requirement.metric)
    low, high = _reach(np.concatenate([chosen, held]), requirement.critical, middle=0.99)
    edges = np.linspace(low, high, 41)
    _shade(requirement.critical, (low, high), ax, along="x")
    if len(chosen):
        ax.hist(np.clip(chosen, low, high), edges, color=UNCRITICAL, label=f"chosen runs: {len(chosen):,}")
    if len(held):
        ax.hist(np.clip(held, low, high), edges, histtype="step", color="black", linewidth=1.2, label=f"held-out runs: {len(held):,}")
    ax.set(xlabel=label(requirement.metric, unit), ylabel="number of runs", xlim=(low, high))
    ax.legend(loc="best")
    return ax


def plot_progress(history: History, requirement: Requirement, ax: Axes) -> Axes:
    """Draw the number of critical runs so far, stacked by stage, and what random runs would have found."""
    critical = requirement.critical.contains(history.y(requirement.metric))
    stages = list(dict.fromkeys(history.stage.tolist()))
    at = np.unique(np.linspace(0, len(history) - 1, _CURVE).round().astype(int))
    found = [np.cumsum(critical & (history.stage == stage))[at] for stage in stages]
    shades = ["#1f4e79", "#8fbbe0", "#d96f50", "#f3c9a8", "#777777", "#c9c9c9"]
    hatches = ["", "//", "", "..", "", "xx"]
    styles = {"colors": [shades[k % 6] for k in range(len(stages))], "hatch": [hatches[k % 6] for k in range(len(stages))]}
    names = [f"{stage}: {int(total[-1]):,} of {int((history.stage == stage).sum()):,}" for stage, total in zip(stages, found, strict=True)]
    ax.stackplot(history.index[at] + 1, *found, labels=[label(name) for name in names], edgecolor="white", linewidth=0.3, **styles)
    held = history.held_out
    if len(held):
        rate = float(requirement.critical.contains(held.y(requirement.metric)).mean())
        ends = np.array([0, history.index[-1] + 1])
        ax.plot(ends, rate * ends, color="black", linestyle="--", linewidth=1.2, label=f"all runs at random: {rate * ends[1]:,.0f}")
    ax.set(xlabel="number of runs", ylabel="critical runs so far", xlim=(0, history.index[-1] + 1))
    ax.set_ylim(bottom=0, top=None if critical.any() else 1)
    ax.legend(loc="upper left")
    return ax


def _shade(critical: CriticalInterval, reach: tuple[float, float], ax: Axes, *, along: str) -> None:
    """Shade the critical interval within `reach`."""
    low, high = max(critical.low, reach[0] - abs(reach[0]) - 1e3), min(critical.high, reach[1] + abs(reach[1]) + 1e3)
    span, line = (ax.axvspan, ax.axvline) if along == "x" else (ax.axhspan, ax.axhline)
    span(low, high, color=REGION, linewidth=0, zorder=0, label="critical")
    for end in (critical.low, critical.high):
        if reach[0] <= end <= reach[1]:
            line(end, color=CRITICAL, linewidth=0.9, zorder=1)


def _reach(y: Vector, critical: CriticalInterval, middle: float = 1.0) -> tuple[float, float]:
    """Return the range of an axis that shows the values and the nearest end of the critical interval."""
    tail = (1 - middle) / 2
    ends = [e for e in (critical.low, critical.high) if np.isfinite(e)]
    low, high = (float(np.quantile(y, q)) for q in (tail, 1 - tail)) if len(y) else (min(ends), max(ends))
    nearest = min(ends, key=lambda e: max(low - e, e - high, 0.0))
    low, high = min(low, nearest), max(high, nearest)
    gap = 0.05 * (high - low) if high > low else 0.5
    return low - gap, high + gap


def _padded(low: float, high: float) -> tuple[float, float]:
    """Return the range with a little air, so that runs on its ends are whole markers."""
    return low - 0.02 * (high - low), high + 0.02 * (high - low)
