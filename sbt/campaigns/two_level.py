"""Estimation with two levels of fidelity: pairs of inputs and seed are run coarse, and those that matter at the scenario's own.

A round is two batches: coarse runs of a pool of pairs, then runs of the scenario, drawn by what the coarse ones tell. That is
done only where coarse runs clearly pay, by runs that the beliefs had not seen; and pairs are drawn by what inputs tell only where
that clearly pays. Where neither does, a round is one batch from the inputs' distribution, as in crude Monte Carlo. While nothing
critical was met, most runs are of that kind: they bound the probability. The budget counts a coarse run as its cost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sbt.campaigns.counting import DRAWN
from sbt.campaigns.levels import COARSE, Pairs, coarse_runs, is_two_level, spent
from sbt.campaigns.records import (
    COUNT,
    LEARN,
    CoarseDraws,
    CountedDraws,
    EstimationProposal,
    LevelsRecord,
    NominalDraws,
    PoolSummary,
)
from sbt.campaigns.repeats import repeats_wanted, simulator_noise
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import Settings
from sbt.campaigns.stopping import is_precise
from sbt.estimators.two_level import Shares, TwoPhases, drawn, inclusion, split, split_as_if_normal
from sbt.loop.stages import Batch, Log
from sbt.metamodels.belief import Belief, cross_fitted, fit_belief, fit_mean, fit_score, fit_trend
from sbt.problem.arrays import Mask, Points, Vector
from sbt.seeds import SEED_END, stream
from sbt.store.database import PlannedRun

__all__ = ["TwoLevelStage"]

_FIRST, _FIRST_SHARE, _MOST_FIRST = 12, 0.12, 100  # pairs at both levels to begin with: at least, of the budget, at most
_GROWTH = 0.35  # runs of a round, of those before it: what rounds learn from grows with what they cost
_BOTH = 0.15  # of a round, pairs that are run at both levels whatever is believed: they bound what is not, and teach
_POOL, _LEAST_POOL, _MOST_POOL = 10, 2_000, 50_000  # pairs of a pool for a coarse run; at least and at most
_EVENT = 10  # critical pairs from which on what coarse runs are worth is judged by them, and not by correlations
_PILOT, _LOOKED = 0.06, 0.1  # of the budget, what coarse runs may cost to begin with, and before they are known to pay
_UNMET = 0.25  # runs drawn by a belief, of those from the inputs' distribution, at most while nothing critical was met
_REST = 1.5  # rounds in what is left of the budget below which it is one


@dataclass(frozen=True)
class TwoLevelStage:
    """Draws pairs in two phases; leaves a simulator without noise to the sequential estimator.

    Source:
        the estimator: `sbt.estimators.two_level`.
    """

    settings: Settings
    name: str = DRAWN

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough; not within a round."""
        if not log.iterations or _awaits_fine(log):
            return None
        if self._hands_over(log):
            return self._without.stop(log)
        if self.settings.budget - spent(log, self.settings) < 1.0:
            return "budget"
        return "cov" if is_precise(log, self.settings, self.settings.stop.get("cov")) else None

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        s = self.settings
        if not log.iterations:
            return self._first()
        if _awaits_fine(log):
            return self._fine(log)
        if len(log.iterations) == 1:
            again = repeats_wanted(log.history, s.scenario, min(int(s.budget - spent(log, s)), 2))
            if again:
                return Batch(again, EstimationProposal(LEARN, "repeats"))
        return self._without.propose(log) if self._hands_over(log) else self._round(log)

    def _hands_over(self, log: Log) -> bool:
        """Return whether equal inputs give equal metrics: the sequential estimator learns what inputs tell from few runs."""
        if any(map(is_two_level, log.iterations)):
            return False
        return len(log.iterations) > 1 and simulator_noise(log.history, self.settings.scenario.requirement).noisy is False

    @property
    def _without(self) -> SequentialStage:
        """The campaign without coarse runs, with what those of the beginning have left of the budget."""
        first = math.ceil((self.settings.coarse_cost or 0.0) * self._pairs_first)
        return SequentialStage(replace(self.settings, budget=max(self.settings.budget - first, 1)))

    @property
    def _pairs_first(self) -> int:
        """Number of pairs that are run at both levels to begin with."""
        s, cost = self.settings, self.settings.coarse_cost or 1.0
        wanted = min(max(_FIRST, int(min(_FIRST_SHARE, _PILOT / cost) * s.budget)), _MOST_FIRST)
        return max(min(wanted, int(s.budget / (1.0 + cost))), 1)

    def _first(self) -> Batch:
        """Return pairs of the inputs' distribution at both levels."""
        s, n = self.settings, self._pairs_first
        x, seeds = self._pool(n, 0)
        fine = self._runs(x, seeds, np.ones(n), DRAWN)
        coarse = self._runs(x, seeds, np.ones(n), COARSE) if n * (1.0 + (s.coarse_cost or 0.0)) <= s.budget else []
        counted = CountedDraws(0.0, (1.0,) * n, (0.0,) * n, (1.0,) * n)
        kept = EstimationProposal(LEARN, "difference", counted=counted, nominal=NominalDraws((1.0,) * n))
        return Batch((*coarse, *fine), kept)

    def _pool(self, n: int, iteration: int) -> tuple[Points, NDArray[np.int64]]:
        """Return n fresh pairs: x (n, d) and seeds (n,)."""
        rng = stream(self.settings.seed, "pairs", iteration)
        return self.settings.scenario.space.sample(n, rng), rng.integers(0, SEED_END, n)

    def _runs(
        self, x: Points, seeds: NDArray[np.int64], coefficient: Vector, stage: str, blind: Mask | bool = True
    ) -> list[PlannedRun]:  # fmt: skip
        """Return runs of pairs that were drawn with a known density: coarse ones by their stage."""
        space, level = self.settings.scenario.space, int(stage == COARSE)
        log_q = space.log_density(x) - np.log(coefficient)
        blinds = np.broadcast_to(np.asarray(blind), len(x))
        rows = zip(x, log_q, seeds, blinds, strict=True)
        return [PlannedRun(stage, space.named(r), float(q), int(seed), level, blind=bool(b)) for r, q, seed, b in rows]

    def _round(self, log: Log) -> Batch:
        """Return the first batch of a round."""
        s, cost = self.settings, self.settings.coarse_cost or 1.0
        left, used = s.budget - spent(log, s), spent(log, s)
        size = max(float(s.batch), _GROWTH * used)
        size = left if left < _REST * size else size
        pairs = Pairs.of(log, s)
        if not len(pairs.margin):  # nothing gave a metric: there is nothing to believe
            return self._alone(log, None, size, LevelsRecord(coarse=False))
        shares = self._worth(pairs, log.iteration)
        told = shares.two_levels, shares.one_level, shares.pays
        before = self._before(pairs, log.iteration) if shares.by_inputs else None
        both = max(round(_BOTH * size / (1.0 + cost)), 1)
        room = size - both * (1.0 + cost)
        fine = int(shares.fine * room / (cost + shares.fine))
        m = int(room / (cost + shares.fine)) if fine else int((room - 1.0) / cost)
        fine, most = max(fine, 1), self._most_believed(log, both)
        if shares.pays and m >= fine and fine <= most:
            return self._coarse(log, before, m, both, fine, LevelsRecord(True, *told))
        found = LevelsRecord(False, *told)
        look = not shares.pays and cost * len(coarse_runs(log)) < _LOOKED * s.budget
        believed = before is not None and size <= most
        return self._alone(log, before if believed else None, size, found, again=look)

    def _most_believed(self, log: Log, nominal: int) -> float:
        """Return how many runs a belief may draw beside so many others: any number once something critical was met."""
        if self.settings.scenario.requirement.critical_runs(log.history).any():
            return math.inf
        proposals = [batch.read(EstimationProposal) for batch in log.iterations]
        drawn = sum(len(p.counted.pi) for p in proposals if p.counted is not None)
        even = sum(len(p.nominal.pi) for p in proposals if p.nominal is not None)
        return _UNMET * (even + nominal) - (drawn - even)

    def _worth(self, pairs: Pairs, iteration: int) -> Shares:
        """Return what coarse runs are worth by the pairs so far; while few are critical, by correlations."""
        from scipy.stats import rankdata  # takes half a second to load

        rng, cost = stream(self.settings.seed, "worth", iteration), self.settings.coarse_cost or 1.0
        critical = (pairs.margin <= 0.0).astype(np.float64)
        if min(critical.sum(), len(critical) - critical.sum()) >= _EVENT:
            after = cross_fitted(fit_belief, pairs.after, pairs.margin, rng)
            return split(critical, cross_fitted(fit_mean, pairs.before, after, rng), after, pairs.weight, cost, rng)
        score = ndtri(rankdata(pairs.margin) / (len(pairs.margin) + 1.0))
        told = (0.5 * (cross_fitted(fit_score, k, score, rng) + fit_trend(k, score)[1]) for k in (pairs.before, pairs.after))
        low, high = (max(_correlation(each, score, pairs.weight), 0.0) for each in told)
        p = float(pairs.weight @ critical + 0.5) / (float(pairs.weight.sum()) + 1.0)
        known = float(pairs.weight.sum() ** 2 / (pairs.weight**2).sum())
        return split_as_if_normal(low, high, p, cost, known)

    def _after(self, pairs: Pairs, iteration: int) -> Belief:
        return fit_belief(pairs.after, pairs.margin, stream(self.settings.seed, "after", iteration))

    def _before(self, pairs: Pairs, iteration: int) -> Belief:
        """Return P(critical) given inputs: what coarse runs state, and runs that were drawn by inputs alone."""
        rng = stream(self.settings.seed, "before", iteration)
        stated = self._after(pairs, iteration)(pairs.coarse_after)
        coarse = fit_mean(pairs.coarse_before, stated, rng)
        if len(pairs.alone) < _FIRST:
            return coarse
        alone, share = fit_belief(pairs.alone, pairs.alone_margin, rng), len(pairs.alone) / (len(pairs.alone) + len(stated))
        return lambda known: share * alone(known) + (1.0 - share) * coarse(known)

    def _coarse(self, log: Log, before: Belief | None, m: int, both: int, fine: int, found: LevelsRecord) -> Batch:
        """Return the coarse runs of a round; without a belief before them, all of the pool."""
        x, seeds = self._pool((m if before is None else int(np.clip(_POOL * m, _LEAST_POOL, _MOST_POOL))) + both, log.iteration)
        g, probability, rows = self._first_phase(log, before, x, both, m, "coarse")
        told = tuple(g[rows].tolist()), tuple(probability[rows].tolist())
        kept = CoarseDraws(len(x), float(g.sum()), float((g**2).sum()), *told, both, fine)
        runs = self._runs(x[rows], seeds[rows], len(rows) / (len(x) * probability[rows]), COARSE)
        return Batch(tuple(runs), EstimationProposal(COARSE, "two_level", drawn_coarse=kept, levels=found))

    def _first_phase(
        self, log: Log, before: Belief | None, x: Points, both: int, m: int, name: str
    ) -> tuple[Vector, Vector, NDArray[np.intp]]:
        """Return (n,) beliefs of pairs before any run, (n,) probabilities of being drawn, and the rows drawn: `both` and m."""
        if before is None:
            return np.zeros(len(x)), np.ones(len(x)), np.arange(len(x))
        g, probability, rest = before(Pairs.inputs(self.settings, x)), np.ones(len(x)), slice(both, None)
        probability[rest] = inclusion(np.sqrt(g[rest] * (1.0 - g[rest])), np.ones(len(x) - both), m)
        chosen = drawn(probability[rest], g[rest], stream(self.settings.seed, name, log.iteration))
        return g, probability, np.concatenate([np.arange(both), both + chosen])

    def _fine(self, log: Log) -> Batch:
        """Return the runs of the scenario that follow coarse ones."""
        s, last = self.settings, log.iterations[-1].read(EstimationProposal)
        kept, found = last.drawn_coarse, last.levels
        mine = coarse_runs(log).where(coarse_runs(log).iteration == log.iterations[-1].number)
        if kept is None:
            raise RuntimeError("a round must have coarse runs before those of the scenario, but has none")
        after = self._after(Pairs.of(log, s), log.iteration)(Pairs.known_after(log, s, mine))
        first, second = np.array(kept.probability), np.ones(len(mine))
        rest, n = slice(kept.both, None), min(kept.fine, len(mine) - kept.both)
        second[rest] = inclusion(np.sqrt(after[rest] * (1.0 - after[rest])) / first[rest], 1.0 / first[rest], n, fine=True)
        chosen = drawn(second[rest], after[rest], stream(s.seed, "fine", log.iteration))
        rows = np.concatenate([np.arange(kept.both), kept.both + chosen])
        phases = TwoPhases(kept.pool, kept.total, kept.squares, np.array(kept.before), first, after, second)
        blind = np.arange(len(rows)) < kept.both
        found = found or LevelsRecord(coarse=True)
        k = s.warm_ups
        by_warm_up = tuple(phases.by_warm_up(mine.seed, k).tolist()) if k else None  # coarse runs begin with the same traffic
        return self._counted(phases, rows, mine.x[rows], mine.seed[rows], kept.both, blind, found, by_warm_up)

    def _alone(self, log: Log, before: Belief | None, size: float, found: LevelsRecord, *, again: bool = False) -> Batch:
        """Return a round without coarse runs: drawn by what inputs tell, some of them by nothing; without a belief, all of them.

        `again`: some of the latter are run coarse as well, so that it can be judged again what that is worth.
        """
        cost = (self.settings.coarse_cost or 0.0) * again
        n = max(int(size / (1.0 + _BOTH * cost) + 1e-9), 1)
        look = min(int((size - n) / cost), n) if again else 0
        both = n if before is None else min(max(round(_BOTH * n), look, 1), n)
        rest = int(np.clip(_POOL * n, _LEAST_POOL, _MOST_POOL)) if n > both else 0
        x, seeds = self._pool(both + rest, log.iteration)
        g, probability, rows = self._first_phase(log, before if rest else None, x, both, n - both, "fine")
        sums = float(g.sum()), float((g**2).sum())
        phases = TwoPhases(len(x), *sums, g[rows], probability[rows], g[rows], np.ones(len(rows)))
        batch = self._counted(phases, np.arange(len(rows)), x[rows], seeds[rows], both, True, found)
        further = self._runs(x[:look], seeds[:look], np.ones(look), COARSE)
        return replace(batch, runs=(*batch.runs, *further))

    def _counted(
        self, phases: TwoPhases, rows: NDArray[np.intp], x: Points, seeds: NDArray[np.int64], nominal: int,
        blind: Mask | bool, found: LevelsRecord, by_warm_up: tuple[float, ...] | None = None,
    ) -> Batch:  # fmt: skip
        """Return the runs of the scenario that count, and how."""
        coefficient, after = phases.coefficient(rows), tuple(phases.after[rows].tolist())
        pool = PoolSummary(phases.pool, phases.prior, phases.anticipated(len(rows)), 1)
        weight = len(rows) if found.coarse is False else len(rows) + (self.settings.coarse_cost or 0.0) * len(phases.first)
        counted = CountedDraws(
            phases.pool_variance, tuple(coefficient.tolist()), after, after, weight=weight, by_warm_up=by_warm_up
        )
        kept = EstimationProposal(
            COUNT, "difference", pool=pool, counted=counted, nominal=NominalDraws((1.0,) * nominal), levels=found
        )  # with noise no belief denies a region: what no run has met is bounded by these draws alone
        return Batch(tuple(self._runs(x, seeds, coefficient, DRAWN, blind)), kept)


def _correlation(a: Vector, b: Vector, weight: Vector) -> float:
    """Return the correlation of a and b (n,) with weights (n,); 0 where one of them is constant."""
    a, b = (v - np.average(v, weights=weight) for v in (a, b))
    scale = float(np.average(a**2, weights=weight) * np.average(b**2, weights=weight))
    return float(np.average(a * b, weights=weight)) / math.sqrt(scale) if scale > 0.0 else 0.0


def _awaits_fine(log: Log) -> bool:
    """Return whether the last batch was the coarse one of a round."""
    return log.iterations[-1].read(EstimationProposal).drawn_coarse is not None
