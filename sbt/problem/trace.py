"""A trace: the states of every actor over time in one run, as arrays.

Positions are rectangle centres in the network's plane, headings are mathematical (radians,
counter-clockwise from +x): SUMO's front-bumper positions and compass angles are converted once,
where the trace is recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RunError
from sbt.problem.arrays import Vector
from sbt.problem.outcome import Status

__all__ = ["ActorTrace", "Trace"]

States = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ActorTrace:
    """One actor of a trace: (t,) arrays and the size of its rectangle."""

    x: Vector
    y: Vector
    heading: Vector
    speed: Vector
    acceleration: Vector
    length: float
    width: float


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

    In traffic road users come and go: where one is not there, all its states are NaN (`present`).

    Two traces are the same where `identical` says so; as keys they count by identity.

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

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.actors))
        for name in ("x", "y", "heading", "speed", "acceleration"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"trace.{name} must have shape {shape}, but got {getattr(self, name).shape}")
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
            float(self.length[k]), float(self.width[k]),
        )  # fmt: skip

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
        return same and (self.actors, self.ended, self.reported) == (other.actors, other.ended, other.reported)

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
