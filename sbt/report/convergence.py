"""The figure of an estimation: estimate and interval over the runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from sbt.campaigns.estimation import EstimationConclusion
from sbt.campaigns.wording import percent
from sbt.report.style import CRITICAL, new_figure, to_svg
from sbt.report.words import Findings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["drawing_of_convergence", "plot_convergence"]


def plot_convergence(conclusion: EstimationConclusion, ax: Axes) -> Axes:
    """Draw the estimate after each counted batch with its interval, and the threshold of the gate where there is one."""
    steps, gate = conclusion.convergence or (), conclusion.gate
    runs = np.array([step.runs for step in steps], dtype=np.float64)
    low, value, high = (np.array([getattr(step, key) for step in steps]) for key in ("low", "probability", "high"))
    positive = np.concatenate([v[v > 0] for v in (low, value, high)])
    floor = 0.5 * float(positive.min()) if len(positive) else 1e-9
    low, value, high = (np.maximum(v, floor) for v in (low, value, high))
    ax.fill_between(runs, low, high, color=CRITICAL, alpha=0.2, linewidth=0, label="interval")
    ax.plot(runs, value, color=CRITICAL, marker="o", markersize=3, label="estimate")
    if gate is not None:
        ax.axhline(gate.probability, color="black", linestyle="--", linewidth=1.0, label="gate")
    ax.set(xlabel="number of runs", ylabel="probability of a critical run", yscale="log")
    ax.locator_params(axis="x", integer=True)
    ax.legend(loc="best")
    return ax


def drawing_of_convergence(found: Findings) -> Iterator[tuple[str, str]]:
    """Yield caption and SVG of the figure; nothing before two batches have counted."""
    conclusion = found.conclusion
    if not isinstance(conclusion, EstimationConclusion) or len(conclusion.convergence or ()) < 2:  # one point is no course
        return
    figure = new_figure(5.4, 3.7)
    plot_convergence(conclusion, figure.subplots())
    confidence = percent(conclusion.confidence)
    caption = (
        f"The estimate after each batch that counts, with its {confidence} interval. Runs before the first point were for"
        " search and training. The interval should narrow and the estimate stay within the earlier intervals; a jump"
        " indicates a critical region that was found late."
    )
    yield caption, to_svg(figure, "convergence")
