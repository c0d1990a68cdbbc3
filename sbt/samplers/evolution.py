"""CMA-ES: replayed from the runs so far, so that no state is kept between batches."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube
from sbt.samplers.room import fill_uniformly
from sbt.samplers.search import Picks
from sbt.seeds import stream

__all__ = ["propose", "require"]

_SIGMA = 0.3  # of the unit cube, at each start: the range is about 3 sigma wide, as Hansen (2016) recommends
_FAILED = 1e9  # stands for the margin of a failed run: worse than all others
_DRAWN_AGAIN, _TIMES = 256, 64  # points at once in place of infeasible ones; of a narrow space uniform ones after so many times


def require() -> None:
    """Check that the library is installed.

    Raises:
        InputError: it is not.
    """
    if importlib.util.find_spec("cma") is None:
        raise InputError("acquisition cma_es needs the library cma, but it is not installed: pip install 'sumo-sbt[compare]'")


def propose(
    start: Vector, margins: Sequence[Vector], n: int, seed: int, cube: Cube = CONTINUOUS,
    feasible: Callable[[Points], Mask] = lambda u: np.ones(len(u), dtype=bool),
) -> Picks:  # fmt: skip
    """Return the next n points of a covariance matrix adaptation evolution strategy.

    The same seed and margins give the same points: earlier generations are drawn again and given their
    margins. A strategy that has converged is restarted at a random point. An input with choices has a coordinate for each
    of them, and takes the one of the largest: the strategy never moves between choices along their list. Infeasible points are
    drawn again.

    Args:
        start: (d,) where the first one starts, in the unit cube.
        margins: of each generation so far, one for each of its points; NaN where a run failed.
        n: points wanted >= 1.
        seed: of the campaign.
        cube: which coordinates take single values.
        feasible: (m, d) points to (m,) booleans.

    Raises:
        InputError: the library is not installed, or no point is feasible.

    Source:
        Hansen (2016), The CMA evolution strategy: a tutorial, arXiv 1604.00772; library pycma.
    """
    require()
    first = cube.embedded(start[None])[0]
    d, restarts = len(first), 0
    strategy = _started(first, n, seed, restarts)

    def points(embedded: Points) -> Points:
        return cube.restored(np.clip(embedded, 0.0, 1.0), len(start))

    def asked(size: int, number: int) -> Points:
        found = np.array(strategy.ask(size)).reshape(size, -1)[:, :d]
        bad = np.flatnonzero(~feasible(points(found)))
        for _ in range(_TIMES):
            if len(bad) == 0:
                return found
            again = np.array(strategy.ask(_DRAWN_AGAIN)).reshape(_DRAWN_AGAIN, -1)[:, :d]
            again = again[feasible(points(again))][: len(bad)]
            found[bad[: len(again)]], bad = again, bad[len(again) :]
        found[bad] = cube.embedded(fill_uniformly(feasible, len(bad), len(start), stream(seed, "cma", "feasible", number)))
        return found

    for number, values in enumerate(margins):
        generation = list(asked(len(values), number))
        strategy.tell(generation, np.where(np.isfinite(values), values, _FAILED).tolist())
        if strategy.stop():
            restarts += 1
            strategy = _started(stream(seed, "cma", "restart", restarts).random(d), n, seed, restarts)
    return Picks(points(asked(n, len(margins))), ("cma_es",) * n)


def _started(start: Vector, n: int, seed: int, restarts: int) -> Any:
    """Return a strategy that draws from our streams alone."""
    import cma

    rng = stream(seed, "cma", restarts)
    options = {
        "bounds": [0.0, 1.0], "popsize": max(n, 2), "verbose": -9, "seed": math.nan,
        "randn": lambda *shape: rng.standard_normal(shape), "CMA_elitist": False,
    }  # fmt: skip
    return cma.CMAEvolutionStrategy(np.clip(start, 0.05, 0.95).tolist(), _SIGMA, options)
