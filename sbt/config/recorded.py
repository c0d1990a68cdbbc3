"""Recorded road users as traffic, and the network that is made of a recording, from the entries of a `scenario.yaml`."""

from __future__ import annotations

import math
from pathlib import Path

from sbt.config.scenario_model import RecordedEntry
from sbt.errors import InputError
from sbt.metrics.tracks import read_meta
from sbt.sumo.recorded import RecordedTraffic, recorded_tracks
from sbt.sumo.recorded_net import extent, motorway, path_of, write_net
from sbt.sumo.template import tried

__all__ = ["is_number", "net_of_recording", "recorded_traffic"]


def is_number(text: str) -> bool:
    """Return whether a text is a finite number once its placeholders are filled."""
    try:
        return math.isfinite(float(tried(text)))
    except ValueError:
        return False


def recorded_traffic(entry: RecordedEntry, folder: Path) -> RecordedTraffic:
    """Return the traffic of an entry.

    Raises:
        InputError: the recording cannot be read, one that is left out is not there, or its beginning is no number.
    """
    if not is_number(str(entry.begin)):
        rule = 'begin must be a number (s), or a placeholder such as "${t}"'
        raise InputError(f"{rule}, but got '{entry.begin}'")
    return RecordedTraffic(_path(entry, folder), str(entry.begin), entry.without, entry.offset)


def net_of_recording(entry: RecordedEntry, folder: Path) -> Path:
    """Return the file of a network that is made of a recording: the roads that are wanted, or a motorway by its lane markings.

    Raises:
        InputError: the recording cannot be read, a road is not possible, or there are neither roads nor lane markings.
    """
    path = _path(entry, folder)
    tracks = recorded_tracks(path)
    roads = [path_of(name, r.along, tracks, r.width, r.speed) for name, r in entry.roads.items()]
    return write_net(roads or motorway(read_meta(path), extent(tracks)), entry.offset)


def _path(entry: RecordedEntry, folder: Path) -> Path:
    return (folder / Path(entry.file).expanduser()).resolve()
