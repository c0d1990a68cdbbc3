"""A trace: the states of every actor over time in one run, as arrays.

Positions are rectangle centres in the network's plane, headings are mathematical (radians,
counter-clockwise from +x): SUMO's front-bumper positions and compass angles are converted once,
where the trace is recorded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RunError
from sbt.problem.arrays import Vector
from sbt.problem.outcome import Status

__all__ = ["ActorTrace", "FieldOfView", "States", "Trace", "select_parts"]

States = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ActorTrace:
    """One actor of a trace: (t,) arrays and the size of its rectangle.

    Attributes:
        parts: rectangles that follow each other, the front one first, where the body bends: a long vehicle in a bend.
            Their shape is that of the actor; its own rectangle is straight. Empty: the rectangle is the shape.
        way: where it goes on after its last instant: (k, 3) x, y and heading; a last row of NaN where it leaves the road
            there. None: unknown.
    """

    x: Vector
    y: Vector
    heading: Vector
    speed: Vector
    acceleration: Vector
    length: float
    width: float
    parts: tuple[ActorTrace, ...] = ()
    way: States | None = None

    def during(self, i: slice) -> ActorTrace:
        """Return it at some instants; how it goes on afterwards becomes its way, and that of its parts."""
        states = self.x[i], self.y[i], self.heading[i], self.speed[i], self.acceleration[i]
        parts = tuple(part.during(i) for part in self.parts)
        return ActorTrace(*states, self.length, self.width, parts, _way_after(self, i))


def select_parts(parts: tuple[ActorTrace, ...], i: slice | NDArray[Any]) -> tuple[ActorTrace, ...]:
    """Return the parts of an actor at some instants only."""
    return tuple(
        ActorTrace(p.x[i], p.y[i], p.heading[i], p.speed[i], p.acceleration[i], p.length, p.width, select_parts(p.parts, i))
        for p in parts
    )


@dataclass(frozen=True)
class FieldOfView:
    """Where the sensor of the first actor sees something; films draw it.

    Attributes:
        reach: how far it sees (m); inf: as far as the picture shows.
        ahead: of the sensor ahead of the middle of the actor (m).
        half_angle: to each side of the heading (rad).
        half_width: it sees only so far to each side of the actor's own axis, its path (m); inf: no such limit.
        hidden_by: names of the actors that hide what is behind them; None: all others.

    Raises:
        ValueError: a length or angle is not positive.
    """

    reach: float = math.inf
    ahead: float = 0.0
    half_angle: float = 0.5 * math.pi
    half_width: float = math.inf
    hidden_by: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("reach", "half_angle", "half_width"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"a field of view needs {name} > 0, but got {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Trace:
    """States of m actors at t instants.

    Attributes:
        time: (t,) seconds from the start of the concrete scenario, increasing.
        actors: m names, in the order of the columns.
        x, y: (t, m) centre of the rectangle (m).
        heading: (t, m) radians, counter-clockwise from +x.
        speed: (t, m) along the heading (m/s).
        acceleration: (t, m) rate of the speed over the step that led to the state (m/s^2).
        length, width: (m,) size of the rectangle (m).
        ended: why the run ended, such as "collision" or "duration".
        reported: SUMO's own collision list ("collider>victim@time"), a cross-check only.
        signals: name to (t,) numbers recorded beside the states, such as what the ego perceived.
        ways: name to the way that an actor would go on after the last instant at which it is there (`ActorTrace.way`).
        parts: name to the parts of a long vehicle (`ActorTrace.parts`), NaN where it is not there.
        unconfirmed: contacts on which geometry and SUMO's own list differ, and what differs (`sbt.sumo.contacts`); other doubts.
        unreacting: actors that are moved as they were recorded, whatever happens.
        flat: actors that are driven over, such as what hides a marking: films show them, metrics do not see them.
        seen: of several vehicles under test: name to what each came upon, its own trace. Who is too far from it, or on another
            level, is not there.
        ballistic: speeds change evenly within a step (SUMO's option `step-method.ballistic`), else in jumps at its begin.
        view: where the sensor of the first actor sees something, for films (not compared); None: unknown.

    In traffic road users come and go: where one is not there, all its states are NaN (`present`).

    Two traces are the same where `identical` says so; as keys they count by identity. States cannot be written to.

    Raises:
        ValueError: the arrays do not have these shapes.
    """

    time: Vector
    actors: tuple[str, ...]
    x: States
    y: States
    heading: States
    speed: States
    acceleration: States
    length: Vector
    width: Vector
    ended: str = ""
    reported: tuple[str, ...] = field(default=())
    signals: Mapping[str, Vector] = field(default_factory=dict)
    ways: Mapping[str, States] = field(default_factory=dict)
    parts: Mapping[str, tuple[ActorTrace, ...]] = field(default_factory=dict)
    unconfirmed: tuple[str, ...] = ()
    unreacting: tuple[str, ...] = ()
    view: FieldOfView | None = None
    flat: tuple[str, ...] = ()
    ballistic: bool = False
    seen: Mapping[str, Trace] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.actors))
        for name in ("x", "y", "heading", "speed", "acceleration"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"trace.{name} must have shape {shape}, but got {getattr(self, name).shape}")
        for name in ("time", "x", "y", "heading", "speed", "acceleration", "length", "width"):
            kept = getattr(self, name).view()
            kept.flags.writeable = False  # what one metric changes others would measure
            object.__setattr__(self, name, kept)
        if len(set(self.actors)) < len(self.actors):
            raise ValueError(f"trace.actors must have different names, but got {', '.join(map(str, self.actors))}")
        if not (np.diff(self.time) > 0.0).all():
            raise ValueError("trace.time must increase, but does not")
        for name in ("length", "width"):
            if getattr(self, name).shape != shape[1:] or not (getattr(self, name) > 0.0).all():
                raise ValueError(f"trace.{name} must have {shape[1]} values > 0, but got {getattr(self, name)}")
        for name, values in self.signals.items():
            if values.shape != shape[:1]:
                raise ValueError(f"trace.signals['{name}'] must have shape {shape[:1]}, but got {values.shape}")

    @property
    def present(self) -> NDArray[np.bool_]:
        """(t, m) whether the actor is there: not all of its states are NaN."""
        gone = [np.isnan(getattr(self, name)) for name in ("x", "y", "heading", "speed")]
        return ~np.logical_and.reduce(gone)

    def actor(self, name: str) -> ActorTrace:
        """Return the columns of one actor.

        Raises:
            RunError: there is no such actor in this trace.
        """
        if name not in self.actors:
            known = ", ".join(self.actors)
            raise RunError(Status.FAILED, f"no actor '{name}' in the trace, there are: {known}")
        k = self.actors.index(name)
        return ActorTrace(
            self.x[:, k], self.y[:, k], self.heading[:, k], self.speed[:, k], self.acceleration[:, k],
            float(self.length[k]), float(self.width[k]), self.parts.get(name, ()), self.ways.get(name),
        )  # fmt: skip

    def select(self, i: slice, actors: Mapping[str, str] | None = None) -> Trace:
        """Return some instants, of all actors or of some under new names; how they go on afterwards becomes their way.

        Args:
            i: the instants.
            actors: name in this trace to name in the result, in its order; None: all. Signals are those of all actors.
        """
        names = self.actors if actors is None else tuple(actors)
        at: slice | list[int] = slice(None) if actors is None else [self.actors.index(name) for name in names]
        new = dict(zip(names, names, strict=True)) if actors is None else actors
        parts = {new[n]: tuple(p.during(i) for p in self.parts[n]) for n in names if n in self.parts}
        ways = {new[name]: way for name in names if (way := _way_after(self.actor(name), i)) is not None}
        some = Trace(
            self.time[i], tuple(new.values()), self.x[i][:, at], self.y[i][:, at], self.heading[i][:, at], self.speed[i][:, at],
            self.acceleration[i][:, at], self.length[at], self.width[at], self.ended, ways=ways, parts=parts,
            ballistic=self.ballistic, seen=self._seen(i, actors),
        )  # fmt: skip
        if actors is not None:
            return some
        signals = {name: v[i] for name, v in self.signals.items()}
        return replace(
            some, reported=self.reported, signals=signals, unconfirmed=self.unconfirmed, unreacting=self.unreacting,
            view=self.view, flat=self.flat,
        )  # fmt: skip

    def seen_by(self, ego: str) -> Trace:
        """Return what a vehicle under test came upon: the trace itself, where there is but one."""
        return self.seen.get(ego, self)

    def _seen(self, i: slice, actors: Mapping[str, str] | None) -> dict[str, Trace]:
        """Return what the vehicles under test came upon at some instants, of all actors or of some under new names."""
        found, times = {}, self.time[i]
        for ego, trace in self.seen.items() if len(times) else ():
            rows = slice(*np.searchsorted(trace.time, (times[0], np.nextafter(times[-1], np.inf))).tolist())
            if actors is None:
                found[ego] = trace.select(rows)
            elif ego in actors:
                found[actors[ego]] = trace.select(rows, {name: actors[name] for name in trace.actors if name in actors})
        return found

    @property
    def measured(self) -> Trace:
        """What metrics see: the trace without what is driven over."""
        if not self.flat:
            return self
        k = [name not in self.flat for name in self.actors]
        states = {name: getattr(self, name)[:, k] for name in ("x", "y", "heading", "speed", "acceleration")}
        names = tuple(name for name in self.actors if name not in self.flat)
        return replace(self, actors=names, length=self.length[k], width=self.width[k], flat=(), **states)

    def signal(self, name: str) -> Vector:
        """Return the (t,) values of one signal.

        Raises:
            RunError: there is no such signal in this trace.
        """
        if name not in self.signals:
            known = ", ".join(self.signals) or "none"
            raise RunError(Status.FAILED, f"no signal '{name}' in the trace, there are: {known}")
        return self.signals[name]

    def identical(self, other: Trace) -> bool:
        """Return whether two traces agree to the last bit, signals and SUMO's collision list included."""
        arrays = ("time", "x", "y", "heading", "speed", "acceleration", "length", "width")
        same = all(np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True) for name in arrays)
        same = same and list(self.signals) == list(other.signals)
        same = same and all(np.array_equal(values, other.signals[name]) for name, values in self.signals.items())
        same = same and self.ways.keys() == other.ways.keys()
        same = same and all(np.array_equal(way, other.ways[name], equal_nan=True) for name, way in self.ways.items())
        texts = ("actors", "ended", "reported", "unconfirmed", "unreacting", "flat", "ballistic")
        same = same and all(getattr(self, name) == getattr(other, name) for name in texts)
        same = same and self.seen.keys() == other.seen.keys()
        same = same and all(trace.identical(other.seen[ego]) for ego, trace in self.seen.items())
        return same and self.parts.keys() == other.parts.keys() and self._part_states() == other._part_states()

    def _part_states(self) -> list[bytes]:
        """Return the states of all parts, for comparison."""
        return [getattr(p, s).tobytes() for parts in self.parts.values() for p in parts for s in ("x", "y", "heading")]

    def rows(self) -> list[dict[str, float | str]]:
        """Return one dictionary a time and actor that is there, for a CSV file."""
        present = self.present
        columns = ("x", "y", "heading", "speed", "acceleration")
        return [
            {
                "time": float(t), "actor": name, **{c: float(getattr(self, c)[i, k]) for c in columns},
                "length": float(self.length[k]), "width": float(self.width[k]),
            }
            for i, t in enumerate(self.time)
            for k, name in enumerate(self.actors)
            if present[i, k]
        ]  # fmt: skip


def _way_after(actor: ActorTrace, i: slice) -> States | None:
    """Return the way of an actor after some instants: its recorded path as long as it stays, and where it goes on then."""
    last = len(actor.x) if i.stop is None else i.stop
    absent = np.isnan(actor.x[last:])
    end = last + (int(absent.argmax()) if absent.any() else len(absent))
    recorded = np.stack([actor.x[last:end], actor.y[last:end], actor.heading[last:end]], axis=1)
    on = actor.way if absent[end - last :].all() else None
    if len(recorded) == 0:
        return on
    return recorded if on is None else np.concatenate([recorded, on])
