"""Several vehicles under test in one run: each is watched by a recorder of its own, and the first contact ends the run.

Time 0 is the departure of the first one; the states of all recorders become one trace. The others have departures of their own,
which are compared like that of the first, and must come before the run is over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sbt.errors import RunError
from sbt.problem.arrays import Vector
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.problem.trace import ActorTrace, Trace
from sbt.seeds import stream
from sbt.sumo.departures import DepartureMonitor, RequestedDeparture, WaitingEgo, requested_departures
from sbt.sumo.files import SumoFiles
from sbt.sumo.guided import Placed
from sbt.sumo.recorder import Recorder, RecordingSettings, RunEnded

__all__ = ["Recorders", "further_recorders"]

_STATES = ("x", "y", "heading", "speed", "acceleration")


_ENDLESS = 1e9
"""Duration of what is watched until the first one's is over (s)."""


def further_recorders(sumo: Any, settings: RecordingSettings, files: SumoFiles, values: Values, seed: int) -> dict[str, Recorder]:
    """Return a recorder for each further vehicle under test, which compares its departure with what is requested."""
    found = {}
    for ego in settings.further:
        requested = {k: v for k, v in requested_departures(files, values, ego.id).items() if k == ego.id}
        departures = DepartureMonitor(sumo, WaitingEgo(ego.id, ego.delay, settings.wait), requested, files, values)
        own = replace(settings, ego=ego, duration=_ENDLESS, further=())
        found[ego.id] = Recorder(sumo, own, stream(seed, "ego", ego.id), departures, None)
    return found


class Recorders:
    """The recorders of several vehicles under test, with the interface of one.

    Args:
        first: that of the vehicle whose departure is time 0.
        further: those of the others by id.
    """

    def __init__(self, first: Recorder, further: Mapping[str, Recorder]):
        self._first, self._further = first, dict(further)
        self._watching = dict(further)
        self._ended = ""

    @property
    def _all(self) -> tuple[Recorder, ...]:
        return (self._first, *self._watching.values())

    @property
    def ended(self) -> str:
        """Why the run is over; "" while it goes on."""
        return self._ended

    @property
    def scenario_time(self) -> float | None:
        """Time since the departure of the first one (s); None before it."""
        return self._first.scenario_time

    def place(self, placed: Mapping[str, Placed]) -> None:
        """Record these road users, which are moved by position, as they are given."""
        for recorder in self._all:
            recorder.place(placed)

    def expect_departure(self, name: str, requested: RequestedDeparture) -> None:
        """Compare the departure of a vehicle that the loop adds with what it requests."""
        self._first.expect_departure(name, requested)

    def ignore_departure(self, name: str) -> None:
        """Do not compare the departure of a vehicle that the loop moves or removes."""
        for recorder in self._all:
            recorder.ignore_departure(name)

    def subscribe_again(self, name: str) -> None:
        """Subscribe once more to the surroundings of this one, if it is under test: the loop has ended all subscriptions."""
        for recorder in self._all:
            recorder.subscribe_again(name)

    def take_as_rigid(self, name: str) -> None:
        """Take the body of a vehicle that the loop moves by poses as a rectangle, however long it is."""
        for recorder in self._all:
            recorder.take_as_rigid(name)

    def take_as_put(self, name: str) -> None:
        """Take a road user as one that the loop puts to another place of a lane: what is between is no way that it drives."""
        for recorder in self._all:
            recorder.take_as_put(name)

    def before_step(self) -> None:
        """Let the controllers act.

        Raises:
            RunEnded: the run is over, but the loop went on.
        """
        if self._ended:
            raise RunEnded(self._ended)
        for recorder in self._all:
            recorder.before_step()

    def after_step(self) -> None:
        """Record the step; one that leaves and may is watched no longer.

        Raises:
            RunEnded: the run is over.
            RunError: one of them is not where it should be, or the wall-clock limit is exceeded.
        """
        end: RunEnded | None = None
        recorded = []
        for name, recorder in [("", self._first), *self._watching.items()]:
            try:
                recorder.record_step()
            except RunEnded as found:
                if name and found.reason == "left":
                    del self._watching[name]
                    continue
                end = found
            else:
                recorded.append(recorder)
        for recorder in recorded:
            if end is not None and end.reason == "collision":  # SUMO may no longer be at this step
                break
            try:
                recorder.judge_step()
            except RunEnded as found:
                end = found
        if end is not None:
            self._ended = end.reason
            raise end

    def trace(self, ended: str) -> Trace:
        """Return one trace; states of absent road users are NaN.

        Raises:
            RunError: one of them never departed.
        """
        late = [name for name, recorder in self._further.items() if recorder.began is None]
        first = self._first.trace(ended)
        if late or self._first.began is None:
            raise RunError(Status.INVALID, f"'{late[0]}' is under test and must depart while '{first.actors[0]}' is, but did not")
        if not self._further:
            return first
        others = [(recorder.trace(ended), (recorder.began or 0) - self._first.began) for recorder in self._further.values()]
        return _merged(first, others)


def _merged(first: Trace, others: Sequence[tuple[Trace, int]]) -> Trace:
    """Return a trace with the actors of all; each of the others begins so many steps after the first (before, if negative)."""
    n = len(first.time)
    names = list(dict.fromkeys(name for trace, _ in [(first, 0), *others] for name in trace.actors))
    table = {state: np.full((n, len(names)), np.nan) for state in _STATES}
    size = {name: (math.nan, math.nan) for name in names}
    parts: dict[str, tuple[ActorTrace, ...]] = {}
    seen: dict[str, Trace] = {}
    for trace, begin in [(first, 0), *others]:
        rows = slice(max(begin, 0), min(begin + len(trace.time), n))
        taken = slice(max(-begin, 0), max(-begin, 0) + rows.stop - rows.start)
        if rows.stop <= rows.start:
            continue
        seen[trace.actors[0]] = replace(trace.select(taken), time=first.time[rows])
        for k, name in enumerate(trace.actors):
            j, size[name] = names.index(name), (float(trace.length[k]), float(trace.width[k]))
            for state, values in table.items():
                new = getattr(trace, state)[taken, k]
                values[rows, j] = np.where(np.isnan(values[rows, j]), new, values[rows, j])
            if name in trace.parts:
                moved = tuple(_shifted(part, rows, taken, n) for part in trace.parts[name])
                parts[name] = moved if name not in parts else tuple(map(_either, parts[name], moved))
    unconfirmed = tuple(dict.fromkeys((*first.unconfirmed, *(text for trace, _ in others for text in trace.unconfirmed))))
    return replace(
        first, actors=tuple(names), x=table["x"], y=table["y"], heading=table["heading"], speed=table["speed"],
        acceleration=table["acceleration"], length=np.array([size[name][0] for name in names]),
        width=np.array([size[name][1] for name in names]), parts=parts, unconfirmed=unconfirmed, seen=seen,
    )  # fmt: skip


def _shifted(part: ActorTrace, rows: slice, taken: slice, n: int) -> ActorTrace:
    """Return a part of a long vehicle over all n instants."""

    def column(values: Vector) -> Vector:
        moved = np.full(n, np.nan)
        moved[rows] = values[taken]
        return moved

    return _with_states(part, [column(getattr(part, state)) for state in _STATES])


def _either(one: ActorTrace, other: ActorTrace) -> ActorTrace:
    """Return a part with the states of another recorder where the first has none."""
    both = ((getattr(one, state), getattr(other, state)) for state in _STATES)
    return _with_states(one, [np.where(np.isnan(a), b, a) for a, b in both])


def _with_states(part: ActorTrace, states: Sequence[Vector]) -> ActorTrace:
    x, y, heading, speed, acceleration = states
    return replace(part, x=x, y=y, heading=heading, speed=speed, acceleration=acceleration)
