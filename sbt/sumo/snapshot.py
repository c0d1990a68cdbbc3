"""Whether and where a user's simulation can begin with traffic that was warmed up once: the conditions of `snapshot`.

What no input changes, up to some time, is simulated once; a run then begins with the state at that time. So whatever an
input changes must depart at that time or later, and nothing else may depend on an input. The conditions are found in the files;
what they forbid is said with its place.
"""

from __future__ import annotations

import itertools
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.arrays import Points, Vector
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.sumo.demand import Piece, expected_departures, pieces_of, seconds_of
from sbt.sumo.files import SumoFiles
from sbt.sumo.template import placeholders, template
from sbt.sumo.unsaved import lost_by_option, lost_in_file, lost_in_traffic

__all__ = ["CAN_FORK", "NoSnapshot", "Snapshot", "WarmUp", "reads_whole", "snapshot_of"]

CAN_FORK = hasattr(os, "fork") and sys.platform.startswith("linux")
"""Whether a run can be a child of a process that has loaded the network; elsewhere each run loads it."""
_TESTED = ("1.28.0",)
"""Versions of libsumo whose states were compared with simulations that load them in a process of their own."""
_SETTLING = 2.0
"""Simulated time that a run has from its state to the first departure that depends on an input (s)."""
_WORTH = (60.0, 100)
"""A warm-up that nobody asks for must be at least so long (s) and have so many departures, or loading is as good."""
_ENDS, _WITHIN, _ROUNDS = 9, 1024, 5
"""Inputs of which all combinations of ends are looked at for the earliest departure; further points, and how often they are
looked at, each time in a box a quarter as wide around the earliest so far: a formula may be least anywhere."""
_STANDING = frozenset((
    "busStop", "trainStop", "containerStop", "chargingStation", "parkingArea", "overheadWireSegment", "tractionSubstation",
    "inductionLoop", "e1Detector", "instantInductionLoop", "laneAreaDetector", "e2Detector", "entryExitDetector", "e3Detector",
    "edgeData", "laneData", "routeProbe", "vTypeProbe", "tlLogic", "poly", "poi", "taz", "tazs", "location", "param", "access",
))  # fmt: skip
"""Elements that have no events of their own, or whose state SUMO saves. Rerouters, calibrators and the like begin anew."""


class NoSnapshot(Exception):  # noqa: N818  (an answer, not a failure)
    """Why a simulation cannot begin with warmed traffic."""


@dataclass(frozen=True)
class WarmUp:
    """What a scenario asks for.

    Args:
        until: simulated time at which the warm-up ends (s); None: shortly before the first departure that depends on an input.
        seeds: number of warm-ups; None: by the campaign.

    Raises:
        InputError: there is no warm-up.
    """

    until: float | None = None
    seeds: int | None = None

    def __post_init__(self) -> None:
        if self.seeds is not None and self.seeds < 1:
            raise InputError(f"warm_up.seeds must be >= 1, but got {self.seeds}")


@dataclass(frozen=True)
class Snapshot:
    """How the traffic of a simulation is divided.

    Attributes:
        begin: of the simulation (s).
        until: end of the warm-up (s).
        definitions: types and routes that no input changes.
        before, after: traffic that no input changes, of the warm-up and of the runs, by departure.
        varying: types, routes and traffic that inputs change.
    """

    begin: float
    until: float
    definitions: tuple[Piece, ...]
    before: tuple[Piece, ...]
    after: tuple[Piece, ...]
    varying: tuple[Piece, ...]

    @property
    def lasts(self) -> float:
        """Simulated time of a warm-up (s)."""
        return self.until - self.begin

    def last_departure(self, values: Values) -> float:
        """Return when the last one departs of what varies (s); the end of the warm-up where nothing does."""
        return max([self.until, *(piece.departure(values) or 0.0 for piece in self.varying if piece.is_traffic)])

    def departing(self, values: Values) -> list[Piece]:
        """Return what varies as a run needs it: definitions, then traffic by departure.

        Raises:
            RunError: something departs before the end of the warm-up.
        """
        first = [piece for piece in self.varying if not piece.is_traffic]
        timed = [(_departure(piece, values), piece) for piece in self.varying if piece.is_traffic]
        for time, piece in timed:
            if time < self.until:
                rule = f"{piece.place}: '{piece.id}' must depart when the warm-up is over, at t = {self.until:g} s or later"
                raise RunError(Status.INVALID, f"{rule}, but departs at {time:g} s")
        return first + [piece for _, piece in sorted(timed, key=lambda each: each[0])]


def snapshot_of(
    files: SumoFiles, moved: tuple[str, ...], space: ParameterSpace, step: float, asked: WarmUp | None,
    until: float | None = None, *, adding: bool = False,
) -> Snapshot:  # fmt: skip
    """Return how traffic is divided between the warm-up and the runs of a space.

    Args:
        files: of the simulation.
        moved: vehicles under test, and others that this package moves.
        space: of the inputs.
        step: SUMO's step (s).
        asked: what the scenario asks for; None: nothing.
        until: end of the warm-up (s) where that is decided already.
        adding: whether a loop may add vehicles of its own to a run, the one under test too.

    Raises:
        NoSnapshot: a condition does not hold; the message says which, and where.
    """
    _check_surroundings(files)
    begin = seconds_of(files.options.get("begin", "0"))
    if begin is None:
        raise NoSnapshot(f"the option begin must be a number, but is '{files.options['begin']}'")
    pieces = [piece for one in files.templates if one.root[0] != "net" for piece in pieces_of(one)[0]]
    varies = _varying(pieces, moved)
    constant = [piece for piece, changes in zip(pieces, varies, strict=True) if not changes]
    varying = tuple(piece for piece, changes in zip(pieces, varies, strict=True) if changes)
    if not adding and not any(piece.is_traffic for piece in varying):
        raise NoSnapshot("the ego is not in the files")
    end = _end_of_warm_up(varying, space, begin, step, asked) if until is None else until
    over = seconds_of(files.options.get("end", "-1"))
    if over is not None and 0.0 <= over <= end:
        place = files.places.get("end", "options")
        raise NoSnapshot(
            f"{place}: the simulation must go on after the warm-up, which ends at {end:g} s, but the option end is {over:g} s"
        )
    moving = [(_constant_departure(piece, begin), piece) for piece in constant if piece.is_traffic]
    _check_sorted(files, moving)
    moving.sort(key=lambda each: each[0])
    before = tuple(piece for time, piece in moving if time < end)
    if not before and until is None:
        raise NoSnapshot(f"nothing departs before t = {end:g} s: there is no traffic to warm up")
    definitions = tuple(piece for piece in constant if not piece.is_traffic)
    if why := lost_in_traffic(before, definitions, template(files.net)):
        raise NoSnapshot(why)
    if asked is None and until is None:
        _check_worth(end - begin, before)
    return Snapshot(begin, end, definitions, before, tuple(piece for time, piece in moving if time >= end), varying)


def _end_of_warm_up(varying: tuple[Piece, ...], space: ParameterSpace, begin: float, step: float, asked: WarmUp | None) -> float:
    """Return when the warm-up ends (s): as asked for, or shortly before the first departure that depends on an input."""
    first, earliest, latest = _first_departure(varying, space, begin)
    wanted = None if asked is None else asked.until
    end = _in_steps(earliest - _SETTLING if wanted is None else wanted, begin, step)
    if wanted is not None and abs(end - wanted) > 1e-6:
        raise NoSnapshot(f"warm_up.until must be whole steps of {step:g} s after {begin:g} s, but is {wanted:g} s")
    if end <= begin and wanted is not None:
        raise NoSnapshot(f"the simulation begins at {begin:g} s, and the warm-up ends at {wanted:g} s")
    if first is None:  # a loop adds what depends on inputs, from the end of the warm-up on
        return end
    if end <= begin:
        least = begin + _SETTLING + step
        raise NoSnapshot(f"{first.place}: '{first.id}' departs at {earliest:g} s; before {least:g} s there is nothing to warm up")
    if end > earliest:
        remedy = f"{_because(first, varying)}let it depart later, or warm_up.until be smaller or auto"
        when = f"at {earliest:g} s" if latest == earliest else f"at {earliest:g} to {latest:g} s, as the inputs have it"
        raise NoSnapshot(f"{first.place}: '{first.id}' departs {when}, before the warm-up ends ({end:g} s): {remedy}")
    return end


def _because(piece: Piece, varying: tuple[Piece, ...]) -> str:
    """Return by which type or route traffic without a placeholder depends on an input; "" where it has one."""
    defined = {name: other.place for other in varying for name in other.defines}
    found = [] if piece.varies else sorted(piece.names.intersection(defined))
    return f"it depends on an input by '{found[0]}' ({defined[found[0]]}); " if found else ""


def _check_options(files: SumoFiles) -> None:
    for name, value in files.options.items():
        place = files.places.get(name, "options")
        if placeholders(value, place):
            raise NoSnapshot(f"{place}: the option {name} depends on an input")
        if why := lost_by_option(name, value):
            raise NoSnapshot(f"{place}: {why}")


def _check_surroundings(files: SumoFiles) -> None:
    """Refuse what a saved state does not hold, and inputs anywhere but in traffic."""
    _check_options(files)
    for one in files.templates:
        if why := lost_in_file(one):
            raise NoSnapshot(f"{one.path}: {why}")
        if one.root[0] == "net":
            if one.placeholders:
                raise NoSnapshot(f"{one.placeholders[0].place}: the network depends on an input")
            continue
        for other in pieces_of(one)[1]:
            if other.varies:
                raise NoSnapshot(f"{other.place}: <{other.tag}> depends on an input")
            if other.tag not in _STANDING:
                raise NoSnapshot(f"{other.place}: a saved state does not hold what <{other.tag}> has done")
    try:
        found = version("libsumo")
    except PackageNotFoundError:
        found = "none"
    if found not in _TESTED:
        raise NoSnapshot(f"warmed states were tested with libsumo {', '.join(_TESTED)}, but this is {found}")


def _varying(pieces: list[Piece], moved: tuple[str, ...]) -> list[bool]:
    """Return what varies: what has a placeholder, the vehicles that are moved, and what names a type or route that varies."""
    ids = {name for one in moved for name in (one, one.rpartition(".")[0]) if name}
    varies = [piece.varies or (piece.is_traffic and piece.id in ids) for piece in pieces]
    names: set[str] = set()
    while True:
        found = {name for piece, changes in zip(pieces, varies, strict=True) if changes for name in piece.defines}
        if found == names:
            return varies
        names = found
        varies = [changes or not names.isdisjoint(piece.names) for piece, changes in zip(pieces, varies, strict=True)]


def _first_departure(varying: tuple[Piece, ...], space: ParameterSpace, begin: float) -> tuple[Piece | None, float, float]:
    """Return what departs first of all that varies, when (s), and when at the latest; None, and never, where nothing does."""
    traffic = [piece for piece in varying if piece.is_traffic]
    if not traffic:
        return None, math.inf, math.inf
    found = {piece: _departures(piece, space) for piece in traffic}
    first = min(traffic, key=lambda piece: found[piece][0])
    return first, max(found[first][0], begin), found[first][1]


def _departures(piece: Piece, space: ParameterSpace) -> tuple[float, float]:
    """Return when a piece departs at the earliest, and at the latest of the points that are looked at (s)."""
    names = {name for hole in placeholders(piece.departs or "", piece.place) for name in hole.formula.names()}
    used = [k for k, p in enumerate(space.parameters) if p.name in names]
    if not used:
        time = _departure(piece, {})
        return time, time
    ends = np.array(list(itertools.product((0.0, 0.5, 1.0), *[(0.0, 1.0)] * (min(len(used), _ENDS) - 1))))
    ends = np.pad(ends, ((0, 0), (0, len(used) - ends.shape[1])), constant_values=0.5)
    box = stream(0, "departures").random((_WITHIN, len(used)))
    u = np.vstack([ends, ends[:, ::-1], box])
    times = _departures_at(piece, space, used, u)
    if np.isnan(times).all() or np.nanmin(times) == -np.inf:
        raise NoSnapshot(f"{piece.place}: '{piece.id}' departs at \"{piece.departs}\", which is no time")
    for k in range(1, _ROUNDS + 2):
        best, earliest = u[np.nanargmin(times)], np.nanmin(times)
        if k < _ROUNDS:
            further = np.clip(best + 0.25**k * (box - 0.5), 0.0, 1.0)
        else:  # each input at either end, and all of them where that is earlier
            further = np.repeat(best[None], 2 * len(used), axis=0)
            further[np.arange(2 * len(used)), np.arange(2 * len(used)) // 2] = np.tile([0.0, 1.0], len(used))
            either = np.nan_to_num(_departures_at(piece, space, used, further), nan=np.inf).reshape(-1, 2)
            further = np.vstack([further, np.where(either.min(axis=1) < earliest, either.argmin(axis=1), best)])
        u, times = np.vstack([u, further]), np.concatenate([times, _departures_at(piece, space, used, further)])
    return float(np.nanmin(times)), float(np.nanmax(times))


def _departures_at(piece: Piece, space: ParameterSpace, used: Sequence[int], u: Points) -> Vector:
    """Return when a piece departs (s) at points u (n, k) of the inputs that are used, the others in the middle of their range.

    NaN where a formula has no value: such a run is invalid whenever it begins.
    """
    points = np.full((len(u), space.dimension), 0.5)
    points[:, used] = u
    x, text = space.from_unit(points), (piece.departs or "").strip()
    formula = placeholders(text, piece.place)[0].formula
    if text == f"${{{formula.text}}}" and not set(formula.numbers()) & set(space.choices):
        columns = {p.name: x[:, k] for k, p in enumerate(space.parameters)}
        columns |= {name: np.array(choices)[columns[name].astype(int)] for name, choices in space.choices.items()}
        with np.errstate(all="ignore"):
            times = np.array(np.broadcast_to(np.asarray(formula(columns), dtype=np.float64), len(x)))
        times[np.isposinf(times)] = np.nan
        return times
    return np.array([_departure_or_nan(piece, space.named(row)) for row in x])


def _departure_or_nan(piece: Piece, values: Values) -> float:
    try:
        return _departure(piece, values)
    except RunError:
        return math.nan


def _departure(piece: Piece, values: Values) -> float:
    """Return when a piece departs (s)."""
    time = piece.departure(values)
    if time is None or not math.isfinite(time):
        what = "has no departure" if piece.departs is None else f'departs at "{piece.departs}"'
        raise NoSnapshot(f"{piece.place}: '{piece.id}' {what}, which is no time")
    return time


def _constant_departure(piece: Piece, begin: float) -> float:
    """Return when traffic that no input changes departs (s); a flow without a beginning begins with the simulation."""
    return begin if piece.departs is None and piece.tag.lower().endswith("flow") else _departure(piece, {})


def reads_whole(options: Mapping[str, str]) -> bool:
    """Return whether SUMO reads route files at once, and not as the simulation goes on (`route-steps: 0`)."""
    return seconds_of(options.get("route-steps", "200")) == 0.0


def _check_sorted(files: SumoFiles, moving: Sequence[tuple[float, Piece]]) -> None:
    """Refuse route files of which SUMO would leave out a part, as it is not sorted: a warm-up would have that traffic.

    With the option `route-steps: 0` SUMO reads them whole, and leaves out nothing.
    """
    if reads_whole(files.options):
        return
    last: dict[Path, tuple[float, Piece]] = {}
    for time, piece in moving:
        if piece.file.path in files.routes:
            latest, before = last.get(piece.file.path, (time, piece))
            if time < latest:
                rule = "a route file must be sorted by departure, as SUMO leaves out what is not"
                raise NoSnapshot(f"{piece.place}: {rule}: '{piece.id}' ({time:g} s) stands behind '{before.id}' ({latest:g} s)")
            last[piece.file.path] = time, piece


def _check_worth(duration: float, before: tuple[Piece, ...]) -> None:
    """Refuse warm-ups that nobody asks for and that spare little."""
    least, many = _WORTH
    count = sum(expected_departures(piece, duration) for piece in before)
    if duration < least or count < many:
        said = f"{duration:g} s with {count:.0f} departures before the first that depends on an input"
        raise NoSnapshot(f"{said} are no warm-up (from {least:g} s and {many} departures on), unless warm_up asks for it")


def _in_steps(time: float, begin: float, step: float) -> float:
    """Return the last instant of the simulation that is not after a time (s)."""
    milliseconds = round(step * 1000)
    return begin + math.floor(round((time - begin) * 1000) / milliseconds) * milliseconds / 1000
