"""Are two critical runs of one failure mode? The metamodel says how surely the way between them is critical; runs on it tell."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from sbt.campaigns.between import LIKELY, SURE, RunsBetween
from sbt.campaigns.wording import plural
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cube import CONTINUOUS, Cube
from sbt.samplers.search import WarpedModel
from sbt.seeds import stream
from sbt.store.records import optional

__all__ = [
    "JoinedPart", "Link", "LinksTold", "Way", "connected", "doubtful", "modes_counted", "pairs_joined", "unasked", "ways_between",
    "ways_in_noise",
]  # fmt: skip

_PROBES = 9  # on the segment between two runs
_CHUNK = 100  # segments asked for at once
_DOUBT = (0.02, 0.9995)
"""Least P(critical) on a way, between which a run on it is worth its price."""
_SURE = 1.0 - 1e-9  # P(critical) that tells no point of a way from the others
_LONG = 0.2
"""Length of a way, in the unit cube, from which on a metamodel is too sure of it: a run on it tells, once."""
_JOINED = 0.5  # least P(critical) of a way within a mode
_SETTLED = 0.9  # how likely a way fails about as often as its ends, from which on no run is made on it
_POINTS, _EDGE = 4, 0.25  # of a way in noise that are asked about at once; of its length at either end, where none is
_GROUPS, _APART = 12, 24  # modes that are compared, and ways between two of them, the shortest
_TOLD = 5  # parts in the sentence
_BENDS, _REACH = 128, 0.5  # points over which such a way may lead, and how far from its middle, in its length


@dataclass(frozen=True)
class Link:
    """A run between two critical ones; all are indices of runs."""

    run: int
    ends: tuple[int, int]


@dataclass(frozen=True)
class Way:
    """The segment between two critical runs that decides whether they are of one mode.

    Attributes:
        ends: these two, of n.
        least: smallest P(critical) on it.
        at: (d,) where that is, in the unit cube; of a way between two modes, the point over which it leads.
        untested: the metamodel is sure of it, but no run was made on it: it is long, or bends.
        nearest: it is between two modes, and one of the shortest that would make all of them one.
        sides: with noise, of a way within a mode, what it joins: those of the n on either side that no other such way is needed
            for, the likeliest to fail first.
    """

    ends: tuple[int, int]
    least: float
    at: Vector
    untested: bool
    nearest: bool = False
    sides: tuple[tuple[int, ...], ...] = ()

    @property
    def excluded(self) -> bool:
        """Whether the metamodel excludes that the way is critical."""
        return self.least <= _DOUBT[0]


@dataclass(frozen=True)
class JoinedPart:
    """A part of a mode of a noisy simulator that a way in doubt joins with the rest.

    Attributes:
        run: the likeliest to fail again, by the search.
        inputs: different ones of its critical runs.
    """

    run: int
    inputs: int


@dataclass(frozen=True)
class LinksTold:
    """Runs between critical runs, which asked whether these are of one failure mode.

    Attributes:
        runs: how many.
        critical: of them.
        left: ways in doubt that were not asked about.
        lost: of the runs, those that gave no metric; None: all gave one.
        untested: shortest ways between modes on which no run was made: there may be fewer modes; None: there are none.
        dividing: ways in doubt between two modes: there may be fewer; None: there are none.
        joining: of a noisy simulator, ways in doubt within modes: there may be more; None: there are none.
        parts: what these join, where it is of several inputs, the most inputs first; None: there are none.
    """

    runs: int
    critical: int
    left: int
    lost: int | None = optional()
    untested: int | None = optional()
    dividing: int | None = optional()
    joining: int | None = optional()
    parts: tuple[JoinedPart, ...] | None = optional()

    @property
    def may_be_fewer(self) -> bool:
        """Whether modes may be fewer than are told."""
        return self.untested is not None or self.dividing is not None

    def sentence(self) -> str:
        """Return in words what was asked, and what remains open."""
        if self.runs == 0:
            open_, where = (self.left, "within") if self.dividing is None else (self.dividing, "between")
            open_words = f"{plural(open_, 'way')} {where} modes {'is' if open_ == 1 else 'are'} in doubt"
            return f"Too few runs between critical ones tell whether they are of one failure mode: {open_words}.{self._more()}"
        asked = f"{plural(self.runs, 'run')} between critical ones tested whether they are of one failure mode"
        found = f"{self.critical} {'was' if self.critical == 1 else 'were'} critical"
        found += "" if self.lost is None else f", {self.lost} gave no metric and {'tells' if self.lost == 1 else 'tell'} nothing"
        still = f"; {plural(self.left, 'way')} between them {'is' if self.left == 1 else 'are'} still in doubt"
        still += "" if self.dividing is None else f", {self.dividing} of them between two modes"
        return f"{asked}: {found}{still if self.left else ''}.{self._more()}"

    def _more(self) -> str:
        """Return which parts of modes may be modes of their own."""
        told = ", ".join(f"run {part.run} (of {part.inputs} critical inputs)" for part in (self.parts or ())[:_TOLD])
        return f" Joined to others only by ways in doubt, and perhaps of modes of their own: {told}." if told else ""


def modes_counted(modes: int, alone: int, links: LinksTold | None) -> str:
    """Return in words how many failure modes there are, `alone` of them of one input each."""
    told, more = plural(modes, "distinct failure mode"), 0 if links is None else links.joining or 0
    fewer = alone > 1 or (links is not None and links.may_be_fewer)
    if fewer and more:
        least = modes - max(alone - 1, 0) - (0 if links is None else links.dividing or 0)
        return f"about {told} ({max(least, 1)} to {modes + more})"
    return f"{'up to ' if fewer else 'at least ' if more else ''}{told}"


Pairs = Sequence[tuple[int, int]]
"""Of n critical runs, two that are joined."""


def pairs_joined(links: Sequence[Link], runs: Sequence[int], *, nested: int = 1) -> list[tuple[int, int]]:
    """Return the pairs of critical runs, as places in `runs` (n,), that runs between them tell: a critical one and its ends.

    Those between which a run was made later are no pair any more: that run decides. `nested`: only pairs that so many critical
    runs, each between the run before and an end of its, have told.
    """
    place, pairs = {run: k for k, run in enumerate(runs)}, dict[tuple[int, int], int]()
    for link in links:
        depth = pairs.pop(link.ends, 0) + 1
        if link.run in place:
            pairs |= {(min(end, link.run), max(end, link.run)): depth for end in link.ends}
    return [(place[a], place[b]) for (a, b), depth in pairs.items() if depth >= nested and a in place and b in place]


def connected(
    fitted: WarpedModel, u: Points, kind: Vector, *, noisy: bool = False, tested: Pairs = (), sure: Pairs = (),
    cube: Cube = CONTINUOUS, between: RunsBetween | None = None,
) -> NDArray[np.int64]:  # fmt: skip
    """Return (n,) group numbers: single linkage over segments on which P(critical) > 0.5 at 9 probes; equal inputs are one.

    With a noisy simulator P(critical) is small even where runs fail most: there it must exceed half of the smaller P at the two
    ends, and runs between them must not deny it, for much noise leaves P alike all over. Of two runs that a run between critical
    ones has joined it is enough that the metamodel does not exclude it, whatever it says where another one between these was
    critical too.

    Args:
        fitted: of the metamodel.
        u: (n, d) critical runs in the unit cube.
        kind: (n,) only runs of the same kind are joined.
        noisy: see above.
        tested: of `pairs_joined`.
        sure: those of them that are nested twice.
        cube: in which u is. There is nothing between choices: a way begins with those of its end.
        between: with noise, what runs tell of the ways; None: they are not asked.
    """
    return _linked(fitted, u, kind, cube, noisy=noisy, tested=tested, sure=sure, between=between)[0]


def ways_between(
    fitted: WarpedModel, u: Points, kind: Vector, link: Mask, tested: Pairs = (), sure: Pairs = (), cube: Cube = CONTINUOUS
) -> list[Way]:  # fmt: skip
    """Return the ways that decide which of n critical runs are of one mode, of a simulator without noise.

    They are those that join the runs of a mode, and between modes that could be one the likeliest that bends once.

    Args:
        fitted: of the metamodel.
        u: (n, d) critical runs in the unit cube.
        kind: (n,) only runs of the same kind can be of one mode.
        link: (n,) the run was between others.
        tested: as in `connected`.
        sure: as in `connected`.
        cube: as in `connected`.
    """
    group, joined = _linked(fitted, u, kind, cube, tested=tested, sure=sure)
    distance = cdist(u, u)
    apart = sorted(_between_groups(group, kind, distance), key=lambda pair: float(distance[pair]))[:_APART]
    first, second = np.array([pair for pair in joined if distance[pair] > 0.0], dtype=np.intp).reshape(-1, 2).T
    probes, p = _probed(fitted, u[first], u[second], cube)
    at = np.where(p.min(axis=1) < _SURE, p.argmin(axis=1), _PROBES // 2)
    untested = (distance[first, second] > _LONG) & ~link[first] & ~link[second]
    ends = list(zip(first.tolist(), second.tolist(), strict=True))
    straight = [Way(ends[k], float(p[k].min()), probes[k, i], bool(untested[k])) for k, i in enumerate(at)]
    tree = _tree(apart, group)
    return [*straight, *(Way((i, j), *_bent(fitted, u[i], u[j], cube), (i, j) in tree) for i, j in apart)]


def ways_in_noise(
    fitted: WarpedModel, u: Points, kind: Vector, between: RunsBetween, made: Mapping[frozenset[int], int],
    cube: Cube = CONTINUOUS,
) -> tuple[list[Way], int]:  # fmt: skip
    """Return the ways of a noisy simulator on which runs would tell whether two modes are one, and how many divide them in doubt.

    They are the shortest that would make all modes one, whatever the metamodel says there, and long ones that join a mode; each
    with several points on it. Those points come first that may tell most: on ways most in doubt, with many inputs on either side,
    and few other points.

    Args:
        fitted: as in `connected`.
        u: as in `connected`.
        kind: as in `connected`.
        between: what runs tell of the ways.
        made: how many runs there were between two of u.
        cube: as in `connected`.
    """
    group, joined = _linked(fitted, u, kind, cube, noisy=True, between=between)
    p, distance = fitted.probability(u), cdist(u, u)
    same = np.unique(u, axis=0, return_inverse=True)[1].reshape(-1)
    parts = np.arange(len(u), dtype=np.int64)
    asked, within = list[tuple[float, list[Way]]](), list[tuple[int, int]]()

    def ask(ends: tuple[int, int], likely: float, sides: tuple[Mask, Mask]) -> None:
        inputs = min(len(np.unique(same[side])) for side in sides)
        points = list(_along(u, ends, likely, made.get(frozenset(ends), 0), cube))
        asked.append((likely * (1.0 - likely) * inputs, points))

    for i, j in joined:
        if distance[i, j] > _LONG:
            least = _JOINED * float(min(p[i], p[j]))
            likely = between.likely(i, j, (parts == parts[i], parts == parts[j]), least)
            if likely < _SETTLED:
                within.append((i, j))
                ask((i, j), likely, _sides(len(u), joined, (i, j)))
        parts[parts == parts[j]] = parts[i]
    apart = sorted(_between_groups(group, kind, distance), key=lambda pair: float(distance[pair]))
    tree, dividing = _tree(apart, group), 0
    for i, j in (pair for pair in apart if pair in tree):
        sides = group == group[i], group == group[j]
        if (likely := between.likely(i, j, sides, 0.0)) > SURE:
            ask((i, j), likely, sides)
            dividing += 1
    label, kept = _labels(len(u), [pair for pair in joined if pair not in within]), dict[int, tuple[int, ...]]()
    for part in np.unique(label[np.array(within, dtype=np.intp).reshape(-1)]).tolist():
        kept[part] = tuple(sorted(np.flatnonzero(label == part).tolist(), key=lambda k: (-between.rates.mean[k], k)))

    told = [(-score / (1.0 + k), way) for score, points in asked for k, way in enumerate(points)]
    ways = [way for _, way in sorted(told, key=lambda each: each[0])]
    inside = {ends: tuple(kept[label[end]] for end in ends) for ends in within}
    return [replace(way, sides=inside.get(way.ends, ())) for way in ways], dividing


def _sides(n: int, joined: Sequence[tuple[int, int]], way: tuple[int, int]) -> tuple[Mask, Mask]:
    """Return (n,) which runs are on either side of one of the ways that join n runs."""
    label = _labels(n, [pair for pair in joined if pair != way])
    return label == label[way[0]], label == label[way[1]]


def _labels(n: int, pairs: Pairs) -> NDArray[np.int64]:
    """Return (n,) numbers from 0, the same for runs that pairs of them join."""
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return np.asarray(connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(n, n)))[1], dtype=np.int64)


def _along(u: Points, ends: tuple[int, int], likely: float, made: int, cube: Cube) -> Iterator[Way]:
    """Yield ways over the next points on a segment, of which so many were run: in the middle, then between those before."""
    from scipy.stats import qmc

    start, end = cube.with_choices_of(u[[ends[1]]], u[[ends[0]]])[0], u[ends[1]]
    for place in qmc.Halton(1, scramble=False).random(made + _POINTS + 1)[made + 1 :, 0]:
        yield Way(ends, likely, start + (_EDGE + (1.0 - 2.0 * _EDGE) * place) * (end - start), untested=True)


def _tree(ways: Sequence[tuple[int, int]], group: NDArray[np.int64]) -> set[tuple[int, int]]:
    """Return those of ways between runs of different groups, shortest first, that join what those before have not."""
    group, found = group.copy(), set[tuple[int, int]]()
    for i, j in ways:
        if group[i] != group[j]:
            found.add((i, j))
            group[group == group[j]] = group[i]
    return found


def _between_groups(group: NDArray[np.int64], kind: Vector, distance: Points) -> Iterator[tuple[int, int]]:
    """Yield the nearest runs of each two groups of one kind."""
    for one, other in itertools.combinations(list(dict.fromkeys(group.tolist()))[:_GROUPS], 2):
        a, b = np.flatnonzero(group == one), np.flatnonzero(group == other)
        if kind[a[0]] == kind[b[0]]:
            i, j = np.unravel_index(int(distance[np.ix_(a, b)].argmin()), (len(a), len(b)))
            yield int(a[i]), int(b[j])


def _bent(fitted: WarpedModel, a: Vector, b: Vector, cube: Cube) -> tuple[float, Vector, bool]:
    """Return the way from a to b (d,) over one more point, of many, on which the least P(critical) is largest.

    Coordinates that are the same at both ends stay.
    """
    a = cube.with_choices_of(b, a)
    rng, middle = stream(0, "ways"), 0.5 * (a + b)
    steps = rng.standard_normal((_BENDS, len(a)))
    steps *= rng.random((_BENDS, 1)) ** (1.0 / len(a)) / np.linalg.norm(steps, axis=1, keepdims=True)  # uniform in a ball
    over = np.clip(np.vstack([middle, middle + _REACH * np.linalg.norm(b - a) * (a != b) * steps]), 0.0, 1.0)
    least = np.minimum(*(_probed(fitted, np.broadcast_to(end, over.shape), over)[1].min(axis=1) for end in (a, b)))
    least = np.minimum(least, fitted.probability(over))
    best = int(least.argmax()) if least.max() > _DOUBT[0] else 0  # excluded: straight
    return float(least[best]), over[best], bool(least[best] > _JOINED)


def doubtful(ways: list[Way]) -> list[Way]:
    """Return the ways on which a run would tell something, those that are most in doubt first."""
    found = [way for way in ways if _DOUBT[0] < way.least and (way.least < _DOUBT[1] or way.untested)]
    return sorted(found, key=lambda way: abs(way.least - 0.5))


def unasked(ways: list[Way], links: Sequence[Link]) -> list[Way]:
    """Return the shortest ways that would make all modes one and on which no run was made, whatever the metamodel says there.

    Where a metric jumps, a metamodel knows little beside its runs, and yet excludes most. Ends of both are indices of runs.
    """
    known = {link.ends for link in links}
    return [way for way in ways if way.nearest and way.ends not in known]


def _linked(
    fitted: WarpedModel, u: Points, kind: Vector, cube: Cube, *, noisy: bool = False, tested: Pairs = (), sure: Pairs = (),
    between: RunsBetween | None = None,
) -> tuple[NDArray[np.int64], list[tuple[int, int]]]:  # fmt: skip
    """Return (n,) group numbers, and the pairs that join them."""
    n, pairs = len(u), list[tuple[int, int]]()
    level = _JOINED * fitted.probability(u) if noisy else np.full(n, _JOINED)
    group = np.arange(n, dtype=np.int64)
    distance = cdist(u, u)

    denied = np.zeros((n, n), dtype=np.bool_)

    def join(i: int, j: int) -> None:
        if group[i] != group[j]:
            pairs.append((i, j))
            group[group == group[j]] = group[i]

    def judged(i: int, j: int) -> None:
        one, other = group == group[i], group == group[j]
        if between is None or distance[i, j] == 0.0 or between.likely(i, j, (one, other), min(level[i], level[j])) >= LIKELY:
            join(i, j)
        else:  # the nearest way between two modes decides
            denied[np.ix_(one, other)] = denied[np.ix_(other, one)] = True

    for i, j in tested:
        if kind[i] == kind[j] and ((i, j) in sure or _probed(fitted, u[[i]], u[[j]], cube)[1].min() > _DOUBT[0]):
            join(i, j)
    first, second = np.triu_indices(n, 1)
    alike = kind[first] == kind[second]
    first, second = first[alike], second[alike]
    order = np.argsort(distance[first, second], kind="stable")
    first, second = first[order], second[order]
    while len(first):
        apart = group[first] != group[second]
        first, second = first[apart], second[apart]
        a, b = first[:_CHUNK], second[:_CHUNK]
        first, second = first[_CHUNK:], second[_CHUNK:]
        if len(a) == 0:
            break
        least = np.minimum(level[a], level[b])[:, None]
        inside: Mask = (_probed(fitted, u[a], u[b], cube)[1] > least).all(axis=1) | (distance[a, b] == 0.0)
        for i, j in zip(a[inside].tolist(), b[inside].tolist(), strict=True):
            if group[i] != group[j] and not denied[i, j]:
                judged(i, j)
    return group, pairs


def _probed(fitted: WarpedModel, a: Points, b: Points, cube: Cube = CONTINUOUS) -> tuple[NDArray[np.float64], Points]:
    """Return (m, k, d) points on the segments from a to b (m, d), and (m, k) P(critical) there.

    There are nine between the ends; where inputs have choices the first end with those of the other one is a point too.
    """
    steps = np.linspace(0.0, 1.0, _PROBES + 2)[0 if cube.nominal else 1 : -1, None]
    a = cube.with_choices_of(b, a)
    probes = a[:, None, :] * (1.0 - steps) + b[:, None, :] * steps
    return probes, fitted.probability(probes.reshape(-1, a.shape[1])).reshape(len(a), len(steps))
