"""Covariates of any drawn scene: who meets the ego's path, and how long before or after the ego gets there."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from sbt.plugins import kept
from sbt.problem.arrays import Points
from sbt.problem.plain import Values
from sbt.sumo.actors import Actor, Scene
from sbt.sumo.nets import net_file, pavements
from sbt.sumo.projecting import Arrivals, arrivals_at, beside, crossing_of, driver_value, gaps
from sbt.sumo.road_ahead import path_of

__all__ = ["general"]

_SPACING = 1.0
"""Between the points of a path (m)."""
_SAME_WAY, _ACROSS, _OPPOSITE = 4.5, 2.5, 1.5
"""Distance within which paths conflict, by how their headings differ (m): the lane beside counts, the oncoming one does not."""
_NEIGHBOURS = 3
_FOOT, _SLOWEST_WALK = 2.0, 0.3
"""Distance within which a way on foot meets the ego's path (m), and speed below which nobody is projected (m/s)."""


def general(net: str) -> Callable[[Values, Scene], Mapping[str, float]]:
    """Return the covariates of scenes on a network: gaps and neighbours, as of the moment at which the ego gets to each conflict.

    Every other vehicle that keeps to lanes is projected to the first place where its path comes near the ego's; who is ahead of
    the ego in its lane, to where the ego is. Persons who walk by SUMO's model go straight from pavement to pavement, at the
    speed of their start. The times are relative to when the ego is there at the speed of its start. Who is moved by pose is
    not told.
    """

    def covariates(values: Values, scene: Scene) -> dict[str, float]:
        del values  # what they decide is in the scene
        ego, others = scene.actors[0], [a for a in scene.actors[1:] if not a.person and a.pose is None]
        parts = list(_meeting(net, ego, others))
        time = np.concatenate([part.time for part in parts]) if parts else np.empty(0)
        speed = np.concatenate([part.speed for part in parts]) if parts else np.empty(0)
        order = np.argsort(time, kind="stable")
        relative = Arrivals(time[order], speed[order])
        found = {"vehicles": float(len(time)), **gaps(relative, 0.0), **beside(relative, 0.0, max(ego.speed, 1.0), _NEIGHBOURS)}
        walkers = _walkers(net, ego, [a for a in scene.actors[1:] if a.person and a.pose is None])
        told = {"persons": float(len(walkers.time)), **gaps(walkers, 0.0, longer_than=(), following=2)}
        return found | {f"person_{name}" if name != "persons" else name: value for name, value in told.items()}

    return covariates


def _walkers(net: str, ego: Actor, persons: list[Actor]) -> Arrivals:
    """Return when persons get to where their way meets the ego's path, less when the ego does, sorted."""
    file, times = str(net_file(net)), []
    for person in persons:
        way = _way_on_foot(file, person.route)
        found = None if way is None else _crossed(file, (ego.route, ego.lane, ego.position), person.route)
        if way is None or found is None:
            continue
        length, forwards = way
        done = person.position if forwards else length - person.position
        there = (found[1] - done) / max(person.speed, _SLOWEST_WALK)
        times.append((there - (found[0] - ego.position) / max(ego.speed, 1.0), person.speed))
    ordered = np.array(sorted(times)).reshape(-1, 2)
    return Arrivals(ordered[:, 0], ordered[:, 1])


@kept
def _crossed(file: str, ego: tuple[tuple[str, ...], int, float], route: tuple[str, ...]) -> tuple[float, float] | None:
    """Return where on the ego's path and on a way on foot (m) they first come near each other ahead of the ego."""
    ours, theirs = _path(file, *ego[:2]), _on_foot(file, route)
    if ours is None or theirs is None:
        return None
    start = int(ego[2] / _SPACING)
    if len(ours) - start < 2 or len(theirs[0]) < 2:
        return None
    found = crossing_of(ours[start:], theirs[0], lambda _: _FOOT)
    return None if found is None else (found[0] + start * _SPACING, found[1])


def _way_on_foot(file: str, route: tuple[str, ...]) -> tuple[float, bool] | None:
    """Return the length of the first edge of a way on foot (m), and whether it is walked in its direction."""
    found = _on_foot(file, route)
    return None if found is None else found[1:]


@kept
def _on_foot(file: str, route: tuple[str, ...]) -> tuple[Points, float, bool] | None:
    """Return the (n, 2) points, a metre apart, of a straight walk from edge to edge; its first edge's length and direction."""
    shapes = [pavements(file).get(edge) for edge in route]
    known = [shape for shape in shapes if shape is not None]
    if len(known) < len(shapes) or not known:
        return None
    length = float(np.hypot(*np.diff(known[0], axis=0).T).sum())
    forwards = len(known) < 2 or _apart(known[0][-1], known[1]) <= _apart(known[0][0], known[1])
    way = [known[0] if forwards else known[0][::-1]]
    for shape in known[1:]:
        ahead = np.hypot(*(shape[0] - way[-1][-1])) <= np.hypot(*(shape[-1] - way[-1][-1]))
        way.append(shape if ahead else shape[::-1])
    return _spaced(np.concatenate(way)), length, forwards


def _apart(point: Points, shape: Points) -> float:
    """Return the distance of a point (2,) to the nearer end of a shape (m)."""
    return float(min(np.hypot(*(shape[0] - point)), np.hypot(*(shape[-1] - point))))


def _meeting(net: str, ego: Actor, others: list[Actor]) -> Iterator[Arrivals]:
    """Yield, for the vehicles of each lane and route, when they get to the conflict less when the ego does."""
    file = str(net_file(net))
    path = _path(file, ego.route, ego.lane)

    def way(a: Actor) -> tuple[tuple[str, ...], int]:
        return a.route, a.lane

    for (route, lane), group in itertools.groupby(sorted(others, key=way), key=way):
        found = _conflict(file, (ego.route, ego.lane, ego.position), (route, lane))
        if found is None or path is None:
            continue
        ours, theirs = found
        cars = sorted(group, key=lambda a: -a.position)
        speed = max(ego.speed, 1.0)
        limits = [a.speed / max(driver_value(a, "speedFactor", 1.0), 1e-6) for a in cars]
        there = arrivals_at(theirs, cars, float(np.median(limits)))
        yield Arrivals(there.time - (ours - ego.position) / speed, there.speed)


@kept
def _conflict(
    file: str, ego: tuple[tuple[str, ...], int, float], other: tuple[tuple[str, ...], int]
) -> tuple[float, float] | None:
    """Return where on the two paths (m) they first come near each other ahead of the ego; None where they do not."""
    ours, theirs = _path(file, *ego[:2]), _path(file, *other)
    if ours is None or theirs is None:
        return None
    start = int(ego[2] / _SPACING)
    if len(ours) - start < 2 or len(theirs) < 2:
        return None
    found = crossing_of(ours[start:], theirs, _near)
    return None if found is None else (found[0] + start * _SPACING, found[1])


def _near(cosine: float) -> float:
    return _OPPOSITE if cosine < -0.5 else _SAME_WAY if cosine > 0.5 else _ACROSS


@kept
def _path(file: str, route: tuple[str, ...], lane: int) -> Points | None:
    """Return the (n, 2) points of the path of a route, a metre apart; None where it has no lanes."""
    try:
        shapes, _ = path_of(file, route, lane)
    except KeyError:
        return None
    return _spaced(np.concatenate([shape if k == 0 else shape[1:] for k, shape in enumerate(shapes)]))


def _spaced(points: Points) -> Points:
    """Return points (m, 2) along a line (n, 2), a metre apart."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    s = np.arange(0.0, along[-1], _SPACING)
    return np.column_stack([np.interp(s, along, points[:, k]) for k in (0, 1)])
