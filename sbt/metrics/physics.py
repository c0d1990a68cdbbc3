"""What tyres, drivers and pedestrians cannot do: laws of motion as functions of a trace.

Nobody believes a failure in which a car drifts sideways or a pedestrian jumps. Each law is a quantity of every road user
over time, and its limit. Accelerations across the heading are means over half a second, computed from positions, because
the lanes of a road network are polygonal lines that SUMO's vehicles follow exactly.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbt.metrics.geometry import part_pairs, rectangle_distance, select_instants
from sbt.problem.arrays import Mask
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["LAWS", "Breach", "Law", "beyond_tyres", "breaches", "drove_on", "persons", "stopped_dead", "worst"]

LATERAL_WINDOW, JERK_WINDOW = 0.5, 0.2
"""Times over which lateral accelerations and jerks are averaged (s)."""
SLIP = 0.2
"""Tangent of the largest angle between heading and velocity of a rolling vehicle's centre, at a steering angle of 22 degrees."""
DRIFT = 1.5
"""Largest speed across the lane beyond it (m/s), as in a change to a lane 3.5 m beside within 2.3 s."""
START = 0.1
"""Collisions that SUMO reports up to this time belong to the start (s)."""
_TYRES = 15.0
"""Acceleration that no tyre holds (m/s^2): half again what dry asphalt lets it."""
_SAME = 1e-3  # by which times with three digits may be off (s)
_LISTED = re.compile(r"([^>]+)>([^>]+)@(\d+(?:\.\d+)?)")
"""An entry of a trace's list of collisions, as SUMO's are written; those of a scenario of one's own may be any text."""
_PERSON = 1.0
_AHEAD, _BESIDE = 60.0, 7.0

Table = NDArray[np.float64]
"""(t, m) values over time and road user; NaN where there is nothing to measure."""


@dataclass(frozen=True)
class Law:
    """A quantity that must not exceed its limit.

    Attributes:
        limit: largest value that is possible.
        unit: of value and limit.
        values: trace to its (t, m) values.
        description: what is measured, and why the limit.
    """

    limit: float
    unit: str
    values: Callable[[Trace], Table]
    description: str


@dataclass(frozen=True)
class Breach:
    """A law that a road user breaks, at its worst instant.

    Attributes:
        law: name in `LAWS`.
        actor: the road user.
        time: of the worst value (s).
        value, limit, unit: what it reaches, and what is possible.
    """

    law: str
    actor: str
    time: float
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        """Return the breach in words."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.law} must be <= {self.limit:g}{unit}, but {self.actor} has {self.value:.3g}{unit} at {self.time:.2f} s"

    def told(self, egos: Sequence[str]) -> str:
        """Return the breach as a remark: what is compared, and whether it is one of the egos."""
        unit, what = f" {self.unit}" if self.unit else "", LAWS[self.law].description.partition(";")[0]
        who = f"{self.actor}, {'the' if self.actor in egos else 'not the'} ego, at {self.time:.2f} s"
        return f"{self.law} ({what}) {self.value:.3g}{unit} of {who}, above {self.limit:g}{unit}"


def breaches(trace: Trace, scripted: Sequence[str] = ()) -> tuple[Breach, ...]:
    """Return every law that the trace breaks.

    Args:
        trace: of a run.
        scripted: road users whose braking an input of the scenario decides: not judged as drivers.

    >>> import numpy as np
    >>> still = np.zeros((3, 1))
    >>> aside = Trace(np.array([0.0, 0.1, 0.2]), ("ego",), still, np.array([[0.0], [3.5], [3.5]]), still, still + 20.0, still,
    ...               np.array([5.0]), np.array([1.8]))
    >>> print(breaches(aside)[1])
    sideways must be <= 1.5 m/s, but ego has 35 m/s at 0.10 s
    """
    found = []
    for name, law in LAWS.items():
        value, actor, time = worst(trace, name, scripted)
        if value > law.limit:
            found.append(Breach(name, actor, time, value, law.limit, law.unit))
    return tuple(found)


def worst(trace: Trace, law: str, scripted: Sequence[str] = ()) -> tuple[float, str, float]:
    """Return the largest value of a law, whose it is, and when (s); -inf where there is nothing to measure."""
    values = LAWS[law].values(trace)
    if law == "braking_of_others":
        values[:, [k for k, name in enumerate(trace.actors) if name in scripted]] = np.nan
    if not np.isfinite(values).any():
        return -math.inf, "", 0.0
    i, k = np.unravel_index(int(np.nanargmax(values)), values.shape)
    return float(values[i, k]), trace.actors[k], float(trace.time[i])


def persons(trace: Trace) -> Mask:
    """Return (m,) booleans: the road user is so small that it must be a person."""
    return np.asarray((trace.length < _PERSON) & (trace.width < _PERSON))


def beyond_tyres(trace: Trace, actor: str) -> list[tuple[float, float]]:
    """Return the largest acceleration of a vehicle (m/s^2) and when (s), where no tyre holds it; empty elsewhere."""
    if actor not in trace.actors or len(trace.time) < 2:
        return []
    k = trace.actors.index(actor)
    size = np.nan_to_num(np.abs(trace.acceleration[1:, k]))
    worst = int(size.argmax()) + 1
    if size[worst - 1] <= _TYRES or persons(trace)[k]:
        return []
    return [(float(trace.acceleration[worst, k]), float(trace.time[worst]))]


def stopped_dead(trace: Trace, ego: str) -> list[tuple[str, float, float]]:
    """Return who else brakes hardest (m/s^2) and when (s), where no tyre holds it; empty elsewhere.

    SUMO stops who would drive over a red light or the end of its lane, however fast. Persons halt in one step, and who is moved
    as it was recorded has the noise of its track.
    """
    others = ~persons(trace) & [name != ego and name not in trace.unreacting for name in trace.actors]
    braking = np.nan_to_num(np.where(others, -trace.acceleration[1:], 0.0))
    if not braking.size or braking.max() <= _TYRES:
        return []
    at, k = np.unravel_index(braking.argmax(), braking.shape)
    return [(trace.actors[k], float(braking[at, k]), float(trace.time[at + 1]))]


def drove_on(trace: Trace, ego: str) -> list[tuple[str, str, float]]:
    """Return which two others drove into each other, and when (s), before the run ended; each pair once.

    Those that SUMO lists and whose bodies overlap: it lets both drive on.
    """
    found: dict[tuple[str, str], float] = {}
    for text in filter(None, map(_LISTED.fullmatch, trace.reported)):
        a, b = sorted(text.group(1, 2))
        t = float(text[3])
        k = int(np.searchsorted(trace.time, t - _SAME))
        if ego not in (a, b) and {a, b} <= set(trace.actors) and k < len(trace.time) - 1:
            one, other = (select_instants(trace.actor(name), slice(max(k - 1, 0), k + 2)) for name in (a, b))
            if any((rectangle_distance(p, q) <= 0.0).any() for p, q in part_pairs(one, other)):
                found.setdefault((a, b), t)
    return [(*pair, t) for pair, t in found.items()]


def longitudinal(trace: Trace) -> Table:
    """Return the absolute accelerations of vehicles over each step (m/s^2)."""
    return _table(trace, np.abs(trace.acceleration[1:]), ~persons(trace))


def lateral(trace: Trace) -> Table:
    """Return the absolute mean accelerations of vehicles across their heading over half a second (m/s^2)."""
    dt, n = _window(trace, LATERAL_WINDOW)
    vx, vy = np.diff(trace.x, axis=0) / dt, np.diff(trace.y, axis=0) / dt
    ax, ay = (vx[n:] - vx[:-n]) / (n * dt), (vy[n:] - vy[:-n]) / (n * dt)
    heading = trace.heading[1 + n // 2 :][: len(ax)]
    return _table(trace, np.abs(ay * np.cos(heading) - ax * np.sin(heading)), ~persons(trace))


def sideways(trace: Trace) -> Table:
    """Return how much faster vehicles move across their heading than the slip angle in a bend explains (m/s)."""
    along, across = _velocity(trace)
    return _table(trace, np.abs(across) - SLIP * np.abs(along), ~persons(trace))


def mismatch(trace: Trace) -> Table:
    """Return how far the speeds of vehicles by their positions are from the recorded ones, beyond 10 % of these (m/s)."""
    along, _ = _velocity(trace)
    mean = 0.5 * (trace.speed[1:] + trace.speed[:-1])
    return _table(trace, np.abs(along - mean) - 0.1 * np.abs(mean), ~persons(trace))


def jerk(trace: Trace) -> Table:
    """Return the absolute mean jerk of vehicles over 0.2 s (m/s^3), 0 where they stand at its begin or end."""
    dt, n = _window(trace, JERK_WINDOW)
    acceleration, speed = trace.acceleration[1:], trace.speed[1:]
    values = np.abs(acceleration[n:] - acceleration[:-n]) / (n * dt)
    return _table(trace, np.where(np.minimum(speed[n:], speed[:-n]) == 0.0, 0.0, values), ~persons(trace))


def walking(trace: Trace) -> Table:
    """Return the speeds of persons from step to step, by their positions (m/s)."""
    along, across = _velocity(trace)
    return _table(trace, np.hypot(along, across), persons(trace))


def overlap(trace: Trace) -> Table:
    """Return 1 at the first instant for those who touch another one there, or collide by SUMO's list, else 0."""
    table = np.full(trace.x.shape, np.nan)
    first = [ActorTrace(a.x[:1], a.y[:1], a.heading[:1], a.speed[:1], a.acceleration[:1], a.length, a.width)
             for a in map(trace.actor, trace.actors)]  # fmt: skip
    there = [k for k, a in enumerate(first) if np.isfinite(a.x[0])]
    table[0, there] = 0.0
    for i, k in enumerate(there):
        for j in there[:i]:
            a, b = first[k], first[j]
            near = math.hypot(a.x[0] - b.x[0], a.y[0] - b.y[0]) < a.length + a.width + b.length + b.width
            if near and rectangle_distance(a, b)[0] <= 0.0:
                table[0, [k, j]] = 1.0
    for entry in trace.reported:
        pair, _, t = entry.rpartition("@")
        if float(t) <= START:
            table[0, [trace.actors.index(name) for name in pair.split(">") if name in trace.actors]] = 1.0
    return table


def braking_of_others(trace: Trace) -> Table:
    """Return the decelerations of all vehicles but the first, the ego, where it is not ahead of them (m/s^2).

    Who finds the ego within 60 m ahead, and less than 7 m beside its course, may have to brake as hard as it can.
    """
    values = -trace.acceleration[1:]
    dx, dy = trace.x[1:, :1] - trace.x[1:], trace.y[1:, :1] - trace.y[1:]
    cos, sin = np.cos(trace.heading[1:]), np.sin(trace.heading[1:])
    ahead, beside = dx * cos + dy * sin, np.abs(dy * cos - dx * sin)
    forced = (ahead > 0.0) & (ahead < _AHEAD) & (beside < _BESIDE)
    table = _table(trace, np.where(forced, np.nan, values), ~persons(trace))
    table[:, :1] = np.nan
    return table


def _window(trace: Trace, length: float) -> tuple[float, int]:
    """Return the step (s) and the number of steps in a window, less where the trace is shorter."""
    dt = float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 1.0
    return dt, max(min(round(length / dt), len(trace.time) - 2), 1)


def _velocity(trace: Trace) -> tuple[Table, Table]:
    """Return the (t - 1, m) velocities over each step (m/s), along and across the heading in the middle of it."""
    dt = np.diff(trace.time)[:, None]
    vx, vy = np.diff(trace.x, axis=0) / dt, np.diff(trace.y, axis=0) / dt
    cos = np.cos(trace.heading[1:]) + np.cos(trace.heading[:-1])
    sin = np.sin(trace.heading[1:]) + np.sin(trace.heading[:-1])
    norm = np.maximum(np.hypot(cos, sin), 1e-9)
    return (vx * cos + vy * sin) / norm, (vy * cos - vx * sin) / norm


def _table(trace: Trace, values: Table, who: Mask) -> Table:
    """Return (t, m) values of some road users, NaN for the others and where the values, of the last instants, are missing."""
    table = np.full(trace.x.shape, np.nan)
    table[len(table) - len(values) :] = values
    table[:, ~who] = np.nan
    return table


LAWS: Mapping[str, Law] = {
    "longitudinal": Law(10.3, "m/s^2", longitudinal, "acceleration and braking of a vehicle; 1.05 g is what tyres hold on dry "
                        "asphalt"),
    "lateral": Law(5.0, "m/s^2", lateral, "acceleration across the heading, mean of 0.5 s; drivers stay below 4 to 5 in bends"),
    "sideways": Law(DRIFT, "m/s", sideways, "speed across the heading beyond 0.2 of the speed along it; 1.5 is a quick lane "
                    "change"),
    "jerk": Law(50.0, "m/s^3", jerk, "rate of the acceleration, mean of 0.2 s; brakes build up full force in 0.2 s"),
    "mismatch": Law(0.5, "m/s", mismatch, "difference between the speed and the distance driven per step, beyond 10 %"),
    "walking": Law(4.0, "m/s", walking, "speed of a person from step to step; a running child"),
    "start": Law(0.0, "", overlap, "contact at the start"),
    "braking_of_others": Law(6.0, "m/s^2", braking_of_others, "braking of drivers who do not have the ego ahead; more is "
                             "an emergency, and without the ego there is none"),
}  # fmt: skip
"""The laws by name."""
