"""Covariates of any drawn scene: who meets the ego's path, and how long before or after the ego gets there."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from sbt.plugins import kept
from sbt.problem.arrays import Points
from sbt.problem.plain import Values
from sbt.sumo.actors import Actor, Scene
from sbt.sumo.nets import net_file
from sbt.sumo.projecting import Arrivals, arrivals_at, beside, crossing_of, driver_value, gaps
from sbt.sumo.road_ahead import path_of

__all__ = ["general"]

_SPACING = 1.0
"""Between the points of a path (m)."""
_SAME_WAY, _ACROSS, _OPPOSITE = 4.5, 2.5, 1.5
"""Distance within which paths conflict, by how their headings differ (m): the lane beside counts, the oncoming one does not."""
_NEIGHBOURS = 3


def general(net: str) -> Callable[[Values, Scene], Mapping[str, float]]:
    """Return the covariates of scenes on a network: gaps and neighbours, as of the moment at which the ego gets to each conflict.

    Every other vehicle that keeps to lanes is projected to the first place where its path comes near the ego's; who is ahead of
    the ego in its lane, to where the ego is. The times are relative to when the ego is there at the speed of its start. Persons
    and vehicles that are moved by pose are not told.
    """

    def covariates(values: Values, scene: Scene) -> dict[str, float]:
        del values  # what they decide is in the scene
        ego, others = scene.actors[0], [a for a in scene.actors[1:] if not a.person and a.pose is None]
        parts = list(_meeting(net, ego, others))
        time = np.concatenate([part.time for part in parts]) if parts else np.empty(0)
        speed = np.concatenate([part.speed for part in parts]) if parts else np.empty(0)
        order = np.argsort(time, kind="stable")
        relative = Arrivals(time[order], speed[order])
        return {"vehicles": float(len(time)), **gaps(relative, 0.0), **beside(relative, 0.0, max(ego.speed, 1.0), _NEIGHBOURS)}

    return covariates


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
    points = np.concatenate([shape if k == 0 else shape[1:] for k, shape in enumerate(shapes)])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    s = np.arange(0.0, along[-1], _SPACING)
    return np.column_stack([np.interp(s, along, points[:, k]) for k in (0, 1)])
