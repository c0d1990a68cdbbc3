"""Figures of the scores: how good the metamodel is, and how many critical runs the campaign found.

Every function draws data on axes that it is given, and returns them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sbt.estimators.binomial import interval
from sbt.problem.arrays import Mask, Vector
from sbt.problem.requirement import Requirement
from sbt.report.axes import drawn, reach, shade
from sbt.report.style import CRITICAL, MODEL, UNCRITICAL, label
from sbt.store.history import VALIDATION, History
from sbt.store.records import FitRecord

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "PANELS",
    "plot_metric_histogram",
    "plot_precision_recall",
    "plot_progress",
    "plot_reliability",
    "plot_validation",
]

PANELS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "log likelihood a held-out run": (
        ("log_likelihood", "all"),
        ("log_likelihood_critical", "critical ones"),
    ),
    "RMSE of held-out runs": (("rmse", ""),),
    "precision on held-out runs": (
        ("average_precision", "average precision"),
        ("precision_at_recall_90", "precision at 90 % recall"),
    ),
    "calibration error": (("calibration_error", ""),),
}
"""The panels of `plot_validation`: label of the ordinate, and (key of a fit, name of the curve) pairs."""
_LEAST_AXIS = 1e-3
"""An axis of errors reaches at least so far: what is smaller is zero to a reader."""
_CURVE = 400
"""A curve over the runs is drawn at no more places than this."""


def plot_validation(fits: Sequence[FitRecord], panel: str, ax: Axes, *, unit: str = "") -> Axes:
    """Draw one of `PANELS` over the number of runs; fits without the score leave a gap."""
    runs = np.array([fit.learned for fit in fits], dtype=np.float64)
    for (key, name), look in zip(PANELS[panel], ("o-", "s--"), strict=False):
        values = np.array([fit.score(key) for fit in fits], dtype=np.float64)
        if np.isfinite(values).any():
            colour = MODEL if look == "o-" else CRITICAL
            ax.plot(runs, values, look, color=colour, markersize=3.5, linewidth=1.4, label=name or None)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best")
    ax.set(xlabel="runs learned from", ylabel=label(panel, unit if "RMSE" in panel else ""))
    if "RMSE" in panel or "error" in panel:
        ax.set_ylim(bottom=0.0, top=max(ax.get_ylim()[1], _LEAST_AXIS))
    elif "precision" in panel:
        ax.set_ylim(-0.03, 1.03)
    return ax


def plot_precision_recall(p: Vector, critical: Mask, ax: Axes) -> Axes:
    """Draw precision against recall on held-out runs, a star at full recall, the base rate as line.

    Args:
        p: (n,) P(critical) by the metamodel, or a score that ranks as it does, such as its log odds.
        critical: (n,) the truth, at least one run critical.
        ax: where.
    """
    from sbt.metamodels.scores import precision_recall

    precision, recall, _ = precision_recall(p, critical)
    base = float(np.mean(critical))
    end = int(np.argmax(recall >= 1.0 - 1e-12)) + 1  # beyond full recall, more flags are only more false alarms
    full = float(precision[end - 1])
    steps = np.concatenate([[0.0], recall[:end]]), np.concatenate([precision[:1], precision[:end]])
    ax.plot(*steps, drawstyle="steps-pre", color=MODEL, clip_on=False)
    ax.axhline(base, color="#777777", linestyle="--", linewidth=1.0, label=f"base rate {base:.3g}")
    ax.plot(
        [1.0],
        [full],
        "*",
        color=CRITICAL,
        markersize=13,
        clip_on=False,
        zorder=5,
        label=f"all critical found: precision {full:.2f}",
    )
    ax.set(
        xlabel="recall (share of the critical runs found)",
        ylabel="precision (share critical of those flagged)",
    )
    ax.set(xlim=(0.0, 1.03), ylim=(0.0, 1.03))
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize="small", frameon=False)
    return ax


def plot_reliability(p: Vector, critical: Mask, ax: Axes, *, bins: int = 10) -> Axes:
    """Draw the share of runs that were critical over the probability that the metamodel predicted.

    Bars are 95 % Clopper-Pearson intervals of the frequency; the numbers on top count the runs of the bins.
    """
    from sbt.metamodels.scores import reliability

    mean, frequency, count = (np.asarray(column, dtype=np.float64) for column in reliability(p, critical, bins))
    some = count > 0
    mean, frequency, count = mean[some], frequency[some], count[some]
    low, high = interval(np.round(frequency * count), count)
    ax.plot([0, 1], [0, 1], color="#777777", linestyle="--", linewidth=1.0)
    bars = np.stack([np.maximum(frequency - low, 0.0), np.maximum(high - frequency, 0.0)])
    ax.errorbar(mean, frequency, yerr=bars, fmt="o-", color=MODEL, markersize=5, linewidth=1.2, elinewidth=1.0, capsize=2.5)
    top = ax.secondary_xaxis("top")
    top.set_xticks((np.flatnonzero(some) + 0.5) / bins, [f"{int(n):,}" for n in count])
    top.tick_params(length=0, pad=1)
    top.set_xlabel("number of runs", fontsize=8.5, color="#444444")
    top.spines["top"].set_visible(False)
    ax.set(xlabel="P(critical) by the metamodel", ylabel="share of runs that were critical")
    ax.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    return ax


def plot_metric_histogram(history: History, requirement: Requirement, ax: Axes, *, unit: str = "") -> Axes:
    """Draw the distribution of the safety metric, the critical interval shaded, held-out runs outlined.

    The middle 99 % of the values and the ends of the critical interval set the range; the outermost
    bins hold what lies beyond.
    """
    y = drawn(requirement, history)
    held = y[history.ok & (history.stage == VALIDATION)]
    chosen = y[history.ok & (history.stage != VALIDATION)]
    chosen, held = chosen[np.isfinite(chosen)], held[np.isfinite(held)]
    low, high = reach(np.concatenate([chosen, held]), requirement.critical, middle=0.99)
    edges = np.linspace(low, high, 41).tolist()
    shade(requirement.critical, (low, high), ax, along="x")
    if len(chosen):
        ax.hist(np.clip(chosen, low, high), edges, color=UNCRITICAL, label=f"chosen runs: {len(chosen):,}")
    if len(held):
        ax.hist(
            np.clip(held, low, high),
            edges,
            histtype="step",
            color="black",
            linewidth=1.2,
            label=f"held-out runs: {len(held):,}",
        )
    ax.set(xlabel=label(requirement.told_as, unit), ylabel="number of runs", xlim=(low, high))
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return ax


def plot_progress(history: History, requirement: Requirement, ax: Axes) -> Axes:
    """Draw the number of critical runs so far, stacked by stage, and what random runs would have found."""
    critical = requirement.critical_runs(history)
    stages = list(dict.fromkeys(history.stage.tolist()))
    at = np.unique(np.linspace(0, len(history) - 1, _CURVE).round().astype(int))
    found = [np.cumsum(critical & (history.stage == stage))[at] for stage in stages]
    shades = ["#1f4e79", "#8fbbe0", "#d96f50", "#f3c9a8", "#777777", "#c9c9c9"]
    hatches = ["", "//", "", "..", "", "xx"]
    planned = [int((history.stage == stage).sum()) for stage in stages]
    names = [f"{stage}: {n[-1]:,} of {all_:,}" for stage, n, all_ in zip(stages, found, planned, strict=True)]
    steps, heights = np.append(at + 1, len(history) + 1), [np.append(n, n[-1]) for n in found]  # the last is as wide
    bands = ax.stackplot(steps, *heights, labels=[label(n) for n in names], edgecolor="white", linewidth=0.3, step="post")
    for k, band in enumerate(bands):
        band.set(facecolor=shades[k % 6], hatch=hatches[k % 6])
    held = history.held_out
    if len(held):
        hits = requirement.critical_runs(held)
        rate, ends = float(hits.mean()), np.array([0, len(history)])
        least, most = (float(share) * ends[1] for share in interval(int(hits.sum()), len(held)))
        ax.plot(
            ends,
            rate * ends,
            color="black",
            linestyle="--",
            linewidth=1.2,
            label=f"all runs at random: {rate * ends[1]:,.0f} ({least:,.0f} to {most:,.0f})",
        )
    ax.locator_params(axis="y", integer=True)
    ax.set(xlabel="number of runs", ylabel="critical runs so far", xlim=(0, len(history) + 1))
    ax.set_ylim(bottom=0, top=None if critical.any() else 1)
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2 if len(names) < 4 else 3, fontsize="small")
    return ax
