"""Time to collision along the paths that were driven: for bends and turns, where straight extrapolation misleads.

On a roundabout or in a turn, road users that never come close may point at each other all the time. Here both are
assumed to follow their own recorded paths, and then the lanes of their routes; only their speeds are extrapolated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sbt.metrics.geometry import contact_share, part_pairs
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import first_contact
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["HORIZON", "path_of", "ttc_on_paths"]

HORIZON = 5.0
"""Time to collision of road users that do not interact, and the largest value reported (s)."""
_STEP = 0.2
"""Step of the prediction (s); in between, centres move on straight lines, with the headings at its end."""
_TURNED = 0.02
"""A step in which a corner moves by more than this because its rectangle turns (m) is divided ..."""
_SPLIT, _FINEST = 4, 0.02
"""... by so much, down to this (s): else the tail of a truck that turns seems to touch what it passes."""


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Predicted positions and headings of one actor, (t, k): at k times after each of t instants."""

    x: np.ndarray
    y: np.ndarray
    heading: np.ndarray


def ttc_on_paths(trace: Trace, ego: str = "ego", other: str = "co") -> Vector:
    """Return the (t,) time until the rectangles touch if both follow their recorded paths at their current speeds (s).

    At most 5 s, also while one of them is not there, and 0 from the first contact on. After its last instant an actor goes
    on along its way (`Trace.ways`); where that is unknown, or at its end, straight ahead.
    """
    times = np.full(len(trace.time), HORIZON)
    if not trace.present[:, [trace.actors.index(name) for name in (ego, other)]].all():
        for instants, part in joint_intervals(trace, ego, other):
            times[instants] = ttc_on_paths(part)
        return times
    for a, b in part_pairs(trace.actor(ego), trace.actor(other)):
        _predict_contacts(a, b, times)
    contact = first_contact(trace, ego, other)
    if contact is not None:
        times[contact:] = 0.0
    return np.minimum(times, HORIZON)


def _predict_contacts(a: ActorTrace, b: ActorTrace, times: Vector) -> None:
    """Lower the (t,) times to those until two rectangles touch."""
    after = np.arange(0.0, HORIZON + 0.5 * _STEP, _STEP)
    reach = 0.5 * (np.hypot(a.length, a.width) + np.hypot(b.length, b.width))
    farthest = HORIZON * (np.abs(a.speed) + np.abs(b.speed)) + reach
    near = np.flatnonzero(np.hypot(b.x - a.x, b.y - a.y) <= farthest)
    if near.size:
        p, q = _predict(a, near, after), _predict(b, near, after)
        dx, dy = q.x - p.x, q.y - p.y  # (t, k)
        moved = np.hypot(np.diff(dx, axis=1), np.diff(dy, axis=1))
        rows, steps = np.nonzero(np.hypot(dx[:, 1:], dy[:, 1:]) <= reach + moved)  # circumscribed circles first
        np.minimum.at(times, near[rows], _contact_times(a, b, near[rows], _STEP * steps, _STEP))


def _contact_times(a: ActorTrace, b: ActorTrace, rows: np.ndarray, start: np.ndarray, length: float) -> Vector:
    """Return the (n,) times at which the rectangles touch in steps of the prediction (s after the instants), inf where not.

    Args:
        a: one actor.
        b: the other.
        rows: (n,) instants from which is predicted.
        start: (n,) begin of the steps (s after the instants).
        length: of the steps (s).
    """
    p, q = (_predict(actor, rows, np.stack([start, start + length], axis=1)) for actor in (a, b))
    dx, dy = (q.x - p.x)[:, 0], (q.y - p.y)[:, 0]
    every = np.arange(len(rows))
    ends = _states(a, p, every, 1), _states(b, q, every, 1)
    times: Vector = start + length * contact_share(*ends, dx, dy)
    turned = np.zeros(len(rows))
    for actor, predicted in ((a, p), (b, q)):
        corner = 0.5 * np.hypot(actor.length, actor.width)
        turned = np.fmax(turned, np.abs(np.diff(predicted.heading, axis=1)[:, 0]) * corner)
    if length <= _FINEST or not (turned > _TURNED).any():
        return times
    wide = 2.0 * float(turned[turned > _TURNED].max())  # whatever is between the headings lies within
    larger = [replace(end, length=end.length + wide, width=end.width + wide) for end in ends]
    inside = np.flatnonzero((turned > _TURNED) & np.isfinite(contact_share(larger[0], larger[1], dx, dy)))
    times[turned > _TURNED] = np.inf
    if len(inside):
        fine = length / _SPLIT
        begins = (start[inside, None] + fine * np.arange(_SPLIT)).ravel()
        finer = _contact_times(a, b, np.repeat(rows[inside], _SPLIT), begins, fine)
        times[inside] = finer.reshape(-1, _SPLIT).min(axis=1)
    return times


def _predict(actor: ActorTrace, rows: np.ndarray, after: Vector) -> _Prediction:
    """Return the prediction for the times `after` (s), (k,) or (n, k), each of the n instants `rows`; NaN once it has left."""
    x, y, heading = path_of(actor)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    travelled = way[rows, None] + actor.speed[rows, None] * after
    beyond = np.maximum(travelled - way[-1], 0.0)
    if actor.way is not None and len(actor.way) and np.isnan(actor.way[-1, 0]):
        beyond[beyond > 0.0] = np.nan
    return _Prediction(
        np.interp(travelled, way, x) + beyond * np.cos(heading[-1]),
        np.interp(travelled, way, y) + beyond * np.sin(heading[-1]),
        np.interp(travelled, way, heading),
    )


def path_of(actor: ActorTrace) -> tuple[Vector, Vector, Vector]:
    """Return x, y and heading along the path of an actor, which is there all the time, and along its way after that."""
    x, y, heading = actor.x, actor.y, actor.heading
    if actor.way is not None:
        on = actor.way[~np.isnan(actor.way[:, 0])]
        x, y, heading = (np.concatenate([part, rest]) for part, rest in zip((x, y, heading), on.T, strict=True))
    return x, y, np.unwrap(heading)


def _states(actor: ActorTrace, prediction: _Prediction, rows: np.ndarray, step: int) -> ActorTrace:
    """Return the predicted states at the given rows and step, one after another."""
    still = np.zeros(len(rows))
    x, y, heading = (field[rows, step] for field in (prediction.x, prediction.y, prediction.heading))
    return ActorTrace(x, y, heading, still, still, actor.length, actor.width)
