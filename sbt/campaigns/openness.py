"""What critical shares leave open where it is not known whether a run gives a metric."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sbt.campaigns.repeats import lost_inputs
from sbt.loop.learner import FittedMetamodel, Learner
from sbt.problem.arrays import Mask, Vector
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["fails_by_chance", "open_range"]

_SURE = 0.95  # P(a run gives a metric), from which on it does, and below 1 - which it fails
_MATTERS = 0.2  # of the share, by which its ends must differ to be told
_BY_CHANCE = 0.8  # share of the variance of "gives a metric" that inputs leave open, from which on runs may fail by chance
_FEWEST, _NEAREST, _SHUFFLES = 10, 3, 499  # failed runs that can tell it; nearest runs, and shuffles, by which they do
_LEVEL = 0.05  # at which failed runs lie no closer together than by chance
_NEARER = 3.0  # so many times nearer than the nearest run of the other kind a point has what the nearest run has


def fails_by_chance(learner: Learner, fitted: FittedMetamodel, history: History) -> bool:
    """Return whether runs fail wherever they lie: inputs explain little of it, and enough failed runs show that, or equal inputs.

    A metamodel of few failed runs explains little also where they fill a place of their own.
    """
    if fitted.log_success is None or _explained(np.exp(fitted.log_success(learner.probe))):
        return False
    if lost_inputs(history) is not None:
        return True
    failed = ~history.ok
    if failed.sum() < _FEWEST or len(history) <= _NEAREST:
        return False
    at = learner.scenario.space.cube.embedded(learner.scenario.space.to_unit(history.x))
    near = cKDTree(at).query(at, k=_NEAREST + 1)[1][:, 1:]
    rng = stream(0, "failed")
    shuffled = [failed[rng.permutation(len(failed))] for _ in range(_SHUFFLES)]
    beside = int(failed[near[failed]].sum())
    return sum(int(each[near[each]].sum()) >= beside for each in shuffled) + 1 > _LEVEL * (_SHUFFLES + 1)


def open_range(learner: Learner, fitted: FittedMetamodel, history: History) -> tuple[float, float] | None:
    """Return the least and the largest critical share of what gives a metric; None where no run fails, or it hardly matters.

    Least: where it is open whether a run gives a metric, what is critical fails and the rest does not; largest: the other way
    round. Where runs fail by chance nothing is open: their mean is what counts. Where the metamodel cannot say where they fail,
    the nearest runs do.
    """
    if fitted.log_success is None or fails_by_chance(learner, fitted, history):
        return None
    u = learner.probe
    p, ok = fitted.predict(u).probability(learner.scenario.requirement.critical), np.exp(fitted.log_success(u))
    sure, doubtful = (ok >= _SURE, (ok < _SURE) & (ok > 1.0 - _SURE)) if _explained(ok) else _by_nearest(learner, history)
    critical, beside, safe = float(p[sure].sum()), float(p[doubtful].sum()), float((1.0 - p[doubtful]).sum())
    n = float(sure.sum())
    if n == 0.0:
        return None
    least, most = critical / (n + safe), (critical + beside) / (n + beside)
    return (least, most) if most - least > _MATTERS * max(float(np.average(p, weights=ok)), 1e-12) and most > 1e-3 else None


def _explained(ok: Vector) -> bool:
    """Return whether inputs explain enough of whether a run gives a metric, by P of that over the space."""
    mean = float(ok.mean())
    return float((ok * (1.0 - ok)).mean()) <= _BY_CHANCE * mean * (1.0 - mean)


def _by_nearest(learner: Learner, history: History) -> tuple[Mask, Mask]:
    """Return where a run gives a metric, and where that is open, by which kind of run is much nearer."""
    space = learner.scenario.space
    at, u = space.cube.embedded(space.to_unit(history.x)), space.cube.embedded(learner.probe)
    gave, failed = (cKDTree(at[kind]).query(u)[0] for kind in (history.ok, ~history.ok))
    sure = gave * _NEARER < failed
    return sure, ~sure & (failed * _NEARER >= gave)
