"""The part of a rectangle that is in the strip of another one, which is as wide as that and goes straight on, to both sides."""

from __future__ import annotations

import numpy as np

from sbt.metrics.geometry import corners, select_instants
from sbt.problem.arrays import Mask, Vector
from sbt.problem.trace import ActorTrace

__all__ = ["turned_in_behind"]


def turned_in_behind(a: ActorTrace, b: ActorTrace, rear: float, aside: Vector | float, where: Mask) -> Mask:
    """Return (t,) whether all of b that is in a's strip is behind a, though another part of b, beside the strip, is not.

    The projections of a rectangle that has turned are those of different corners: they tell where the strip is reached, and
    how far ahead the rectangle is, but not whether it is there in the strip.

    Args:
        a: a rectangle.
        b: another one.
        rear: how far behind the centre of a that ends, which a rectangle may only be the front of (m).
        aside: by how much the strip is wider than a, on either side (m).
        where: (t,) instants to be looked at; False elsewhere.
    """
    found = np.zeros(len(where), dtype=bool)
    (at,) = (where & (np.abs(np.sin(b.heading - a.heading)) > 1e-6)).nonzero()
    if at.size:
        edge = np.broadcast_to(0.5 * a.width + aside, where.shape)[at, None]
        found[at] = _front_between(select_instants(a, at), select_instants(b, at), edge) <= -rear
    return found


def _front_between(a: ActorTrace, b: ActorTrace, edge: np.ndarray) -> Vector:
    """Return (n,) how far ahead of a's centre what is left of b between two lines reaches (m), inf without any.

    Args:
        a: a rectangle, along whose heading the lines are.
        b: another one.
        edge: (n, 1) distance of the lines from a's centre (m).
    """
    away = corners(b) - np.stack([a.x, a.y], axis=-1)[:, None]
    cos, sin = np.cos(a.heading)[:, None], np.sin(a.heading)[:, None]
    along, left = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
    to_along, to_left = (np.roll(values, -1, axis=1) - values for values in (along, left))
    reached = [np.where(np.abs(left) <= edge, along, -np.inf)]
    for line in (edge, -edge):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (line - left) / to_left  # of each side, up to where it crosses the line
            reached.append(np.where((share >= 0.0) & (share <= 1.0), along + share * to_along, -np.inf))
    front = np.concatenate(reached, axis=1).max(axis=1)
    return np.where(np.isneginf(front), np.inf, front)
