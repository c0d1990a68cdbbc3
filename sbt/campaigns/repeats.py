"""Is the simulator noisy? Runs that repeat inputs with other seeds, and what they tell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sbt.campaigns.wording import number, percent, plural
from sbt.problem.arrays import Points, Vector
from sbt.problem.plain import Json
from sbt.problem.requirement import Requirement, within_scale
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.store.database import PlannedRun
from sbt.store.history import PLANNED, History
from sbt.store.records import optional, to_json

__all__ = ["REPEAT", "WANTED", "SimulatorNoise", "equal_inputs", "repeats_wanted", "simulator_noise", "stated_noise"]

REPEAT = "repeat"
"""Stage of the early runs that repeat inputs with other seeds; metamodels learn from them."""
WANTED = 2
"""Early repeats: all that a deterministic simulator costs. A noisy one gives itself away by the first, unless the metric stands
at an end of its range."""
_ATTEMPTS = 4
"""Most of them, where some fail."""
_HITS_AGAIN = 5
"""Repeats of critical inputs, where the metric has few values: two of them agree by chance where every other seed fails."""
_ALONE, _ALONE_AGAIN, _MOST_ALONE, _SURPRISING = 3, 3, 9, 1.5
"""A critical run stands alone where so many nearest inputs are uncritical. Of those so many are repeated that differ most from
what is near them: what fails with one seed in a hundred, wherever, no repeat of other runs shows. Of a smooth region the first
ones stand alone too, but differ little, and tell nothing of others: up to so many critical inputs are repeated where one differs
by this factor more than all before."""
_FEW_VALUES, _SHARE_OF_VALUES = 3, 0.1
"""A metric has few values where there are at most three, or a tenth of the runs."""
_DOUBT = 0.05
"""That noise in some share of the pairs was met by none of them."""
_DOUBT_OF_FEW = 1e-3
"""The same where a metric has few values, of each of them: one input in ten may fail with one seed in twenty."""
_EQUAL = 1e-9
"""Relative difference up to which two values of a metric are the same: the last digits of a sum are no noise."""


@dataclass(frozen=True)
class SimulatorNoise:
    """What runs of equal inputs and different seeds tell of the simulator.

    Attributes:
        repeats: runs beyond the first one at the same inputs; only those that gave metrics count.
        noisy: some metric differed; False: none did; None: nothing was repeated.
        std: pooled standard deviation of the requirement's metric at equal inputs; None: nothing was repeated.
        lost: inputs at which a run gave a metric and another one, with another seed, gave none; None: there are none.
        inputs: different inputs that were repeated; None: nothing was.
        silent: no metric differed, but they have values there that other inputs gave too, such as 0: repeats agree by chance.
    """

    repeats: int
    noisy: bool | None
    std: float | None
    lost: int | None = optional()
    inputs: int | None = optional()
    silent: bool | None = optional()

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        found: Json = to_json(self)
        return found

    def sentences(self, metric: str, unit: str = "") -> list[str]:
        """Return in words what is known; nothing where nothing was repeated."""
        if self.lost is None:
            return self._of_metrics(metric, unit)
        places = "the same inputs" if self.lost == 1 else f"{self.lost} inputs"
        alike = f"at {places} a run gave a metric, and one with another seed gave none"
        said = f"The seed decides, too, whether a run fails: {alike}."
        return [said, *(self._of_metrics(metric, unit) if self.noisy else ())]

    def _of_metrics(self, metric: str, unit: str) -> list[str]:
        if self.noisy is None or self.std is None:
            return []
        again = f"{plural(self.repeats, 'run')} repeated inputs with other seeds"
        if not self.noisy:
            n = self.inputs or self.repeats  # repetitions of one input are no independent looks
            missed, sure = percent(1.0 - _DOUBT ** (1.0 / n)), percent(1.0 - _DOUBT)
            at = "the only input that was" if n == 1 else "both inputs that were" if n == 2 else f"all {n} inputs that were"
            said = f"No noise was met: metrics were equal at {at} repeated with other seeds, near the critical interval or in it"
            if self.silent:
                said += ", with values that so many other inputs gave, too, that noise would hardly show"
            return [f"{said}; with {sure} confidence noise shows at less than {missed} of such inputs. Others were not repeated."]
        if self.std == 0.0:
            return [f"The simulator is noisy: where {again}, other metrics differed; {metric} did not."]
        spread = f"{number(self.std, 3)} {unit}".rstrip()
        return [f"The simulator is noisy: where {again}, {metric} has a standard deviation of {spread}."]


def equal_inputs(x: Points) -> NDArray[np.intp]:
    """Return (n,) numbers from 0, the same for rows of x (n, d) that are equal."""
    return np.unique(x, axis=0, return_inverse=True)[1].reshape(-1)


def simulator_noise(history: History, requirement: Requirement) -> SimulatorNoise:
    """Return what these runs tell of the simulator's noise, in the requirement's metric and in all others."""
    runs = history.where(history.ok & history.drawn & (history.columns["level"] == 0))
    if len(runs) < 2:
        return SimulatorNoise(0, None, None)
    group = equal_inputs(runs.x)
    size = np.bincount(group)
    repeats = int((size - 1).sum())
    if repeats == 0:
        return SimulatorNoise(0, None, None)
    noisy = any(_differs(runs.y(name), group) for name in runs.metrics)
    y = requirement.told(runs)
    inputs = int((size > 1).sum())
    if not _differs(y, group):
        silent = True if not noisy and _silent(runs, group, size) else None
        return SimulatorNoise(repeats, noisy, 0.0, inputs=inputs, silent=silent)
    std = _pooled(y, group) or _pooled(within_scale(y, requirement.critical), group)  # at times infinite, at times not
    return SimulatorNoise(repeats, noisy, std, inputs=inputs)


def _silent(runs: History, group: NDArray[np.intp], size: NDArray[np.intp]) -> bool:
    """Return whether repeats (`size` runs of each group, all equal) could agree by chance.

    A run that depends on its seed alone agrees as often as other inputs gave the same metrics. Of few values each must be ruled
    out for itself: where failures are certain, they may be a matter of chance elsewhere.
    """
    metrics = np.column_stack([runs.y(name) for name in runs.metrics])[np.unique(group, return_index=True)[1]]
    which, count = np.unique(np.nan_to_num(metrics, nan=-np.inf), axis=0, return_inverse=True, return_counts=True)[1:]
    value, log_share = which.reshape(-1), np.log(count / count.sum())
    chance = np.bincount(value, (size - 1) * log_share[value], len(count))
    few = len(count) <= max(_FEW_VALUES, _SHARE_OF_VALUES * len(value))
    return bool(chance.max() > np.log(_DOUBT_OF_FEW) if few else chance.sum() > np.log(_DOUBT))


def _pooled(y: Vector, group: NDArray[np.intp]) -> float:
    """Return the standard deviation within groups of the finite values among y (n,)."""
    y, group = y[np.isfinite(y)], group[np.isfinite(y)]
    count = np.bincount(group, minlength=1)
    mean = np.bincount(group, y, len(count)) / np.maximum(count, 1)
    return float(np.sqrt(((y - mean[group]) ** 2).sum() / max(int((count - 1).clip(0).sum()), 1)))


def stated_noise(history: History, scenario: LogicalScenario) -> SimulatorNoise | None:
    """Return what a conclusion says of the simulator's noise; None for recorded rows, which nothing simulates."""
    return replace(simulator_noise(history, scenario.requirement), lost=_lost(history)) if scenario.pool is None else None


def _lost(history: History) -> int | None:
    """Return at how many inputs some runs gave a metric and others gave none; None: at none."""
    runs = history.where((history.status != PLANNED) & history.drawn & (history.columns["level"] == 0))
    if not len(runs):
        return None
    group = equal_inputs(runs.x)
    gave, all_ = np.bincount(group, runs.ok), np.bincount(group)
    return int(((gave > 0) & (gave < all_)).sum()) or None


def _differs(y: NDArray[np.float64], group: NDArray[np.intp]) -> bool:
    """Say whether a metric (n,) has different values in one group; NaN is a value, and the same as NaN."""
    first = y[np.unique(group, return_index=True)[1]][group]
    return not np.isclose(y, first, rtol=_EQUAL, atol=1e-300, equal_nan=True).all()


def repeats_wanted(history: History, scenario: LogicalScenario, most: int) -> tuple[PlannedRun, ...]:
    """Return up to `most` runs that repeat inputs of earlier ones, until two repeats gave metrics.

    Those with the smallest margin are repeated; values that other inputs gave too come last: there the metric stands at an end of
    its range, and hides the noise. As long as all agree, critical runs that stand alone are repeated as well, up to three, and,
    where a metric has few values, such as 0 and 1, critical inputs up to five times. Recorded rows cannot be repeated.
    """
    runs = history.training
    noise, again = simulator_noise(history, scenario.requirement), history.where(history.stage == REPEAT)
    awaited = int((again.status == PLANNED).sum())
    n = min(WANTED - noise.repeats - awaited, _ATTEMPTS - len(again), most)
    if scenario.pool is not None or len(runs) == 0:
        return ()
    y, margin = scenario.requirement.told(runs), scenario.requirement.margins(runs)
    values, which, count = np.unique(y, return_inverse=True, return_counts=True)
    if n <= 0:
        if noise.noisy is not False or awaited:
            return ()
        if len(values) <= max(_FEW_VALUES, _SHARE_OF_VALUES * len(runs)) < len(runs):
            return _hits_again(runs, again, margin, most)
        return _alone_again(runs, again, margin, scenario.space, most)
    common = count[which.reshape(-1)] > 1
    tried_at = {tuple(row) for row in again.x}
    order = [k for k in np.lexsort((margin, common)) if tuple(runs.x[k]) not in tried_at]
    return tuple(PlannedRun(REPEAT, runs.inputs(int(k))) for k in order[:n])


def _hits_again(runs: History, again: History, margin: Vector, most: int) -> tuple[PlannedRun, ...]:
    """Return repeats of critical inputs, in turn, until there are enough of them."""
    hits = runs.where(margin <= 0.0)
    if len(hits) == 0:
        return ()
    first = np.unique(hits.x, axis=0, return_index=True)[1]
    done = np.array([int((again.x == hits.x[k]).all(axis=1).sum()) for k in first])
    n = min(_HITS_AGAIN - int(done.sum()), most)
    order = [first[k] for k in np.argsort(done, kind="stable")]
    return tuple(PlannedRun(REPEAT, hits.inputs(int(order[k % len(order)]))) for k in range(n))


def _alone_again(runs: History, again: History, margin: Vector, space: ParameterSpace, most: int) -> tuple[PlannedRun, ...]:
    """Return repeats of critical runs that no other is near, of those that differ most from what is, each once."""
    x, first = np.unique(runs.x, axis=0, return_index=True)
    critical = margin[first] <= 0.0
    if len(x) <= _ALONE or not critical.any():
        return ()
    u = space.to_unit(x)
    near = cKDTree(u).query(u[critical], k=_ALONE + 1)[1][:, 1:]
    single = ~critical[near].any(axis=1)
    alone = first[critical][single]
    differ = np.nan_to_num(margin[first[near[single]]].mean(axis=1) - margin[alone])
    repeated = {tuple(row) for row in again.x}
    done = np.array([tuple(row) in repeated for row in runs.x[alone]], dtype=np.bool_)
    spent = sum(tuple(row) in repeated for row in x[critical])
    more = differ > _SURPRISING * differ[done].max(initial=0.0)  # than all that were repeated
    rows = [k for k in np.lexsort((alone, -differ))[:_ALONE_AGAIN] if not done[k] and (more[k] or spent < _ALONE_AGAIN)]
    n = min((_MOST_ALONE if spent >= _ALONE_AGAIN else _ALONE_AGAIN) - spent, most)
    return tuple(PlannedRun(REPEAT, runs.inputs(int(alone[k]))) for k in rows[: max(n, 0)])
