"""Runs of which metrics alone are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["Runs"]


class Runs:
    """Runs by metric."""

    def __init__(self, **metrics: Sequence[float] | np.ndarray):
        self.metrics = {name: np.array(values) for name, values in metrics.items()}

    def y(self, metric: str) -> np.ndarray:
        """Return the values of a metric."""
        return self.metrics[metric]
