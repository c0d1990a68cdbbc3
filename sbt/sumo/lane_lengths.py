"""Lanes whose length is not that of their shape: SUMO's gaps are along the one, metrics measure the other."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

__all__ = ["told_of_lengths"]

_METRES, _PART = 2.0, 0.05
"""Differences that are told are larger than both, the second in the length of the shape."""
_NAMED = 3


def told_of_lengths(sumo: Any) -> str:
    """Return in words which edges of the network that SUMO has loaded have another length than their shape; "" where none has."""
    lane, found = sumo.lane, dict[str, tuple[float, float]]()
    for name in lane.getIDList():
        if name.startswith(":"):
            continue
        length, drawn = float(lane.getLength(name)), sum(math.dist(a, b) for a, b in pairwise(lane.getShape(name)))
        if abs(length - drawn) > max(_METRES, _PART * drawn):
            found.setdefault(name.rpartition("_")[0], (length, drawn))
    if not found:
        return ""
    named = ", ".join(f"'{edge}' {length:.0f} m for {drawn:.0f} m" for edge, (length, drawn) in list(found.items())[:_NAMED])
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return (
        f"edges have another length than their shape ({named}{more}): SUMO drives and keeps gaps along the length, and metrics"
        " measure in the plane, so that gaps, times and contacts there are not those of SUMO; leave their attribute length out"
    )
