"""Estimation with many inputs: draws in the subspace that the metric depends on, else subset simulation.

The first runs follow the inputs' distribution. Where a metamodel of a few directions explains them, the draws that count
come from its proposal, as with few inputs; where it does not, from the chains of subset simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DRAWN
from sbt.campaigns.crude import SubsetStage
from sbt.campaigns.known import metamodel_of
from sbt.campaigns.pools import Frame, Proposal, draw_batch, draw_pool, fit_proposal
from sbt.campaigns.records import EstimationProposal
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import count_begins, relative_error, steadier
from sbt.estimators.events import with_failed_runs
from sbt.estimators.importance import BLIND, SHARES
from sbt.estimators.mixture import wide_scales
from sbt.estimators.subspace import find_subspace, inputs_that_matter, unit
from sbt.estimators.surrogate import fit_log_probability
from sbt.loop.stages import Batch, Log
from sbt.metamodels.warp import warp_around
from sbt.problem.arrays import Points, Vector
from sbt.seeds import stream
from sbt.store.database import PlannedRun

__all__ = ["ManyInputsStage", "took_subset"]

_FIRST, _ROWS_AN_INPUT = 6, 3
"""The first batch: a sixth of the budget, at least three rows an input, at most half of the budget."""
_EXPLAINED = 0.5
"""Share of the metric's variance from which on the subspace is worth following: it explains more than it leaves."""
_BATCHES = 20
"""Batches of the whole budget: proposals take seconds with thousands of runs."""
_FIRST_ROWS, _LATEST_ROWS = 100, 200
"""First and latest runs that the metamodel learns from: those from the inputs' distribution, and those near the boundary. The
directions are learned from all."""


@dataclass(frozen=True)
class ManyInputsStage:
    """First runs from the inputs' distribution, then importance sampling in a subspace, or subset simulation."""

    settings: Settings
    name: str = DRAWN

    def stop(self, log: Log) -> str | None:
        """Return why the way that was taken is over."""
        return (SubsetStage if took_subset(log) else SequentialStage)(self.settings).stop(log)

    def propose(self, log: Log) -> Batch:
        """Return the next batch; on one thread, so that the machine does not decide the last digit."""
        with threadpool_limits(1):
            return self._proposed(log)

    def _proposed(self, log: Log) -> Batch:
        if log.iteration == 0:
            return self._first()
        if took_subset(log):
            return SubsetStage(self.settings).propose(log)
        axes = self._axes(log) if log.iteration == 1 else log.iterations[1].read(EstimationProposal).axes
        return SubsetStage(self.settings).propose(log) if axes is None else self._drawn(log, axes)

    def _first(self) -> Batch:
        s, space = self.settings, self.settings.scenario.space
        n = min(max(s.budget // _FIRST, _ROWS_AN_INPUT * space.dimension), max(s.budget // 2, 1))
        x = space.sample(n, stream(s.seed, "monte_carlo", 0))
        densities = space.log_density(x)
        runs = tuple(PlannedRun("initial", space.named(row), float(q)) for row, q in zip(x, densities, strict=True))
        return Batch(runs, EstimationProposal("initial", "monte_carlo"))

    def _known(self, log: Log) -> tuple[Points, Vector, Vector]:
        """Return normal scores z (n, d), metric y (n,), or (n, q) of a combination, and what a trend is looked for in (n,)."""
        requirement, runs = self.settings.scenario.requirement, log.history.training
        y = requirement.values(runs)
        return self.settings.scenario.space.to_normal(runs.x), y, warp_around(y, requirement.critical).values(y)

    def _axes(self, log: Log) -> tuple[int, ...] | None:
        """Return the inputs that the subspace needs beside its direction; None where it explains too little."""
        z, _, t = self._known(log)
        if len(t) < z.shape[1] or np.ptp(t) == 0:
            return None
        inputs, explained = inputs_that_matter(metamodel_of(self.settings), z, t, stream(self.settings.seed, "subspace"))
        return inputs if explained >= _EXPLAINED else None

    def _drawn(self, log: Log, axes: tuple[int, ...]) -> Batch:
        """Return draws from a fresh pool that differs from the inputs' distribution in the subspace alone."""
        s, rng = self.settings, stream(self.settings.seed, "draw", log.iteration)
        frame, proposal, shares = self._learned(log, axes, log.iteration, rng)
        iteration = steadier(log, relative_error(proposal.pilot.anticipated, proposal.pilot.predicted))
        if iteration is not None:
            frame, proposal, shares = self._learned(log, axes, iteration, rng)
        pool = draw_pool(s.scenario.space, frame, proposal, shares, rng)
        n = min(max(s.budget // _BATCHES, 10), s.budget - len(log.history))
        runs, kept = draw_batch(
            s.scenario.space, pool, n, rng, counts=count_begins(log, s, n, 1.0), fallback=iteration is not None
        )  # fmt: skip
        return Batch(runs, replace(kept, axes=axes))

    def _learned(
        self, log: Log, axes: tuple[int, ...], iteration: int, rng: np.random.Generator
    ) -> tuple[Frame, Proposal, tuple[float, ...]]:
        """Return the subspace, the proposal and the shares of the draws, by what was known before an iteration."""
        s = self.settings
        history = log.history.where(log.history.iteration < iteration)
        z, y, t = self._known(replace(log, history=history))
        critical = s.scenario.requirement.critical
        subspace = find_subspace(z, t, axes, other=y if y.ndim == 1 else None)
        v, hit = subspace.reduce(z), critical.contains(y)
        rows = np.r_[: min(len(v), _FIRST_ROWS), max(len(v) - _LATEST_ROWS, min(len(v), _FIRST_ROWS)) : len(v)]
        fit = stream(s.seed, "fit", iteration)
        given = fit_log_probability(metamodel_of(s), unit, critical, v[rows], y[rows], fit)
        lost = history.x[~history.ok]
        every = np.vstack([v, subspace.reduce(s.scenario.space.to_normal(lost))]) if len(lost) else v
        learned = with_failed_runs(given, unit, every, np.arange(len(every)) < len(v), fit)
        shares = BLIND if not hit.any() or hit.all() else SHARES
        frame = Frame(wide_scales(np.zeros(v.shape[1])), lift=subspace.lift)
        return frame, fit_proposal(s.scenario.space, frame, learned, v[hit], shares, rng), shares


def took_subset(log: Log) -> bool:
    """Return whether subset simulation was chosen: where no subspace explains the first runs."""
    return log.iteration > 1 and log.iterations[1].read(EstimationProposal).axes is None
