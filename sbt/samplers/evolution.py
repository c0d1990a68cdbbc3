"""CMA-ES as a proposer: replayed from the runs so far, so that nothing is remembered between batches."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector
from sbt.samplers.search import Picks
from sbt.seeds import stream

__all__ = ["propose", "require"]

_SIGMA = 0.3  # of the unit cube, at each start
_FAILED = 1e9  # stands for the margin of a failed run: worse than all others


def require() -> None:
    """Check that the library is there.

    Raises:
        InputError: it is not installed.
    """
    if importlib.util.find_spec("cma") is None:
        raise InputError("acquisition cma_es needs the library cma, but it is not installed: pip install 'sumo-sbt[compare]'")


def propose(start: Vector, margins: Sequence[Vector], n: int, seed: int) -> Picks:
    """Return the next n points of a covariance matrix adaptation evolution strategy.

    The same seed and margins give the same points: earlier generations are drawn again and told their
    margins. A strategy that has converged is started anew at a random point.

    Args:
        start: (d,) where the first one starts, in the unit cube.
        margins: of each generation so far, one for each of its points; NaN where a run failed.
        n: points wanted >= 1.
        seed: of the campaign.

    Raises:
        InputError: the library is not installed.

    Source:
        Hansen (2016), The CMA evolution strategy: a tutorial, arXiv 1604.00772; library pycma.
    """
    require()
    d, begun = len(start), 0
    strategy, shared = _started(start, n, seed, begun), start
    for values in margins:
        asked = strategy.ask(len(values))
        strategy.tell(asked, np.where(np.isfinite(values), values, _FAILED).tolist())
        if strategy.stop():
            begun += 1
            shared = stream(seed, "cma", "restart", begun).random(d)
            strategy = _started(shared, n, seed, begun)
    points: Points = np.clip(np.array(strategy.ask(n)), 0.0, 1.0).reshape(n, -1)[:, :d]
    return Picks(points, ("cma_es",) * n)


def _started(start: Vector, n: int, seed: int, begun: int) -> Any:
    """Return a strategy that draws from our streams alone."""
    import cma

    rng = stream(seed, "cma", begun)
    options = {
        "bounds": [0.0, 1.0], "popsize": max(n, 2), "verbose": -9, "seed": math.nan,
        "randn": lambda *shape: rng.standard_normal(shape), "CMA_elitist": False,
    }  # fmt: skip
    return cma.CMAEvolutionStrategy(np.clip(start, 0.05, 0.95).tolist(), _SIGMA, options)
