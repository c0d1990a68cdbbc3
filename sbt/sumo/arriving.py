"""Whom an ego touches in the step in which it arrives: SUMO takes it off the road before anybody can ask where it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from sbt.metrics.geometry import contact_moment, contact_part
from sbt.problem.outcome import UNCONFIRMED
from sbt.problem.trace import ActorTrace
from sbt.sumo.actors import State
from sbt.sumo.guided import Placed
from sbt.sumo.levels import is_known
from sbt.sumo.off_lanes import ANGLE, POSITION, SPEED, VEHICLE, placed_variables, read

__all__ = ["LastStep", "last_step", "unknown_end", "way_to"]

_STRAIGHT = math.cos(0.1)
"""Cosine between the heading and the way to the end up to which that way is straight."""
_BRAKES = 9.0
"""How hard an ego may brake (m/s^2), by SUMO's default."""
_EARLY = 0.1
"""Distance (m) before its end at which SUMO lets a vehicle arrive: `POSITION_EPS`."""
_BESIDE = 1.0
"""How much farther than at its speeds one may come in a step (m); more is a jump."""


class _Surroundings(Protocol):
    states: dict[str, State]
    present: list[str]
    placed: Mapping[str, Placed]

    def is_person(self, name: str) -> bool: ...
    def body(self, name: str) -> ActorTrace: ...


@dataclass(frozen=True)
class LastStep:
    """A contact of the ego before it has arrived.

    Attributes:
        own: x, y (m), heading (rad), speed (m/s) and acceleration (m/s^2) at the end of the step, had it driven on.
        other: whom it touches.
        others: variables of all who are there at the end of the step.
    """

    own: tuple[float, ...]
    other: str
    others: Mapping[str, Mapping[int, Any]]


def way_to(sumo: Any, edge: str, here: float, end: float, state: State) -> tuple[float, float] | None:
    """Return the way (m) in x and y of a vehicle along an edge from one position to another; None where that is not straight."""
    ends = [[sumo.simulation.convert2D(edge, at, k)[:2] for at in (here, end)] for k in range(sumo.edge.getLaneNumber(edge))]
    front = state.x + 0.5 * state.length * state.cos, state.y + 0.5 * state.length * state.sin
    a, b = min(ends, key=lambda pair: math.dist(pair[0], front))
    x, y = b[0] - a[0], b[1] - a[1]
    return (x, y) if x * state.cos + y * state.sin > _STRAIGHT * math.hypot(x, y) else None


def last_step(sumo: Any, near: _Surroundings, ego: str, way: tuple[float, float], dt: float) -> LastStep | None:
    """Return the first contact of an ego that drives on at its speed until it arrives, and then is gone; None without one.

    Whom it touches so it must also touch if it brakes as hard as it can.

    Args:
        sumo: libsumo or traci, after the step in which it has arrived.
        near: road users as they were before it.
        ego: no vehicle of several parts.
        way: of the ego until it arrives (m), in x and y.
        dt: step (s).
    """
    others = {name: one for name in near.present if name != ego and (one := _variables(sumo, near, name)) is not None}
    steps = {name: step for name, one in others.items() if (step := _step(near, name, one, dt)) is not None}
    body, length, speed = near.body(ego), math.hypot(*way), near.states[ego].speed
    touched, fastest = list[dict[str, float]](), max(speed, length / dt)
    for each in (max(speed - _BRAKES * dt, length / dt), fastest):
        share = length / (each * dt)  # of the step until it arrives
        own = _moved(body, way[0] / share, way[1] / share)
        moments = {name: contact_moment(own, step, 1) for name, step in steps.items() if contact_part(own, step) is not None}
        touched.append({name: moment for name, moment in moments.items() if moment <= share})
    first = min(touched[0].keys() & touched[1].keys(), key=lambda name: (touched[1][name], name), default=None)
    if first is None:
        return None
    driven = max(speed, (length - _EARLY) / dt)  # it may have been taken off the road so much before its end
    row = float(own.x[1]), float(own.y[1]), float(own.heading[1]), driven, (driven - speed) / dt
    return LastStep(row, first, {name: others[name] for name in steps})


def unknown_end(other: str, t: float) -> str:
    """Return what there is to say of such a contact that SUMO does not list, at a time of the trace (s)."""
    how = "the ego arrives within this step, of which SUMO tells no position: it is taken to drive on straight at its speed"
    return f"{UNCONFIRMED}'{other}' at {t:.3f} s: {how}"


def _variables(sumo: Any, near: _Surroundings, name: str) -> Mapping[int, Any] | None:
    """Return the variables of a road user after the step; None where it is gone, too, or rides."""
    if name in near.placed:
        return placed_variables({name: near.placed[name]})[name]
    if not near.is_person(name):
        return read(sumo, name) if is_known(sumo, name) else None
    of = sumo.person
    if name not in of.getIDList() or of.getVehicle(name):
        return None
    return {POSITION: of.getPosition3D(name), ANGLE: of.getAngle(name), SPEED: of.getSpeed(name), VEHICLE: ""}


def _step(near: _Surroundings, name: str, variables: Mapping[int, Any], dt: float) -> ActorTrace | None:
    """Return a road user before and after the step, the parts of a long one moved as its front is; None where it has jumped."""
    before, state = near.body(name), near.states[name]
    heading, half = math.radians(90.0 - variables[ANGLE]), 0.0 if near.is_person(name) else 0.5 * state.length
    fronts = [(u[0] + half * c) for u, c in ((before.x, state.cos), (before.y, state.sin))]
    x, y = (variables[POSITION][k] - fronts[k] for k in (0, 1))
    if math.hypot(x, y) > (abs(state.speed) + abs(variables[SPEED])) * dt + _BESIDE:
        return None
    if before.parts:
        return _moved(before, x, y)
    x, y = x + half * (state.cos - math.cos(heading)), y + half * (state.sin - math.sin(heading))
    return replace(_moved(before, x, y), heading=np.array([state.heading, heading]))


def _moved(body: ActorTrace, x: float, y: float) -> ActorTrace:
    """Return a body of one instant, and as it is after a way (m)."""
    heading, speed, acceleration = (np.repeat(values, 2) for values in (body.heading, body.speed, body.acceleration))
    parts = tuple(_moved(part, x, y) for part in body.parts)
    xs, ys = body.x + np.array([0.0, x]), body.y + np.array([0.0, y])
    return ActorTrace(xs, ys, heading, speed, acceleration, body.length, body.width, parts)
