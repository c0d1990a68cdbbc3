"""Figures of a result: every function takes `ax=None` and returns the Axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sbt.errors import InputError, did_you_mean, must_be
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Conclusion
from sbt.metamodels.ended import ended
from sbt.problem.arrays import Mask, Vector
from sbt.problem.plain import Value
from sbt.problem.scenario import LogicalScenario
from sbt.store.history import VALIDATION, History
from sbt.workflows.study import Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plots"]

_SLICE_POINTS = 201
"""Points along a slice: below a pixel of the default figure."""


class Plotted(Protocol):
    """What the figures are of: a result."""

    @property
    def store(self) -> Path:
        """Its folder."""
        ...

    @property
    def study(self) -> Study:
        """The campaign as it is configured."""
        ...

    @property
    def scenario(self) -> LogicalScenario:
        """With the campaign's inputs and requirement."""
        ...

    @property
    def history(self) -> History:
        """All finished runs."""
        ...

    @property
    def fitted(self) -> FittedMetamodel | None:
        """The metamodel that learned from all runs but the held-out ones."""
        ...

    @property
    def finished(self) -> bool:
        """Whether the campaign has concluded."""
        ...

    @property
    def conclusion(self) -> Conclusion:
        """What it found."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Plots:
    """Figures of a campaign.

    Args:
        result: the campaign.
    """

    result: Plotted

    def runs(self, ax: Axes | None = None, *, x: str | None = None, y: str | None = None) -> Axes:
        """Scatter the runs over two inputs; with one input, the safety metric over it.

        Args:
            ax: where; None: a new figure.
            x: name of the input along the axis; None: the most influential one.
            y: likewise, upwards.
        """
        from sbt.report import figures

        r, space = self.result, self.result.scenario.space
        if space.dimension == 1:
            drawn = figures.plot_metric(r.history, r.scenario.requirement, space, _axes(ax), unit=r.scenario.unit)
        else:
            drawn = figures.plot_runs(r.history, r.scenario.requirement, space, _axes(ax), pair=self._pair(x, y))
        if drawn.get_legend_handles_labels()[0]:
            drawn.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize="small", frameon=False)
        return drawn

    def boundary(
        self, ax: Axes | None = None, *, x: str | None = None, y: str | None = None, at: Mapping[str, Value] | None = None
    ) -> Axes:
        """Draw P(critical) over two inputs, averaged over the others, with the runs that the metamodel learned from.

        Args:
            ax: where; None: a new figure.
            x: name of the input along the axis; None: the most influential one.
            y: likewise, upwards.
            at: values of inputs that are held instead of averaged over, such as {"kind": "truck"}.
        """
        from sbt.report import figures
        from sbt.report.projection import probability_plane

        r, space = self.result, self.result.scenario.space
        values = space.numbers(space.values(at or {}))
        fixed = {self._column(name): float(values[self._column(name)]) for name in at or {}}
        free = space.dimension - len(fixed)
        self._need(free > 0, "an input to draw along (at holds all)")
        pair = self._pair(x, y, tuple(fixed)) if free > 1 else tuple(k for k in range(space.dimension) if k not in fixed)
        if set(pair) & set(fixed):
            raise InputError(f"an input is drawn along or held, not both, but got {', '.join(at or {})} in at")
        plane = probability_plane(self._fitted.predict, r.scenario.requirement.critical, space, pair, fixed=fixed)
        drawn = figures.plot_probability(plane, space, _axes(ax))
        if len(pair) == 2 and free == 2 and all(space.parameters[k].choices for k in fixed):
            learned = r.history.where(r.history.stage != VALIDATION)
            for k, value in fixed.items():
                learned = learned.where(learned.x[:, k] == value)
            figures.plot_runs(learned, r.scenario.requirement, space, drawn, pair=pair, size=10.0)
        return drawn

    def slices(self, ax: Axes | None = None, *, x: str | None = None, at: int | dict[str, Value] | None = None) -> Axes:
        """Draw the metamodel's mean and its 5 % to 95 % band along one input through a point.

        Args:
            ax: where; None: a new figure.
            x: name of the input; None: the most influential one.
            at: index of a run, or values of inputs (the others at their centre); None: the centre.
        """
        from sbt.report import figures
        from sbt.report.axes import padded, reach, shade
        from sbt.report.style import label

        r, space = self.result, self.result.scenario.space
        k = int(np.argmax(self._influence)) if x is None else self._column(x)
        low, high = space.parameters[k].bounds
        along = np.linspace(low, high, _SLICE_POINTS)
        if space.parameters[k].logarithmic:
            along = space.parameters[k].from_unit(np.linspace(0.0, 1.0, _SLICE_POINTS))
        if space.parameters[k].discrete:
            along = np.unique(along.round())
        point = np.tile(self._point(at), (len(along), 1))
        point[:, k] = along
        drawn, critical = _axes(ax), r.scenario.requirement.critical
        prediction = ended(self._fitted.predict(np.clip(space.to_unit(point), 0.0, 1.0)))
        ends = reach(np.concatenate([prediction.quantile(0.05), prediction.quantile(0.95)]), critical)
        shade(critical, ends, drawn, along="y")
        parameter = space.parameters[k]
        figures.plot_prediction(along, prediction, drawn, choices=bool(parameter.choices))
        figures.whole_ticks(drawn, parameter)
        if parameter.choices:
            drawn.set_xlim(-0.5, len(parameter.choices) - 0.5)
        drawn.set(xlabel=label(parameter.name, parameter.unit), ylabel=label(r.scenario.requirement.told_as, r.scenario.unit))
        drawn.set(ylim=padded(*ends))
        drawn.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize="small", frameon=False)
        return drawn

    def convergence(self, ax: Axes | None = None) -> Axes:
        """Draw how the answer settled: an estimation's probability, or the critical runs found so far."""
        from sbt.campaigns.estimation import EstimationConclusion
        from sbt.report.convergence import plot_convergence
        from sbt.report.curves import plot_progress

        r = self.result
        conclusion = r.conclusion if r.finished else None
        if isinstance(conclusion, EstimationConclusion) and conclusion.convergence:
            return plot_convergence(conclusion, _axes(ax))
        self._need(len(r.history) > 0, "runs")
        return plot_progress(r.history, r.scenario.requirement, _axes(ax))

    def precision_recall(self, ax: Axes | None = None) -> Axes:
        """Draw precision over recall of finding critical runs by P(critical), on the held-out runs."""
        from sbt.report.curves import plot_precision_recall

        log_p, log_not, truth = self._held_out()
        self._need(bool(truth.any()), "critical runs among the held-out ones")
        return plot_precision_recall(log_p - log_not, truth, _axes(ax))

    def reliability(self, ax: Axes | None = None) -> Axes:
        """Draw how often held-out runs with a given P(critical) were critical."""
        from sbt.report.curves import plot_reliability

        log_p, _, truth = self._held_out()
        return plot_reliability(np.exp(log_p), truth, _axes(ax))

    def influence(self, ax: Axes | None = None) -> Axes:
        """Draw how much each input influences P(critical), or the metric where there is no metamodel, relative to the largest."""
        from sbt.report.style import MODEL

        names, weights, drawn = self.result.scenario.space.names, self._influence, _axes(ax)
        order = np.argsort(weights, kind="stable")
        drawn.barh([names[k] for k in order], weights[order], color=MODEL)
        drawn.set(xlabel="influence on P(critical), relative to the largest", xlim=(0.0, 1.05))
        return drawn

    @cached_property
    def _influence(self) -> Vector:
        """(d,) influence of each input: of the metamodel, or of the runs alone."""
        from sbt.report.influence import influence_of
        from sbt.report.projection import influence_from_runs

        r = self.result
        if r.study.learns and r.fitted is not None:
            found = influence_of(r.fitted.predict, r.scenario.requirement.critical, r.scenario.space.dimension)
            if found is not None:
                return found.relative
        return influence_from_runs(r.history, r.scenario.requirement)

    @property
    def _fitted(self) -> FittedMetamodel:
        """The metamodel."""
        fitted = self.result.fitted
        if fitted is None:
            self._need(self.result.study.learner is not None, "a metamodel (run with metamodel=...)")
            raise InputError(f"this figure needs two runs to learn from, but {self.result.store} has fewer")
        return fitted

    def _held_out(self) -> tuple[Vector, Vector, Mask]:
        """Return log P(critical), log P(uncritical) and the verdicts of the held-out runs."""
        from sbt.report.projection import log_probability

        r = self.result
        held = r.history.held_out
        self._need(len(held) > 0, "held-out runs (validation: {share: 0.1})")
        space, need = r.scenario.space, r.scenario.requirement
        log_p, log_not = log_probability(self._fitted.predict, need.critical, space.to_unit(held.x))
        return log_p, log_not, need.critical_runs(held)

    def _need(self, there: bool, what: str) -> None:
        if not there:
            raise InputError(f"this figure needs {what}, but {self.result.store} has none")

    def _pair(self, x: str | None, y: str | None, held: tuple[int, ...] = ()) -> tuple[int, int]:
        """Return the columns of two inputs: those named, the most influential ones that are not held for the rest."""
        named = [None if name is None else self._column(name) for name in (x, y)]
        if x is not None and x == y:
            raise InputError(f"x and y must be two inputs, but got '{x}' twice")
        rest = (int(k) for k in np.argsort(-self._influence, kind="stable") if int(k) not in (*named, *held))
        if named == [None, None]:
            first, second = sorted((next(rest), next(rest)))
            return first, second
        first, second = (next(rest) if k is None else k for k in named)
        return first, second

    def _column(self, name: str) -> int:
        names = self.result.scenario.space.names
        if name not in names:
            raise InputError(f"an input must be one of {', '.join(names)}, but got '{name}'{did_you_mean(name, names)}")
        return names.index(name)

    def _point(self, at: int | dict[str, Value] | None) -> Vector:
        """Return the (d,) point that slices go through."""
        space, history = self.result.scenario.space, self.result.history
        if at is None or isinstance(at, dict):
            values = space.values(at or {})
            return space.numbers(values)
        must_be("at must be the index of a run, or values of inputs by name", at, Integral)
        rows = np.flatnonzero(history.index == at)
        if len(rows) == 0:
            raise InputError(f"a run must be a finished one (0 to {len(history) - 1}), but got {at}")
        found: Vector = history.x[rows[0]]
        return found


def _axes(ax: Axes | None) -> Axes:
    """Return the axes, or those of a new figure that a notebook shows."""
    if ax is not None:
        from matplotlib.axes import Axes

        must_be("ax must be matplotlib's axes (inputs are named by x and y)", ax, Axes)
        return ax
    import matplotlib.pyplot as plt

    _, made = plt.subplots(figsize=(5.4, 4.0), layout="constrained")
    return made
