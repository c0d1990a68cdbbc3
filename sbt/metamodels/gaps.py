"""A gap between critical and uncritical values of a metric, and the unit without it.

A metric jumps where contact, or a lane that is taken, adds a constant: the values on both sides go on as if nothing lay between
them. A process that learns them as they are must climb the jump, and noise on its two sides looks like noise of its height.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sbt.metamodels.base import gives_different
from sbt.metamodels.stacking import cell_shares, surely_positive
from sbt.metamodels.warp import Warp, gap_of
from sbt.metamodels.warped import better_warp
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

if TYPE_CHECKING:
    from sbt.metamodels.gaussian_process import GaussianProcess
    from sbt.metamodels.gp_predictor import GaussianProcessPredictor
    from sbt.metamodels.stepped import SteppedPredictor

__all__ = ["better_without_gap"]

_MOST = 1000
"""Rows up to which it is looked for: more show where the edge is."""
_SURE = 2.0
"""Standard errors by which sides have to be better known without the gap, where values do not tell."""
_LIKELIER = (1.0, 0.5)
"""Nats a row by which values are likelier where they go on beyond the gap, and of a noisy simulator: of such .7 to 4, of others
.1 to 1.5, as much as the jump alone costs. Beside noise sides hardly tell."""


def better_without_gap(
    settings: GaussianProcess, u: Points, y: Vector, critical: CriticalInterval, unit: Warp | None
) -> Warp | None:  # fmt: skip
    """Return a unit without the gap in which left-out rows are surely better known than in another one; else None.

    Their sides are, or their values are much likelier and their sides are known better, if not surely (of a noisy simulator: are
    known as well). In the other unit jumps are widened, or signed distances learned, where that is better (see `stepped`,
    `sided`).

    Args:
        settings: of the process.
        u: (n, d) rows, none of them twice with equal values.
        y: (n,) their metric.
        critical: M_c.
        unit: the other one; None: that of y.
    """
    gap, inside = gap_of(y, critical), critical.contains(y)
    flat = min(np.ptp(y[side]) if side.any() else 0.0 for side in (inside, ~inside)) == 0.0  # one value goes on to nothing
    warp = None if len(y) > _MOST or gap == (0.0, 0.0) or flat else better_warp(settings, u, y, critical, gap)
    if warp is None:
        return None
    shares = cell_shares(u, _generator())
    sides, values = _known(settings, u, y, critical, warp, shares) - _known(settings, u, y, critical, unit, shares)
    if surely_positive(sides, _SURE) and shares @ sides > 0.0:
        return warp
    noisy = gives_different(u, y)
    least = -float(sides.std()) / math.sqrt(len(sides)) if noisy else 0.0
    return warp if float(sides.mean()) > least and float(values.mean()) > _LIKELIER[noisy] else None


def _known(
    settings: GaussianProcess, u: Points, y: Vector, critical: CriticalInterval, unit: Warp | None, shares: Vector
) -> Points:  # fmt: skip
    """Return (2, n) log P(the side that a row fell on) and log density of its value, learned in a unit from all others."""
    from sbt.metamodels.sided import better_sided
    from sbt.metamodels.stepped import better_stepped, side_score

    rng = _generator()
    t, edges = (y, critical) if unit is None else (unit.values(y), unit.interval(critical))
    plain = settings.fit(u, t, rng)
    stepped = better_stepped(settings, plain, edges, u, t, shares, rng)
    values: GaussianProcessPredictor | SteppedPredictor = plain if stepped is None else stepped
    sided = better_sided(settings, values, edges, u, t, shares, rng)
    known = side_score(values.leave_one_out(u, t), t, edges)
    density = plain.leave_one_out(u, t).log_density(t) + (0.0 if unit is None else unit.log_slope(y))
    return np.stack([known if sided is None else known + sided[1], density])


def _generator() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(0))
