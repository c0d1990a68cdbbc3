"""Panels that only a benchmark draws: predictions coloured by residual risk, expected against observed recall."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import log_ndtr

from sbt.problem.arrays import Mask, Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_reliability_of_recall", "plot_residual_risk", "recall_curve"]

_LEAST_RISK = 1e-9
_MOST_POINTS = 3000


def plot_residual_risk(y: Vector, mu: Vector, sigma: Vector, critical: Vector, ax: Axes) -> Any:
    """Scatter predicted means over true values, coloured by the residual risk that would just cover the outcome.

    The risk is P(|Y - mu| > |y - mu|) of a Gaussian: 0.01 where the outcome lies 2.58 sigma away.

    Args:
        y: (n,) outcomes.
        mu: (n,) means.
        sigma: (n,) standard deviations.
        critical: (2,) ends of M_c, drawn as lines where finite.
        ax: where.

    Returns:
        What a colour bar needs.

    Source:
        Winkelmann et al. (2022), figures of the predictions for the scenario Parking.
    """
    from matplotlib.colors import LogNorm

    risk = np.maximum(2.0 * np.exp(log_ndtr(-np.abs(y - mu) / sigma)), _LEAST_RISK)
    shown = np.arange(len(y))
    if len(y) > _MOST_POINTS:  # all of the unlikely ones, and every k-th of the others
        unlikely = np.flatnonzero(risk < 1e-3)[:_MOST_POINTS]
        shown = np.union1d(unlikely, np.arange(0, len(y), -(-len(y) // _MOST_POINTS)))
    shown = shown[np.argsort(-risk[shown])]  # the least likely on top
    marks = ax.scatter(
        y[shown], mu[shown], c=risk[shown], s=4, linewidths=0, cmap="turbo_r", norm=LogNorm(_LEAST_RISK, 1.0), rasterized=True
    )
    low, high = float(y.min()), float(y.max())
    room = 0.05 * (high - low) or 1.0
    ax.plot([low, high], [low, high], color="#555555", linewidth=0.8)
    for end in critical:
        if low < end < high:
            ax.axvline(end, color="#999999", linewidth=0.8, linestyle="--")
    ax.set(xlim=(low - room, high + room), ylim=(low - 4 * room, high + 4 * room))
    return marks


def recall_curve(p: Vector, critical: Mask) -> tuple[Vector, Vector]:
    """Return (n,) expected and (n,) observed recall as ever more runs are flagged, the most probable first.

    The expected recall is what the probabilities promise: their sum over the flagged runs by their sum over all.

    >>> expected, observed = recall_curve(np.array([0.5, 0.9, 0.6]), np.array([False, True, True]))
    >>> expected.round(2).tolist(), observed.tolist()
    ([0.45, 0.75, 1.0], [0.5, 1.0, 1.0])
    """
    order = np.argsort(-p, kind="stable")
    promised, found = np.cumsum(p[order]), np.cumsum(critical[order])
    return promised / promised[-1], found / found[-1]


def plot_reliability_of_recall(p: Vector, critical: Mask, ax: Axes, *, colour: str) -> Axes:
    """Draw observed over expected recall, a star where all critical runs are found; the diagonal is calibrated.

    Source:
        Winkelmann et al. (2022), section VI-D: expected and observed recall.
    """
    if not critical.any() or not p.sum() > 0.0:
        ax.text(0.5, 0.5, "no critical run", ha="center", fontsize=7)
        return ax
    expected, observed = recall_curve(p, critical)
    ax.plot(expected, observed, color=colour, linewidth=1.2)
    full = int(np.argmax(observed >= 1.0 - 1e-12))
    ax.plot([expected[full]], [1.0], "*", color=colour, markersize=8, clip_on=False, zorder=5)
    return ax
