"""Named signals of a trace: quantities at every instant, (t,) finite numbers.

Scalar metrics are their worst values, and formulas of `sbt.metrics.stl` refer to them. Without an interaction
a signal has a fixed value; from a rear-end collision on it keeps the value at that collision, those of RSS from any contact on.

Of the ego and the other road user:

    gap              m      from the ego's front to the other's rear along the ego's heading; 1,000 if not in the path
    ttc              s      time to collision along the ego's heading, at most 10; negative beside
    thw              s      time headway, at most 10
    mttc             s      time to collision at constant accelerations, at most 10
    drac             m/s^2  deceleration that avoids the collision, 0 if the gap does not shrink, at most 100
    mdrac            m/s^2  the same after a reaction time of 1 s
    btn              -      brake threat number: required deceleration divided by 8 m/s^2
    ttc2d            s      time until the two moving rectangles touch, at most 10
    distance         m      between the rectangles, at most 1,000
    closing          m/s    rate at which the gap shrinks
    lateral          m      offset of the other's centre from the ego's centre line, positive to the left
    rss_longitudinal m      gap minus the safe distance of RSS, at most 1,000
    rss_lateral      m      lateral clearance minus the safe distance of RSS, at most 1,000

Of one road user: `speed` (m/s), `acceleration` (m/s^2), `jerk` (m/s^3), `x`, `y` (m), `heading` (rad).
And `time` (s).

A bare name refers to the ego, or to the ego and the other; `NAME.speed` to the actor NAME, `NAME.gap` to the ego and NAME.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.metrics.braking import btn, drac, mdrac, mttc
from sbt.metrics.comfort import jerk
from sbt.metrics.longitudinal import Signal, encounter, gap, thw, ttc
from sbt.metrics.planar import distance, ttc_2d
from sbt.metrics.rss import lateral_margin, longitudinal_margin
from sbt.problem.arrays import Vector
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["ACTOR_SIGNALS", "PAIR_SIGNALS", "check_signal", "signal"]


def closing(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) rate at which the gap shrinks (m/s), also while the other is not in the path."""
    return encounter(trace, ego, other, margin).closing


def lateral(trace: Trace, ego: str, other: str, margin: float) -> Vector:
    """Return the (t,) offset of the other's centre to the left of the ego's centre line (m)."""
    a, b = trace.actor(ego), trace.actor(other)
    return np.cos(a.heading) * (b.y - a.y) - np.sin(a.heading) * (b.x - a.x)


PAIR_SIGNALS: dict[str, Signal] = {
    "gap": gap, "ttc": ttc, "thw": thw, "mttc": mttc, "drac": drac, "mdrac": mdrac, "btn": btn, "ttc2d": ttc_2d,
    "distance": distance, "closing": closing, "lateral": lateral,
    "rss_longitudinal": longitudinal_margin, "rss_lateral": lateral_margin,
}  # fmt: skip
"""Signals of two actors: name to a function of trace, ego, other and the margin of the path."""

ACTOR_SIGNALS: dict[str, Callable[[ActorTrace, Vector], Vector]] = {
    "speed": lambda actor, time: actor.speed,
    "acceleration": lambda actor, time: actor.acceleration,
    "jerk": jerk,
    "x": lambda actor, time: actor.x,
    "y": lambda actor, time: actor.y,
    "heading": lambda actor, time: actor.heading,
}
"""Signals of one actor: name to a function of the actor and the times."""


def check_signal(name: str) -> None:
    """Check that a signal of this name exists; the actor can be checked in a trace only.

    Raises:
        InputError: it does not.
    """
    actor, dot, what = name.rpartition(".")
    if name == "time" or what in ACTOR_SIGNALS or what in PAIR_SIGNALS:
        if dot and not actor:
            raise InputError(f"a signal must be NAME or actor.NAME, but got '{name}'")
        return
    known = ("time", *PAIR_SIGNALS, *ACTOR_SIGNALS)
    raise InputError(f"a signal must be one of {', '.join(known)}, but got '{name}'{did_you_mean(what, known)}")


def signal(trace: Trace, name: str, ego: str = "ego", other: str = "co", margin: float = 0.0) -> Vector:
    """Return a named signal of a trace.

    Args:
        trace: t instants.
        name: as listed above, bare or `actor.name`.
        ego: the road user under test.
        other: the other road user of a bare name of two.
        margin: lateral clearance below which the other is in the ego's path (m).

    Returns:
        (t,) numbers.

    Raises:
        InputError: there is no such signal.
        RunError: there is no such actor in the trace.
    """
    check_signal(name)
    if name == "time":
        return trace.time
    actor, _, what = name.rpartition(".")
    if what in ACTOR_SIGNALS:
        return ACTOR_SIGNALS[what](trace.actor(actor or ego), trace.time)
    return PAIR_SIGNALS[what](trace, ego, actor or other, margin)
