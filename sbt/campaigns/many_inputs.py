"""Estimation with many inputs: draws in the subspace that the metric depends on, else crude Monte Carlo or subset simulation.

The first runs follow the inputs' distribution. Where a metamodel of a few directions explains them, the draws that count
come from its proposal, as with few inputs. Where it does not, the rest is crude Monte Carlo, with which the first runs count;
or, where the budget is large and critical runs look rare, the chains of subset simulation.

Each half of the first runs says whether critical runs are common, and the other half counts with crude Monte Carlo if they are:
no run decides whether it counts itself, so that the estimate is as unbiased as if nothing had been decided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DRAWN, RANDOM
from sbt.campaigns.crude import MonteCarloStage, SubsetStage, points_a_level, took_monte_carlo
from sbt.campaigns.known import metamodel_of
from sbt.campaigns.pools import Frame, Proposal, draw_batch, draw_pool, fit_proposal
from sbt.campaigns.records import COUNT, LEARN, EstimationProposal
from sbt.campaigns.repeated import are_precise
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import count_begins, relative_error, steadier
from sbt.estimators.events import with_failed_runs
from sbt.estimators.importance import BLIND, SHARES
from sbt.estimators.mixture import wide_scales
from sbt.estimators.subset import has_levels
from sbt.estimators.subspace import find_subspace, inputs_that_matter, unit
from sbt.estimators.surrogate import fit_log_probability
from sbt.loop.stages import Batch, Log
from sbt.metamodels.warp import warp_around
from sbt.problem.arrays import Points, Vector
from sbt.seeds import stream
from sbt.store.database import PlannedRun

__all__ = ["ManyInputsStage", "halves_that_count", "took_subset"]

_FIRST, _ROWS_AN_INPUT = 6, 3
"""The first batch: a sixth of the budget, at least three rows an input, at most half of the budget."""
_EXPLAINED = 0.5
"""Share of the metric's variance from which on the subspace is worth following: it explains more than it leaves."""
_BATCHES = 20
"""Batches of the whole budget: proposals take seconds with thousands of runs."""
_COMMON = 0.004
"""P(critical) from which on crude Monte Carlo is as precise as subset simulation, with 1,000 runs as with 4,000 (measured)."""
_FEWEST_POINTS = 80
"""Points a level below which it is as precise for anything but what neither can tell: budgets below about 2,000."""
_FIRST_ROWS, _LATEST_ROWS = 100, 200
"""First and latest runs that the metamodel learns from: those from the inputs' distribution, and those near the boundary. The
directions are learned from all."""


@dataclass(frozen=True)
class ManyInputsStage:
    """First runs from the inputs' distribution, then importance sampling in a subspace, or what needs no metamodel."""

    settings: Settings
    name: str = DRAWN

    def stop(self, log: Log) -> str | None:
        """Return why the way that was taken is over; what subset simulation leaves of the budget goes to random draws."""
        if not took_subset(log):
            return (MonteCarloStage if took_monte_carlo(log) else SequentialStage)(self.settings).stop(log)
        why = SubsetStage(self.settings).stop(log)
        if why is not None and are_precise(log, self.settings, self.settings.stop.get("cov")):
            return "cov"
        of_once = log.iterations[1].read(EstimationProposal).level is None  # a store that ended here: nothing is added to it
        return why if of_once or len(log.history) >= self.settings.budget else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch; on one thread, so that the machine does not decide the last digit."""
        with threadpool_limits(1):
            return self._proposed(log)

    def _proposed(self, log: Log) -> Batch:
        if log.iteration == 0:
            return self._first()
        if took_subset(log):
            over = SubsetStage(self.settings).stop(log) is not None
            return self._random(log) if over else SubsetStage(self.settings).propose(log)
        if took_monte_carlo(log):
            return self._crude(log)
        axes = self._axes(log) if log.iteration == 1 else log.iterations[1].read(EstimationProposal).axes
        if axes is not None:
            return self._drawn(log, axes)
        counts = self._trial(log)
        return self._crude(log, counts) if any(counts) else SubsetStage(self.settings).propose(log)

    def _trial(self, log: Log) -> tuple[bool, bool]:
        """Return which halves of the first runs count with crude Monte Carlo; none: it is not chosen."""
        s = self.settings
        margin = s.scenario.requirement.margins(log.history)
        return (True, True) if s.scenario.space.constraints else halves_that_count(margin, s.budget)

    def _crude(self, log: Log, counts: tuple[bool, bool] | None = None) -> Batch:
        """Return draws that count from the inputs' distribution; `counts`: the halves of the first ones that do."""
        s = self.settings
        batch = MonteCarloStage(replace(s, batch=max(s.batch, s.budget // _BATCHES))).propose(log)
        return replace(batch, proposal=EstimationProposal(COUNT, "monte_carlo", trial=counts))

    def _random(self, log: Log) -> Batch:
        """Return the rest of the budget as draws from the inputs' distribution: they bound what no chain has met."""
        s = self.settings
        batch = self._plain(min(max(s.batch, s.budget // _BATCHES), s.budget - len(log.history)), log.iteration)
        return Batch(batch, EstimationProposal(LEARN, "monte_carlo"))

    def _first(self) -> Batch:
        s, space = self.settings, self.settings.scenario.space
        n = min(max(s.budget // _FIRST, _ROWS_AN_INPUT * space.dimension), max(s.budget // 2, 1))
        return Batch(self._plain(n, 0), EstimationProposal("initial", "monte_carlo"))

    def _plain(self, n: int, iteration: int) -> tuple[PlannedRun, ...]:
        space = self.settings.scenario.space
        x = space.sample(n, stream(self.settings.seed, "monte_carlo", iteration))
        densities = space.log_density(x)
        return tuple(PlannedRun(RANDOM, space.named(row), float(q)) for row, q in zip(x, densities, strict=True))

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
        frame = Frame(wide_scales(np.zeros(v.shape[1])), lift=subspace.lift, reduce=subspace.reduce)
        return frame, fit_proposal(s.scenario.space, frame, learned, v[hit], shares, rng), shares


def halves_that_count(margin: Vector, budget: int) -> tuple[bool, bool]:
    """Return which halves of the first runs count with crude Monte Carlo: each as the other one says; none: not chosen.

    Args:
        margin: (n,) distances of these runs to the critical interval, NaN of failed ones.
        budget: of the campaign, runs.
    """
    if points_a_level(budget - len(margin)) < _FEWEST_POINTS:
        return True, True
    first, second = (_prefers_crude(half) for half in np.array_split(margin, 2))
    return second, first


def _prefers_crude(margin: Vector) -> bool:
    """Return whether critical runs are common among these, or nothing tells of most runs how far they are from critical."""
    return (margin <= 0).sum() >= max(math.ceil(_COMMON * len(margin)), 1) or not has_levels(margin)


def took_subset(log: Log) -> bool:
    """Return whether subset simulation was chosen: where no subspace explains the first runs and critical ones are rare."""
    return log.iteration > 1 and log.iterations[1].read(EstimationProposal).method == "subset"
