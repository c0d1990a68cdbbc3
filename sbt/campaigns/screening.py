"""Falsification with coarse runs: candidates are run coarse, and the likeliest to be critical at the scenario's own level.

A coarse run never counts as a failure: it only chooses what is run. Some candidates are run whatever their coarse run gave, so
that it stays known how well it predicts; how many candidates there are for each run follows from that, from the cost of a coarse
run and from how often a candidate is critical. Of candidates that were not run the search learns the metric that their coarse
runs let expect, and they may be run later. Where screening does not pay, batches are those of the search without it.

Candidates of a noisy simulator are the search's points, each with several seeds, of which the worst is run; where equal inputs
give equal metrics, and where seeds are chosen with the inputs (covariates), they are more points than are run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from sbt.campaigns.failures import FailureSearch
from sbt.campaigns.levels import COARSE, Twins, coarse_runs, rank_correlation, twins
from sbt.campaigns.parts import named_inputs
from sbt.campaigns.records import ScreenRecord, SearchProposal
from sbt.campaigns.repeats import simulator_noise
from sbt.loop.stages import Batch, Log
from sbt.metamodels.belief import fit_trend, within_reach
from sbt.problem.arrays import Mask, Vector
from sbt.seeds import SEED_END, stream
from sbt.store.database import PlannedRun
from sbt.store.history import History

__all__ = ["ScreenStage"]

_SCREEN = "screen"
"""Method of a batch of coarse runs."""
_TIMES = (2, 3, 4)  # candidates for each run
_RANDOM = 0.1  # share of the runs that are chosen at random among the candidates, at least one
_PAYS = 1.25  # critical runs for the same cost over those without, from which on candidates are screened
_PILOT = 0.1  # of the budget, what coarse runs of the first runs cost at most
_FEWEST, _RECENT = 6, 30  # pairs that tell how coarse runs predict; the latest candidates that tell how often one is critical
_SURE = 0.9  # P(critical) from which on candidates are alike: the search has put the most different ones first


class Searching(Protocol):
    """The search whose candidates are screened."""

    @property
    def failure_search(self) -> FailureSearch:
        """The search as functions of its runs."""
        ...

    @property
    def name(self) -> str:
        """The stage of its runs."""
        ...

    def stop(self, log: Log) -> str | None:
        """Return why it is over."""
        ...

    def spent(self, log: Log) -> float:
        """Return what it has cost so far, in runs of the scenario."""
        ...

    def picked(self, log: Log, runs: History, n: int) -> list[PlannedRun]:
        """Return n runs where it would look next, as it learns from these runs."""
        ...

    def propose(self, log: Log, screened: Callable[[int], list[PlannedRun]] | None = None) -> Batch:
        """Return its next batch; `screened` gives so many runs in place of its own."""
        ...


@dataclass(frozen=True)
class ScreenStage:
    """A search whose candidates are run coarse first, where that pays.

    Args:
        search: proposes the candidates, and batches where screening does not pay.
    """

    search: Searching

    @property
    def name(self) -> str:
        """The name of the search."""
        return self.search.name

    def stop(self, log: Log) -> str | None:
        """Return why the search is over; not between coarse runs and those that they choose."""
        return None if _awaits(log) else self.search.stop(log)

    def propose(self, log: Log) -> Batch:
        """Return the next batch: of candidates at the coarse level, or of runs of the scenario."""
        if not log.iterations:
            return self._first(log)
        if _awaits(log):
            return self._chosen(log)
        found, s = self._judged(log), self.search.failure_search.settings
        cost, left = s.coarse_cost or 0.0, s.budget - self.search.spent(log)
        n = min(s.batch, int(left / (1.0 + found.times * cost)))
        if found.times == 1 or n < 1:
            batch = self.search.propose(log)
            return replace(batch, proposal=replace(_proposal(batch), coarse=replace(found, times=1)))
        candidates = self._candidates(log, n, found.times)
        last = log.last(SearchProposal)
        at = 0 if last is None else last.next_position
        return Batch(candidates, SearchProposal(_SCREEN, at, coarse=found))

    def _first(self, log: Log) -> Batch:
        """Return the first runs, with coarse ones of the same inputs and seeds."""
        s, batch = self.search.failure_search.settings, self.search.propose(log)
        cost, runs = s.coarse_cost or 0.0, list(batch.runs)
        room = min(max(_PILOT * s.budget, _FEWEST * cost), s.budget - len(runs) + s.reference)
        n = min(len(runs) - s.reference, int(room / cost + 1e-9))
        seeds = stream(s.seed, _SCREEN, 0).integers(0, SEED_END, max(n, 0)).tolist()
        runs[: len(seeds)] = [replace(run, seed=seed, blind=True) for run, seed in zip(runs, seeds, strict=False)]
        coarse = [replace(run, stage=COARSE, level=1) for run in runs[: len(seeds)]]
        return replace(batch, runs=(*runs, *coarse))

    def _candidates(self, log: Log, n: int, times: int) -> tuple[PlannedRun, ...]:
        """Return n times so many coarse runs, where the search would look next."""
        s = self.search.failure_search.settings
        by_seed = s.covariates is None and simulator_noise(log.history, s.scenario.requirement).noisy is not False
        points = self.search.picked(log, self._taught(log), n if by_seed else n * times)
        runs = [run for run in points for _ in range(times if by_seed else 1)]
        seeds = stream(s.seed, _SCREEN, log.iteration).integers(0, SEED_END, len(runs)).tolist()
        return tuple(
            replace(run, stage=COARSE, level=1, seed=seed if run.seed is None else run.seed, blind=run.seed is None)
            for run, seed in zip(runs, seeds, strict=True)
        )

    def _taught(self, log: Log) -> History:
        """Return the runs, and coarse ones with the metric that is expected of the scenario; of a combination, the runs alone."""
        requirement, history = self.search.failure_search.settings.scenario.requirement, log.history
        coarse, (fine, at) = coarse_runs(log), twins(log)
        if requirement.combined or not len(at):
            return history
        name = requirement.metric
        known, told = _margins(coarse.y(name)), _margins(history.y(name))[fine]
        line, _ = fit_trend(known[at, None], told)
        alone = ~np.isin(np.arange(len(coarse)), at) & coarse.ok
        columns = {**coarse.columns, f"y.{name}": line(known[:, None])}
        none = np.full(len(coarse), np.nan)
        both = {key: np.concatenate([values, columns.get(key, none)[alone]]) for key, values in history.columns.items()}
        return History(history.names, both, history.choices)

    def _chosen(self, log: Log) -> Batch:
        """Return runs of the scenario: candidates by their coarse runs, some at random, and what else a batch has."""
        s, last = self.search.failure_search.settings, log.last(SearchProposal)
        every, pairs = coarse_runs(log), twins(log)
        left = ~np.isin(np.arange(len(every)), pairs[1])
        mine, order = every.where(left), self._order(log, pairs, left)
        newest = np.flatnonzero(mine.iteration == log.iteration - 1)
        deterministic = simulator_noise(log.history, s.scenario.requirement).noisy is False
        rng = stream(s.seed, "screened", log.iteration)
        drawn = ~mine.columns["seed_chosen"].astype(bool)
        count = 0

        def screened(n: int) -> list[PlannedRun]:
            nonlocal count
            n = min(n, len(order))
            count = min(max(round(_RANDOM * n), 1), n)
            even = rng.permutation(newest)[:count]
            rows = [*even.tolist(), *order[~np.isin(order, even)][: n - count].tolist()]
            return [
                PlannedRun(
                    self.name, named_inputs(s.scenario, mine.x[row]), seed=int(mine.seed[row]),
                    blind=bool(drawn[row] and (k < count or deterministic)),
                )
                for k, row in enumerate(rows)
            ]  # fmt: skip

        batch = self.search.propose(log, screened)
        record = None if last is None or last.coarse is None else replace(last.coarse, random=count)
        return replace(batch, proposal=replace(_proposal(batch), coarse=record))

    def _order(self, log: Log, pairs: Twins, mine: Mask) -> NDArray[np.intp]:
        """Return the rows of some coarse runs, the likeliest to be critical first; further seeds of a point last."""
        expected, likely = (values[mine] for values in self._expected(log, pairs))
        likely = np.minimum(likely, _SURE)
        worst = np.lexsort((np.where(likely >= _SURE, 0.0, expected), -likely))
        _, point = np.unique(coarse_runs(log).x[mine], axis=0, return_inverse=True)
        times, turn = np.zeros(len(worst), dtype=np.intp), np.empty(len(worst), dtype=np.intp)
        for row in worst:
            turn[row] = times[point[row]]
            times[point[row]] += 1
        return worst[np.argsort(turn[worst], kind="stable")]

    def _expected(self, log: Log, pairs: Twins) -> tuple[Vector, Vector]:
        """Return (n,) expected margins of the scenario's runs at all coarse runs, and (n,) P(critical)."""
        requirement = self.search.failure_search.settings.scenario.requirement
        coarse, (fine, at) = _margins(requirement.margins(coarse_runs(log))), pairs
        margin = _margins(requirement.margins(log.history))[fine]
        line, left_out = fit_trend(coarse[at, None], margin)
        expected, std = line(coarse[:, None]), max(float(np.sqrt(((margin - left_out) ** 2).mean())), 1e-12)
        return expected, ndtr(-expected / std)

    def _rate(self, log: Log, pairs: Twins) -> float:
        """Return how often the latest candidates are critical: by their coarse runs, or as they were run without."""
        history, coarse = log.history, coarse_runs(log)
        critical = self.search.failure_search.settings.scenario.requirement.critical_runs(history).astype(np.float64)
        likely, found = self._expected(log, pairs)[1], np.empty(0)
        for batch in log.iterations:
            proposal, rows = batch.read(SearchProposal), history.iteration == batch.number
            if proposal.method == _SCREEN:
                found = np.concatenate([found, likely[coarse.iteration == batch.number]])
            elif batch.number and (proposal.coarse is None or proposal.coarse.times == 1):
                found = np.concatenate([found, critical[rows & (history.stage == self.name)]])
            elif not batch.number:
                found = critical[rows]
        return (float(found[-_RECENT:].sum()) + 0.5) / (min(len(found), _RECENT) + 1.0)

    def _judged(self, log: Log) -> ScreenRecord:
        """Return how many candidates there should be for each run, and why."""
        s = self.search.failure_search.settings
        requirement, history = s.scenario.requirement, log.history
        fine, at = both = twins(log)
        margin, coarse = requirement.margins(history)[fine], requirement.margins(coarse_runs(log))[at]
        known = _unselected(log, self.name)[fine] & np.isfinite(margin) & np.isfinite(coarse)
        correlation = rank_correlation(margin[known], coarse[known])
        pairs = int(known.sum())
        if pairs < _FEWEST:
            return ScreenRecord(1, 0.0, correlation, pairs)
        rate = self._rate(log, both)
        sure = math.tanh(max(math.atanh(min(abs(correlation or 0.0), 0.995)) - 1.0 / math.sqrt(pairs - 3.0), 0.0))
        times, gain = max(((k, _gain(k, sure, rate, s.coarse_cost or 0.0)) for k in _TIMES), key=lambda each: each[1])
        return ScreenRecord(times if gain > _PAYS else 1, rate, correlation, pairs, gain)


def _gain(times: int, correlation: float, rate: float, cost: float) -> float:
    """Return critical runs for the same cost over those without screening, as if metrics at both levels were normal."""
    z = ndtri((np.arange(200) + 0.5) / (200.0 * times))  # the candidates that look worst
    chosen = float(ndtr((ndtri(rate) - correlation * z) / math.sqrt(1.0 - correlation**2)).mean())
    return ((1.0 - _RANDOM) * chosen + _RANDOM * rate) / (rate * (1.0 + times * cost))


def _margins(margin: Vector) -> Vector:
    """Return margins, or metrics, (n,) within reach of each other; a missing one as large."""
    return within_reach(margin[:, None])[:, 0] if len(margin) else margin


def _unselected(log: Log, stage: str) -> Mask:
    """Return (n,) booleans: candidates of the scenario's runs that no coarse run chose; the first runs while there are few."""
    history = log.history
    found = np.zeros(len(history), dtype=np.bool_)
    for batch in log.iterations:
        rows = np.flatnonzero(history.iteration == batch.number)
        proposal = batch.read(SearchProposal)
        if proposal.coarse is not None and proposal.coarse.times > 1:
            rows = rows[history.stage[rows] == stage][: proposal.coarse.random]
        elif batch.number:
            rows = rows[history.stage[rows] == stage]
        found[rows] = True
    return found


def _proposal(batch: Batch) -> SearchProposal:
    if not isinstance(batch.proposal, SearchProposal):
        raise TypeError(f"a search must keep how it chose, but kept {type(batch.proposal).__name__}")
    return batch.proposal


def _awaits(log: Log) -> bool:
    """Return whether the last batch was one of candidates."""
    last = log.last(SearchProposal)
    return last is not None and last.method == _SCREEN
