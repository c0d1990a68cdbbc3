"""Runs of which it is only known that the metric lies beyond a limit.

A distance of 0 in every collision, or a speed of impact of 0 in every run without one, is a value that the metric ends with: what
a smooth function that goes on would have been there is on the other side of that value, how far is not known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sbt.metamodels.base import Predictor
from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["Limit", "beyond"]


@dataclass(frozen=True, eq=False)
class Limit:
    """What is known of k rows: the metric, as a function that goes on, is at most, or at least, so much.

    Args:
        u: (k, d) the rows.
        learned: (k,) the values that a predictor was fitted to there.
        value: (k,) the limit there.
        at_most: (k,) the metric lies below; otherwise above.
    """

    u: Points
    learned: Vector
    value: Vector
    at_most: Mask

    def moved(self, to: Callable[[Vector], Vector]) -> Limit:
        """Return the limit in another unit."""
        return replace(self, learned=to(self.learned), value=to(self.value))

    def rows(self, u: Points, y: Vector, within: float) -> NDArray[np.intp]:
        """Return (n,) which of the rows each of u (n, d) is that was learned with y (n,), -1 where it is none.

        Of a noisy simulator other runs at the same inputs may have ended beside the limit.
        """
        known: dict[bytes, list[int]] = {}
        for k, row in enumerate(np.ascontiguousarray(self.u)):
            known.setdefault(row.tobytes(), []).append(k)
        found = np.full(len(u), -1, dtype=np.intp)
        for i, row in enumerate(np.ascontiguousarray(u)):
            same = [k for k in known.get(row.tobytes(), ()) if abs(self.learned[k] - y[i]) <= within]
            found[i] = same[0] if same else -1
        return found


@runtime_checkable
class _Limited(Protocol):
    def beyond(self, limit: Limit) -> Self:
        """Return the predictor that knows the limit."""


def beyond(predictor: Predictor, limit: Limit | None) -> Predictor:
    """Return a predictor that knows a limit in place of the values that it was fitted to there; itself where it cannot."""
    return predictor.beyond(limit) if limit is not None and isinstance(predictor, _Limited) else predictor
