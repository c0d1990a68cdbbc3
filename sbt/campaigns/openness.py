"""What critical shares leave open where it is not known whether a run gives a metric."""

from __future__ import annotations

import numpy as np

from sbt.loop.learner import FittedMetamodel, Learner

__all__ = ["open_range"]

_SURE = 0.95  # P(a run gives a metric), from which on it does, and below 1 - which it fails
_MATTERS = 0.2  # of the share, by which its ends must differ to be told
_BY_CHANCE = 0.8  # share of the variance of "gives a metric" that inputs leave open, from which on runs fail by chance


def open_range(learner: Learner, fitted: FittedMetamodel) -> tuple[float, float] | None:
    """Return the least and the largest critical share of what gives a metric; None where no run fails, or it hardly matters.

    Least: where it is open whether a run gives a metric, what is critical fails and the rest does not; largest: the other way
    round. Where runs fail by chance nothing is open: their mean is what counts.
    """
    if fitted.log_success is None:
        return None
    u = learner.probe
    p, ok = fitted.predict(u).probability(learner.scenario.requirement.critical), np.exp(fitted.log_success(u))
    mean = float(ok.mean())
    if float((ok * (1.0 - ok)).mean()) > _BY_CHANCE * mean * (1.0 - mean):
        return None
    sure, doubtful = ok >= _SURE, (ok < _SURE) & (ok > 1.0 - _SURE)
    critical, beside, safe = float(p[sure].sum()), float(p[doubtful].sum()), float((1.0 - p[doubtful]).sum())
    n = float(sure.sum())
    if n == 0.0:
        return None
    least, most = critical / (n + safe), (critical + beside) / (n + beside)
    return (least, most) if most - least > _MATTERS * max(float(np.average(p, weights=ok)), 1e-12) and most > 1e-3 else None
