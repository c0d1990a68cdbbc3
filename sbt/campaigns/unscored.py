"""Batches of which an acquisition scored no run: it is -inf wherever one looked, and so they are spread evenly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.loop.stages import Log
from sbt.problem.arrays import Points, Vector

__all__ = ["UNSCORED", "are_unscored", "unscored_batches", "unscored_words"]

UNSCORED = "unscored"
"""In the proposal of a batch, or among its criteria: how many runs a score was to choose and did not."""


def are_unscored(score: Callable[[Points], Vector], u: Points) -> bool:
    """Return whether the points (n, d) that were chosen by a score all have the score -inf: it has chosen none of them."""
    return len(u) > 0 and bool(np.isneginf(score(u)).all())


def unscored_batches(log: Log) -> int | None:
    """Return the number of batches with runs that an acquisition was to choose and did not; None: there are none."""
    proposals = [batch.proposal for batch in log.iterations]
    return sum(bool(p.get(UNSCORED) or (p.get("criteria") or {}).get(UNSCORED)) for p in proposals) or None


def unscored_words(batches: int | None) -> list[str]:
    """Return in a sentence that so many batches were not chosen; nothing where all were."""
    if batches is None:
        return []
    which = "1 batch" if batches == 1 else f"{batches:,} batches"
    return [f"The acquisition scored nothing above -inf in {which}: what it was to choose there is spread evenly."]
