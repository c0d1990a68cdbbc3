"""Networks for recorded traffic where the user has none: the lanes of a motorway by their markings, or single roads."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sbt.errors import InputError
from sbt.metrics.tracks import RecordingMeta
from sbt.problem.arrays import Points
from sbt.sumo.recorded import Track
from sbt.sumo.session import scratch_folder

__all__ = ["Road", "extent", "motorway", "path_of", "write_net"]

_BEYOND = 1000.0
"""Length by which a road goes on straight where the recording ends (m), so that nobody reaches its end within a run."""
_SPACING = 0.5
"""Smallest distance of two points of a recorded path (m): positions of a standing vehicle are noise."""
_FREE = 50.0
"""Allowed speed where none is known (m/s)."""


@dataclass(frozen=True)
class Road:
    """One edge: its lanes from the right, each (n, 2) points along its centre.

    Args:
        name: of the edge.
        lanes: centre lines (m), in driving direction.
        widths: of the lanes (m).
        speed: allowed (m/s); None: not limited.
    """

    name: str
    lanes: tuple[Points, ...]
    widths: tuple[float, ...]
    speed: float | None = None


def motorway(meta: RecordingMeta, ends: tuple[float, float]) -> tuple[Road, ...]:
    """Return the edges `upper` (to the left) and `lower` (to the right) of a recording with lane markings.

    Args:
        meta: with the lane markings.
        ends: smallest and largest x of the recording (m); positions on the lanes count from where their direction enters.

    Raises:
        InputError: there are no lane markings.
    """
    roads = []
    for name, marks, (begin, end) in (
        ("upper", meta.upper, (ends[1], ends[0] - _BEYOND)), ("lower", meta.lower[::-1], (ends[0], ends[1] + _BEYOND)),
    ):  # fmt: skip
        if len(marks) > 1:
            centres = [0.5 * (a + b) for a, b in pairwise(marks)]
            lanes = tuple(np.array([(begin, y), (end, y)]) for y in centres)
            roads.append(Road(name, lanes, tuple(abs(a - b) for a, b in pairwise(marks)), meta.speed_limit))
    if not roads:
        raise InputError("a network can be made of a recording with lane markings in its recordingMeta.csv, but there are none")
    return tuple(roads)


def path_of(
    name: str, along: str | Sequence[tuple[float, float]], tracks: Sequence[Track], width: float, speed: float | None
) -> Road:
    """Return a road of one lane along the path of a recorded road user's front, or along points, straight on at its end.

    Raises:
        InputError: there is no such road user, or fewer than two points that are apart.
    """
    if isinstance(along, str):
        track = next((t for t in tracks if t.name == along), None)
        if track is None:
            some = ", ".join(t.name for t in tracks[:8])
            raise InputError(f"a road must be along a road user of the recording ({some}, ...) or points, but got '{along}'")
        points = np.column_stack([track.x, track.y])
    else:
        points = np.asarray(along, dtype=np.float64)
    kept = [points[0]] if len(points) else []
    for point in points[1:]:
        if np.hypot(*(point - kept[-1])) >= _SPACING:
            kept.append(point)
    if len(kept) < 2:
        raise InputError(f"a road must have two points or more that are {_SPACING:g} m apart, but road '{name}' has not")
    last = kept[-1] - kept[-2]
    kept.append(kept[-1] + _BEYOND * last / np.hypot(*last))
    return Road(name, (np.array(kept),), (width,), speed)


def write_net(roads: Sequence[Road], offset: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Write a network of unconnected roads to the temporary folder of this process and return the file."""
    shifted = [Road(r.name, tuple(lane + offset for lane in r.lanes), r.widths, r.speed) for r in roads]
    points = np.vstack([lane for road in shifted for lane in road.lanes])
    box = ",".join(f"{v:.2f}" for v in (*points.min(axis=0), *points.max(axis=0)))
    lines = [
        '<net version="1.20" junctionCornerDetail="5" limitTurnSpeed="-1">',
        f'    <location netOffset="0.00,0.00" convBoundary="{box}" origBoundary="{box}" projParameter="!"/>',
        *(line for road in shifted for line in _edge(road)),
        *(line for road in shifted for line in _junctions(road)),
        "</net>\n",
    ]
    text = "\n".join(lines)
    path = scratch_folder() / f"recorded-{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}.net.xml"
    path.write_text(text)
    return path


def _edge(road: Road) -> list[str]:
    name, speed = road.name, _FREE if road.speed is None else road.speed
    lanes = [
        f'        <lane id={quoteattr(f"{name}_{k}")} index="{k}" speed="{speed:g}" length="{_length(lane):.3f}" '
        f'width="{width:.3f}" shape="{_shape(lane)}"/>'
        for k, (lane, width) in enumerate(zip(road.lanes, road.widths, strict=True))
    ]
    ends = f"from={quoteattr(f'{name}.begin')} to={quoteattr(f'{name}.end')}"
    return [f'    <edge id={quoteattr(name)} {ends} priority="-1">', *lanes, "    </edge>"]


def _junctions(road: Road) -> list[str]:
    lanes = " ".join(f"{road.name}_{k}" for k in range(len(road.lanes)))
    first, last = road.lanes[0][0], road.lanes[0][-1]
    return [
        f'    <junction id={quoteattr(f"{road.name}.{end}")} type="dead_end" x="{p[0]:.3f}" y="{p[1]:.3f}" '
        f'incLanes={quoteattr(incoming)} intLanes="" shape="{_shape(np.array([p, p]))}"/>'
        for end, p, incoming in (("end", last, lanes), ("begin", first, ""))
    ]  # fmt: skip


def _shape(points: Points) -> str:
    return " ".join(f"{x:.3f},{y:.3f}" for x, y in points.tolist())


def _length(points: Points) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def extent(tracks: Sequence[Track]) -> tuple[float, float]:
    """Return the smallest and largest x of the fronts of all tracks (m)."""
    return min(float(t.x.min()) for t in tracks), max(float(t.x.max()) for t in tracks)
