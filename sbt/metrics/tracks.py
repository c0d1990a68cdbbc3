"""Recorded trajectories in the columns of the highD and the inD family of data sets, as `Recording`s.

highD (also its siblings of motorways): `frame, id, x, y, width, height, xVelocity, yVelocity`, optionally `xAcceleration`.
x and y are the upper left corner of the bounding box in image coordinates, y pointing down; `width` is along x, so it is the
vehicle's length. Here y points up: it is the negative of theirs. Vehicles are parallel to x.

inD (also rounD, exiD, uniD): `trackId, frame, xCenter, yCenter, heading, width, length, xVelocity, yVelocity`, optionally
`lonAcceleration` or `xAcceleration, yAcceleration`. Headings are degrees, counter-clockwise from +x.

Frames become times by the `frameRate` of `NN_recordingMeta.csv`, and classes are those of `NN_tracksMeta.csv`, both looked for
beside `NN_tracks.csv`. Lane markings of a motorway are `upperLaneMarkings` and `lowerLaneMarkings` there.

Source: Krajewski et al. (2018), doi 10.1109/ITSC.2018.8569552 (highD); Bock et al. (2020), doi 10.1109/IV47402.2020.9304839
(inD); the columns as in the data sets' format descriptions.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sbt.errors import InputError
from sbt.metrics.fcd import PERSON_SIZE, Recording, read_fcd, recording_of_columns
from sbt.problem.arrays import Vector

__all__ = ["RecordingMeta", "read_meta", "read_recording"]

Columns = dict[str, Vector]

_FRAME_RATE = 25.0
"""Frames per second of all these data sets, where no file says it."""
_HIGHD = ("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity")
_IND = ("trackId", "frame", "xCenter", "yCenter", "heading", "width", "length", "xVelocity", "yVelocity")
_PERSONS = ("pedestrian", "person")
_STANDING = 0.1
"""Mean speed along x below which a vehicle of a motorway is taken to face +x (m/s)."""


@dataclass(frozen=True)
class RecordingMeta:
    """What a `recordingMeta.csv` says.

    Attributes:
        frame_rate: frames per second.
        speed_limit: m/s; None: none, or not stated.
        upper, lower: y of the lane markings of a motorway's two directions (m), up, from the top; empty without.
    """

    frame_rate: float = _FRAME_RATE
    speed_limit: float | None = None
    upper: tuple[float, ...] = ()
    lower: tuple[float, ...] = ()


def read_recording(path: Path, *, length: float = 5.0, width: float = 1.8) -> Recording:
    """Read recorded traffic: tracks in the columns of highD or inD, otherwise SUMO's FCD.

    Args:
        path: a file of tracks (.csv), or an FCD file.
        length: of vehicles without a length in an FCD file (m).
        width: of vehicles without a width in an FCD file (m).

    Raises:
        InputError: it cannot be read, or is none of them.
    """
    header = _header(path) if path.suffix == ".csv" else ()
    for wanted, convert in ((_IND, _of_ind), (_HIGHD, _of_highd)):
        if set(wanted[:4]) <= set(header):
            missing = [name for name in wanted if name not in header]
            if missing:
                rule = f"tracks must have the columns {', '.join(wanted)}"
                raise InputError(f"{rule}, but in '{path}' {', '.join(missing)} is missing")
            return _recording(path, wanted, convert)
    return read_fcd(path, length=length, width=width)


def read_meta(path: Path) -> RecordingMeta:
    """Return what the `recordingMeta.csv` of a file of tracks says; the data sets' common values without one.

    Raises:
        InputError: it cannot be read, or holds no numbers where there should be some.
    """
    meta = _beside(path, "recordingMeta")
    if meta is None:
        return RecordingMeta()
    row = next(iter(_rows(meta)), {})
    try:
        limit = float(row.get("speedLimit") or -1.0)
        marks = ((row.get(f"{side}LaneMarkings") or "").split(";") for side in ("upper", "lower"))
        upper, lower = (tuple(-float(y) for y in side if y.strip()) for side in marks)
        found = RecordingMeta(float(row.get("frameRate") or _FRAME_RATE), limit if limit > 0 else None, upper, lower)
    except ValueError as error:
        raise InputError(f"{meta}: frame rate, speed limit and lane markings must be numbers, but {error}") from None
    if not 0 < found.frame_rate < math.inf:
        raise InputError(f"{meta}: frameRate must be > 0, but got {found.frame_rate}")
    return found


def _recording(path: Path, wanted: tuple[str, ...], convert: Callable[[Any], tuple[Any, Columns]]) -> Recording:
    """Return the recording of a file of tracks, by the function that converts its columns."""
    import pandas as pd

    try:
        table = pd.read_csv(path, low_memory=False)
        _check_cells(path, table, wanted)
        ids, columns = convert(table)
        columns["time"] = table["frame"].to_numpy(dtype=np.float64) / read_meta(path).frame_rate
    except (ValueError, TypeError) as error:
        raise InputError(f"tracks must be a table of numbers, but in '{path}': {str(error).splitlines()[0]}") from None
    if not len(ids):
        raise InputError(f"tracks must have road users in them, but there is none in '{path}'")
    classes = _classes(path)
    person = np.isin([classes.get(name, "vehicle") for name in ids.tolist()], _PERSONS)
    for name, of_person, of_vehicle in zip(("length", "width"), PERSON_SIZE, (5.0, 1.8), strict=True):
        given = columns[name]  # inD has no size of persons
        columns[name] = np.where(given > 0, given, np.where(person, of_person, of_vehicle))
    heading, half = np.radians(90.0 - columns["angle"]), 0.5 * columns["length"]
    columns["x"] += half * np.cos(heading)  # to the front, as in FCD
    columns["y"] += half * np.sin(heading)
    recording = recording_of_columns(path, ids, person.astype(int), columns, (5.0, 1.8))
    kinds = tuple(classes.get(name, "vehicle") for name in recording.names)
    return replace(recording, kinds=tuple("person" if kind in _PERSONS else kind for kind in kinds))


def _check_cells(path: Path, table: Any, wanted: tuple[str, ...]) -> None:
    """Refuse the first cell that is no finite number; sizes may be empty in the columns of inD, which has none of persons."""
    import pandas as pd

    for name in (column for column in wanted if column not in ("id", "trackId")):
        cells = table[name]
        numbers = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=np.float64)
        may_be_empty = wanted == _IND and name in ("width", "length")
        bad = np.isinf(numbers) | (np.isnan(numbers) & (cells.notna().to_numpy() | (not may_be_empty)))
        if bad.any():
            k = int(bad.argmax())
            got = "nothing" if pd.isna(cells.iloc[k]) else f"'{cells.iloc[k]}'"
            rule = f"tracks must be a table of numbers, but in '{path}' row {k + 2}, column {name} has no finite number"
            raise InputError(f"{rule}: {got}")


def _of_ind(table: Any) -> tuple[Any, Columns]:
    """Return ids, and centres, compass angles, sizes and motion along the heading of inD's columns."""
    column = _columns_of(table)
    heading = np.radians(column("heading"))
    cos, sin = np.cos(heading), np.sin(heading)
    acceleration = column("lonAcceleration")
    if np.isnan(acceleration).all():
        acceleration = column("xAcceleration") * cos + column("yAcceleration") * sin
    return table["trackId"].astype(str).to_numpy(), {
        "x": column("xCenter"), "y": column("yCenter"), "angle": 90.0 - column("heading"),
        "speed": column("xVelocity") * cos + column("yVelocity") * sin, "acceleration": acceleration,
        "length": column("length"), "width": column("width"),
    }  # fmt: skip


def _of_highd(table: Any) -> tuple[Any, Columns]:
    """Return the same of highD's columns: boxes from their upper left corner in an image."""
    column = _columns_of(table)
    ids = table["id"].astype(str).to_numpy()
    mean = table.groupby("id")["xVelocity"].transform("mean").to_numpy(dtype=np.float64)
    side = np.where(mean < -_STANDING, -1.0, 1.0)
    return ids, {
        "x": column("x") + 0.5 * column("width"), "y": -(column("y") + 0.5 * column("height")),
        "angle": np.where(side > 0, 90.0, 270.0), "speed": side * column("xVelocity"),
        "acceleration": side * column("xAcceleration"), "length": column("width"), "width": column("height"),
    }  # fmt: skip


def _columns_of(table: Any) -> Callable[[str], Vector]:
    """Return a function that returns a column as numbers, NaN where the table has none."""
    return lambda name: table[name].to_numpy(dtype=np.float64, copy=True) if name in table else np.full(len(table), np.nan)


def _classes(path: Path) -> dict[str, str]:
    """Return the class of every road user in lower case, as far as a `tracksMeta.csv` says it."""
    meta = _beside(path, "tracksMeta")
    if meta is None:
        return {}
    return {row.get("trackId") or row.get("id") or "": (row.get("class") or "vehicle").strip().lower() for row in _rows(meta)}


def _beside(path: Path, what: str) -> Path | None:
    """Return `NN_what.csv` beside `NN_tracks.csv`; None where there is none."""
    other = path.with_name(path.name.replace("tracks", what, 1))
    return other if other != path and other.is_file() else None


def _header(path: Path) -> tuple[str, ...]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return tuple(name.strip() for name in file.readline().split(","))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"a recording must be a readable file, but '{path}' is not: {error}") from None


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} must be a readable table, but is not: {error}") from None
