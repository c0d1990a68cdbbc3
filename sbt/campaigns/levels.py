"""Two levels of fidelity in a log: pairs of inputs and seed that were run at both, and what to conclude from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbt.campaigns.counting import DRAWN, LEARNED
from sbt.campaigns.records import CONFIRM, EstimationProposal, SearchProposal
from sbt.campaigns.repeats import simulator_noise
from sbt.campaigns.settings import Settings
from sbt.campaigns.wording import number, plural
from sbt.loop.stages import Log
from sbt.metamodels.belief import within_reach
from sbt.problem.arrays import Points, Vector
from sbt.store.history import History
from sbt.store.records import Iteration

__all__ = [
    "COARSE", "LevelsTold", "Pairs", "ScreeningTold", "Twins", "coarse_runs", "is_two_level", "left_two_levels", "levels_told",
    "rank_correlation", "screening_told", "spent", "twins",
]  # fmt: skip

COARSE = "coarse"
"""Stage of runs at the coarse level."""
_FEWEST = 3

Twins = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows of runs, and of coarse runs, that have the same inputs and seed."""


def is_two_level(batch: Iteration) -> bool:
    """Return whether a batch of an estimation was drawn in two levels."""
    return "levels" in batch.proposal


def left_two_levels(log: Log) -> bool:
    """Return whether an estimation with a coarse level drew all its runs from the inputs' distribution."""
    proposals = [batch.read(EstimationProposal) for batch in log.iterations]
    counted = [(p.nominal, p.counted) for p in proposals if p.counted is not None]
    even = all(nominal is not None and len(nominal.pi) == len(draws.pi) for nominal, draws in counted)
    return any(map(is_two_level, log.iterations)) and even


def coarse_runs(log: Log) -> History:
    """Return the coarse runs; none where there are none yet."""
    return log.history.where(np.zeros(len(log.history), dtype=bool)) if log.coarse is None else log.coarse


def spent(log: Log, settings: Settings) -> float:
    """Return what the runs so far cost, in runs of the scenario."""
    return len(log.history) + (settings.coarse_cost or 0.0) * len(coarse_runs(log))


def twins(log: Log) -> Twins:
    """Return the rows of the runs of a log, and of its coarse runs, that have the same inputs and seed."""
    at = _same_pair(log.history, coarse_runs(log))
    return np.flatnonzero(at >= 0), at[at >= 0]


def rank_correlation(a: Vector, b: Vector) -> float | None:
    """Return the correlation of the ranks of a and b (n,); None of fewer than three, or where one of them is constant."""
    from scipy.stats import spearmanr  # takes half a second to load

    return float(spearmanr(a, b)[0]) if len(a) >= _FEWEST and np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else None


@dataclass(frozen=True, eq=False)
class Pairs:
    """What the pairs of a log teach.

    Attributes:
        margin: (n,) of the scenario's runs of pairs that were run at both levels, <= 0 critical; the largest where a run failed.
        weight: (n,) of these pairs under the inputs' distribution.
        before, after: (n, k) what is known of them without, and (n, l) with their coarse run.
        coarse_before, coarse_after: the same of all coarse runs.
        alone: (a, k) what is known of pairs that were run at the scenario's level alone.
        alone_margin: (a,) of these.
    """

    margin: Vector
    weight: Vector
    before: Points
    after: Points
    coarse_before: Points
    coarse_after: Points
    alone: Points
    alone_margin: Vector

    @classmethod
    def of(cls, log: Log, settings: Settings) -> Pairs:
        """Return the pairs of a log."""
        scenario, coarse = settings.scenario, coarse_runs(log)
        runs = log.history.where(np.isin(log.history.stage, (DRAWN, LEARNED)))
        at = _same_pair(runs, coarse)
        margin = scenario.requirement.margins(runs)
        known = margin[np.isfinite(margin)]
        margin = np.where(np.isfinite(margin), margin, max(float(known.max(initial=0.0)), 1.0))
        weight = np.exp(scenario.space.log_density(runs.x) - runs.log_q)
        paired, inputs = at >= 0, cls.inputs(settings, runs.x)
        before, after = cls.inputs(settings, coarse.x), cls.known_after(log, settings, coarse)
        if not len(known):
            margin, paired = margin[:0], paired[:0]
        return cls(
            margin[paired], weight[paired], before[at[paired]], after[at[paired]], before, after, inputs[~paired],
            margin[~paired],
        )  # fmt: skip

    @staticmethod
    def inputs(settings: Settings, x: Points) -> Points:
        """Return (n, k) what is known of inputs x (n, d) before any run."""
        return settings.scenario.space.metamodel_inputs_at(x)

    @classmethod
    def known_after(cls, log: Log, settings: Settings, runs: History) -> Points:
        """Return (n, l) what is known of some coarse runs of a log: their inputs and all their metrics."""
        coarse = coarse_runs(log)
        names = [name for name in coarse.metrics if name in settings.scenario.measured]
        metrics = within_reach(np.column_stack([coarse.y(name) for name in names])) if names else np.empty((len(coarse), 0))
        mine = np.isin(coarse.index, runs.index)
        return np.column_stack([cls.inputs(settings, runs.x), metrics[mine]])


def _same_pair(runs: History, coarse: History) -> NDArray[np.intp]:
    """Return the row of each run's inputs and seed (n,) among the coarse runs; -1: they were not run there."""
    place = {(x.tobytes(), int(seed)): k for k, (x, seed) in enumerate(zip(coarse.x, coarse.seed, strict=True))}
    return np.array([place.get((x.tobytes(), int(s)), -1) for x, s in zip(runs.x, runs.seed, strict=True)], dtype=np.intp)


@dataclass(frozen=True)
class LevelsTold:
    """What two levels of fidelity did for an estimate.

    Attributes:
        coarse, fine: runs at the coarse level and of the scenario.
        cost: of a coarse run, in runs of the scenario.
        correlation: of the ranks of the metric at both levels, over pairs that were run at both whatever the coarse run gave.
        pairs: number of these.
        pays: whether coarse runs are worth their cost, as it was last judged; None: there was no round.
        two_levels, one_level: variance times cost as it was last judged, with coarse runs and without.
        noisy: whether repeats of inputs differ; None: too few tell.
    """

    coarse: int
    fine: int
    cost: float
    correlation: float | None
    pairs: int
    pays: bool | None
    two_levels: float | None = None
    one_level: float | None = None
    noisy: bool | None = None

    def sentence(self) -> str:
        """Return it in words."""
        alike = ""
        if self.correlation is not None:
            alike = f" and correlates with it by {number(self.correlation, 2)} ({plural(self.pairs, 'pair')})"
        taught = f"{plural(self.coarse, 'coarse run')} taught {plural(self.fine, 'run')}"
        told = f"{taught}: a coarse run costs {number(self.cost, 2)} of a run{alike}"
        if self.pays is None:
            why = "equal inputs give equal metrics" if self.noisy is False else "the budget was used up"
            return f"{told}. They were not used further: {why}."
        if self.two_levels is None or self.one_level is None or self.two_levels <= 0.0:
            return f"{told}."
        times = self.one_level / self.two_levels
        if self.pays:
            return f"{told}, which promise that equal precision would take {number(times, 2)} times the runs without them."
        if self.correlation is None:  # as where all runs have one metric
            return f"{told}. They were left out: {plural(self.pairs, 'pair')} told nothing of how alike both levels are."
        much = f"without them equal precision would take {number(times, 2)} times the runs, as far as these pairs tell"
        return f"{told}. They do not clearly pay, and were left out: {much}."


def levels_told(log: Log, settings: Settings) -> LevelsTold | None:
    """Return what two levels did; None where there is one."""
    if settings.coarse_cost is None:
        return None
    coarse, runs = coarse_runs(log), log.history.where(log.history.drawn & log.history.ok)
    margins, at = settings.scenario.requirement.margins, _same_pair(runs, coarse)
    both = np.column_stack([margins(runs)[at >= 0], margins(coarse)[at[at >= 0]]])
    both = both[np.isfinite(both).all(axis=1)]
    rounds = [found for batch in log.iterations if (found := batch.read(EstimationProposal).levels) is not None]
    last = rounds[-1] if rounds else None
    judged: tuple[bool | None, float | None, float | None] = (None, None, None)
    if last is not None:
        judged = (last.coarse if last.pays is None else last.pays, last.two_levels, last.one_level)
    noisy, alike = simulator_noise(log.history, settings.scenario.requirement).noisy, rank_correlation(*both.T)
    return LevelsTold(len(coarse), len(log.history), settings.coarse_cost, alike, len(both), *judged, noisy)


@dataclass(frozen=True)
class ScreeningTold:
    """What coarse runs did for a falsification.

    Attributes:
        coarse, fine: runs at the coarse level and of the search.
        cost: of a coarse run, in runs of the scenario.
        correlation: of the ranks of the metric at both levels, over pairs that no coarse run chose; None: they tell none.
        pairs: number of these.
        screened: runs that coarse runs chose among more candidates.
        times: candidates for each run as last judged; 1: screening does not pay.
        gain: critical runs for the same cost over those without, as last judged; None: too little was known.
        without: coarse runs that gave no metric.
    """

    coarse: int
    fine: int
    cost: float
    correlation: float | None
    pairs: int
    screened: int
    times: int
    gain: float | None = None
    without: int = 0

    def sentence(self) -> str:
        """Return it in words."""
        none = f", and {self.without:,} of the coarse runs gave no metric" if self.without else ""
        alike = "" if self.correlation is None else f" and correlates with it by {number(self.correlation, 2)}"
        told = (
            f"{plural(self.coarse, 'coarse run')} chose {plural(self.screened, 'run')} of {self.fine:,}: a coarse run costs"
            f" {number(self.cost, 2)} of a run{alike} ({plural(self.pairs, 'pair')} that none chose{none})."
            " A coarse run counts as no failure"
        )
        if self.times > 1 and self.gain is not None:
            promised = f"these pairs promise {number(self.gain, 2)} times as many critical runs for the same cost"
            return f"{told}; {promised}, which no run measured."
        return f"{told}. Screening did not pay, and was left out: {self._why}."

    @property
    def _why(self) -> str:
        if self.gain is None:
            return "there are too few pairs to tell"
        return f"at equal cost it would give {number(self.gain, 2)} times the critical runs"


def screening_told(log: Log, settings: Settings) -> ScreeningTold | None:
    """Return what coarse runs did for a falsification; None where there is one level."""
    if settings.coarse_cost is None:
        return None
    records = [found for batch in log.iterations if (found := batch.read(SearchProposal).coarse) is not None]
    last, at = records[-1] if records else None, twins(log)[0]
    screened = int((log.history.iteration[at] > 0).sum())
    told = (None, 0, screened, 1, None) if last is None else (last.correlation, last.pairs, screened, last.times, last.gain)
    fine = int((log.history.stage != CONFIRM).sum())
    coarse = coarse_runs(log)
    without = int(np.isnan(settings.scenario.requirement.margins(coarse)).sum())
    return ScreeningTold(len(coarse), fine, settings.coarse_cost, *told, without)
