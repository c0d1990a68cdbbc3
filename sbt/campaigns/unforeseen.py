"""How much of the space lies on the side that the metamodel excludes, as far as runs tell that no metamodel chose."""

from __future__ import annotations

import math

import numpy as np

from sbt.acquisitions import even
from sbt.campaigns.exploration import space_filling
from sbt.campaigns.settings import Settings
from sbt.loop.learner import FittedMetamodel, Learner, chunked
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Vector

__all__ = ["lacking", "unforeseen_share"]

_EXCLUDED = 0.05
"""P below which a side is excluded, as of the ambiguous volume: what is likelier is expected on the wrong side anyway."""
_FOLDS = 5


def lacking(settings: Settings, log: Log, learner: Learner, share: float) -> int:
    """Return how many further runs that fill the space it takes until there are 1 / share, so that few miss as large a part."""
    return max(math.ceil(1.0 / share) - _count(settings, log, learner), 0)


def unforeseen_share(settings: Settings, log: Log, learner: Learner, fitted: FittedMetamodel, most: float) -> float:
    """Return the share of the space to expect on the side that the metamodel excludes: (k + 1/2) / (n + 1), by Jeffreys' prior.

    Of n runs that fill the space k, beyond those that the metamodel expects, lie on a side that it excludes without having
    learned from them: held-out runs (of a table, the rows that are left), and the others, a fifth at a time left out. Where the
    share is above `most` even with k = 0, that one is returned.
    """
    n, missed = _count(settings, log, learner), 0.0
    if 0.5 / (n + 1.0) > most:
        return 0.5 / (n + 1.0)
    training, filling = log.history.training, _filling(settings, log)
    (x, y), space, requirement = learner.unseen(log.history), settings.scenario.space, settings.scenario.requirement
    if len(y):
        p = chunked(fitted.predict, space.to_unit(x)).probability(requirement.critical)
        missed += _missed(p, requirement.critical.contains(y))
    fold = np.where(filling, np.cumsum(filling) % _FOLDS, _FOLDS)
    for k in np.unique(fold[filling]).tolist():
        left, rest = training.where(fold == k), training.where(fold != k)
        p = learner.on_inputs(learner.train(rest), len(rest))(space.to_unit(left.x)).probability(requirement.critical)
        missed += _missed(p, requirement.critical_runs(left))
    return (max(missed, 0.0) + 0.5) / (n + 1.0)


def _count(settings: Settings, log: Log, learner: Learner) -> int:
    """Return how many runs fill the space; of a recorded table the rows that are left count, too."""
    return len(learner.unseen(log.history)[1]) + int(_filling(settings, log).sum())


def _filling(settings: Settings, log: Log) -> Mask:
    """Return which of the training runs fill the space."""
    filling = space_filling(log) | (settings.acquisition is even)
    return np.isin(log.history.training.index, log.history.index[filling])


def _missed(p: Vector, critical: Mask) -> float:
    """Return how many of runs with P(critical) (n,) lie on a side that it excludes, beyond those that it expects there.

    >>> round(_missed(np.array([0.01, 0.99, 0.4, 0.02]), np.array([True, True, True, False])), 2)  # the first one
    0.96
    """
    unlikely = np.minimum(p, 1.0 - p)
    sure = unlikely < _EXCLUDED
    return float(((p > 0.5) != critical)[sure].sum() - unlikely[sure].sum())
