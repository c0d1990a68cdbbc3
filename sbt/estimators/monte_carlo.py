"""Crude Monte Carlo: draws from the inputs' distribution itself, an exact binomial interval, no metamodel."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.special import betaincinv

from sbt.estimators.intervals import binomial_upper

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
        return float(betaincinv(self.hits, self.n - self.hits + 1, 1.0 - confidence)) if self.hits else 0.0

    def upper(self, confidence: float) -> float:
        """Return the exact one-sided upper limit, failed runs as critical.

        Source:
            Clopper and Pearson (1934), doi 10.1093/biomet/26.4.404.
        """
        return binomial_upper(self.hits + self.failed, self.n, confidence) if self.n else 1.0
