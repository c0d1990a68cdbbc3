"""Where a noisy simulator is critical most often, though nowhere with most of the seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit
from scipy.stats import hypergeom

from sbt.campaigns.place import BoundaryPlace, LogOdds, boundary_place
from sbt.campaigns.wording import percent, plural
from sbt.problem.arrays import Mask, Points
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence

__all__ = ["ChancePlace", "chance_place"]

_POINTS, _LEAST = 4096, 1024
_LARGEST = 0.99  # quantile of P(critical) over the space that counts as its largest
_HALF = 0.5  # of it: the least in the place
_UNEVEN = 2.0  # times its mean, below which inputs decide too little to name a place
_FEWEST = 5  # critical runs in a place
_CHANCE = 0.01  # P(as many of the critical runs lie in a place that tells nothing), up to which one is named: runs chose it


@dataclass(frozen=True)
class ChancePlace:
    """Where runs are critical most often.

    Attributes:
        place: its edge, where P(critical) is half of the largest.
        runs: that lie in it and gave a metric.
        hits: critical ones among them.
    """

    place: BoundaryPlace
    runs: int
    hits: int

    def words(self, here: str, condition: str, units: Mapping[str, str], widths: Mapping[str, float] | None = None) -> str:
        """Return the first words of a conclusion, of a scenario (`In x`), and what critical is; see `BoundaryPlace.words`."""
        where, share = self.place.words(units, widths, edges=False), percent(self.hits / self.runs)
        said = f"{here}, chance decides which runs are critical ({condition}); most often they are where {where}"
        return f"{said} (by the metamodel): {self.hits:,} of the {plural(self.runs, 'run')} there ({share})"


def chance_place(log_odds: LogOdds, scenario: LogicalScenario, seed: int, u: Points, hit: Mask) -> ChancePlace | None:
    """Return where runs are critical most often; None where most of them are in a place, inputs tell nothing, or no run is there.

    Args:
        log_odds: of critical, at points of the unit cube.
        scenario: with its space; its simulator is noisy.
        seed: of the points.
        u: (n, d) runs that gave a metric, in the unit cube.
        hit: (n,) whether they were critical.
    """
    space = scenario.space
    at = SobolSequence(space.dimension, seed).admissible(lambda v: space.feasible(space.from_unit(v)), _POINTS, _LEAST)
    if len(at) == 0 or len(u) == 0:
        return None
    own = log_odds(u)
    likely, p = own > 0.0, expit(np.nan_to_num(log_odds(space.cube.snapped(at)), neginf=-700.0, posinf=700.0))
    if likely.any() and hit[likely].mean() >= 0.5:
        return None
    least = _HALF * float(np.quantile(p, _LARGEST))
    if least < _HALF * _UNEVEN * float(p.mean()) or (not likely.any() and bool((p > 0.5).any())):
        return None
    if least == 0.0:
        return None
    above = np.log(least / (1.0 - least))
    there = own > above
    if hit[there].sum() < _FEWEST or _as_elsewhere(hit, there) > _CHANCE:
        return None
    place = boundary_place(lambda v: log_odds(v) - above, scenario, seed)
    if place is None or not place.cuts:
        return None
    return ChancePlace(place, int(there.sum()), int(hit[there].sum()))


def _as_elsewhere(hit: Mask, there: Mask) -> float:
    """Return how likely so many of the critical runs, or more, lie in a place if runs are critical as often elsewhere.

    Source:
        Fisher's exact test.
    """
    return float(hypergeom.sf(int((hit & there).sum()) - 1, len(hit), int(hit.sum()), int(there.sum())))
