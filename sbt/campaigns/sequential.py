"""The sequential estimator as a stage: search, learn, then count, every batch a function of the log.

A batch of the estimation has draws from a fresh pool, with known density, and search picks without
one. Up to a stopping time the draws only teach; from then on they count, with weights fixed in advance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DRAWN, LEARNED
from sbt.campaigns.each import part_draws
from sbt.campaigns.known import Known, metamodel_of
from sbt.campaigns.records import COUNT, EXPLORE, LEARN, CountedDraws, EstimationProposal, NominalDraws, PoolSummary
from sbt.campaigns.repeats import repeats_wanted
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import count_begins, is_precise, pools_of, relative_error, relative_error_of
from sbt.estimators.choices import ChoiceScore, choice_scores, from_cube, log_normal, log_wide, to_cube
from sbt.estimators.importance import BLIND, SHARES, Plan, draw_systematic, plan_batch
from sbt.estimators.mixture import Mixture, fit_mixture, particles, wide_scales
from sbt.estimators.parts import parts_of_pool
from sbt.estimators.surrogate import Coordinates, LogProbability
from sbt.loop.stages import Batch, Log
from sbt.problem.arrays import Points, Vector
from sbt.problem.cube import Cube
from sbt.samplers import portfolio
from sbt.samplers.search import Search
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store.database import PlannedRun

__all__ = ["SequentialStage"]

_SEARCH_STAGE = "hunt"
"""Stage of runs that search for modes."""

# Sizes: larger ones changed the estimates of the testbeds by less than their spread (docs/estimation.md).
_POOL = 10_000
"""Points of a pool: its own variance is a hundredth of what 100 draws leave."""
_PILOT = 2_500
"""Points of the pool that decides the form of the estimator and whether the newest metamodel is drawn with: a pool that is
counted must not decide that itself, as it would choose what its own points happen to flatter."""
_PARTICLES = 800
"""Particles that the mixture is fitted to, per cloud."""
_CANDIDATES = 6_000
"""Points that the particles are resampled from."""

# When the search for modes ends.
_SEARCH_BUDGET = 0.4
"""Largest share of the budget that it takes."""
_QUIET = 3
"""Batches without a new mode after which it ends."""
_COMMON = 0.02
"""P(critical) under the inputs' distribution above which draws from it meet every region that counts."""
_EVEN_SHARE = 0.1
"""Of the search picks, those that are spread evenly: they do not depend on the metamodel."""
_SEARCH_SHARE = (0.2, 0.1)
"""Of later batches, the share that still searches: before and after the count has begun."""

# When an earlier metamodel is preferred to the newest one.
_LOST, _MEMORY, _SURPRISE = 10.0, 4, 0.01
"""Loss of precision by this factor against one of so many batches before, although no critical run since then lay where that
metamodel's P was below the value."""


@dataclass(frozen=True)
class SequentialStage:
    """Searches for critical regions, learns them, then draws runs that count.

    Source:
        the difference form, its defence, weights and interval: `sbt.estimators`.
    """

    settings: Settings
    name: str = DRAWN

    @cached_property
    def _coordinates(self) -> Coordinates:
        return Coordinates(self.settings.scenario.space)

    @cached_property
    def _choices(self) -> tuple[ChoiceScore, ...]:
        return choice_scores(self.settings.scenario.space)

    @cached_property
    def _wide(self) -> Vector:
        return wide_scales(self._coordinates.bounded)

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough."""
        if log.iterations and len(log.history) >= self.settings.budget:
            return "budget"
        return "cov" if is_precise(log, self.settings) else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch; on one thread, so that the machine does not decide the last digit."""
        with threadpool_limits(1):
            s, left = self.settings, self.settings.budget - len(log.history)
            again = repeats_wanted(log.history, s.scenario, left - 1)
            batch = self._proposed(log, max(min(s.batch, left) - len(again), 1))
            return replace(batch, runs=(*batch.runs, *again))

    def _proposed(self, log: Log, size: int) -> Batch:
        s = self.settings
        if log.iteration == 0 and (s.prior_runs is None or len(s.prior_runs.training) < 2):
            return self._initial(min(s.initial, s.budget))
        known = Known.of(log.history, self._coordinates, s)
        log_probability = known.learn(stream(s.seed, "fit", log.iteration))
        modes = self._modes_while_searching(log, known, log_probability)
        if modes is not None:
            rows = self._search_modes(known, log.iteration, size)
            return Batch(self._runs(rows, _SEARCH_STAGE), EstimationProposal(EXPLORE, "explore", modes=modes))
        return self._drawn(log, known, log_probability, size)

    def _initial(self, n: int) -> Batch:
        """Return an even design over the wide distribution."""
        sobol = SobolSequence(self.settings.scenario.space.dimension, self.settings.seed)
        z = self._scores(sobol.points(0, n))
        return Batch(self._runs(self._feasible(z, 0), "initial"), EstimationProposal("initial", "sobol"))

    def _feasible(self, z: Points, iteration: int) -> Points:
        """Return the points with those outside of the constraints replaced by draws of the inputs' distribution."""
        space = self.settings.scenario.space
        bad = ~space.feasible(space.from_normal(z))
        if bad.any():
            z = z.copy()
            z[bad] = space.to_normal(space.sample(int(bad.sum()), stream(self.settings.seed, "feasible", iteration)))
        return z

    def _runs(self, z: Points, stage: str, log_q: Vector | None = None) -> tuple[PlannedRun, ...]:
        space = self.settings.scenario.space
        rows = space.from_normal(z)
        densities = [None] * len(rows) if log_q is None else [float(q) for q in log_q]
        return tuple(PlannedRun(stage, space.named(row), density) for row, density in zip(rows, densities, strict=True))

    def _modes_while_searching(self, log: Log, known: Known, log_probability: LogProbability | None) -> int | None:
        """Return the number of modes known so far while phase 0 goes on, None once it is over.

        It ends with 40 % of the budget, after three batches without a new mode, and where failures are common:
        draws from the inputs' distribution meet every region that counts.
        """
        proposals = [batch.read(EstimationProposal) for batch in log.iterations]
        if len(log.history) >= _SEARCH_BUDGET * self.settings.budget or any(p.phase in (LEARN, COUNT) for p in proposals):
            return None
        modes = [p.modes or 0 for p in proposals if p.phase == EXPLORE] + [known.modes(log_probability)]
        if modes[-1] > 0 and len(modes) > _QUIET and modes[-1] <= modes[-1 - _QUIET]:
            return None
        return None if modes[-1] > 0 and self._common(log_probability, log.iteration) else modes[-1]

    def _common(self, log_probability: LogProbability | None, iteration: int) -> bool:
        """Return whether the metamodel takes more than 1 in 50 draws from the inputs' distribution to be critical."""
        z = stream(self.settings.seed, "common", iteration).standard_normal((2000, len(self._wide)))
        return log_probability is not None and float(np.exp(log_probability(z)[0]).mean()) > _COMMON

    def _search_modes(self, known: Known, iteration: int, n: int) -> Points:
        """Return n search picks (n, d): the falsification portfolio in the cube of the wide distribution, some spread evenly."""
        s, space, rng = self.settings, self.settings.scenario.space, stream(self.settings.seed, "hunt", iteration)
        even = round(_EVEN_SHARE * n)
        spread = rng.random((even, space.dimension))
        if n > even:
            search = Search(
                s.scenario.requirement.critical, metamodel_of(s), lambda v: self._coordinates(self._scores(v)),
                lambda v: space.feasible(space.from_normal(self._scores(v))), cube=Cube(nominal=space.cube.nominal),
            )  # fmt: skip
            picks = portfolio.propose(search, to_cube(known.z, self._wide, self._choices), known.y, n - even, rng, known.batch)
            spread = np.vstack([picks.u, spread])
        return self._feasible(self._scores(spread), iteration)

    def _scores(self, v: Points) -> Points:
        """Return normal scores of points of the cube in which the wide distribution is uniform."""
        return from_cube(v, self._wide, self._choices)

    def _drawn(self, log: Log, known: Known, log_probability: LogProbability | None, size: int) -> Batch:
        """Return draws from a fresh pool, and search picks."""
        s, rng = self.settings, stream(self.settings.seed, "draw", log.iteration)
        shares = BLIND if known.one_sided else SHARES
        mixture = self._mixture(log_probability, known, rng)
        pilot = self._pooled(log_probability, mixture, shares, _PILOT, rng).plan
        fallback = self._fallback(log, known, relative_error(pilot.anticipated, pilot.predicted))
        if fallback is not None:
            log_probability, mixture = fallback, self._mixture(fallback, known, rng)
            pilot = self._pooled(log_probability, mixture, shares, _PILOT, rng).plan
        pool = self._pooled(log_probability, mixture, shares, _POOL, rng, form=pilot.form)
        plan, log_pi = pool.plan, pool.log_pi
        summary = PoolSummary(_POOL, plan.predicted, plan.anticipated, len(mixture.shares), fallback is not None)
        counts = known.one_sided or count_begins(log, s, size, 1.0 - _SEARCH_SHARE[True])
        searched = 0 if self._common(log_probability, log.iteration) else min(round(_SEARCH_SHARE[counts] * size), size - 1)
        n = size - searched
        picks = self._runs(self._search_modes(known, log.iteration, searched), _SEARCH_STAGE)
        draws = draw_systematic(plan, n, log_pi - pool.log_not, rng)
        pi = tuple(np.exp(log_pi[draws.rows]).tolist())
        nominal = NominalDraws(pi[: draws.nominal])
        z = pool.z[draws.rows]
        if not counts:
            proposal = EstimationProposal(LEARN, "uncertainty", pool=summary, nominal=nominal)
            return Batch((*self._runs(z, LEARNED), *picks), proposal)
        log_q = s.scenario.space.log_density(pool.x[draws.rows]) - np.log(draws.coefficient)
        counted = CountedDraws(
            plan.pool_variance, tuple(draws.coefficient.tolist()), tuple(draws.control_variate.tolist()), pi,
            part_draws(parts_of_pool(log_probability, pool.z, plan, pool.stratum), draws.rows),
        )  # fmt: skip
        proposal = EstimationProposal(COUNT, plan.form, pool=summary, counted=counted, nominal=nominal)
        return Batch((*self._runs(z, DRAWN, log_q), *picks), proposal)

    def _pooled(
        self, log_probability: LogProbability | None, mixture: Mixture, shares: tuple[float, ...], n: int,
        rng: np.random.Generator, form: str | None = None,
    ) -> _Pool:
        """Return a fresh pool of n points of a mixture, and how a batch would be drawn from it with this metamodel."""
        space = self.settings.scenario.space
        z, stratum = mixture.sample(n, rng)
        x = space.from_normal(z)
        log_w = log_normal(z) - mixture.log_density(z)
        if space.constraints:
            log_w = np.where(space.feasible(x), log_w - np.log(space.feasible_mass), -np.inf)
        over_wide = log_wide(z, self._wide, self._choices) - mixture.log_density(z)
        unsure = np.full(len(z), np.log(0.5))
        log_pi, log_not = (unsure, unsure) if log_probability is None else log_probability(z)
        plan = plan_batch(log_pi, log_not, log_w, over_wide, stratum, shares, form)
        return _Pool(z, x, plan, log_pi, log_not, stratum)

    def _fallback(self, log: Log, known: Known, error: float) -> LogProbability | None:
        """Return an earlier metamodel to draw with, where the newest one has lost its precision for no reason.

        A fit can fail: hyperparameters of another mode of their posterior. That shows in an anticipated error ten times as
        large as that of an earlier batch, although no critical run since then lay where that batch denied it. The estimate
        is unbiased with any metamodel that knows only earlier runs.
        """
        drawn = [(batch.number, pool) for batch, pool in pools_of(log) if not pool.fallback]
        if not drawn:
            return None
        iteration, best = min(drawn[-_MEMORY:], key=lambda item: relative_error_of(item[1]))
        if error <= _LOST * relative_error_of(best):
            return None
        before = Known.of(log.history.where(log.history.iteration < iteration), self._coordinates, self.settings)
        log_probability = before.learn(stream(self.settings.seed, "fit", iteration))
        since = known.batch >= iteration
        if log_probability is None or not since.any():
            return None
        met = known.z[since & known.critical]
        surprised = len(met) > 0 and bool((np.exp(log_probability(met)[0]) < _SURPRISE).any())
        return None if surprised else log_probability

    def _mixture(self, log_probability: LogProbability | None, known: Known, rng: np.random.Generator) -> Mixture:
        """Return h, fitted to particles of p pi and of p sqrt(pi (1 - pi))."""
        if log_probability is None or not known.critical.any():
            return Mixture(self._wide, choices=self._choices)
        z, log_q = Mixture(self._wide, choices=self._choices).sample_near(_CANDIDATES, known.z[known.critical], rng)

        at_start = log_probability(z)  # both clouds begin there

        def mass(points: Points) -> Vector:
            log_pi, _ = at_start if points is z else log_probability(points)
            return log_normal(points) + log_pi

        def boundary(points: Points) -> Vector:
            log_pi, log_not = at_start if points is z else log_probability(points)
            return log_normal(points) + 0.5 * (log_pi + log_not)

        clouds = tuple(particles(target, z, log_q, _PARTICLES, rng) for target in (mass, boundary))
        return fit_mixture(clouds, self._wide, rng, choices=self._choices)


@dataclass(frozen=True, eq=False)
class _Pool:
    """A pool: points z (N, d) and x (N, d), how a batch is drawn from it, and what the metamodel says there."""

    z: Points
    x: Points
    plan: Plan
    log_pi: Vector
    log_not: Vector
    stratum: Vector
