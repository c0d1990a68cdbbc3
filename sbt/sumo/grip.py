"""The limits of a vehicle's acceleration in SUMO, and their bound by friction: |acceleration| <= mu g."""

from __future__ import annotations

from typing import Any

__all__ = ["GRAVITY", "Limits", "limit_to_friction", "set_limits"]

GRAVITY = 9.81
"""m/s^2."""
_BOUNDED = 2 | 4
"""Speed modes in which SUMO keeps to the vehicle's acceleration and deceleration."""

Limits = tuple[float, float, float, float, int]
"""Of a vehicle: accel, decel, emergencyDecel, apparentDecel (m/s^2), and its speed mode."""


def limit_to_friction(sumo: Any, name: str, mu: float) -> Limits:
    """Bound the acceleration of a vehicle by a coefficient of friction, and return its limits from before."""
    vehicle, most = sumo.vehicle, mu * GRAVITY
    before: Limits = (
        vehicle.getAccel(name), vehicle.getDecel(name), vehicle.getEmergencyDecel(name), vehicle.getApparentDecel(name),
        vehicle.getSpeedMode(name),
    )  # fmt: skip
    if before[-1] & _BOUNDED:  # a driver of SUMO, with limits of its own
        set_limits(sumo, name, (*(min(value, most) for value in before[:4]), before[-1]))  # type: ignore[arg-type]
    else:
        set_limits(sumo, name, (most, most, most, most, before[-1] | _BOUNDED))
    return before


def set_limits(sumo: Any, name: str, limits: Limits) -> None:
    """Give a vehicle these limits."""
    vehicle = sumo.vehicle
    accel, decel, emergency, apparent, mode = limits
    vehicle.setEmergencyDecel(name, max(emergency, vehicle.getDecel(name)))  # never below decel, of which SUMO would warn
    vehicle.setDecel(name, decel)
    vehicle.setEmergencyDecel(name, emergency)
    vehicle.setApparentDecel(name, apparent)
    vehicle.setAccel(name, accel)
    if mode != vehicle.getSpeedMode(name):
        vehicle.setSpeedMode(name, mode)
