"""What is recorded step by step, as a table of all road users."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

__all__ = ["table_of"]


def table_of(rows: Sequence[Mapping[str, tuple[float, ...]]], names: Sequence[str]) -> np.ndarray:
    """Return (t, names, 5) states of the rows of t instants; NaN where one is not there."""
    column = {name: k for k, name in enumerate(names)}
    table = np.full((len(rows), len(names), 5), np.nan)
    at = [(i, column[name]) for i, row in enumerate(rows) for name in row]
    i, j = np.array(at).T
    table[i, j] = np.array([state for row in rows for state in row.values()])
    return table
