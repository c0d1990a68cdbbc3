"""Metrics of the ego alone: jerk and braking."""

from __future__ import annotations

import numpy as np

from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import ActorTrace, Trace

__all__ = ["deceleration_max", "jerk", "jerk_max"]


def jerk(actor: ActorTrace, time: Vector) -> Vector:
    """Return the (t,) rate of change of the acceleration over the step before each instant (m/s^3), NaN while it is absent.

    0 at its first two instants, and at the first two after an absence, because the first acceleration is not measured.
    Accelerations are means over the steps before their instants, as differences of speeds are.
    """
    a, step = actor.acceleration, np.diff(time)
    result = np.where(np.isnan(a), np.nan, 0.0)
    known = np.isfinite(a[2:]) & np.isfinite(a[1:-1]) & np.isfinite(a[:-2])
    mean = 0.5 * (step[1:] + step[:-1])
    apart = np.where(np.isclose(step[1:], step[:-1]), step[1:], mean)  # the middles of the two steps (s)
    result[2:][known] = (np.diff(a[1:]) / apart)[known]
    return result


def jerk_max(ego: str = "ego") -> Metric:
    """Return the largest absolute jerk along the heading (m/s^3), by differences over the steps of the trace."""

    def function(trace: Trace) -> float:
        return float(np.nanmax(np.abs(jerk(trace.actor(ego), trace.time)), initial=0.0))

    return Metric("jerk_max", function, "m/s^3", "high", 0.0, "largest absolute rate of the ego's acceleration", alone=True)


def deceleration_max(ego: str = "ego") -> Metric:
    """Return the strongest deceleration (m/s^2), 0 if the ego never brakes."""

    def function(trace: Trace) -> float:
        return float(np.nanmax(-trace.actor(ego).acceleration, initial=0.0)) + 0.0  # no -0

    return Metric("deceleration_max", function, "m/s^2", "high", 0.0, "strongest deceleration of the ego", alone=True)


JERK_MAX = jerk_max()
DECELERATION_MAX = deceleration_max()
