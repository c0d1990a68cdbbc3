"""Recorded traffic: SUMO's floating car data (FCD) as traces of pairs of road users.

Reads XML, CSV (separated by `,` or `;`), both also gzipped, and Parquet, with SUMO's names of elements and columns
(`timestep_time`, `vehicle_x`, `person_x`, ...) or plain ones (`time`, `id`, `x`, `y`, `angle`, `speed`). SUMO's
positions are those of the front bumper, and its angles are degrees clockwise from north; both are converted here.
Sizes and accelerations are read where the file has them (`length`, `width`, `acceleration`); otherwise sizes are
arguments of the reader, and accelerations are finite differences of the speeds, 0 where a track begins. Heights (`z`,
and `slope` in degrees) tell who is on a bridge and who is below; without them all is one level. SUMO writes two decimal
places by default; `--precision 6` is recommended.
"""

from __future__ import annotations

import gzip
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sbt.errors import InputError
from sbt.metrics import heights
from sbt.metrics.geometry import FASTER, STEPPED, farthest
from sbt.metrics.pairwise import without_overtaking
from sbt.plugins import load, names
from sbt.problem.arrays import Mask, Vector
from sbt.problem.metric import Metric
from sbt.problem.trace import Trace

__all__ = ["PERSON_SIZE", "Recording", "catalogue", "encounters", "near_pairs", "pair_traces", "read_fcd", "recording_of_columns"]

PERSON_SIZE = (0.215, 0.478)
"""Length and width of a person whose size is not in the file (m): SUMO's default pedestrian."""
_ABLE, _INEXACT, _RARE, _FEW = 10.0, 1.0, 0.01, 2
"""Who is farther ahead than by such accelerations (m/s^2), and this far (m), was teleported: in this share of steps, or few."""
_COLUMNS = ("time", "x", "y", "angle", "speed", "acceleration", "length", "width", "z", "slope")
_REQUIRED = ("time", "id", "x", "y", "angle", "speed")
_KINDS = ("vehicle", "person")

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recording:
    """States of m road users, one row per road user and time step, sorted by road user and then by time.

    Attributes:
        names: of the road users.
        time: (s,) time steps of the file (s).
        start: (m + 1,) index of the first row of each road user.
        step: (n,) index of the time step of each row.
        x: (n,) of the centre (m).
        y: (n,) of the centre (m).
        heading: (n,) radians, counter-clockwise from +x.
        speed: (n,) along the heading (m/s).
        acceleration: (n,) along the heading (m/s^2).
        length: (m,) of the rectangles (m).
        width: (m,) of the rectangles (m).
        goes_on: (n - 1,) whether a road user has driven from a row to the next one.
    """

    names: tuple[str, ...]
    time: Vector
    start: Integers
    step: Integers
    x: Vector
    y: Vector
    heading: Vector
    speed: Vector
    acceleration: Vector
    length: Vector
    width: Vector
    goes_on: Mask
    kinds: tuple[str, ...] = ()
    """m texts, such as vehicle, person, truck or bicycle."""
    z: Vector | None = None
    """(n,) height, of the front bumper of a vehicle (m), NaN where it is not known; None where the file has none."""
    rise: Vector | None = None
    """(n,) of the road, along the heading (m/m), 0 where it is not known; None where the file has no heights."""
    assumed: int = 0
    """How many of the vehicles have no size in the file."""

    @cached_property
    def stacked(self) -> bool:
        """Whether road users were one above the other, so that heights tell levels: hills hide nobody."""
        if self.z is None:
            return False
        user = np.repeat(np.arange(len(self.names)), np.diff(self.start))
        return heights.are_stacked(self.path(slice(None)), np.diff(user) == 0)

    def path(self, rows: slice) -> heights.Path:
        """Return the places of some rows; the file must have heights."""
        z, rise = (np.full(len(self.x), np.nan) if each is None else each for each in (self.z, self.rise))
        heading = self.heading[rows]
        return heights.Path(self.x[rows], self.y[rows], z[rows], rise[rows] * np.cos(heading), rise[rows] * np.sin(heading))


def read_fcd(path: Path, *, length: float = 5.0, width: float = 1.8) -> Recording:
    """Read an FCD file.

    Args:
        path: `.xml`, `.xml.gz`, `.csv`, `.csv.gz` or `.parquet`.
        length: of vehicles without a length in the file (m).
        width: of vehicles without a width in the file (m).

    Raises:
        InputError: it cannot be read, is not FCD, or declares a document type or entities.
    """
    if not (0 < length < math.inf and 0 < width < math.inf):
        raise InputError(f"a vehicle needs length > 0 and width > 0, but got {length} m x {width} m")
    suffixes = [s for s in path.suffixes if s != ".gz"]
    readers = {".xml": _read_xml, ".csv": _read_table, ".parquet": _read_table}
    if not suffixes or suffixes[-1] not in readers:
        raise InputError(f"an FCD file must end in .xml, .csv or .parquet (or .gz of the first two), but got '{path}'")
    try:
        ids, kinds, columns = readers[suffixes[-1]](path)
    except OSError as error:
        raise InputError(f"an FCD file must be readable, but got '{path}': {error.strerror or error}") from None
    if not len(columns["time"]):
        raise InputError(f"an FCD file must have road users in it, but there is none in '{path}'")
    return recording_of_columns(path, ids, kinds, columns, (length, width))


def recording_of_columns(path: Path, ids: Any, kinds: Any, columns: dict[str, Any], size: tuple[float, float]) -> Recording:
    """Return the recording with sorted and converted rows; positions are of the front bumper, angles clockwise from north.

    Args:
        path: for messages.
        ids: (n,) of the road users.
        kinds: (n,) 0 for a vehicle, 1 for a person.
        columns: (n,) numbers by name, NaN where the file has none.
        size: length and width of vehicles without a size in the file (m).
    """
    users, user = np.unique(np.asarray(ids, dtype=str), return_inverse=True)
    data = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    for name in (*_REQUIRED[2:], "time"):
        if not np.isfinite(data[name]).all():
            k = int((~np.isfinite(data[name])).argmax())
            where = f"that of '{users[user[k]]}' at {data['time'][k]:g} s (row {k + 1} of the states) is {data[name][k]:g}"
            raise InputError(f"{name} of every road user in a recording must be a finite number, but {where} in '{path}'")
    time, step = np.unique(data["time"], return_inverse=True)
    order = np.lexsort((step, user))
    user, step = user[order], step[order]
    data = {name: values[order] for name, values in data.items()}
    duplicates = np.flatnonzero((np.diff(user) == 0) & (np.diff(step) == 0))
    if duplicates.size:
        k = int(duplicates[0])
        where = f"'{users[user[k]]}' at {time[step[k]]:g} s"
        rule = "a road user of a recording must occur once per time step, a person and a vehicle under ids of their own"
        raise InputError(f"{rule}, but in '{path}' {where} does not")
    start = np.searchsorted(user, np.arange(len(users) + 1))
    _check_metres(path, data, user)
    person = np.asarray(kinds)[order][start[:-1]] == 1
    lengths, widths = (
        np.where(np.isnan(given), np.where(person, small, big), given)
        for given, small, big in zip((data["length"][start[:-1]], data["width"][start[:-1]]), PERSON_SIZE, size, strict=True)
    )
    assumed = int((np.isnan(data["length"] + data["width"])[start[:-1]] & ~person).sum())
    heading = np.radians(90.0 - data["angle"])
    half = 0.5 * lengths[user]
    x, y = data["x"] - half * np.cos(heading), data["y"] - half * np.sin(heading)
    goes_on = _goes_on(user, step, time[step], (x, y, heading, data["speed"]), person)
    acceleration = _differences(data["speed"], time[step], goes_on)
    unknown = np.isnan(data["acceleration"])
    unknown[1:] |= goes_on & _is_long(np.diff(time[step]), goes_on)  # what is in the file is that of its end
    acceleration = np.where(unknown, acceleration, data["acceleration"])
    z, slope = (data.get(name, np.full(len(order), np.nan)) for name in ("z", "slope"))
    flat = bool(np.isnan(z).all())
    rise = np.tan(np.radians(np.nan_to_num(slope)))
    return Recording(
        tuple(users.tolist()), time, start, step.astype(np.int64), x, y, heading, data["speed"], acceleration, lengths, widths,
        goes_on, tuple(np.array(_KINDS)[person.astype(int)].tolist()),
        None if flat else z, None if flat else rise, assumed,
    )  # fmt: skip


def _check_metres(path: Path, data: dict[str, Vector], user: Integers) -> None:
    """Check that the road users move about as far as their speeds imply."""
    same = np.diff(user) == 0
    moved = np.hypot(np.diff(data["x"]), np.diff(data["y"]))[same].sum()
    expected = (np.diff(data["time"]) * data["speed"][1:])[same].sum()
    if expected > 10.0 and moved < 0.01 * expected:
        raise InputError(
            f"positions of a recording must be in metres, but in '{path}' the road users move {moved:.3g} "
            f"instead of about {expected:.3g} m (was it written with --fcd-output.geo?)"
        )


def _is_long(elapsed: Vector, goes_on: Mask) -> Mask:
    """Return (n - 1,) which steps are half as long again as most, or longer."""
    usual = float(np.median(elapsed[goes_on])) if goes_on.any() else 0.0
    return elapsed > 1.5 * usual


def _goes_on(
    user: Integers, step: Integers, time: Vector, states: tuple[Vector, Vector, Vector, Vector], person: Mask
) -> Mask:
    """Return (n - 1,) whether rows are followed by one of the same road user, at the next step, that it may have driven to.

    Else it was away, or was teleported: farther ahead than by its speeds, if these are those of its positions elsewhere.

    Args:
        user: (n,) of each row, sorted.
        step: (n,) of each row, sorted of each user.
        time: (n,) s.
        states: (n,) x, y (m), heading (rad) and speed (m/s).
        person: (m,) of each road user, whether it is one: SUMO puts persons onto crossings and off them, a few metres at most.
    """
    x, y, heading, speed = states
    elapsed, dx, dy = np.diff(time), np.diff(x), np.diff(y)
    follows = (np.diff(user) == 0) & (np.diff(step) == 1)
    driven = follows & (np.hypot(dx, dy) <= farthest(elapsed))
    ahead = dx * np.cos(heading[:-1]) + dy * np.sin(heading[:-1])
    begin, change = speed[:-1], _ABLE * elapsed
    end = np.clip(speed[1:], begin - change, begin + change)
    peak = 0.5 * (begin + end + change)  # who accelerates as long as it can, and brakes then, is farthest
    of = user[:-1]
    walked = np.hypot(dx, dy) <= FASTER * np.maximum(speed[1:], speed[:-1]) * elapsed + STEPPED
    reached = ahead <= (2.0 * peak**2 - begin**2 - end**2) / (2.0 * _ABLE) + _INEXACT
    explained = driven & np.where(person[of], walked, reached)
    steps, teleports = (np.bincount(of[rows], minlength=user[-1] + 1) for rows in (driven, driven & ~explained))
    return driven & (explained | ~person[of] & (teleports > np.maximum(_RARE * steps, _FEW))[of])


def _differences(speed: Vector, time: Vector, goes_on: Mask) -> Vector:
    """Return the (n,) rate of change of the speed since the previous row, 0 where the row does not go on from it."""
    rate = np.zeros(len(speed))
    rate[1:][goes_on] = np.diff(speed)[goes_on] / np.diff(time)[goes_on]
    return rate


def _read_xml(path: Path) -> tuple[list[str], array[int], dict[str, array[float]]]:
    """Return ids, kinds and columns of an XML file, which is never in memory as a whole."""
    parser = expat.ParserCreate()
    ids: list[str] = []
    kinds: array[int] = array("b")
    columns = {name: array("d") for name in _COLUMNS}
    now = math.nan

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal now
        if tag == "timestep":
            now = _seconds(attributes["time"])
        elif tag in _KINDS:
            columns["time"].append(now)
            ids.append(attributes["id"])
            kinds.append(_KINDS.index(tag))
            for name in _COLUMNS[1:5]:
                columns[name].append(float(attributes[name]))
            for name in _COLUMNS[5:]:
                columns[name].append(float(attributes.get(name, math.nan)))

    def refuse(*_: Any) -> None:
        raise InputError(f"an FCD file must not declare a document type or entities, but '{path}' does")

    parser.StartElementHandler = begin
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.buffer_text = True
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            parser.ParseFile(file)
    except (expat.ExpatError, EOFError, gzip.BadGzipFile) as error:
        raise InputError(f"an FCD file must be whole, but '{path}' is not: {error}") from None
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        what = f"attribute {error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"'{path}', line {parser.CurrentLineNumber}: {what}") from None
    return ids, kinds, columns


def _seconds(text: str) -> float:
    """Return a time in SUMO's format, seconds or [days:]hours:minutes:seconds, in s."""
    seconds, parts = 0.0, text.split(":")
    for part, unit in zip(parts[::-1], (1.0, 60.0, 3600.0, 86400.0), strict=False):
        seconds += float(part) * unit
    return seconds


def _read_table(path: Path) -> tuple[Any, Any, dict[str, Any]]:
    """Return ids, kinds and columns of a CSV or Parquet file."""
    import pandas as pd

    try:
        if path.suffix == ".parquet":
            table = pd.read_parquet(path)
        else:
            with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
                separator = ";" if ";" in file.readline() else ","
            table = pd.read_csv(path, sep=separator, dtype={"id": str, "vehicle_id": str, "person_id": str}, low_memory=False)
    except ImportError:
        raise InputError(f"reading '{path}' needs pyarrow: pip install 'sumo-sbt[parquet]'") from None
    except (ValueError, EOFError) as error:  # raised by pandas and pyarrow for files of another format
        raise InputError(f"an FCD file must be a table, but '{path}' cannot be read: {str(error).splitlines()[0]}") from None
    parts = []
    for kind, prefix in enumerate(("", *(f"{name}_" for name in _KINDS))):
        if f"{prefix}id" in table:
            called = {c: f"{prefix}{c}" if f"{prefix}{c}" in table else f"timestep_{c}" for c in ("id", *_COLUMNS)}
            rows = pd.DataFrame({c: table[name] for c, name in called.items() if name in table})
            rows = rows[rows["id"].notna()]
            parts.append(rows.assign(kind=max(kind - 1, 0)))
    found = pd.concat(parts) if parts else pd.DataFrame()
    missing = [c for c in _REQUIRED if c not in found]
    if missing:
        raise InputError(f"an FCD table must have {', '.join(_REQUIRED)}, but in '{path}' {', '.join(missing)} is missing")
    try:
        columns = {c: found.get(c, pd.Series(math.nan, found.index)).to_numpy(dtype=np.float64) for c in _COLUMNS}
    except ValueError as error:
        raise InputError(f"the columns of an FCD table must be numbers, but in '{path}': {error}") from None
    return found["id"].astype(str).to_numpy(), found["kind"].to_numpy(), columns


def catalogue() -> tuple[Metric, ...]:
    """Return all installed metrics for recorded traffic."""
    return tuple(without_overtaking(load("metrics", name)) for name in names("metrics"))


def near_pairs(recording: Recording, within: float) -> list[tuple[int, int]]:
    """Return the sorted pairs of road users whose centres come within a distance of each other (m) on one level."""
    m = len(recording.names)
    user = np.repeat(np.arange(m), np.diff(recording.start))
    order = np.argsort(recording.step, kind="stable")
    ends = np.searchsorted(recording.step[order], np.arange(len(recording.time) + 1))
    points = np.stack([recording.x, recording.y], axis=1)
    found: set[int] = set()  # smaller * m + larger
    for first, last in pairwise(ends.tolist()):
        rows = order[first:last]
        near = cKDTree(points[rows]).query_pairs(within, output_type="ndarray")
        one, two = user[rows[near[:, 0]]], user[rows[near[:, 1]]]
        found.update((np.minimum(one, two) * m + np.maximum(one, two)).tolist())
    pairs = [divmod(code, m) for code in sorted(found)]
    return [pair for pair in pairs if _is_near(recording, *pair, within)] if recording.stacked else pairs


def _together(recording: Recording, one: int, two: int) -> tuple[Integers, Integers]:
    """Return the time steps at which two road users are there on one level, and the (t, 2) rows of both."""
    spans = [slice(recording.start[k], recording.start[k + 1]) for k in (one, two)]
    step_one, step_two = (recording.step[s] for s in spans)
    steps, at_one, at_two = np.intersect1d(step_one, step_two, assume_unique=True, return_indices=True)
    rows = np.stack([at_one + spans[0].start, at_two + spans[1].start], axis=1)
    if not recording.stacked:
        return steps, rows
    level = heights.on_one_level(recording.path(spans[0]), recording.path(spans[1]), at_one, at_two)
    return steps[level], rows[level]


def _is_near(recording: Recording, one: int, two: int, within: float) -> bool:
    """Return whether two road users come within a distance (m) while they are on one level."""
    (x, u), (y, v) = (values[_together(recording, one, two)[1]].T for values in (recording.x, recording.y))
    return bool((np.hypot(u - x, v - y) <= within).any())


def pair_traces(recording: Recording, ego: int, other: int) -> Iterator[Trace]:
    """Yield a trace of the actors `ego` and `co` for every interval in which both are present.

    An interval ends where a time step of the file lacks one of them, where they are on different levels (`Recording.z`), or
    where one of them was teleported. Times are those of the file.
    """
    steps, rows = _together(recording, ego, other)
    if not len(steps):
        return
    time = recording.time[steps]
    cut = (np.diff(steps) > 1) | ~recording.goes_on[rows[1:] - 1].all(axis=1)
    who = [ego, other]
    for part in np.split(np.arange(len(steps)), np.flatnonzero(cut) + 1):
        if len(part) > 1:
            r = rows[part]
            yield Trace(
                time[part], ("ego", "co"), recording.x[r], recording.y[r], recording.heading[r], recording.speed[r],
                recording.acceleration[r], recording.length[who], recording.width[who], "recorded",
            )  # fmt: skip


def encounters(recording: Recording, within: float) -> Iterator[tuple[str, str, Trace]]:
    """Yield ego, other and trace of every pair that comes close, with each of the two as the ego in turn.

    Args:
        recording: the recorded traffic.
        within: distance of the centres below which a pair is considered (m).
    """
    for one, two in near_pairs(recording, within):
        for ego, other in ((one, two), (two, one)):
            for trace in pair_traces(recording, ego, other):
                yield recording.names[ego], recording.names[other], trace
