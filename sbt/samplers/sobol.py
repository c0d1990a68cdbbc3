"""One continued, scrambled Sobol sequence, addressed by position.

The paper draws the candidates of all iterations from the same sequence, so that new points lie
between the old ones. A position never changes its point, however the sequence is read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points
from sbt.seeds import stream

if TYPE_CHECKING:
    from scipy.stats import qmc  # takes a second to import

__all__ = ["SobolSequence"]

_BITS = 32  # the most that SciPy's fast_forward takes; 4.3e9 positions
_MOST_DIMENSIONS = 21201  # of SciPy's direction numbers
_HALF_CELL = 0.5 * 2.0**-_BITS
_LOCK = Lock()


@dataclass(frozen=True)
class SobolSequence:
    """The scrambled Sobol sequence that belongs to a seed; the same points whoever reads it.

    Args:
        dimension: number of coordinates d >= 1.
        seed: campaign seed >= 0; decides the scrambling.

    Raises:
        InputError: d < 1 or more than SciPy's tables hold (21,201).

    Source:
        Sobol (1967); scrambling by Matousek (1998) as in `scipy.stats.qmc.Sobol`; one sequence for all
        iterations: Winkelmann et al. (2022), section V-A.

    >>> sequence = SobolSequence(2, seed=7)
    >>> bool((sequence.points(5, 9) == sequence.points(0, 100)[5:9]).all())
    True
    """

    dimension: int
    seed: int

    def __post_init__(self) -> None:
        if not 1 <= self.dimension <= _MOST_DIMENSIONS:
            raise InputError(f"a Sobol sequence needs 1 <= dimension <= {_MOST_DIMENSIONS}, but got {self.dimension}")

    def points(self, start: int, stop: int) -> Points:
        """Return the points at positions start, ..., stop - 1, strictly inside the unit cube.

        Args:
            start: first position >= 0.
            stop: position after the last one, >= start.

        Returns:
            (stop - start, d) coordinates in (0, 1).

        Raises:
            InputError: not 0 <= start <= stop <= 2**32.
        """
        start, stop = int(start), int(stop)  # SciPy takes no NumPy integers
        if not 0 <= start <= stop <= 2**_BITS:
            raise InputError(f"positions must be 0 <= start <= stop <= 2**32, but got [{start}, {stop})")
        if start == stop:
            return np.empty((0, self.dimension))
        engine = _engine(self.dimension, self.seed)
        with _LOCK:
            if engine.num_generated > start:
                engine.reset()
            if engine.num_generated < start:
                engine.fast_forward(start - engine.num_generated)
            if start > 0:
                return np.asarray(engine.random(stop - start)) + _HALF_CELL
            first = engine.random(1)  # alone: SciPy warns of a first block that is no power of two
            rest = engine.random(stop - 1) if stop > 1 else np.empty((0, self.dimension))
            return np.concatenate([first, rest]) + _HALF_CELL

    def admissible(self, accept: Callable[[Points], Mask], n: int, least: int, most: int = 2**22) -> Points:
        """Return the admissible ones of the first n points; of as many more, up to `most`, as it takes to have `least`."""
        found, at, size = np.empty((0, self.dimension)), 0, n
        while at < most and (at == 0 or len(found) < least):
            u = self.points(at, at + size)
            kept = u[accept(u)]
            found = np.concatenate([found, kept[: max(least - len(found), 0)] if at else kept])
            at, size = at + size, min(2 * size, 2**18)
        return found


@lru_cache(maxsize=8)
def _engine(dimension: int, seed: int) -> qmc.Sobol:
    """Return the engine at any position: the next points mostly follow those it gave last."""
    from scipy.stats import qmc

    return qmc.Sobol(dimension, scramble=True, bits=_BITS, rng=stream(seed, "sobol", dimension))
