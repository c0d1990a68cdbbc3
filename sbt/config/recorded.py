"""Recorded road users as traffic, and the network that is made of a recording, from the entries of a `scenario.yaml`."""

from __future__ import annotations

from pathlib import Path

from sbt.config.scenario_model import RecordedEntry
from sbt.metrics.tracks import read_meta
from sbt.sumo.recorded import RecordedTraffic, recorded_tracks
from sbt.sumo.recorded_net import extent, motorway, path_of, write_net

__all__ = ["net_of_recording", "recorded_traffic"]


def recorded_traffic(entry: RecordedEntry, folder: Path) -> RecordedTraffic:
    """Return the traffic of an entry.

    Raises:
        InputError: the recording cannot be read, or one that is left out is not there.
    """
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
