"""Which roads of a network pass over each other: edges that cross in the plane without a junction.

Two road users on such edges, or on those that lead there, are on different levels, and no conflict. Where the network has heights
they decide; else a crossing without a junction and without a short way between is taken for a bridge, and the user is told once.
"""

from __future__ import annotations

import heapq
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from sbt.metrics.heights import LEVEL_HEIGHT, STACKED

__all__ = ["Levels", "is_known", "levels_of", "road_of"]

_RAMP = 60.0
"""A way between two roads that is not longer does not lead to another level (m): 3 m in 60 m are a slope of 5 %."""
_APPROACH = 150.0
"""Edges that begin or end within this distance of a bridge belong to its road (m)."""
_PIECE = 20.0
"""Longest piece of a lane in the search for crossings (m)."""
_CHUNK = 20_000
_NAMED = 3
_WALKING_AREA = re.compile(r":.*_w\d+")
_FLAT = 1e-6


@dataclass(frozen=True)
class Levels:
    """The roads of a network on different levels.

    Attributes:
        apart: edge to the edges that are on another level than it; edges without such are missing.
        inferred: crossings (edge, edge, x, y) that only the missing junction tells to be bridges: the network is flat.
        level: those where heights are told, but differ by less than a vehicle: roads that meet there unknown to SUMO.
        stacked: whether a road passes above another one, or itself, so that heights tell levels.
    """

    apart: Mapping[str, frozenset[str]] = field(default_factory=dict)
    inferred: tuple[tuple[str, str, float, float], ...] = ()
    level: tuple[tuple[str, str, float, float], ...] = ()
    stacked: bool = False

    @property
    def several(self) -> bool:
        """Whether road users may be on different levels."""
        return bool(self.apart) or self.stacked

    @property
    def warning(self) -> str:
        """What the user is told; "" where there is nothing."""
        said = []
        if self.inferred:
            said.append(
                f"the network has no heights where edges cross without a junction ({_named(self.inferred)}): they are taken"
                " for bridges, and road users on one are not recorded for an ego on the other; give the nodes heights (z) to"
                " decide it"
            )
        if self.level:
            said.append(
                f"edges cross without a junction at heights that differ by less than {LEVEL_HEIGHT:g} m"
                f" ({_named(self.level)}): they are taken to meet there, although in SUMO nobody sees the other; give bridges"
                " their height (z), or make a junction"
            )
        return "; ".join(said)


def _named(crossings: Sequence[tuple[str, str, float, float]]) -> str:
    few = ", ".join(f"'{a}' and '{b}' at ({x:.0f}, {y:.0f})" for a, b, x, y in crossings[:_NAMED])
    return f"{few} and {len(crossings) - _NAMED} more" if len(crossings) > _NAMED else few


def levels_of(sumo: Any) -> Levels:
    """Return the levels of the network that SUMO has loaded; computed once a network and process."""
    try:
        state = Path(sumo.simulation.getOption("net-file")).stat()  # to resolve the path would take ten times as long
    except OSError:  # traci with a SUMO that has another working directory
        return _find(sumo)
    return _cached((state.st_dev, state.st_ino, state.st_mtime_ns, state.st_size), _Client(sumo))


def is_known(sumo: Any, vehicle: str) -> bool:
    """Return whether a vehicle is in the simulation: SUMO does not list as arrived whom a loop has removed."""
    try:
        sumo.vehicle.getPosition(vehicle)
    except sumo.TraCIException:
        return False
    return True


def road_of(sumo: Any, name: str, *, person: bool = False) -> str:
    """Return the road that somebody is on; "" for a vehicle off the lanes, where libsumo's getRoadID ends the process."""
    road: str = sumo.person.getRoadID(name) if person else sumo.vehicle.getLaneID(name).rpartition("_")[0]
    return road


class _Client:
    """SUMO's client; equal to any other one, so that it does not count in a cache."""

    def __init__(self, sumo: Any):
        self.sumo = sumo

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Client)

    def __hash__(self) -> int:
        return 0


@lru_cache(maxsize=8)
def _cached(file: tuple[int, ...], client: _Client) -> Levels:
    found = _find(client.sumo)
    del client.sumo  # the cache keeps the key
    return found


@dataclass(frozen=True)
class _Road:
    """One edge: the nodes at its ends and the middle of its first lane."""

    edge: str
    ends: tuple[str, str]
    line: tuple[tuple[float, float], ...]

    @property
    def internal(self) -> bool:
        return self.edge.startswith(":")


def _roads(sumo: Any) -> list[_Road]:
    """Return all edges but the areas where pedestrians walk, which have no direction."""
    edge, shape = sumo.edge, sumo.lane.getShape
    names = (name for name in edge.getIDList() if not _WALKING_AREA.fullmatch(name))
    return [_Road(name, (edge.getFromJunction(name), edge.getToJunction(name)), tuple(shape(f"{name}_0"))) for name in names]


def _find(sumo: Any) -> Levels:
    roads = _roads(sumo)
    crossings = list(_crossings(roads))
    heights = [_height(sumo, roads[i], at_i) - _height(sumo, roads[j], at_j) for i, j, at_i, at_j, _, _ in crossings]
    stacked = max(map(abs, heights), default=0.0) >= LEVEL_HEIGHT or _stacked(sumo, roads)
    if not crossings:
        return Levels(stacked=stacked)
    network = _Network(roads)
    apart: dict[str, set[str]] = defaultdict(set)
    inferred, level = [], []
    for (i, j, at_i, at_j, x, y), height in zip(crossings, heights, strict=True):
        a, b = roads[i], roads[j]
        if network.connected(a, at_i, b, at_j):
            continue
        if abs(height) < _FLAT and not stacked:  # else heights tell that there is no bridge
            inferred.append((a.edge, b.edge, x, y))
        elif abs(height) < LEVEL_HEIGHT:
            level.append((a.edge, b.edge, x, y))
            continue
        for one, other in product(network.road(a, at_i), network.road(b, at_j)):
            if not network.near(one, other):
                apart[one.edge].add(other.edge)
                apart[other.edge].add(one.edge)
    known = {edge: frozenset(others) for edge, others in apart.items()}
    return Levels(known, tuple(inferred), tuple(level), stacked)


def _stacked(sumo: Any, roads: list[_Road]) -> bool:
    """Return whether there are places on roads one above the other."""
    from scipy.spatial import cKDTree

    if all(abs(_height(sumo, road, at)) < _FLAT for road in roads for at in (0.0, math.inf)):
        return False
    start, end, owner, place = _pieces(roads)
    at = place + np.hypot(*(end - start).T)
    points = np.concatenate([start, end])
    heights = np.array([_height(sumo, roads[k], x) for k, x in zip((*owner, *owner), (*place, *at), strict=True)])
    pairs = cKDTree(points).query_pairs(STACKED, output_type="ndarray")
    return bool((np.abs(heights[pairs[:, 0]] - heights[pairs[:, 1]]) >= LEVEL_HEIGHT).any())


def _height(sumo: Any, road: _Road, at: float) -> float:
    """Return the height of a place on an edge (m), 0 where the network has none; SUMO's lengths may differ from the lines'."""
    length = sumo.lane.getLength(f"{road.edge}_0")
    position = min(max(at * length / max(_length(road.line), 1e-3), 0.0), length)
    return float(sumo.simulation.convert3D(road.edge, position, 0)[2])


class _Network:
    """The ways between the junctions of a network, as long as they are short."""

    def __init__(self, roads: list[_Road]):
        self._ways: dict[str, list[tuple[str, float]]] = defaultdict(list)
        self._at: dict[str, list[_Road]] = defaultdict(list)
        self._reached: dict[str, dict[str, float]] = {}
        for road in roads:
            start, end = road.ends
            for node in {start, end}:
                self._at[node].append(road)
            if start != end:
                length = _length(road.line)
                self._ways[start].append((end, length))
                self._ways[end].append((start, length))

    def _reachable(self, node: str) -> dict[str, float]:
        """Return the nodes within a ramp's length and their distances (m), in whatever direction."""
        if node not in self._reached:
            found: dict[str, float] = {}
            queue = [(0.0, node)]
            while queue:
                far, at = heapq.heappop(queue)
                if at not in found:
                    found[at] = far
                    for to, length in self._ways[at]:
                        if far + length < _RAMP:
                            heapq.heappush(queue, (far + length, to))
            self._reached[node] = found
        return self._reached[node]

    def connected(self, a: _Road, at_a: float, b: _Road, at_b: float) -> bool:
        """Return whether a short way leads from a place on one road (m from its beginning) to a place on the other."""
        for (node, far), (goal, rest) in product(_to_ends(a, at_a), _to_ends(b, at_b)):
            if far + rest + self._reachable(node).get(goal, math.inf) < _RAMP:
                return True
        return False

    def near(self, a: _Road, b: _Road) -> bool:
        """Return whether two edges are one, share a junction, or are joined by a short edge."""
        return a is b or any(goal in self._reachable(node) for node in a.ends for goal in b.ends)

    def road(self, a: _Road, at: float) -> list[_Road]:
        """Return an edge and those that continue it near a place on it."""
        found = {a.edge: a}
        for node, far in _to_ends(a, at):
            if far < _APPROACH and not a.internal:
                found.update((road.edge, road) for road in self._at[node])
        return list(found.values())


def _to_ends(road: _Road, at: float) -> tuple[tuple[str, float], tuple[str, float]]:
    """Return the nodes at the ends of an edge and their distances from a place on it (m)."""
    return (road.ends[0], at), (road.ends[1], _length(road.line) - at)


def _length(line: tuple[tuple[float, float], ...]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(line))


def _pieces(roads: list[_Road]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (n, 2) the beginnings and ends of short pieces of the lanes, and (n,) their road and place on it (m)."""
    starts, ends, owner, place = [], [], [], []
    for k, road in enumerate(roads):
        along, line = 0.0, (road.line[0], road.line[-1]) if road.internal else road.line  # ways in a junction are short
        for (ax, ay), (bx, by) in pairwise(line):
            step = math.hypot(bx - ax, by - ay)
            n = max(1, math.ceil(step / _PIECE))
            for i in range(n):
                starts.append((ax + (bx - ax) * i / n, ay + (by - ay) * i / n))
                ends.append((ax + (bx - ax) * (i + 1) / n, ay + (by - ay) * (i + 1) / n))
                owner.append(k)
                place.append(along + step * i / n)
            along += step
    return np.array(starts), np.array(ends), np.array(owner), np.array(place)


def _crossings(roads: list[_Road]) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Yield where lines of edges without a common junction cross: both edges, the places on them (m), x and y; once a pair."""
    from scipy.spatial import cKDTree

    start, end, owner, place = _pieces(roads)
    if not len(owner):
        return
    numbers = {node: k for k, node in enumerate(sorted({node for road in roads for node in road.ends}))}
    nodes = np.array([[numbers[node] for node in road.ends] for road in roads])
    internal = np.array([road.internal for road in roads])[owner]
    middle, normal = 0.5 * (start + end), np.flatnonzero(~internal)
    if not len(normal):
        return
    tree, seen = cKDTree(middle[normal]), set()
    for first in range(0, len(owner), _CHUNK):
        found = tree.query_ball_point(middle[first : first + _CHUNK], _PIECE)
        i = first + np.repeat(np.arange(len(found)), [len(f) for f in found])
        j = normal[np.concatenate([np.asarray(f, dtype=np.int64) for f in found])]
        once = (owner[i] != owner[j]) & (internal[i] | (i < j))
        i, j = i[once], j[once]
        a, b = nodes[owner[i]], nodes[owner[j]]
        strangers = (a[:, :, None] != b[:, None, :]).all(axis=(1, 2))
        i, j = i[strangers], j[strangers]
        s, t = _intersections(start[i], end[i], start[j], end[j])
        for k in np.flatnonzero((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)).tolist():
            p, q = int(i[k]), int(j[k])
            pair = (int(owner[p]), int(owner[q]))
            if pair not in seen:
                seen.add(pair)
                x, y = start[p] + s[k] * (end[p] - start[p])
                at, other_at = (float(place[r] + share * math.dist(start[r], end[r])) for r, share in ((p, s[k]), (q, t[k])))
                yield *pair, at, other_at, float(x), float(y)


def _intersections(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) where the segments from a to b and from c to d, (n, 2) each, cross, as shares of both; NaN if parallel."""
    u, v, w = b - a, d - c, c - a
    cross = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / cross
        t = (w[:, 0] * u[:, 1] - w[:, 1] * u[:, 0]) / cross
    return np.where(cross == 0, np.nan, s), np.where(cross == 0, np.nan, t)
