"""Failure modes: critical runs of one conflict type that the metamodel's critical region connects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from sbt.campaigns.between import RunsBetween
from sbt.campaigns.linking import Link, connected, pairs_joined
from sbt.campaigns.wording import input_widths, narrow_digits
from sbt.estimators.binomial import interval
from sbt.metrics.conflict_types import METRIC_NAME as CONFLICT_TYPE
from sbt.metrics.conflict_types import describe_conflict_type, without_standing
from sbt.problem.arrays import Mask, Vector
from sbt.problem.plain import Value
from sbt.problem.requirement import Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.search import WarpedModel
from sbt.store.history import History
from sbt.store.records import Judgement, optional

__all__ = [
    "FailureMode", "FailureRate", "Mode", "NearestSafe", "RunPoint", "critical_groups", "describe", "modes_of",
    "most_often", "representative_of", "single", "violations",
]  # fmt: skip

_MOST = 200  # critical runs that are compared with each other; further ones join the nearest
_UNMEASURED = -2.0
_FAR = 1e6  # beyond any distance in the unit cube
_NOT_WITHIN = 1e-9
_RATE_STEPS, _LEAST_RATE = 100, 1e-12  # failure rates within a hundredth of themselves are alike: depth decides


@dataclass(frozen=True)
class Mode:
    """A failure mode.

    Args:
        rows: of its critical runs in the history.
        representative: the row deepest in the critical interval; with a noisy simulator the one of the largest failure rate
            (`rates.local_rates`), for depth is luck.
        most_likely: the row of largest p(x).
        safe: the uncritical row nearest to the representative in the unit cube; None: there is none.
    """

    rows: tuple[int, ...]
    representative: int
    most_likely: int
    safe: int | None


@dataclass(frozen=True)
class RunPoint:
    """A run, its inputs and its metric; None: it is infinite."""

    run: int
    inputs: Mapping[str, Value]
    metric: float | None


@dataclass(frozen=True)
class NearestSafe:
    """The uncritical run nearest to a failure, and the change of each input that differs: a difference, or the other choice."""

    run: int
    inputs: Mapping[str, Value]
    metric: float | None
    change: Mapping[str, Value]


@dataclass(frozen=True)
class FailureRate:
    """How often runs of the same inputs and fresh seeds are critical.

    Attributes:
        estimate: share of critical ones among those that gave a metric; None: none did.
        low, high: ends of its exact binomial interval; failed runs count as uncritical for the low end, as critical for the high.
        confidence: of the interval.
        runs: repetitions, all after representatives and order were chosen.
    """

    estimate: float | None
    low: float
    high: float
    confidence: float
    runs: int

    @classmethod
    def of(cls, critical: Mask, failed: Mask) -> FailureRate:
        """Return the rate of repetitions that were critical (n,) or failed (n,)."""
        hits, lost, n = int(critical.sum()), int(failed.sum()), len(critical)
        low, high = float(interval(hits, n)[0]), float(interval(hits + lost, n)[1])
        return cls(hits / (n - lost) if n > lost else None, low, high, 0.95, n)


@dataclass(frozen=True)
class FailureMode:
    """A distinct way to fail, as the conclusion tells it.

    Attributes:
        representative: index of its run deepest in the critical interval, or most likely to fail again (see `Mode`).
        inputs, metric: of the representative; a metric of None is infinite.
        size: critical runs in it, of the search and between its runs.
        conflict: how ego and the nearest other met; None where it is not measured.
        runs: their indices.
        confirmed: share of the repetitions of the representative with fresh seeds that were critical, of those that gave a
            metric; None: none did, or it was not repeated.
        confirmation_runs: repetitions.
        confirmations_lost: repetitions that gave no metric; None: all gave one.
        failure_rate: of the representative's inputs, where the simulator is noisy; None: it is not, or nothing was repeated.
        most_likely: its run of largest density.
        nearest_safe: the uncritical run nearest to the representative; None: there is none.
        preventable: what the reference drivers made of the representative; None: they were not asked.
        violates: of a combination, how many of its runs violate each requirement.
        choices: of inputs with choices, all that its critical runs have, where they have several.
        digits: significant digits that tell inputs of a narrow range, by name; None: three are enough.
        unconfirmed: its critical runs with a contact that SUMO's own list does not confirm.
    """

    representative: int
    inputs: Mapping[str, Value]
    metric: float | None
    size: int
    conflict: str | None
    runs: tuple[int, ...]
    confirmed: float | None
    confirmation_runs: int
    most_likely: RunPoint
    nearest_safe: NearestSafe | None
    preventable: tuple[Judgement, ...] | None = optional()
    unconfirmed: int = 0
    violates: Mapping[str, int] | None = optional()
    failure_rate: FailureRate | None = optional()
    confirmations_lost: int | None = optional()
    choices: Mapping[str, tuple[str, ...]] | None = optional()
    digits: Mapping[str, int] | None = optional()

    @property
    def came_back(self) -> tuple[int, int]:
        """How many of the repetitions were critical, and how many gave a metric."""
        gave = self.confirmation_runs - (self.confirmations_lost or 0)
        return round((self.confirmed or 0.0) * gave), gave

    @property
    def never(self) -> str:
        """With which seed to pin it, and why, in words; empty where it came back, or was not repeated."""
        again, gave = self.came_back
        if again or not self.confirmation_runs:
            return ""
        return f", with its own seed, as no repetition {'was critical' if gave else 'gave a metric'}"


def severity(history: History) -> Vector:
    """Return (n,) how bad runs are among those with the same margin, as of a metric that saturates: the speed of impact.

    0 where none was measured.
    """
    if "impact_speed" not in history.metrics:
        return np.zeros(len(history))
    return np.nan_to_num(history.y("impact_speed"))


def worst_first(history: History, margins: Vector) -> NDArray[np.int64]:
    """Return (n,) the rows by margin, the smallest first, those with the same margin by severity, what has no margin last."""
    return np.lexsort((-severity(history), margins))


def modes_of(
    fitted: WarpedModel, history: History, scenario: LogicalScenario, *, rates: Vector | None = None, links: Sequence[Link] = (),
    between: RunsBetween | None = None,
) -> list[Mode]:  # fmt: skip
    """Return the failure modes, the one with the deepest run first; of a noisy simulator the likeliest to fail again first.

    Repetitions that are told do not decide the order: the rate of the one that failed most often in them would be stated
    too large.

    Args:
        fitted: learned from these runs.
        history: runs; only finished ones count.
        scenario: with the campaign's space and requirement.
        rates: (n,) failure rates at these runs, where the simulator is noisy, see `connected` and `Mode`; None: it is not.
        links: runs among them that were made between critical ones.
        between: with noise, what runs tell of the ways between those of `critical_groups`.
    """
    critical = scenario.requirement.critical
    y = scenario.requirement.values(history)
    chosen, kind = critical_groups(history, scenario)
    hits = np.flatnonzero(scenario.requirement.critical_runs(history))
    if len(hits) == 0:
        return []
    u, cube = scenario.space.to_unit(history.x), scenario.space.cube
    at = cube.embedded(u)
    depth, worse = scenario.requirement.depths(history), severity(history)
    tested, sure = (pairs_joined(links, history.index[chosen].tolist(), nested=times) for times in (1, 2))
    group = connected(
        fitted, u[chosen], kind[chosen], noisy=rates is not None, tested=tested, sure=sure, cube=cube, between=between
    )
    log_rate = np.zeros(len(history)) if rates is None else np.log(np.maximum(rates, _LEAST_RATE))
    apart = kind[hits][:, None] != kind[chosen][None, :]
    label = group[(cdist(at[hits], at[chosen]) + _FAR * apart).argmin(axis=1)]
    log_p = scenario.space.log_density(history.x[hits])
    uncritical = np.flatnonzero(critical.known(y) & ~critical.contains(y))
    found = []
    for name in np.unique(label):
        rows = hits[label == name]
        representative = int(rows[representative_of(log_rate[rows], depth[rows], worse[rows])])
        likely = int(rows[np.argmax(log_p[label == name])])
        safe = int(uncritical[cdist(at[[representative]], at[uncritical])[0].argmin()]) if len(uncritical) else None
        found.append(Mode(tuple(int(k) for k in rows), representative, likely, safe))
    rank = (-np.round(_RATE_STEPS * log_rate), depth, -worse, np.arange(len(history)))
    return sorted(found, key=lambda mode: tuple(by[mode.representative] for by in rank))


def critical_groups(history: History, scenario: LogicalScenario) -> tuple[NDArray[np.intp], Vector]:
    """Return the rows of the critical runs that are compared with each other, and (n,) the kind of each run of the history."""
    hits = np.flatnonzero(scenario.requirement.critical_runs(history))
    depth = scenario.requirement.depths(history)
    chosen = hits[np.argsort(depth[hits], kind="stable")][:_MOST]
    types = without_standing(np.nan_to_num(history.y(CONFLICT_TYPE), nan=_UNMEASURED))
    return chosen, np.unique(types, return_inverse=True)[1].reshape(-1).astype(np.float64)


def representative_of(log_rate: Vector, depth: Vector, worse: Vector) -> int:
    """Return which of n critical runs stands for its mode: the likeliest to fail again, of those alike the deepest.

    Alike is relative: where noise decides, the best place may fail with one seed in ten, and others with one in twenty.

    Args:
        log_rate: (n,) logarithms of failure rates; all alike where the simulator is deterministic.
        depth: (n,) margin, smaller is deeper.
        worse: (n,) severity.
    """
    return int(np.lexsort((-worse, depth, -np.round(_RATE_STEPS * log_rate)))[0])


def describe(mode: Mode, history: History, scenario: LogicalScenario, again: History, *, noisy: bool = False) -> FailureMode:
    """Return what is said of a mode.

    Args:
        mode: rows of the history.
        history: the runs.
        scenario: with the campaign's space and requirement.
        again: the representative's runs with fresh seeds.
        noisy: the simulator is: the mode has a failure rate.
    """
    requirement = scenario.requirement
    y, at, likely = requirement.told(history), mode.representative, mode.most_likely
    inputs = history.inputs(at)
    conflict = history.y(CONFLICT_TYPE)[at]
    return FailureMode(
        int(history.index[at]), inputs, float(y[at]), len(mode.rows),
        describe_conflict_type(-1.0 if np.isnan(conflict) else float(conflict)),
        tuple(int(history.index[k]) for k in mode.rows),
        float(requirement.critical_runs(again)[again.ok].mean()) if again.ok.any() else None, len(again),
        RunPoint(int(history.index[likely]), history.inputs(likely), float(y[likely])),
        None if mode.safe is None else _nearest_safe(mode.safe, inputs, history, y),
        unconfirmed=int(history.unconfirmed[list(mode.rows)].sum()),
        violates=violations(requirement, history.where(np.isin(np.arange(len(history)), mode.rows))),
        failure_rate=FailureRate.of(requirement.critical_runs(again), ~again.ok) if noisy and len(again) else None,
        confirmations_lost=int((~again.ok).sum()) or None, choices=_choices_of(mode, history) or None,
        digits=narrow_digits(inputs, input_widths(history)) or None,
    )  # fmt: skip


def _choices_of(mode: Mode, history: History) -> dict[str, tuple[str, ...]]:
    """Return all choices that a mode's runs have, in their order, of inputs of which they have several."""
    cells = {name: np.unique(history.x[list(mode.rows), history.names.index(name)]).astype(int) for name in history.choices}
    return {name: tuple(history.choices[name][k] for k in found) for name, found in cells.items() if len(found) > 1}


def single(modes: Sequence[FailureMode], history: History) -> int:
    """Return how many modes are of one input each: a thin or bent critical region gives many."""
    row = {int(index): k for k, index in enumerate(history.index)}
    return sum(len(np.unique(history.x[[row[run] for run in mode.runs]], axis=0)) == 1 for mode in modes)


def violations(requirement: Requirement, runs: History) -> dict[str, int] | None:
    """Return how many of these runs violate each requirement of a combination, those that none violates left out; else None."""
    if not requirement.combined:
        return None
    counts = {part.label: int(part.critical_runs(runs).sum()) for part in requirement.parts}
    return {name: count for name, count in counts.items() if count}


def _nearest_safe(row: int, inputs: Mapping[str, Value], history: History, y: Vector) -> NearestSafe:
    """Return an uncritical run, and how it differs from these inputs."""
    safe = history.inputs(row)
    change = {name: _change(value, safe[name]) for name, value in inputs.items()}
    return NearestSafe(int(history.index[row]), safe, float(y[row]), {k: v for k, v in change.items() if v is not None})


def _change(value: Value, other: Value) -> Value | None:
    """Return the other choice, or how much the other number is larger; None where there is no difference."""
    if isinstance(value, str) or isinstance(other, str):
        return None if other == value else other
    return other - value if abs(other - value) > _NOT_WITHIN * abs(value) else None


def most_often(modes: Sequence[FailureMode]) -> FailureMode | None:
    """Return the first mode, or one whose repetitions came back clearly more often: the interval lies above the first's share."""

    def least(mode: FailureMode) -> float:
        return float(interval(*mode.came_back)[0])

    above = [mode for mode in modes[1:] if least(mode) > (modes[0].confirmed or 0.0)]
    return max(above, key=lambda mode: mode.confirmed or 0.0) if above else next(iter(modes), None)
