"""Which runs of a large campaign a page shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sbt.problem.arrays import Mask

__all__ = ["MOST_SHOWN", "shown_runs"]

MOST_SHOWN = 20_000
"""Largest number of runs in a page, and in a figure."""


def shown_runs(ok: Mask, critical: Mask, index: NDArray[np.int64], wanted: Sequence[int] = ()) -> Mask:
    """Return (n,) which runs are shown: all, or critical, failed and wanted ones first and the rest evenly thinned."""
    n = len(ok)
    if n <= MOST_SHOWN:
        return np.ones(n, dtype=bool)
    keep: Mask = np.isin(index, wanted)
    for mask, share in ((critical, 0.6), (~ok, 0.8), (ok & ~critical, 1.0)):
        rows, room = np.flatnonzero(mask & ~keep), int(share * MOST_SHOWN) - int(keep.sum())
        if len(rows) and room > 0:
            keep[rows[np.unique(np.linspace(0, len(rows) - 1, min(room, len(rows))).astype(int))]] = True
    return keep
