"""Recorded road users as the traffic of a user's own simulation: each is moved along its trajectory, whatever happens.

They do not react, neither to the vehicle under test nor to SUMO's own road users. Between two recorded instants positions,
headings and speeds are linear. SUMO's drivers see those that are on a lane, and controllers see all of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sbt.errors import InputError, RunError, did_you_mean
from sbt.metrics.fcd import Recording
from sbt.metrics.geometry import farthest
from sbt.metrics.tracks import read_recording
from sbt.plugins import kept, noted
from sbt.problem.arrays import Vector
from sbt.problem.outcome import Status
from sbt.sumo.guided import Motion, Placed
from sbt.sumo.junctions import Junctions
from sbt.sumo.levels import levels_of
from sbt.sumo.session import unwrapped
from sbt.sumo.template import fill

__all__ = ["RecordedTraffic", "Track", "recorded_tracks"]

_TYPE = "sbt_recorded"
"""Id of the vehicle type of recorded vehicles; its class may use every lane, where there are no walking areas."""
_KEEP_ROUTE, _KEEP_EDGE = 2, 3
"""keepRoute of moveToXY that keeps the pose exactly, on or off the lanes; the latter leaves a person on its edge for SUMO."""
_GAP = 1.5
"""A track is interrupted where two of its instants are further apart than so many of its usual steps."""
_SLACK = 1e-6
_UNRECORDED = 1.0
"""A run may begin so long before a recording, and end so long after it (s)."""
_WAITING_TIME = 1e6
_SHAPES = {
    "truck": "truck", "truck_bus": "truck", "bus": "bus", "bicycle": "bicycle", "motorcycle": "motorcycle", "van": "delivery",
    "trailer": "truck/trailer",
}  # fmt: skip
"""SUMO's shapes in the GUI by class."""


class Track(NamedTuple):
    """A road user while it was recorded without interruption: (n,) arrays over time.

    `x`, `y` (m) are of the front bumper of a vehicle or the centre of a person, as SUMO has them; `heading` (rad) has no jumps;
    `z` (m) is NaN where it is not known.
    """

    name: str
    kind: str
    length: float
    width: float
    time: Vector
    x: Vector
    y: Vector
    heading: Vector
    speed: Vector
    z: Vector

    @property
    def person(self) -> bool:
        """Whether it goes on foot."""
        return self.kind == "person"


def recorded_tracks(path: Path) -> tuple[Track, ...]:
    """Return the tracks of a recording, by the time of their beginning; each file is read once per process.

    Raises:
        InputError: it cannot be read.
    """
    return _recorded(path)[0]


@kept
def _recorded(path: Path) -> tuple[tuple[Track, ...], _Span]:
    """Return the tracks of a recording, and its span."""
    recording = read_recording(noted(path))
    found = [track for k in range(len(recording.names)) for track in _tracks(recording, k)]
    span = _Span(path, float(recording.time[0]), float(recording.time[-1]))
    return tuple(sorted(found, key=lambda track: (float(track.time[0]), track.name))), span


def _tracks(recording: Recording, k: int) -> list[Track]:
    """Return the tracks of road user k; those after the first have `#1`, `#2`, ... behind its name."""
    rows = slice(recording.start[k], recording.start[k + 1])
    time, heading = recording.time[recording.step[rows]], np.unwrap(recording.heading[rows])
    length, kind = float(recording.length[k]), recording.kinds[k]
    half = 0.0 if kind == "person" else 0.5 * length
    x, y = recording.x[rows] + half * np.cos(heading), recording.y[rows] + half * np.sin(heading)
    z = np.full(len(x), np.nan) if recording.z is None else recording.z[rows]
    elapsed = np.diff(time)
    usual = float(np.median(elapsed)) if len(elapsed) else 0.0
    cut = (elapsed > _GAP * usual) | (np.hypot(np.diff(x), np.diff(y)) > farthest(elapsed))
    parts = np.split(np.arange(len(time)), np.flatnonzero(cut) + 1)
    return [
        Track(f"{recording.names[k]}#{i}" if i else recording.names[k], kind, length, float(recording.width[k]),
              time[p], x[p], y[p], heading[p], recording.speed[rows][p], z[p])
        for i, p in enumerate(parts)
    ]  # fmt: skip


@dataclass(frozen=True)
class RecordedTraffic:
    """The road users of a recording.

    Args:
        path: of the recording.
        at_zero: time of the recording at SUMO's time 0 (s): a number, or a formula of inputs as `${t}`.
        without: road users that are left out, such as the one whose place the vehicle under test takes.
        offset: added to recorded positions (m).

    Raises:
        InputError: the recording cannot be read, or one that is left out is not there.
    """

    path: Path
    at_zero: str = "0"
    without: tuple[str, ...] = ()
    offset: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        names = [track.name for track in recorded_tracks(self.path)]
        for name in self.without:
            if name not in names:
                some = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
                rule = f"a road user of the recording must be one of {some}"
                raise InputError(f"{rule}, but got '{name}'{did_you_mean(name, names)}")

    def begin(self, sumo: Any, values: Mapping[str, float]) -> Motion:
        """Return what moves the road users in one run."""
        left_out = {name for track in recorded_tracks(self.path) for name in self.without if track.name.partition("#")[0] == name}
        tracks = [t for t in recorded_tracks(self.path) if t.name.partition("#")[0] not in left_out]
        return _Replay(sumo, tracks, float(fill(self.at_zero, values)), self.offset, _recorded(self.path)[1])


    def told(self, sumo: Any) -> str:
        """Return that roads are on different levels, but nobody knows on which the recorded road users are; else ""."""
        levels = levels_of(sumo)
        lacking = not levels.stacked or all(np.isnan(track.z).all() for track in recorded_tracks(self.path))
        if not levels.several or not lacking:
            return ""
        who = f"the network has no heights (z) where roads cross, or '{self.path.name}' has none"
        return f"{who}: recorded road users are taken to be on the ego's level, also those on or under a bridge"


class _Span(NamedTuple):
    """From when to when there is a recording (s)."""

    path: Path
    first: float
    last: float

    def check(self, now: float) -> None:
        """Refuse a time (s) that was not recorded: an empty road there would say nothing of the vehicle under test.

        Raises:
            RunError: the recording has not begun, or is over.
        """
        if now < self.first - _UNRECORDED:
            rule = f"recorded: {self.path.name} must have begun when the ego departs, but it begins at {self.first:g} s"
            raise RunError(Status.INVALID, f"{rule} of its time, and the run is at {now:g} s: change begin (recorded) or depart")
        if now > self.last + _UNRECORDED:
            rule = f"recorded: {self.path.name} must last as long as the run, but it ends at {self.last:g} s"
            raise RunError(
                Status.INVALID, f"{rule} of its time, and the run is at {now:g} s: change begin (recorded), depart or duration"
            )  # fmt: skip


class _Moving(NamedTuple):
    """A track at the instants of the steps to come, the last one first."""

    person: bool
    states: list[tuple[float, float, float, float, float]]
    """x, y, angle, speed, z."""


class _Replay:
    """Moves recorded road users during one run."""

    def __init__(self, sumo: Any, tracks: list[Track], at_zero: float, offset: tuple[float, float], span: _Span):
        self._span, self._sumo, self._at_zero, self._offset = span, sumo, at_zero, offset
        self._dt = float(sumo.simulation.getDeltaT())
        self._waiting = deque(tracks)
        self._moving: dict[str, _Moving] = {}
        self._placed: dict[str, Placed] = {}
        self._move_vehicle, self._move_person = unwrapped(sumo, "vehicle", "moveToXY"), unwrapped(sumo, "person", "moveToXY")
        self._tell_speed = unwrapped(sumo, "vehicle", "setPreviousSpeed")
        self._edge = next(edge for edge in sumo.edge.getIDList() if not edge.startswith(":"))
        sumo.route.add(_TYPE, [self._edge])
        sumo.vehicletype.copy("DEFAULT_VEHTYPE", _TYPE)
        mapped = Junctions(sumo).lack_walking_areas  # SUMO 1.28 crashes where it takes one for the lane of who is moved by poses
        sumo.vehicletype.setVehicleClass(_TYPE, "ignoring" if mapped else "passenger")
        self._keep_person = _KEEP_ROUTE if mapped else _KEEP_EDGE
        sumo.vehicletype.setMaxSpeed(_TYPE, float(farthest(1.0)))

    def before_step(self, t: float | None) -> None:
        """Move everybody to where they were at the end of the step."""
        now = self._sumo.simulation.getTime() + self._at_zero
        if t is not None:
            self._span.check(now)
        while self._waiting and self._waiting[0].time[0] <= now + _SLACK:
            track = self._waiting.popleft()
            if track.time[-1] >= now - _SLACK:
                self._insert(track, now)
        self._placed = {}
        for name, (person, states) in list(self._moving.items()):
            if not states:
                (self._sumo.person if person else self._sumo.vehicle).remove(name)
                del self._moving[name]
                continue
            x, y, angle, speed, z = states.pop()
            if person:
                self._move_person(name, "", x, y, angle, self._keep_person)
            else:
                self._move_vehicle(name, "", -1, x, y, angle, _KEEP_ROUTE)
            self._placed[name] = Placed(x, y, angle, speed, person, z)

    def after_step(self) -> Mapping[str, Placed]:
        """Tell SUMO the speeds, which it does not take from positions, and return where everybody is."""
        for name, state in self._placed.items():
            if not state.person:
                self._tell_speed(name, state.speed)
        return self._placed

    def _insert(self, track: Track, now: float) -> None:
        """Add a road user, with its states from now on."""
        if track.person:
            domain = self._sumo.person
            domain.add(track.name, self._edge, 0.0)
            domain.appendWaitingStage(track.name, _WAITING_TIME)
        else:
            domain = self._sumo.vehicle
            domain.add(track.name, _TYPE, typeID=_TYPE, depart="now")
            domain.setShapeClass(track.name, _SHAPES.get(track.kind, "passenger"))
        domain.setLength(track.name, track.length)
        domain.setWidth(track.name, track.width)
        times = now + self._dt * np.arange(int((track.time[-1] - now + _SLACK) / self._dt) + 1)
        x, y, heading, speed, z = (np.interp(times, track.time, values) for values in track[5:])
        angle = (90.0 - np.degrees(heading)) % 360.0
        states = np.column_stack([x + self._offset[0], y + self._offset[1], angle, speed, z])
        self._moving[track.name] = _Moving(track.person, [(a, b, c, d, e) for a, b, c, d, e in states[::-1].tolist()])
