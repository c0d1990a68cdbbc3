"""Estimation by pairs of inputs and seed: what the seed draws is known before the run, and tells which pairs to run.

A pool of pairs follows the inputs' distribution, and its seeds are uniform, as those of any run; a metamodel of inputs and
covariates says how likely each pair is critical, and runs are drawn from the pool with known probabilities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DRAWN, LEARNED
from sbt.campaigns.known import metamodel_of
from sbt.campaigns.records import COUNT, EXPLORE, CountedDraws, EstimationProposal, EventDraws, NominalDraws, PoolSummary
from sbt.campaigns.repeats import repeats_wanted, simulator_noise
from sbt.campaigns.sequential import SEARCHED, SequentialStage
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import is_precise
from sbt.errors import InputError
from sbt.estimators.clusters import deviations
from sbt.estimators.importance import draw_systematic, plan_batch, stated
from sbt.loop.stages import Batch, Log
from sbt.metamodels.bootstrap import out_of_bag
from sbt.metamodels.joint import LogPair
from sbt.metamodels.risk import Risk, fit_risk
from sbt.problem.arrays import Points, Vector
from sbt.problem.covariates import Covariates
from sbt.problem.requirement import Requirement
from sbt.samplers.noise import scores
from sbt.samplers.pairs import propose_pairs
from sbt.samplers.search import Search
from sbt.seeds import SEED_END, stream
from sbt.store.database import PlannedRun
from sbt.store.history import VALIDATION, History

__all__ = ["PairStage", "pairs_of", "pairs_words"]

Seeds = NDArray[np.int64]

"""Seeds of runs are uniform below, as those of `sbt.seeds.run_seed`."""
_SHARES = (0.8, 0.2, 0.0, 0.0)
"""Of the draws: in proportion to the metamodel's uncertainty, and to the pool. No draw counts for more than five, whatever the
metamodel denies."""
_BLIND = (0.5, 0.5, 0.0, 0.0)
"""The same until enough critical runs are known: where there are none, only draws in proportion to the pool bound P."""
_BATCH, _GROWTH = 1.0 / 16.0, 0.25
"""Runs of a batch over those before it, at least; and by how much runs grow from one fit to the next: a fit for every few runs
would cost more than the runs."""
_RATIO, _MOST_RATIO = 10, 100
"""Pairs of a pool over the draws from it, at least and at most."""
_CHEAPER = 50.0
"""Price of a run over that of a pair's covariates, by which the variances of draws and pool are weighed (docs/traffic.md)."""
_ENOUGH = 3
"""Critical runs with which the search for the first ones ends."""
_SEARCH_BUDGET, _SEARCHED_SHARE = 0.2, 0.5
"""Largest share of the budget that it takes, and of its batches that is searched; the others are drawn. Later, larger pools
go on where traffic decides more than the inputs."""
_FEWEST, _TELLS = 20, 0.25
"""Runs from which on that is asked, and the least share of the variance of their scores that traffic explains then."""
_PILOT, _RARE = 2_000, 2e-4
"""Pairs by which P(critical) is guessed before the count begins; below the value, pools that follow the inputs' distribution meet
too few critical pairs, and the inputs alone are searched instead."""


@dataclass(frozen=True, eq=False)
class _Pool:
    """Pairs: inputs x (n, d), their seeds (n,), what a metamodel learns from (n, m)."""

    x: Points
    seeds: Seeds
    inputs: Points


@dataclass(frozen=True)
class PairStage:
    """Searches for the first critical pairs, then draws pairs that count; leaves it to the inputs alone where that is better.

    It is where the simulator turns out to be deterministic, and where critical pairs are too rare to be in a pool.
    """

    settings: Settings
    name: str = DRAWN
    _fits: dict[int, tuple[Risk, tuple[Risk, ...]]] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def _by_inputs(self) -> SequentialStage:
        return SequentialStage(self.settings)

    @cached_property
    def _covariates(self) -> Covariates:
        if self.settings.covariates is None:
            raise InputError("pairs need covariates, but the scenario has none")
        return self.settings.covariates

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for; weights are those of the proposal that drew."""
        return self.settings.ahead

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough."""
        if _left_pairs(log):
            return self._by_inputs.stop(log)
        if log.iterations and len(log.planned) >= self.settings.budget:
            return "budget"
        return "cov" if is_precise(log, self.settings, self.settings.stop.get("cov")) else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch; on one thread, so that the machine does not decide the last digit."""
        s, spent = self.settings, len(log.planned)
        if _left_pairs(log):
            return self._by_inputs.propose(log)
        with threadpool_limits(1):
            if log.iteration == 0:
                return self._nominal(min(s.initial, s.budget))
            if not _counts(log) and simulator_noise(log.history, s.scenario.requirement).noisy is False:
                return self._by_inputs.propose(log)
            again = repeats_wanted(log.planned, s.scenario, s.budget - spent - 1)
            size = max(min(max(s.batch, math.ceil(_BATCH * spent)), s.budget - spent) - len(again), 1)
            batch = self._proposed(log, size)
        return self._by_inputs.propose(log) if batch is None else replace(batch, runs=(*batch.runs, *again))

    def _proposed(self, log: Log, size: int) -> Batch | None:
        """Return the next batch of pairs; None where critical ones are too rare for a pool."""
        s, history = self.settings, log.history
        counts = _counts(log)
        hits = int(s.scenario.requirement.critical_runs(history).sum())
        if not counts and hits < _ENOUGH:
            if len(log.planned) < _SEARCH_BUDGET * s.budget:
                return self._searched(log, size, hits)
            if not self._traffic_decides(history):
                return None  # by the inputs
        rng = stream(s.seed, "pairs", log.iteration)
        risk, parts = self._newest(log)
        if not counts:
            pilot = self._drawn(_PILOT, rng)
            if float(np.exp(risk(pilot.inputs)[0]).mean()) < _RARE:
                return None
        return self._counted(risk, parts, size, self._ratio(log), _SHARES if hits >= _ENOUGH else _BLIND, rng)

    def _traffic_decides(self, history: History) -> bool:
        """Return whether the drawn traffic explains more of how near runs come than the inputs do: these are searched in vain."""
        s, runs = self.settings, _to_learn(history)
        runs = runs.where(runs.ok)
        score = scores(s.scenario.requirement.depths(runs))
        if len(runs) < _FEWEST or np.ptp(score) == 0.0:
            return False
        inputs = s.scenario.space.metamodel_inputs_at(runs.x)
        both = self._covariates.beside_inputs(runs.x, runs.seed.tolist())
        alone, together = (out_of_bag(u, score, stream(s.seed, "pairs explain")) for u in (inputs, both))
        return together - alone > max(alone, _TELLS)

    def _nominal(self, n: int) -> Batch:
        """Return the first runs, drawn as crude Monte Carlo draws them."""
        s, space = self.settings, self.settings.scenario.space
        x = space.sample(n, stream(s.seed, "pairs", 0))
        runs = tuple(PlannedRun(LEARNED, space.named(row)) for row in x)
        return Batch(runs, EstimationProposal(EXPLORE, "pairs", modes=0, nominal=NominalDraws((1.0,) * n), pairs=0))

    def _searched(self, log: Log, size: int, hits: int) -> Batch:
        """Return pairs that look for critical runs, as a falsification does, and draws from the inputs' distribution."""
        s, space, rng = self.settings, self.settings.scenario.space, stream(self.settings.seed, "pairs", log.iteration)
        drawn = size - round(_SEARCHED_SHARE * size)
        x = space.sample(drawn, rng)
        runs = [PlannedRun(LEARNED, space.named(row)) for row in x]
        known = _to_learn(log.history)

        if size > drawn and len(known) > 1:
            search = Search(
                s.scenario.requirement.critical, metamodel_of(s), space.metamodel_inputs,
                lambda u: space.feasible(space.from_unit(u)), cube=space.cube,
            )  # fmt: skip
            u, y = np.clip(space.to_unit(known.x), 0.0, 1.0), s.scenario.requirement.values(known)
            found = propose_pairs(search, partial(self._covariates.of_points, keep=False), u, known.seed, y, size - drawn, rng)
            rows = space.from_unit(found.u)
            runs += [PlannedRun(SEARCHED, space.named(v), seed=k) for v, k in zip(rows, found.seeds, strict=True)]
        proposal = EstimationProposal(EXPLORE, "pairs", modes=hits, nominal=NominalDraws((1.0,) * drawn), pairs=0)
        return Batch(tuple(runs), proposal)

    def _newest(self, log: Log) -> tuple[Risk, tuple[Risk, ...]]:
        """Return what was learned when runs had last grown by a quarter since the fit before."""
        before = np.concatenate([[0], np.cumsum(np.bincount(log.planned.iteration, minlength=log.iteration))])
        counted = [batch.number for batch in log.iterations if batch.read(EstimationProposal).counted is not None]
        at = counted[0] if counted else log.iteration
        for k in range(at, log.iteration + 1):
            at = k if before[k] >= (1.0 + _GROWTH) * before[at] else at
        if at not in self._fits:
            self._fits.clear()
            history = log.history.where(log.history.iteration < at - self.settings.ahead)
            self._fits[at] = self._learned(history, stream(self.settings.seed, "pairs fit", at))
        return self._fits[at]

    def _learned(self, history: History, rng: np.random.Generator) -> tuple[Risk, tuple[Risk, ...]]:
        """Return P(critical) of pairs, a failed run as safe, and that of each requirement of a combination."""
        requirement, known = self.settings.scenario.requirement, _to_learn(history)
        inputs = self._covariates.beside_inputs(known.x, known.seed.tolist())

        def learn(part: Requirement) -> Risk:
            margin = np.where(known.ok, np.nan_to_num(part.depths(known), nan=np.inf, posinf=np.inf), np.inf)
            return fit_risk(inputs, scores(margin), margin, part.critical_runs(known), rng)

        whole = learn(requirement)
        return whole, tuple(learn(part) for part in requirement.parts) if requirement.combined else ()

    def _drawn(self, n: int, rng: np.random.Generator) -> _Pool:
        """Return n pairs as they come: inputs by their distribution, seeds uniform."""
        x = self.settings.scenario.space.sample(n, rng)
        seeds = rng.integers(0, SEED_END, n)
        return _Pool(x, seeds, self._covariates.beside_inputs(x, seeds.tolist(), keep=False))

    def _ratio(self, log: Log) -> float:
        """Return how many pairs of the pool there are for each draw: where the draws would err less, more."""
        for batch in log.iterations[::-1]:
            proposal = batch.read(EstimationProposal)
            if proposal.pool is not None and proposal.counted is not None:
                of_pair = proposal.counted.pool_variance * proposal.pool.size
                best = math.sqrt(_CHEAPER * of_pair / max(proposal.pool.anticipated, 1e-300))
                return min(max(best, _RATIO), _MOST_RATIO)
        return _RATIO

    def _counted(
        self, risk: Risk, parts: tuple[Risk, ...], n: int, ratio: float, shares: tuple[float, ...], rng: np.random.Generator
    ) -> Batch:
        """Return n pairs of a fresh pool, drawn with known probabilities."""
        space = self.settings.scenario.space
        pool = self._drawn(math.ceil(ratio * n), rng)
        size = len(pool.seeds)
        event, of_parts = risk(pool.inputs), tuple(part(pool.inputs) for part in parts)
        flat, stratum = np.zeros(size), np.zeros(size)
        plan = plan_batch(*event, flat, flat, stratum, shares, "difference", others=of_parts)
        draws = draw_systematic(plan, n, event[0] - event[1], rng)
        plan, rows = draws.plan, draws.rows
        log_q = space.log_density(pool.x[rows]) - np.log(draws.coefficient)
        runs = tuple(
            PlannedRun(DRAWN, space.named(pool.x[row]), float(q), seed=int(pool.seeds[row]), blind=k < draws.nominal)
            for k, (row, q) in enumerate(zip(rows, log_q, strict=True))
        )

        def by_warm_up(pi: Vector) -> tuple[float, ...] | None:
            k = self.settings.warm_ups
            return tuple(deviations(plan.weight * pi, plan.weight, pool.seeds, k).tolist()) if k else None

        def said(part: LogPair) -> EventDraws:
            f = stated(part, plan, stratum)
            return EventDraws(f.prior, f.anticipated, f.pool_variance, tuple(f.pi[rows].tolist()), by_warm_up(f.pi))

        pi = tuple(np.exp(event[0][rows]).tolist())
        counted = CountedDraws(
            plan.pool_variance, tuple(draws.coefficient.tolist()), tuple(draws.control_variate.tolist()), pi,
            tuple(map(said, of_parts)) or None, by_warm_up=by_warm_up(np.exp(event[0])),
        )  # fmt: skip
        summary = PoolSummary(size, plan.predicted, plan.anticipated, 1)
        return Batch(runs, EstimationProposal(
            COUNT, plan.form, pool=summary, counted=counted, nominal=NominalDraws(pi[: draws.nominal]), pairs=n
        ))  # fmt: skip


def _to_learn(history: History) -> History:
    """Return the runs that a metamodel of pairs learns from, whether their seed was chosen or drawn; those that failed count."""
    return history.where((history.stage != VALIDATION) & (history.columns["level"] == 0))


def _counts(log: Log) -> bool:
    """Return whether pairs count."""
    return pairs_of(log) is not None


def pairs_of(log: Log) -> int | None:
    """Return the number of pairs in the pools that count; None: seeds were not looked at."""
    proposals = [batch.read(EstimationProposal) for batch in log.iterations]
    sizes = [p.pool.size for p in proposals if p.pairs is not None and p.pool is not None and p.counted is not None]
    return sum(sizes) if sizes else None


def pairs_words(pairs: int, counted: int) -> str:
    """Return what was drawn, in a sentence."""
    return (
        f"The counted runs are {counted:,} of {pairs:,} random pairs of inputs and seed, whose traffic is known before the run:"
        " those more likely to be critical were drawn more often, with known probabilities, and count for so much less."
    )


def _left_pairs(log: Log) -> bool:
    """Return whether a batch was chosen by the inputs alone, as all later ones are then."""
    return any(batch.read(EstimationProposal).pairs is None for batch in log.iterations)
