"""Runs of an estimation that only teach: chosen where the metamodel's doubt weighs most, and apart from each other.

Runs that count are drawn independently of what lies around them, so that their density is known. Runs that only teach need none:
points that represent the doubt shrink it faster than draws from it, several of which may fall into one place.
"""

from __future__ import annotations

import numpy as np

from sbt.estimators.importance import Plan, rows_at
from sbt.problem.arrays import Points, Vector
from sbt.samplers.greedy import select_representative

__all__ = ["select_teaching"]

_REPRESENTED = 600
"""Guided draws that are represented by those that teach."""
_LEAST_SPREAD = 0.1
"""Of the coordinates of guided draws, in normal scores: they are distances in units of it."""


def select_teaching(plan: Plan, n: int, points: Points, existing: Points, rng: np.random.Generator) -> tuple[Vector, int]:
    """Return n rows of the pool for runs that only teach, and how many of them, the first, are nominal draws.

    The nominal share is drawn independently, what neither the nominal distribution nor the metamodel guides systematically.
    In place of guided draws are points that represent them: those that leave the least of the doubt far from a run.

    Args:
        plan: of the pool.
        n: number of rows.
        points: (N, m) coordinates of the pool.
        existing: (k, m) those of earlier runs, k >= 1.
        rng: the only source of randomness.
    """
    nominal = int(plan.nominal * n + rng.random())
    known = rows_at(plan.nominal_probability, rng.random(nominal))
    blind = min(int((1.0 - plan.nominal - plan.guided_share) * n + rng.random()), n - nominal)
    rest = np.maximum(plan.probability - plan.nominal * plan.nominal_probability - plan.guided_share * plan.guided, 0.0)
    spread = np.unique(rows_at(rest, (np.arange(blind) + rng.random()) / max(blind, 1)))
    among, times = np.unique(rows_at(plan.guided, (np.arange(_REPRESENTED) + rng.random()) / _REPRESENTED), return_counts=True)
    scale = 1.0 / (points[among].std(axis=0) + _LEAST_SPREAD)
    there = np.vstack([existing, points[known], points[spread]])
    chosen = among[select_representative(points[among], times.astype(np.float64), there, n - nominal - len(spread), scale)]
    found = np.concatenate([known, spread, chosen])
    others = np.setdiff1d(np.arange(len(points)), found)
    likeliest = others[np.argsort(-plan.probability[others], kind="stable")]  # where few points hold all of the doubt
    return np.concatenate([found, likeliest[: n - len(found)]]), nominal
