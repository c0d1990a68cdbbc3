"""What the runs of a noisy simulator tell of a way between critical ones: does what lies there fail as often as its ends do?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import betainc, betaincinv

from sbt.campaigns.rates import LocalRates
from sbt.problem.arrays import Mask, Points, Vector

__all__ = ["LIKELY", "SURE", "RunsBetween"]

_QUANTILES = (np.arange(32) + 0.5) / 32.0  # of the failure rate of a mode, over which is averaged
_HALF = 0.5  # of the rate of the lesser end: a way that fails less often divides two modes
LIKELY, SURE = 0.3, 0.05
"""How likely a way fails so often, from which on it joins two modes, and below which it surely does not."""
_LEAST = 1e-6  # of a rate, a variance and the parameters of a beta distribution


@dataclass(frozen=True, eq=False)
class RunsBetween:
    """Runs with a metric whose seed was drawn, and the failure rates at critical ones.

    Args:
        at: (n, e) these runs, in the embedded unit cube.
        hit: (n,) they were critical.
        probability: (n,) P(critical) there, by the metamodel that joins critical runs.
        ends: (m, e) the critical runs that may be joined, in the embedded unit cube.
        kind: (m,) of their conflicts: one of another kind tells nothing.
        rates: at these.
    """

    at: Points
    hit: Mask
    probability: Vector
    ends: Points
    kind: Vector
    rates: LocalRates

    def likely(self, i: int, j: int, modes: tuple[Mask, Mask], least: float) -> float:
        """Return how likely the way from end i to end j fails with half the rate of the lesser mode, or more often.

        Of all runs in the ball whose diameter the way is those count where the metamodel expects failures, as it does on the way:
        it claims that they fail about as often. Critical runs of the two modes do not count, as they end the way. The rate there
        has a beta distribution, beginning with an even one.

        Args:
            i: end in the one mode.
            j: end in the other one.
            modes: (m,) which ends are of the one and of the other mode.
            least: P(critical) above which the metamodel joins them; 0: all runs there count.

        Source:
            The ball: Gabriel and Sokal (1969), A new statistical approach to geographic variation analysis, Syst. Zoology 18.
            That of the nearest runs of two groups has no other run of these.
        """
        way = float(((self.ends[i] - self.ends[j]) ** 2).sum())
        inside = cdist(self.ends[[i, j]], self.at, "sqeuclidean").sum(axis=0) < way * (1.0 - 1e-9)
        misses = int((inside & ~self.hit & (self.probability > least)).sum())
        own = modes[0] | modes[1]
        met = cdist(self.ends[[i, j]], self.ends, "sqeuclidean").sum(axis=0) < way * (1.0 - 1e-9)
        hits = int((met & ~own & (self.kind == self.kind[i])).sum())
        return max(float((1.0 - betainc(1.0 + hits, 1.0 + misses, _HALF * self._rate(mode))).mean()) for mode in modes)

    def _rate(self, mode: Mask) -> Vector:
        """Return quantiles of the failure rate of a mode, by the beta distribution of its mean and variance."""
        mean = float(np.clip(np.median(self.rates.mean[mode]), _LEAST, 1.0 - _LEAST))
        runs = max(mean * (1.0 - mean) / max(float(np.median(self.rates.std[mode])) ** 2, _LEAST) - 1.0, _LEAST)
        return np.asarray(betaincinv(mean * runs, (1.0 - mean) * runs, _QUANTILES))
