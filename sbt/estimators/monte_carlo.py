"""Crude Monte Carlo: draws from the inputs' distribution itself, an exact binomial interval, no metamodel."""

from __future__ import annotations

from dataclasses import dataclass

from sbt.estimators.binomial import lower, upper

__all__ = ["Proportion"]


@dataclass(frozen=True)
class Proportion:
    """Share of hits among n independent draws, where failed runs may be hits or not.

    Args:
        n: draws, the failed ones included.
        hits: critical runs.
        failed: runs without an outcome.
    """

    n: int
    hits: int
    failed: int = 0

    @property
    def value(self) -> float:
        """The share with failed runs as safe."""
        return self.hits / self.n if self.n else 0.0

    @property
    def cov(self) -> float | None:
        """Coefficient of variation; None without a hit."""
        return ((1.0 - self.value) / self.hits) ** 0.5 if self.hits else None

    def lower(self, confidence: float) -> float:
        """Return the exact one-sided lower limit, failed runs as safe."""
        return float(lower(self.hits, self.n, confidence))

    def upper(self, confidence: float) -> float:
        """Return the exact one-sided upper limit, failed runs as critical."""
        return float(upper(self.hits + self.failed, self.n, confidence))
