"""What a campaign is made of: a log, stages that propose the next batch from it, and a conclusion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from sbt.errors import InputError
from sbt.loop.learner import FittedMetamodel
from sbt.problem.outcome import Doubt, given
from sbt.problem.plain import Json, unit_of, written
from sbt.problem.pool import Pool
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.database import PlannedPoints, PlannedRun
from sbt.store.history import History, as_numbers
from sbt.store.records import FitRecord, Iteration

__all__ = [
    "BACK", "Batch", "Campaign", "Conclusion", "Facts", "Log", "LooksAhead", "Progress", "Shard", "Stage", "few_combinations",
    "notes_of", "proposed", "sentences_of",
]  # fmt: skip

BACK = "back to the first stage"
"""What a later stage says instead of why it is over: its runs have told that an earlier one is not."""

T = TypeVar("T")


@dataclass(frozen=True)
class Batch:
    """What a stage asks for.

    Args:
        runs: the concrete scenarios.
        proposal: how they were chosen: a dataclass or a mapping, written to the log as JSON and read back by `Iteration.read`.
        fitted: the metamodel that chose them, whose scores the log keeps.
    """

    runs: Sequence[PlannedRun]
    proposal: object = field(default_factory=dict)
    fitted: FittedMetamodel | None = None


@dataclass(frozen=True)
class Log:
    """All that a stage may look at.

    Attributes:
        history: finished runs; of a stage that looks ahead, those of the batches that it may look at.
        iterations: how earlier batches were chosen.
        fits: scores of earlier metamodels.
        pending: runs of later batches, of which nothing is known but that they are being run; None: there are none.
        coarse: finished runs of a coarser level of fidelity, which only teach; None: there are none.
    """

    history: History
    iterations: tuple[Iteration, ...]
    fits: tuple[FitRecord, ...]
    pending: History | None = None
    coarse: History | None = None

    @cached_property
    def planned(self) -> History:
        """All runs that were asked for: the finished ones and, behind them, those in flight, without status and metrics."""
        return self.history if self.pending is None else self.history.extended(self.pending)

    @property
    def iteration(self) -> int:
        """Number of the next batch."""
        return len(self.iterations)

    def last(self, kind: type[T]) -> T | None:
        """Return how the last batch was chosen; None before the first one."""
        return self.iterations[-1].read(kind) if self.iterations else None


class Conclusion(Protocol):
    """What a campaign found: a frozen dataclass with typed attributes."""

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        ...

    def sentences(self, facts: Facts) -> list[str]:
        """Return what was found in plain words, the most important first."""
        ...


@dataclass(frozen=True)
class Facts:
    """What sentences about a conclusion may refer to.

    Attributes:
        history: finished runs.
        requirement: metric and critical interval.
        unit: of the metric.
        scenario: its name.
        units: of inputs and metrics, by name.
        combinations: of the inputs, where all are whole numbers or choices and there are at most 4,096; None: otherwise.
        meanings: of metrics, by name.
        recorded: its runs are recorded rows; there are no others.
        notes: in sentences, what is to be known of these rows.
        uneven: why shares of these rows are none of the parameter space; "": they are, or runs are no rows.
    """

    history: History
    requirement: Requirement
    unit: str = ""
    scenario: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    combinations: int | None = None
    meanings: Mapping[str, str] = field(default_factory=dict)
    recorded: bool = False
    notes: tuple[str, ...] = ()
    uneven: str = ""

    @classmethod
    def of(cls, history: History, scenario: LogicalScenario) -> Facts:
        """Return the facts of a campaign with this scenario."""
        return cls(
            history, scenario.requirement, scenario.unit, scenario.name, scenario.units, few_combinations(scenario),
            {m.name: m.description for m in scenario.metrics if m.description}, scenario.pool is not None,
            notes_of(scenario), scenario.uneven,
        )  # fmt: skip


_MOVED = {
    Doubt.IMPOSSIBLE: (
        "the ego moves as no vehicle can", ": what its controller commands is done, however much (column unconfirmed)"
    ),
    Doubt.TELEPORTED: (
        "a road user near the ego was teleported",
        ": metrics see it leave and come, not move (column unconfirmed; SUMO's time-to-teleport)",
    ),
    Doubt.CROSSED: (
        "a road user near the ego was moved over a junction within a step",
        ": metrics see it leave and come (column unconfirmed; the network has no lanes, or no walking areas, inside junctions)",
    ),
    Doubt.STOPPED: (
        "another road user brakes as no vehicle can",
        " (column unconfirmed); SUMO lets one do so before a red light or where its lane ends",
    ),
    Doubt.DROVE_ON: (
        "two other road users near the ego collide and drive on",
        ": SUMO stops nobody, and what comes of it is not what happens on a road (column unconfirmed)",
    ),
}  # fmt: skip
"""What happens in runs that are doubtful by how somebody moves, and why."""


def sentences_of(conclusion: Conclusion, facts: Facts) -> list[str]:
    """Return the sentences of a conclusion, and what a metric of the requirement is that has no unit, where that is known."""
    said = conclusion.sentences(facts)
    violating = _violating(facts)
    if said and violating:
        which = f"Run {violating[0]}, which failed, is critical by what it gave; it counts"
        if len(violating) > 1:
            such = f"{len(violating):,} of the runs that failed (such as run {violating[0]})"
            which = f"{such} are critical by what they gave; they count"
        rule = "as failed, not as critical: give the metric that was no number a value for where there is none"
        said = [*said[:3], f"{which} {rule}.", *said[3:]]
    if said:
        said = [*said, *_doubted(facts)]
    bare = [part.metric for part in facts.requirement.parts if not unit_of(facts.units, part.metric)]
    meant = [f"{metric}: {facts.meanings[metric]}." for metric in bare if metric in facts.meanings]
    return said and [*said, *meant, *facts.notes]


def _doubted(facts: Facts) -> list[str]:
    """Return how many runs, and critical ones, are doubtful by how somebody moves."""
    found, critical = [], facts.requirement.critical_runs(facts.history)
    for doubt, (happens, why) in _MOVED.items():
        doubted = facts.history.doubtful(doubt)
        if doubted.any():
            n = int((doubted & critical).sum())
            also = f" {n:,} of them {'is' if n == 1 else 'are'} critical." if n else ""
            found.append(f"In {int(doubted.sum()):,} of {len(facts.history):,} runs {happens}{why}.{also}")
    return found


def _violating(facts: Facts) -> list[int]:
    """Return the indices of failed runs that are critical by the metrics which they gave."""
    lost = facts.history.where(~facts.history.ok)
    gave = [given(str(reason)) for reason in lost.reason]
    some = np.flatnonzero([bool(metrics) for metrics in gave])
    y = np.array([[gave[k].get(part.metric, np.nan) for part in facts.requirement.parts] for k in some])
    if not len(some):
        return []
    critical = facts.requirement.critical.contains(y if facts.requirement.combined else y[:, 0])
    return [int(index) for index in lost.index[some[critical]]]


def notes_of(scenario: LogicalScenario) -> tuple[str, ...]:
    """Return in sentences what is to be known of the rows of a recorded table; nothing of a scenario that is run."""
    if scenario.pool is None:
        return ()
    uneven = f"The rows are not spread evenly over the parameter space ({scenario.uneven}): shares of them are none of it."
    return (*scenario.pool.told(scenario.requirement), *((uneven,) if scenario.uneven else ()))


def few_combinations(scenario: LogicalScenario) -> int | None:
    """Return the number of combinations of whole numbers and choices that can be run; None where they are not few."""
    points = None if scenario.pool is not None else scenario.space.combinations
    return None if points is None else len(points)


class Stage(Protocol):
    """Proposes batches until it stops; a function of the log alone."""

    @property
    def name(self) -> str:
        """What its iterations are called in the store."""
        ...

    def stop(self, log: Log) -> str | None:
        """Return why the stage is over, None while it goes on; of a later stage `BACK` where the first one goes on."""
        ...

    def propose(self, log: Log) -> Batch:
        """Return the next batch; only called where `stop` gave None."""
        ...


@runtime_checkable
class LooksAhead(Stage, Protocol):
    """A stage whose batches may be chosen while earlier ones are run."""

    @property
    def ahead(self) -> int:
        """Number of batches in flight that a proposal does not wait for, >= 0."""
        ...


def proposed(stage: Stage, log: Log, campaign: Campaign) -> Batch:
    """Return the next batch of a stage of a campaign; of recorded inputs with several rows, the seed says which of them.

    Raises:
        InputError: it has no runs, or some that break the constraints.
    """
    batch, space, recorded = stage.propose(log), campaign.space, campaign.recorded
    if not batch.runs:
        raise InputError(f"stage {stage.name} must propose runs or stop, but it did neither")
    if space is not None and space.constraints:
        _check_constraints(stage.name, batch.runs, space)
    if recorded is None or not recorded.repeats:
        return batch
    known = log.planned
    x = as_numbers([[run.inputs[name] for name in known.names] for run in batch.runs], known.names, known.choices)
    numbers = recorded.numbers(known.x, x)
    runs = [r if k is None else replace(r, seed=k, blind=True) for r, k in zip(batch.runs, numbers, strict=True)]
    return replace(batch, runs=runs)


def _check_constraints(stage: str, runs: Sequence[PlannedRun], space: ParameterSpace) -> None:
    """Refuse runs of a stage that break the constraints."""
    rows = [[run.inputs[name] for name in space.names] for run in runs] if not isinstance(runs, PlannedPoints) else []
    x = runs.x if isinstance(runs, PlannedPoints) else as_numbers(rows, space.names, space.choices)
    broken = np.flatnonzero(~space.satisfied(x))
    if len(broken):
        got = written(space.named(x[broken[0]]))
        raise InputError(f"stage {stage} must propose runs that satisfy '{space.rules}', but proposed {got}")


@dataclass(frozen=True)
class Campaign:
    """Stages one after the other, and what to conclude from the log in the end.

    Args:
        stages: propose the batches, one after the other; a later one may send the campaign back to the first.
        conclude: gives the conclusion, and the metamodel that was fitted for it.
        depends: how batches, or when they end, depend on results; None: not at all, so that all runs
            can be planned ahead and shared out.
        recorded: the rows that runs are; None: they are run.
        space: whose constraints every run satisfies; None: there are none.
    """

    stages: tuple[Stage, ...]
    conclude: Callable[[Log], tuple[Conclusion, FittedMetamodel | None]]
    depends: str | None = "each batch depends on all results before it"
    recorded: Pool | None = None
    space: ParameterSpace | None = None


@dataclass(frozen=True)
class Shard:
    """Every `of`-th run of a campaign, from run `number` - 1 on: number 1, ..., of.

    >>> [index for index in range(10) if index in Shard(2, 4)]
    [1, 5, 9]
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        """Check the rule."""
        if not 1 <= self.number <= self.of:
            raise InputError(f"a shard is I/N with 1 <= I <= N, but got {self}")

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard that is written I/N."""
        number, _, of = text.partition("/")
        if not (number.isdecimal() and of.isdecimal()):
            raise InputError(f"a shard is I/N, such as 3/10, but got '{text}'")
        return cls(int(number), int(of))

    def __str__(self) -> str:
        """Return I/N."""
        return f"{self.number}/{self.of}"

    def __contains__(self, index: int) -> bool:
        """Return whether the run of this index belongs to the shard."""
        return index % self.of == self.number - 1


@dataclass(frozen=True)
class Progress:
    """Where a campaign stands, for a progress bar."""

    done: int
    budget: int
    failed: int
    critical: int
    iteration: int
    activity: str
