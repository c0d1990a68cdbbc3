"""Time to collision along the paths that were driven: for bends and turns, where straight extrapolation misleads.

On a roundabout or in a turn, road users that never come close may point at each other all the time. Here both are
assumed to follow their own recorded paths, and then the lanes of their routes; only their speeds are extrapolated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sbt.metrics.around import first_contacts
from sbt.metrics.courses import Course, near_steps
from sbt.metrics.geometry import Rectangles, contact_share, rectangles
from sbt.metrics.intervals import joint_intervals
from sbt.metrics.longitudinal import first_contact
from sbt.metrics.own_lanes import between_changes
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
    for instants, found in _predicted_contacts(trace, met):
        np.minimum.at(times, instants, found)
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
    return min((float(found.min()) for _, found in _predicted_contacts(trace, met, only_smallest=True)), default=HORIZON)


def _together(trace: Trace, ego: str, other: str | None) -> Iterator[_Together]:
    """Yield every interval in which the ego and another, or anyone else, are both there."""
    there: list[bool] = np.asarray(trace.present.all(axis=0)).tolist()
    own = trace.actors.index(ego)
    for k, name in enumerate(trace.actors):
        if k == own or other not in (None, name):
            continue
        if there[own] and there[k]:
            yield _Together(0, trace, ego, name)
        else:
            for instants, part in joint_intervals(trace, ego, name):
                yield _Together(instants.start, part, "ego", "co")


def _predicted_contacts(
    trace: Trace, met: Sequence[_Together], *, only_smallest: bool = False
) -> Iterator[tuple[np.ndarray, Vector]]:
    """Yield (n,) instants, and (n,) times until two rectangles touch on their paths from then on (s), at most the horizon.

    Args:
        trace: t instants.
        met: who is there together in it.
        only_smallest: larger times than the smallest one need not be exact, or be there.
    """
    pairs: list[tuple[Course, Course]] = []
    first: list[int] = []
    step = max(np.diff(trace.time).tolist(), default=0.0)
    own: dict[tuple[int, int, int], list[Course]] = {}  # by trace and stretch
    for one in met:
        for at, ego, other in between_changes(one.trace, one.ego, one.other):
            stretch = id(one.trace), at, len(ego.x)
            if stretch not in own:
                own[stretch] = [Course(each, step) for each in rectangles(ego)]
            others = [Course(each, step) for each in rectangles(other)]
            pairs += [(a, b) for a in own[stretch] for b in others]
            first += [one.first + at] * (len(pairs) - len(first))
    begins, least = np.array(first), HORIZON
    for begin, pair, rows, steps in near_steps(pairs, _STEP, _STRIDES):
        if only_smallest and begin >= least:
            break
        found = np.minimum(_contact_times(pairs, pair, rows, _STEP * steps, _STEP), HORIZON)
        least = min(least, float(found.min()))
        yield begins[pair] + rows, found


def _contact_times(
    pairs: Sequence[tuple[Course, Course]], which: np.ndarray, rows: np.ndarray, start: np.ndarray, length: float
) -> Vector:
    """Return the (n,) times at which the rectangles touch in steps of the prediction (s after the instants), inf where not.

    Args:
        pairs: of rectangles.
        which: (n,) of the pairs, in their order.
        rows: (n,) instants from which is predicted.
        start: (n,) begin of the steps (s after the instants).
        length: of the steps (s).
    """
    after = np.stack([start, start + length], axis=1)
    (old_a, a, turn_a), (old_b, b, turn_b) = (_predicted([both[k] for both in pairs], which, rows, after) for k in (0, 1))
    dx, dy = old_b[0] - old_a[0], old_b[1] - old_a[1]
    times: Vector = start + length * contact_share(a, b, dx, dy)
    turned = np.fmax(turn_a, turn_b)
    wide_turns = turned > _TURNED
    if length <= _FINEST or not wide_turns.any():
        return times
    wide = 2.0 * float(turned[wide_turns].max())  # whatever is between the headings lies within
    larger = [replace(end, length=end.length + wide, width=end.width + wide) for end in (a, b)]
    inside = np.flatnonzero(wide_turns & np.isfinite(contact_share(larger[0], larger[1], dx, dy)))
    times[wide_turns] = np.inf
    if len(inside):
        fine = length / _SPLIT
        begins = (start[inside, None] + fine * np.arange(_SPLIT)).ravel()
        again, instants = (np.repeat(each[inside], _SPLIT) for each in (which, rows))
        finer = _contact_times(pairs, again, instants, begins, fine)
        times[inside] = finer.reshape(-1, _SPLIT).min(axis=1)
    return times


_Motion = tuple[tuple[Vector, Vector], Rectangles, Vector]
"""x and y before a step, the rectangles after it, and how far their corners move because they turn (m), (n,) each."""


def _predicted(courses: Sequence[Course], which: np.ndarray, rows: np.ndarray, after: np.ndarray) -> _Motion:
    """Return how n rectangles on courses, in their order, move between two times (s), `after` (n, 2), after n instants.

    NaN once one has left the road.
    """
    parts, sizes = [], []
    edges = (np.flatnonzero(which[1:] != which[:-1]) + 1).tolist()
    ends = [k for k in edges if courses[which[k - 1]] is not courses[which[k]]]
    for begin, end in pairwise([0, *ends, len(which)]):
        course = courses[which[begin]]
        way, heading = course.way, course.heading
        travelled = course.begin[rows[begin:end], None] + course.actor.speed[rows[begin:end], None] * after[begin:end]
        x, y = np.interp(travelled, way, course.x), np.interp(travelled, way, course.y)
        beyond = travelled - way[-1]
        if beyond.max() > 0.0:
            beyond = np.where(beyond > 0.0, np.nan, 0.0) if course.leaves else np.maximum(beyond, 0.0)
            x, y = x + beyond * np.cos(heading[-1]), y + beyond * np.sin(heading[-1])
        parts.append((x, y, np.interp(travelled, way, heading)))
        sizes.append(np.broadcast_to([course.actor.length, course.actor.width], (end - begin, 2)))
    x, y, headings = (np.concatenate(column) for column in zip(*parts, strict=True))
    size = np.concatenate(sizes)
    turned = np.abs(headings[:, 1] - headings[:, 0]) * (0.5 * np.hypot(size[:, 0], size[:, 1]))
    now = Rectangles(x[:, 1], y[:, 1], headings[:, 1], size[:, 0], size[:, 1])
    return (x[:, 0], y[:, 0]), now, turned


def path_of(actor: ActorTrace) -> tuple[Vector, Vector, Vector]:
    """Return x, y and heading along the path of an actor, which is there all the time, and along its way after that."""
    course = Course(actor)
    return course.x, course.y, course.heading
