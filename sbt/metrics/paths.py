"""Time to collision along the paths that were driven: for bends and turns, where straight extrapolation misleads.

On a roundabout or in a turn, road users that never come close may point at each other all the time. Here both are
assumed to follow their own recorded paths, and then the lanes of their routes; only their speeds are extrapolated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sbt.metrics.around import first_contacts
from sbt.metrics.courses import Course, near_steps
from sbt.metrics.geometry import contact_share, rectangles
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import first_contact
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["HORIZON", "path_of", "smallest_ttc_on_paths", "ttc_on_paths"]

HORIZON = 5.0
"""Time to collision of road users that do not interact, and the largest value reported (s)."""
_STEP, _STRIDES = 0.2, 5
"""Step of the prediction (s), in which centres move on straight lines, with the headings at its end; and strides of steps."""
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


@dataclass(frozen=True, eq=False)
class _Together:
    """Two actors while both are there: the first instant, the trace of that time, and their names in it."""

    first: int
    trace: Trace
    ego: str
    other: str

    @property
    def contact(self) -> int | None:
        """Index of the first contact; None without one."""
        return first_contact(self.trace, self.ego, self.other)


def ttc_on_paths(trace: Trace, ego: str = "ego", other: str | None = "co") -> Vector:
    """Return the (t,) time until the rectangles touch if both follow their recorded paths at their current speeds (s).

    At most 5 s, also while one of them is not there, and 0 from the first contact on. After its last instant an actor goes
    on along its way (`Trace.ways`); where that is unknown, or at its end, straight ahead.

    Args:
        trace: t instants.
        ego: one actor.
        other: another; None: everyone else, of whom the smallest time counts.
    """
    met = list(_together(trace, ego, other))
    times = np.full(len(trace.time), HORIZON)
    for _, first, rows, found in _predicted_contacts(met):
        np.minimum.at(times, first + rows, found)
    for one in met:
        if one.contact is not None:
            times[one.first + one.contact : one.first + len(one.trace.time)] = 0.0
    return times


def smallest_ttc_on_paths(trace: Trace, ego: str = "ego") -> float:
    """Return the smallest time of `ttc_on_paths` to anyone else, of all instants (s)."""
    if first_contacts(trace, ego):
        return 0.0
    met = list(_together(trace, ego, None))
    if any(one.contact is not None for one in met if one.trace is not trace):
        return 0.0
    least = HORIZON
    for earliest, _, _, found in _predicted_contacts(met):
        if earliest >= least:
            break
        least = min(least, float(found.min()))
    return least


def _together(trace: Trace, ego: str, other: str | None) -> Iterator[_Together]:
    """Yield every interval in which the ego and another, or anyone else, are both there."""
    there = trace.present.all(axis=0)
    own = trace.actors.index(ego)
    for k, name in enumerate(trace.actors):
        if k == own or other not in (None, name):
            continue
        if there[own] and there[k]:
            yield _Together(0, trace, ego, name)
        else:
            for instants, part in joint_intervals(trace, ego, name):
                yield _Together(instants.start, part, "ego", "co")


def _predicted_contacts(met: Sequence[_Together]) -> Iterator[tuple[float, int, np.ndarray, Vector]]:
    """Yield when rectangles touch on their paths; what is yielded later is not earlier than the begin of its stride.

    Yields:
        begin of the stride (s), first instant of the interval, (n,) instants in it, and (n,) times until they touch (s).
    """
    own: dict[int, list[Course]] = {}
    pairs, first = [], []
    for one in met:
        if id(one.trace) not in own:
            own[id(one.trace)] = [Course(each) for each in rectangles(one.trace.actor(one.ego))]
        others = [Course(each) for each in rectangles(one.trace.actor(one.other))]
        pairs += [(a, b) for a in own[id(one.trace)] for b in others]
        first += [one.first] * (len(pairs) - len(first))
    for earliest, near in near_steps(pairs, _STEP, _STRIDES):
        for k, rows, steps in near:
            yield earliest, first[k], rows, _contact_times(*pairs[k], rows, _STEP * steps, _STEP)


def _contact_times(a: Course, b: Course, rows: np.ndarray, start: np.ndarray, length: float) -> Vector:
    """Return the (n,) times at which the rectangles touch in steps of the prediction (s after the instants), inf where not.

    Args:
        a: one actor.
        b: the other.
        rows: (n,) instants from which is predicted.
        start: (n,) begin of the steps (s after the instants).
        length: of the steps (s).
    """
    p, q = (_predict(course, rows, np.stack([start, start + length], axis=1)) for course in (a, b))
    dx, dy = (q.x - p.x)[:, 0], (q.y - p.y)[:, 0]
    every = np.arange(len(rows))
    ends = _states(a.actor, p, every, 1), _states(b.actor, q, every, 1)
    times: Vector = start + length * contact_share(*ends, dx, dy)
    turned = np.zeros(len(rows))
    for course, predicted in ((a, p), (b, q)):
        corner = 0.5 * np.hypot(course.actor.length, course.actor.width)
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


def _predict(course: Course, rows: np.ndarray, after: Vector) -> _Prediction:
    """Return the prediction for the times `after` (s), (k,) or (n, k), each of the n instants `rows`; NaN once it has left."""
    way = course.way
    travelled = way[rows, None] + course.actor.speed[rows, None] * after
    beyond = np.maximum(travelled - way[-1], 0.0)
    if course.leaves:
        beyond[beyond > 0.0] = np.nan
    heading = course.heading
    return _Prediction(
        np.interp(travelled, way, course.x) + beyond * np.cos(heading[-1]),
        np.interp(travelled, way, course.y) + beyond * np.sin(heading[-1]),
        np.interp(travelled, way, heading),
    )


def path_of(actor: ActorTrace) -> tuple[Vector, Vector, Vector]:
    """Return x, y and heading along the path of an actor, which is there all the time, and along its way after that."""
    course = Course(actor)
    return course.x, course.y, course.heading


def _states(actor: ActorTrace, prediction: _Prediction, rows: np.ndarray, step: int) -> ActorTrace:
    """Return the predicted states at the given rows and step, one after another."""
    still = np.zeros(len(rows))
    x, y, heading = (field[rows, step] for field in (prediction.x, prediction.y, prediction.heading))
    return ActorTrace(x, y, heading, still, still, actor.length, actor.width)
