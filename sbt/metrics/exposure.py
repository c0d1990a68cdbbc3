"""Exposure to critical TTC over time: TET and TIT, integrals by the trapezoidal rule."""

from __future__ import annotations

import numpy as np

from sbt.metrics.geometry import contact_moment
from sbt.metrics.longitudinal import encounter, first_contact, time_to_collision
from sbt.problem.arrays import Mask, Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["THRESHOLD", "integral", "tet", "tit"]

THRESHOLD = 3.0
"""TTC below which road users are exposed (s)."""


def integral(trace: Trace, values: Vector | Mask, ego: str, other: str) -> float:
    """Return the time integral of (t,) values until the end or the first contact of the two, which may lie within a step.

    For a condition it is the time during which it holds (s); a step at whose ends it differs counts half.
    """
    k, time = first_contact(trace, ego, other), trace.time
    if k == 0:
        return 0.0
    if k is not None:
        moment = contact_moment(trace.actor(ego), trace.actor(other), k)
        time = np.append(time[:k], time[k - 1] + moment * (time[k] - time[k - 1]))
    return float(np.trapezoid(values[: len(time)].astype(np.float64), time))


def _shortfall(trace: Trace, ego: str, other: str, margin: float, threshold: float) -> Vector:
    """Return the (t,) difference of the threshold and the TTC below it (s), 0 while nobody is ahead in the path."""
    e = encounter(trace, ego, other, margin)
    shortfall = np.where(e.ahead, np.maximum(threshold - time_to_collision(e), 0.0), 0.0)
    return e.after_contact(shortfall, threshold)


def tet(ego: str = "ego", other: str = "co", margin: float = 0.0, threshold: float = THRESHOLD) -> Metric:
    """Return the time exposed TTC: how long TTC is below a threshold (s) while the other is ahead."""
    return Metric(
        "tet", lambda trace: integral(trace, _shortfall(trace, ego, other, margin, threshold) > 0, ego, other), "s", "high", 0.0,
        f"time exposed to a TTC below {threshold:g} s",
        "Minderhoud and Bovy (2001), Extended time-to-collision measures for road traffic safety assessment, "
        "doi 10.1016/S0001-4575(00)00019-1",
    )  # fmt: skip


def tit(ego: str = "ego", other: str = "co", margin: float = 0.0, threshold: float = THRESHOLD) -> Metric:
    """Return the time integrated TTC: the area between TTC and a threshold above it (s^2) while the other is ahead."""
    return Metric(
        "tit", lambda trace: integral(trace, _shortfall(trace, ego, other, margin, threshold), ego, other), "s^2", "high", 0.0,
        f"area between the TTC and {threshold:g} s while the TTC is below it",
        "Minderhoud and Bovy (2001), Extended time-to-collision measures for road traffic safety assessment, "
        "doi 10.1016/S0001-4575(00)00019-1",
    )  # fmt: skip


TET = tet()
TIT = tit()
