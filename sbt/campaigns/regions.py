"""How many critical regions there are, how large they are, and where: connected parts of P(critical) > 0.5."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sbt.campaigns.place import LogOdds, Stretch, succeeding
from sbt.campaigns.wording import input_value, measured, percent, plural
from sbt.problem.arrays import Mask, Points
from sbt.problem.plain import Value
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.samplers.sobol import SobolSequence
from sbt.store.records import optional

__all__ = ["CriticalRegion", "critical_regions", "only_words", "regions_words"]

_POINTS, _LEAST, _MOST = 8192, 2048, 400  # of the space, that satisfy constraints, and critical ones that are joined
_NEIGHBOURS, _BETWEEN = 8, 16  # pairs of points that are tried: of each point, and of each two parts, the nearest
_PROBES = 9  # on the segment between two points
_PARTS = 12  # the largest, which are tried in pairs
_COUNTED = 3  # points that a region has at least: fewer may be the metamodel's roughness
_TOLD, _LARGE = 3, 0.05  # regions in the sentence; share of all that is critical that one has at least to be named there
_INNER = (0.05, 0.95)  # quantiles of its points between which a region is told to lie
_SINGLE, _MOVED = 128, 64  # single values of an input that are tried, and points of a region that are moved to them
_SOME = 0.05  # of the points critical at the value with most of them, from which on a region lies at a value


@dataclass(frozen=True)
class CriticalRegion:
    """A connected part of the space where P(critical) > 0.5.

    Attributes:
        share: of the parameter space.
        extent: of each continuous input, where nine tenths of the region lie.
        only: of inputs with choices or whole numbers at some of which the region does not lie: those at which it does;
            None: it lies at all of them.
    """

    share: float
    extent: Mapping[str, Stretch]
    only: Mapping[str, tuple[Value, ...]] | None = optional()


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

    def inside(v: Points) -> Mask:
        return np.asarray((log_odds(v) > 0.0) & space.feasible(space.from_unit(v)))

    def joined(a: Points, b: Points) -> Mask:
        a = space.cube.with_choices_of(b, a)  # the way begins with the other ones
        probes = a[:, None] * (1.0 - steps) + b[:, None] * steps
        return np.asarray(inside(space.cube.snapped(probes.reshape(-1, u.shape[1]))).reshape(len(a), len(steps)).all(axis=1))

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
        only = _only(critical[label == part][:_MOVED], space, inside)
        found.append(CriticalRegion(share * float(count[part]) / len(critical), extent, only or None))
    return tuple(found)


def regions_words(
    regions: Sequence[CriticalRegion], inputs: Sequence[str], units: Mapping[str, str], widths: Mapping[str, float] | None = None
) -> str:
    """Return how many regions there are, and where the largest lie along these inputs; nothing where one is nearly all.

    Choices and whole numbers to which a region is confined are told before.
    """
    large = _large(regions)
    if len(large) < 2:
        return ""
    told = []
    for region in large[:_TOLD]:
        along = [_values(name, values, units) for name, values in (region.only or {}).items()]
        for name in inputs:
            low, high = (
                input_value(end, (widths or {}).get(name, np.inf)) for end in (region.extent[name].low, region.extent[name].high)
            )
            along.append(f"{name} {low} to {measured('', high, units.get(name, '')).strip()}")
        told.append(f"{percent(region.share)} of the parameter space, nine tenths of it with {' and '.join(along)}")
    small = "" if len(large) == len(regions) else f" ({plural(len(regions) - len(large), 'smaller one')} aside)"
    largest = "" if len(large) <= _TOLD else f", the {_TOLD} largest of them"
    return f"it lies in one of {len(large)} separate regions{small}{largest}: {'; '.join(told)} (by the metamodel)"


def only_words(regions: Sequence[CriticalRegion], units: Mapping[str, str]) -> str:
    """Return the choices and whole numbers to which all that is critical is confined; nothing where it is found with all."""
    large = _large(regions)
    names = [name for name in (large[0].only or {}) if all(name in (region.only or {}) for region in large)] if large else []
    values = {name: tuple(dict.fromkeys(value for region in large for value in (region.only or {})[name])) for name in names}
    return " and ".join(_values(name, found, units) for name, found in values.items())


def _large(regions: Sequence[CriticalRegion]) -> list[CriticalRegion]:
    """Return the regions that are large enough to be named."""
    return [region for region in regions if region.share >= _LARGE * sum(each.share for each in regions)]


def _values(name: str, values: Sequence[Value], units: Mapping[str, str]) -> str:
    """Return an input at some of its choices or whole numbers; those that follow one another as a range."""
    numbers = [value for value in values if not isinstance(value, str)]
    if len(numbers) > 1 and max(numbers) - min(numbers) == len(numbers) - 1:
        return measured(name, f"{input_value(min(numbers))} to {input_value(max(numbers))}", units.get(name, ""))
    return measured(name, " or ".join(map(input_value, sorted(numbers) or values)), units.get(name, ""))


def _only(points: Points, space: ParameterSpace, inside: Callable[[Points], Mask]) -> dict[str, tuple[Value, ...]]:
    """Return the choices and whole numbers at which a region lies, of inputs where it does not lie at all of them.

    Its points (n, d) are moved to each: another choice is a step, and so is the next whole number.
    """
    found: dict[str, tuple[Value, ...]] = {}
    for k, n in (*space.cube.whole, *space.cube.nominal):
        if n > _SINGLE:
            continue
        moved = np.repeat(points, n, axis=0)
        moved[:, k] = np.tile((np.arange(n) + 0.5) / n, len(points))
        hits = inside(moved).reshape(len(points), n).sum(axis=0)
        lies = hits >= max(_SOME * hits.max(), 1)
        if (k, n) in space.cube.whole:
            own = np.floor(points[:, k] * n).astype(int).clip(0, n - 1)
            apart = np.flatnonzero(~lies)
            below, above = apart[apart < own.min()], apart[apart > own.max()]
            lies[: below.max(initial=-1) + 1], lies[above.min(initial=n) :] = False, False
        if not lies.all():
            parameter = space.parameters[k]
            numbers = parameter.from_unit((np.flatnonzero(lies) + 0.5) / n)
            found[parameter.name] = tuple(parameter.value(value) for value in numbers.tolist())
    return found


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
