"""Parts that campaigns are put together from: the batch stage, held-out runs, intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sbt.campaigns.choices import ChoiceRule, evenly, filling
from sbt.campaigns.clustering import clustered_interval
from sbt.campaigns.combinations import ALL_RUN, all_run, few, without_repetition
from sbt.campaigns.exploration import space_filling
from sbt.campaigns.repeats import repeats_wanted
from sbt.campaigns.settings import Settings
from sbt.campaigns.sides import all_critical, few_of_a_side, none_critical
from sbt.campaigns.unforeseen import lacking, unforeseen_share
from sbt.campaigns.wording import percent, plural
from sbt.estimators.binomial import interval, upper
from sbt.loop.learner import FittedMetamodel, changed_share
from sbt.loop.stages import Batch, Facts, Log
from sbt.problem.arrays import Points, Vector
from sbt.problem.plain import Value
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.database import PlannedPoints, PlannedRun
from sbt.store.history import VALIDATION, History
from sbt.store.records import FitRecord, optional

__all__ = ["BatchStage", "CriticalShare", "critical_share", "held_out_runs", "named_inputs", "share_among_held_out", "share_of"]


@dataclass(frozen=True)
class CriticalShare:
    """The share of critical runs of an even or random design.

    Attributes:
        critical_fraction: of the runs that gave a metric; None: there are none.
        low, high: ends of its exact binomial interval; failed runs count as uncritical for the low end and as critical for the
            high end.
        confidence: of the interval.
        counted: runs.
        lost: those among them that gave no metric; None: all gave one, or it is not known.
    """

    critical_fraction: float | None
    low: float
    high: float
    confidence: float = 0.95
    counted: int = 0
    lost: int | None = optional()

    @property
    def given_a_metric(self) -> CriticalShare:
        """The share among the runs that gave a metric, with the interval of their number; itself where all did."""
        if not self.lost or self.critical_fraction is None:
            return self
        ok = self.counted - self.lost
        low, high = (float(end) for end in interval(round(self.critical_fraction * ok), ok, self.confidence))
        return replace(self, low=low, high=high, counted=ok, lost=None)

    def sentence(self) -> list[str]:
        """Return the share in words; nothing where it is not known."""
        if self.critical_fraction is None:
            return []
        interval = f"{percent(self.confidence)} interval {percent(self.low)} to {percent(self.high)}"
        counted = f", from {plural(self.counted, 'run')} spread over it" if self.counted else ""
        return [f"Critical share of the parameter space: {percent(self.critical_fraction)} ({interval}){counted}."]


_SURE = 0.95
"""Confidence of the bound on what no run has met, before `stop.misclassified` ends a campaign."""


@dataclass(frozen=True)
class BatchStage:
    """Batches chosen by one rule, the first one evenly distributed.

    A share of each batch is drawn at random instead and only scores the metamodel.

    Args:
        name: what its iterations are called in the store.
        settings: of the campaign.
        choose: the rule.
        repeats: two early runs repeat inputs with other seeds, to learn whether the simulator is noisy.
        most: gives the largest number of runs of the next batch; None: those of the settings.
        pairs: (settings, metamodel, log, n, stage) to runs among these n whose seeds are chosen, too; None: none are.
    """

    name: str
    settings: Settings
    choose: ChoiceRule
    repeats: bool = False
    most: Callable[[Settings, Log], int] | None = None
    pairs: Callable[[Settings, FittedMetamodel | None, Log, int, str], list[PlannedRun]] | None = None

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for."""
        return self.settings.ahead

    def stop(self, log: Log) -> str | None:
        """Return why the stage is over: `budget`, `no rows left`, `all combinations`, `stable` or `misclassified`."""
        s = self.settings
        if log.iterations and len(log.planned) - s.reference >= s.budget:
            return "budget"
        if s.scenario.pool is not None and len(log.planned) >= len(s.scenario.pool.x):
            return "no rows left"
        if log.iterations and self.repeats and all_run(s.scenario, log.planned):
            return ALL_RUN
        chose = _chose(log)
        stable = s.stop.get("stable")
        if stable is not None and len(chose) >= 3:
            sides = [fit.sides for fit in chose[-3:]]
            moved = [changed_share(a, b) for a, b in pairwise(sides)]
            if max(moved) < stable and _both_sides_known(log, s.scenario, stable):
                return "stable"
        if s.scenario.uneven:
            return None  # its rows tell nothing of what the metamodel excludes
        return "misclassified" if self._sure(chose[-2:], log) else None

    def _sure(self, fits: Sequence[FitRecord], log: Log) -> bool:
        """Say whether fits that agree may end the campaign: the newest runs and those that fill the space do not deny them."""
        learner, target = self.settings.learner, self.settings.stop.get("misclassified")
        if learner is None or target is None or not self._agreed(fits, log, target):
            return False
        learned = learner.fit(log.history)
        if learned is None or not self._confirmed(fits, learned, target):
            return False
        if lacking(self.settings, log, learner, target):
            return False
        left = target - learned.record.expected_misclassified
        return unforeseen_share(self.settings, log, learner, learned, left) <= left

    def _agreed(self, fits: Sequence[FitRecord], log: Log, target: float) -> bool:
        """Say whether two fits in turn expect so little of the space on the wrong side and agree, and no run denies it.

        Held-out runs do not. Several runs tell of each side, or those that fill the space evenly bound what none has met.
        """
        if len(fits) < 2 or max(fit.expected_misclassified for fit in fits) > target:
            return False
        validation = fits[-1].validation
        if validation is None or validation.error_rate is None or changed_share(fits[0].sides, fits[1].sides) > target:
            return False
        wrong = round(validation.error_rate * validation.n)
        if interval(wrong, validation.n)[0] > fits[-1].expected_misclassified:
            return False  # the conclusion would say that they deny its figures
        return _both_sides_known(log, self.settings.scenario, target)

    def _confirmed(self, fits: Sequence[FitRecord], learned: FittedMetamodel, target: float) -> bool:
        """Say whether the fit to all runs, of which the newest taught none before, expects and tells the same."""
        newest = learned.record
        return newest.expected_misclassified <= target and changed_share(fits[-1].sides, newest.sides) <= target

    def _missing(self, fitted: FittedMetamodel | None, log: Log) -> int:
        """Return how many runs that fill the space a stop rule asks for before anything else; 0: it does not."""
        s, target, fits = self.settings, self.settings.stop.get("misclassified"), _chose(log)[-2:]
        if s.learner is None or target is None or fitted is None or not self._agreed(fits, log, target):
            return 0
        return lacking(s, log, s.learner, target) if self._confirmed(fits, fitted, target) else 0

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        s, first = self.settings, log.iteration == 0
        spent = len(log.planned) - (0 if first else s.reference)
        fitted = s.learner.fit(log.history) if s.learner is not None and not first else None
        missing = self._missing(fitted, log)
        batch = s.batch if self.most is None or first else self.most(s, log)
        size = min(s.initial if first else min(batch, missing or batch), s.budget - spent)
        held_out = math.floor(s.holdout_fraction * (spent + size)) - math.floor(s.holdout_fraction * spent)
        held_out = min(held_out, size - 1) if size > 1 else 0
        held_out = 0 if self.repeats and few(s.scenario, log.planned, s.budget) else held_out
        again = () if first or not self.repeats else repeats_wanted(log.planned, s.scenario, size - held_out)
        n = size - held_out - len(again)
        paired = [] if self.pairs is None or first or missing else self.pairs(s, fitted, log, n, self.name)
        n -= len(paired)
        found = (evenly if first or n == 0 else filling if missing else self.choose)(s, fitted, log, n)
        stage = "initial" if first else self.name
        x = without_repetition(s.scenario, log.planned, found.x) if self.repeats else found.x
        chosen = PlannedPoints(stage, x, s.scenario.space.names, s.scenario.space.choices)
        random = held_out_runs(s, log.iteration, held_out + (s.reference if first else 0))
        proposal = replace(found.proposal, held_out=len(random), repeats=len(again) or None, pairs=len(paired) or None)
        more = [*paired, *again, *random]
        return Batch((*chosen, *more) if more else chosen, proposal, fitted)


def _chose(log: Log) -> list[FitRecord]:
    """Return the fits that chose a batch, as a concluding one did not."""
    return [fit for fit in log.fits if fit.iteration < log.iteration]


def _both_sides_known(log: Log, scenario: LogicalScenario, target: float) -> bool:
    """Return whether several runs tell of each side, or those that fill space bound what is missing by so much of it.

    Recorded rows that are not spread evenly bound nothing.
    """
    even, facts = log.history.where(space_filling(log)), Facts.of(log.history, scenario)
    bounded = not facts.uneven and (none_critical(facts) or all_critical(facts)) and bool(upper(0, len(even), _SURE) <= target)
    return bounded or not few_of_a_side(facts, pairs=bool(log.fits and log.fits[-1].over_traffic))


def held_out_runs(settings: Settings, iteration: int, n: int) -> list[PlannedRun]:
    """Return n uniform random runs of the box, with their log density, for the batch of this iteration."""
    space = settings.scenario.space
    rng = stream(settings.seed, VALIDATION, iteration)
    x, log_q = _uniform(space, n, rng)
    return [PlannedRun(VALIDATION, named_inputs(settings.scenario, row), q) for row, q in zip(x, log_q, strict=True)]


def _uniform(space: ParameterSpace, n: int, rng: np.random.Generator) -> tuple[Points, list[float | None]]:
    """Return the values (n, d) at uniform points of the unit cube that are feasible, and the log density of each.

    The densities are None where constraints cut the box (its volume is not known exactly).
    """
    kept: list[Points] = [np.empty((0, space.dimension))]
    missing = n
    while missing > 0:
        u = rng.random((max(missing, 16), space.dimension))
        u = u[space.feasible(space.from_unit(u))][:missing]
        kept.append(u)
        missing -= len(u)
    x = space.from_unit(np.vstack(kept))
    if space.constraints:
        return x, [None] * len(x)
    ends = [(*p.bounds, p) for p in space.parameters]
    spans = [math.log(math.log(b / a)) if p.logarithmic else math.log(b - a + p.discrete) for a, b, p in ends]
    log_q = -float(sum(spans))
    return x, [log_q - stretch for stretch in space.log_stretch(x).tolist()]


def named_inputs(scenario: LogicalScenario, row: Vector) -> dict[str, Value]:
    """Return the (d,) values of a concrete scenario by name, choices as text."""
    return scenario.space.named(row)


def critical_share(history: History, scenario: LogicalScenario) -> CriticalShare:
    """Return the share of critical runs of an even or random design with its 95 % interval, as `share_of`."""
    return share_of(history, scenario.requirement)


def share_of(history: History, requirement: Requirement) -> CriticalShare:
    """Return the share of critical runs of an even or random design with its 95 % interval.

    For Sobol points the interval is that of random ones, which is wider than it needs to be. Runs that began with the same
    warmed traffic say less than independent ones: the interval is that of so many fewer.
    """
    critical, n = requirement.critical_runs(history), len(history)
    hits, failed = int(critical.sum()), int((~history.ok).sum())
    perhaps, ok = critical | ~history.ok, n - failed
    low, high = (clustered_interval(each, history.columns["warm_up"])[side] for side, each in enumerate((critical, perhaps)))
    return CriticalShare(hits / ok if ok else None, low, high, 0.95, n, failed or None)


def share_among_held_out(facts: Facts) -> CriticalShare:
    """Return the critical share among the held-out runs, which are uniform in the ranges."""
    return share_of(facts.history.where(facts.history.stage == VALIDATION), facts.requirement)
