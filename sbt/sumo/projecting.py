"""Drawn traffic, projected without a simulation to the place where the ego meets it: when who gets there, with which gaps.

A covariate is a number that is known before the run. Raw positions and speeds teach a metamodel little; times relative to the
ego's own arrival at the place of conflict teach it much.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sbt.problem.arrays import Mask, Points, Vector
from sbt.sumo.actors import Actor

__all__ = ["FAR", "Arrivals", "arrivals_at", "beside", "crossing_of", "driver_value", "first_gap", "gaps", "taken_gap",
           "time_to_reach"]  # fmt: skip

FAR = 30.0
"""Time that stands for "nobody comes" (s)."""
_LONG = 12.0
"""Gaps longer than this are alike (s)."""
_NOBODY = 10.0
"""Time to a neighbour who is not there (s)."""
_SLOWEST = 1.0
"""Speed below which nobody is projected (m/s)."""
_STANDARD = {"accel": 2.6, "decel": 4.5, "minGap": 2.0, "sigma": 0.5, "speedFactor": 1.0, "tau": 1.0}
"""Of vehicles whose types say nothing."""
_DRAWN = re.compile(r"normc?\((.*?)\)?")
"""SUMO's distributions of an attribute: mean, deviation and, where given, the ends."""
_LARGEST = 1e6
"""No attribute is larger: SUMO takes `inf`, too."""


@dataclass(frozen=True, eq=False)
class Arrivals:
    """When the fronts of cars pass a place, sorted.

    Attributes:
        time: (n,) from the start of the run (s); negative for who is past it.
        speed: (n,) there (m/s).
    """

    time: Vector
    speed: Vector

    def where(self, keep: Mask) -> Arrivals:
        """Return some of them."""
        return Arrivals(self.time[keep], self.speed[keep])


def arrivals_at(place: float, cars: Sequence[Actor], limit: float, *, fastest: float = math.inf, delay: float = 0.0) -> Arrivals:
    """Return when the cars of a lane, the foremost first, pass a place on it.

    A car goes from its own speed to its desired one, less what its driver's imperfection costs on average (half of
    sigma times accel), and keeps its time gap to the car ahead (Newell's simplified car following).

    Args:
        place: on the lane (m).
        cars: of one lane, the foremost first.
        limit: speed limit, to which speed factors refer (m/s).
        fastest: no car is faster (m/s).
        delay: added to the time gap (s).
    """
    if not cars:
        return Arrivals(np.empty(0), np.empty(0))
    types = [_STANDARD | {k: _mean(v, _STANDARD[k]) for k, v in a.type.attributes if k in _STANDARD} for a in cars]
    position, start = np.array([a.position for a in cars]), np.array([a.speed for a in cars])
    wanted = np.array([t["speedFactor"] * limit - 0.5 * t["sigma"] * t["accel"] for t in types])
    speed = np.clip(wanted, _SLOWEST, fastest)
    time = time_to_reach(place - position, start, speed, np.array([t["accel"] for t in types]))
    for k in range(1, len(cars)):
        kept, room = types[k]["tau"] + delay, cars[k].type.length + types[k]["minGap"]
        if time[k] < time[k - 1] + kept + room / speed[k]:
            speed[k] = min(speed[k], speed[k - 1])
            time[k] = max(time[k], time[k - 1] + kept + room / speed[k])
    return Arrivals(time, speed)


def driver_value(actor: Actor, name: str, otherwise: float) -> float:
    """Return a number among the attributes of an actor's type, or another where it has none of this name.

    It is the mean where SUMO draws it (`norm(1,0.1)`, `normc(1,0.1,0.2,2)`), and the other one where it is no number (`off`).
    """
    return _mean(dict(actor.type.attributes).get(name, otherwise), otherwise)


def _mean(text: object, otherwise: float) -> float:
    """Return the number that SUMO reads from an attribute, or the mean of those that it draws, cut to what is within bounds."""
    drawn = _DRAWN.fullmatch(str(text))
    try:
        numbers = [float(each) for each in (drawn[1] if drawn else str(text)).split(",")]
    except ValueError:
        return otherwise
    mean, deviation, low, high = (*numbers, *(0.0, -math.inf, math.inf)[len(numbers) - 1 :])[:4]
    if math.isnan(mean):
        return otherwise
    if deviation > 0.0 and abs(mean) < _LARGEST:
        ends = (np.array([low, high]) - mean) / deviation
        inside, edge = float(np.diff(ndtr(ends))[0]), np.exp(-0.5 * ends**2) / math.sqrt(2.0 * math.pi)
        mean += deviation * float(edge[0] - edge[1]) / inside if inside > 0.0 else 0.0
    return max(-_LARGEST, low, min(mean, high, _LARGEST))


def time_to_reach(distance: Vector | float, start: Vector | float, wanted: Vector | float, accel: Vector | float) -> Vector:
    """Return the time for a distance (m) from a speed with an acceleration up to a wanted speed, a lower one at once.

    Distances that are behind give negative times at the present speed. Speeds in m/s, accelerations in m/s^2.
    """
    d, v, w, a = (np.asarray(each, dtype=np.float64) for each in (distance, start, wanted, accel))
    rise = np.maximum(w - v, 0.0) / a
    during = v * rise + 0.5 * a * rise**2
    rising = (np.sqrt(np.maximum(v**2 + 2.0 * a * d, 0.0)) - v) / a
    after = np.where(d > during, rise + (d - during) / np.maximum(w, _SLOWEST), rising)
    return np.asarray(np.where(d < 0.0, d / np.maximum(v, _SLOWEST), after))


def gaps(
    arrivals: Arrivals, ready: float, longer_than: Sequence[float] = (4.0, 5.0, 6.0, 7.0), following: int = 3
) -> dict[str, float]:
    """Return the gaps among arrivals from when the ego is ready to take one on (s).

    Returns:
        `since` the last arrival, `next_1`, ... to the next ones, `queue`: arrivals within 15 s, and of the first gap longer than
        each of the lengths what `first_gap` gives.
    """
    relative = arrivals.time - ready
    past, coming = relative[relative <= 0.0], relative[relative > 0.0]
    found = {"since": min(float(-past[-1]), FAR) if len(past) else FAR, "queue": float((coming < 15.0).sum())}
    found |= {f"next_{k + 1}": min(float(coming[k]), FAR) if k < len(coming) else FAR for k in range(following)}
    for length in longer_than:
        found |= {f"{name}_{length:g}": value for name, value in first_gap(arrivals, ready, length).items()}
    return found


def first_gap(arrivals: Arrivals, ready: float, length: float) -> dict[str, float]:
    """Return when the first gap longer than this begins (`wait`), how long it is (`gap`) and who ends it (`closing`); s, m/s."""
    relative = arrivals.time - ready
    ahead = relative > 0.0
    begin, speed = 0.0, arrivals.speed[ahead].tolist()
    for end, closing in zip(relative[ahead].tolist(), speed, strict=True):
        if end - begin > length:
            return {"wait": min(begin, FAR), "gap": min(end - begin, _LONG), "closing": closing}
        begin = end
    return {"wait": min(begin, FAR), "gap": min(begin + FAR + max(length, 0.0) - begin, _LONG), "closing": 0.0}


def taken_gap(arrivals: Arrivals, ready: float, need: Vector, into: float, out_of: float) -> dict[str, float]:
    """Return which gap the ego takes that goes at once, or as soon as somebody is out of the way, where the next is late enough.

    Args:
        arrivals: at the place of conflict.
        ready: when the ego could go first (s).
        need: (n,) time that the ego wants until each of them enters (s).
        into: from the conflict to where they enter, negative (m).
        out_of: from the conflict to where they are out of the way (m).

    Returns:
        In s, m/s: `wait` from ready until it goes, `until` the next one is at the conflict, `slack` of the gap beyond the need,
        `missed`, the largest (negative) slack of gaps that it left, and `closing`, the speed of the next one; at ready,
        `offered`, the time until the next one enters, and `since` the last one was out.
    """
    pace = np.maximum(arrivals.speed, _SLOWEST)
    out = np.maximum.accumulate(arrivals.time + out_of / pace)
    k = int(np.searchsorted(out, ready))
    go = np.concatenate([[ready], out[k:]])
    until = np.append(arrivals.time[k:], go[-1] + FAR) - go
    entering = np.append(arrivals.time[k:] + into / pace[k:], go[-1] + FAR) - go
    slack = entering - np.append(need[k:], 0.0)
    j = int(np.argmax(slack > 0.0))
    return {
        "wait": min(float(go[j] - ready), FAR), "until": min(float(until[j]), _LONG), "slack": min(float(slack[j]), _LONG),
        "missed": float(np.clip(slack[:j].max(), -_LONG, 0.0)) if j else -_LONG, "closing": float(np.append(pace[k:], 0.0)[j]),
        "offered": min(float(entering[0]), _LONG), "since": min(float(ready - out[k - 1]), _LONG) if k else _LONG,
    }  # fmt: skip


def beside(arrivals: Arrivals, time: float, speed: float, neighbours: int = 1) -> dict[str, float]:
    """Return who is ahead of and behind the ego, that gets to the same place at a time (s) with a speed (m/s).

    Returns:
        For each neighbour ahead and behind, the time between them (s), the difference of speeds (m/s, theirs less the ego's) and
        the time to a collision if both went on (s); and the `room` between the nearest ones (s).
    """
    relative = arrivals.time - time
    ahead, behind = np.flatnonzero(relative <= 0.0)[::-1], np.flatnonzero(relative > 0.0)
    found: dict[str, float] = {}
    for side, rows, sign in (("ahead", ahead, -1.0), ("behind", behind, 1.0)):
        for k in range(neighbours):
            there = k < len(rows)
            apart = min(sign * float(relative[rows[k]]), _NOBODY) if there else _NOBODY
            faster = float(arrivals.speed[rows[k]]) - speed if there else -5.0 * sign
            space = apart * (speed if sign < 0 else speed + faster) - 5.0
            found |= {
                f"{side}_{k + 1}": apart, f"{side}_{k + 1}_faster": faster,
                f"{side}_{k + 1}_ttc": float(np.clip(space / max(sign * faster, 0.3), -5.0, 20.0)),
            }  # fmt: skip
    return found | {"room": found["ahead_1"] + found["behind_1"]}


def crossing_of(path: Points, other: Points, near: Callable[[float], float]) -> tuple[float, float] | None:
    """Return how far along two paths (n, 2) of points about a metre apart, in m, they first come near; None where they never do.

    Args:
        path: of the ego.
        other: of the other.
        near: cosine between the two headings to the distance (m) within which they conflict.
    """
    ours, theirs = np.diff(path, axis=0), np.diff(other, axis=0)
    step, beyond = np.hypot(*ours.T), np.hypot(*theirs.T)
    apart = np.hypot(*(path[:-1, None, :] - other[None, :-1, :]).transpose(2, 0, 1))
    cosine = (ours @ theirs.T) / np.outer(step, beyond)
    close = apart < np.vectorize(near)(cosine)
    if not close.any():
        return None
    i = int(np.argmax(close.any(axis=1)))
    j = int(np.argmin(np.where(close[i], apart[i], np.inf)))
    return float(step[:i].sum()), float(beyond[:j].sum())
