"""Which differences in height tell that two road users are on different levels, such as on and under a bridge."""

from __future__ import annotations

__all__ = ["DETOUR", "LEVEL_HEIGHT", "STACKED", "STEEPEST"]

LEVEL_HEIGHT = 3.0
"""Difference in height from which on two road users are on different levels, such as on and under a bridge (m)."""
STEEPEST = 0.15
"""Slope of no road: who is so much higher is above, also on a road that the ego's way leads to."""
DETOUR = 1.5
"""Largest ratio of the way to the beeline between road users on one level by their way: a ramp leads around, and above itself."""
STACKED = 15.0
"""Distance of places on roads within which they are one above the other, or not (m)."""
