"""How many critical regions there are, how large they are, and where: connected parts of P(critical) > 0.5."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sbt.campaigns.place import LogOdds, Stretch, succeeding
from sbt.campaigns.wording import input_value, measured, percent, plural
from sbt.problem.arrays import Mask, Points
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.sobol import SobolSequence

__all__ = ["CriticalRegion", "critical_regions", "regions_words"]

_POINTS, _LEAST, _MOST = 8192, 2048, 400  # of the space, that satisfy constraints, and critical ones that are joined
_NEIGHBOURS, _BETWEEN = 8, 16  # pairs of points that are tried: of each point, and of each two parts, the nearest
_PROBES = 9  # on the segment between two points
_PARTS = 12  # the largest, which are tried in pairs
_COUNTED = 3  # points that a region has at least: fewer may be the metamodel's roughness
_TOLD, _LARGE = 3, 0.05  # regions in the sentence; share of all that is critical that one has at least to be named there
_INNER = (0.05, 0.95)  # quantiles of its points between which a region is told to lie


@dataclass(frozen=True)
class CriticalRegion:
    """A connected part of the space where P(critical) > 0.5.

    Attributes:
        share: of the parameter space.
        extent: of each continuous input, where nine tenths of the region lie.
    """

    share: float
    extent: Mapping[str, Stretch]


def critical_regions(
    log_odds: LogOdds, scenario: LogicalScenario, seed: int, met: Points, log_success: LogOdds | None = None
) -> tuple[CriticalRegion, ...]:
    """Return the critical regions, the largest first; none where the metamodel sees none of two thousand points critical.

    Two points are in one region where P(critical) > 0.5 on a chain of segments between critical points; another choice is
    a step. Regions of fewer than three points of the 8,192 that are looked at are left out, and those that no critical run is
    joined to. Points where a run rather fails are in no region, and separate none: nobody knows whether it would be critical.

    Args:
        log_odds: of critical, at points of the unit cube.
        scenario: with its space.
        seed: of the points.
        met: (k, d) critical runs, in the unit cube.
        log_success: log P(a run gives a metric); None: all did.
    """
    space = scenario.space
    u = SobolSequence(space.dimension, seed).admissible(lambda v: space.feasible(space.from_unit(v)), _POINTS, _LEAST)
    u = space.cube.snapped(u)
    critical = u[(log_odds(u) > 0.0) & succeeding(log_success, u)] if len(u) else u
    if len(critical) == 0:
        return ()
    share = len(critical) / len(u)
    critical = critical[:_MOST]  # a part of a Sobol sequence is as evenly spread

    steps = np.linspace(0.0, 1.0, _PROBES + 2)[:-1, None]

    def joined(a: Points, b: Points) -> Mask:
        a = space.cube.with_choices_of(b, a)  # the way begins with the other ones
        probes = a[:, None] * (1.0 - steps) + b[:, None] * steps
        probes = space.cube.snapped(probes.reshape(-1, u.shape[1]))
        inside = (log_odds(probes) > 0.0) & space.feasible(space.from_unit(probes))
        return np.asarray(inside.reshape(len(a), len(steps)).all(axis=1))

    label = _parts(critical, cdist(*[space.cube.embedded(critical)] * 2), joined)
    count = np.bincount(label)
    found = []
    for part in np.argsort(-count, kind="stable"):
        if count[part] < _COUNTED:
            break
        if not _joined_to(critical[label == part], met, space.cube.embedded, joined):
            continue
        x = space.from_unit(critical[label == part])
        ends = np.quantile(x, _INNER, axis=0)
        ranges = zip(space.parameters, *ends.tolist(), strict=True)
        extent = {p.name: Stretch(low, high) for p, low, high in ranges if p.kind == "continuous"}
        found.append(CriticalRegion(share * float(count[part]) / len(critical), extent))
    return tuple(found)


def regions_words(
    regions: tuple[CriticalRegion, ...], inputs: tuple[str, ...], units: Mapping[str, str], widths: Mapping[str, float]
) -> str:
    """Return how many regions there are, and where the largest lie along these inputs; nothing where one is nearly all."""
    large = [region for region in regions if region.share >= _LARGE * sum(each.share for each in regions)]
    if len(large) < 2:
        return ""
    told = []
    for region in large[:_TOLD]:
        along = []
        for name in inputs:
            ends = (region.extent[name].low, region.extent[name].high)
            low, high = (input_value(end, widths.get(name, np.inf)) for end in ends)
            along.append(f"{name} {low} to {measured('', high, units.get(name, '')).strip()}")
        told.append(f"{percent(region.share)} of the parameter space, nine tenths of it with {' and '.join(along)}")
    small = "" if len(large) == len(regions) else f" ({plural(len(regions) - len(large), 'smaller one')} aside)"
    largest = "" if len(large) <= _TOLD else f", the {_TOLD} largest of them"
    return f"it lies in one of {len(large)} separate regions{small}{largest}: {'; '.join(told)} (by the metamodel)"


def _parts(points: Points, distance: Points, joined: Callable[[Points, Points], Mask]) -> NDArray[np.intp]:
    """Return (n,) numbers of the parts that points (n, d) with these distances (n, n) are in."""
    n = len(points)
    np.fill_diagonal(distance, np.inf)
    near = np.argsort(distance, axis=1, kind="stable")[:, :_NEIGHBOURS]
    first, second = np.repeat(np.arange(n), near.shape[1]), near.reshape(-1)
    pairs = np.unique(np.sort(np.stack([first, second], axis=1), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    pairs = pairs[joined(points[pairs[:, 0]], points[pairs[:, 1]])] if len(pairs) else pairs
    label = _components(pairs, n)
    largest = np.argsort(-np.bincount(label), kind="stable")[:_PARTS]
    further = []
    for k, a in enumerate(largest):
        for b in largest[k + 1 :]:
            one, other = np.flatnonzero(label == a), np.flatnonzero(label == b)
            between = distance[np.ix_(one, other)]
            rows, columns = np.unravel_index(np.argsort(between, axis=None, kind="stable")[:_BETWEEN], between.shape)
            further.append(np.stack([one[rows], other[columns]], axis=1))
    more = np.concatenate([np.empty((0, 2), dtype=np.intp), *further])
    more = more[joined(points[more[:, 0]], points[more[:, 1]])] if len(more) else more
    return _components(np.concatenate([pairs, more]), n)


def _joined_to(part: Points, met: Points, embedded: Callable[[Points], Points], joined: Callable[[Points, Points], Mask]) -> bool:
    """Return whether one of some runs (k, d) is joined to a part (n, d); the nearest pairs are tried."""
    if len(met) == 0:
        return False
    distance = cdist(embedded(met), embedded(part))
    nearest = distance.argmin(axis=1)
    runs = np.argsort(distance.min(axis=1), kind="stable")[:_BETWEEN]
    return bool(joined(met[runs], part[nearest[runs]]).any())


def _components(pairs: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)
