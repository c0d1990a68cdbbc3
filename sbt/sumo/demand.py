"""The traffic of a user's files, piece by piece: what can be moved between files, and when it departs.

A warm-up (`sbt.sumo.snapshot`) takes the traffic that no input changes, up to some time; a run takes the rest. For that the
vehicles, persons and flows of all route and additional files, and the types and routes that they name, are found with their
places; everything else (stops, detectors, programs of lights) stays where it is.
"""

from __future__ import annotations

import re
import xml.parsers.expat
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sbt.plugins import kept
from sbt.problem.plain import Values
from sbt.sumo.places import place_in
from sbt.sumo.template import Template, fill, template

__all__ = ["Equipment", "Piece", "excerpts", "expected_departures", "pieces_of", "seconds_of", "texts_of", "without_pieces"]

DEPARTING: Mapping[str, str] = {
    "vehicle": "depart", "trip": "depart", "person": "depart", "container": "depart",
    "flow": "begin", "personFlow": "begin", "containerFlow": "begin",
}  # fmt: skip
"""Elements of traffic, and their attribute for the departure."""
DEFAULT_TYPES: Mapping[str, str] = {
    "vehicle": "DEFAULT_VEHTYPE", "trip": "DEFAULT_VEHTYPE", "flow": "DEFAULT_VEHTYPE", "person": "DEFAULT_PEDTYPE",
    "personFlow": "DEFAULT_PEDTYPE", "container": "DEFAULT_CONTAINERTYPE", "containerFlow": "DEFAULT_CONTAINERTYPE",
}  # fmt: skip
"""Types of traffic that names none; files may define them."""
DEFINITIONS = ("vType", "vTypeDistribution", "route", "routeDistribution")
"""Elements that traffic names."""
_NAMING = ("type", "route", "vTypes", "routes", "refId")
"""Attributes that name types and routes, which may be several."""
_RATES: Mapping[str, Callable[[float], float]] = {
    "probability": float, "period": lambda s: 1.0 / s, "vehsPerHour": lambda n: n / 3600.0, "perHour": lambda n: n / 3600.0,
    "personsPerHour": lambda n: n / 3600.0, "containersPerHour": lambda n: n / 3600.0,
}  # fmt: skip
"""Attributes of flows, to departures a second."""
_CLOCK = re.compile(r"(?:(\d+):)?(\d+):(\d+):(\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Piece:
    """One element of traffic, or one that traffic names, with everything in it.

    Attributes:
        file: that it stands in.
        start, end: its bytes.
        tag: its name.
        id: "" where it has none.
        place: `file:line:column`.
        varies: a placeholder is in it.
        departs: text of its departure; None of a definition, and of traffic without one.
        names: the types and routes that it names; where it names no type, SUMO's default one.
        defines: the types and routes that it defines.
        rate: departures a second of a flow, 0 where it states none.
    """

    file: Template
    start: int
    end: int
    tag: str
    id: str
    place: str
    varies: bool
    departs: str | None
    names: frozenset[str]
    defines: frozenset[str]
    rate: float = 0.0

    @property
    def is_traffic(self) -> bool:
        """Whether it departs, and is no definition."""
        return self.tag in DEPARTING

    def departure(self, values: Values) -> float | None:
        """Return when it departs (s); None where that is no time, such as `triggered`."""
        return None if self.departs is None else seconds_of(fill(self.departs, values, self.place))


@dataclass(frozen=True)
class Equipment:
    """An element that is neither traffic nor named by it.

    Attributes:
        tag: its name.
        place: `file:line:column`.
        varies: a placeholder is in it.
    """

    tag: str
    place: str
    varies: bool


def seconds_of(text: str) -> float | None:
    """Return a time as SUMO reads it, in seconds or as (days:)hours:minutes:seconds; None where it is no time.

    >>> seconds_of("90"), seconds_of("0:01:30"), seconds_of("triggered")
    (90.0, 90.0, None)
    """
    clock = _CLOCK.fullmatch(text.strip())
    if clock is not None:
        days, hours, minutes, seconds = (float(part or 0) for part in clock.groups())
        return ((days * 24 + hours) * 60 + minutes) * 60 + seconds
    try:
        return float(text)
    except ValueError:
        return None


@kept
def pieces_of(file: Template) -> tuple[tuple[Piece, ...], tuple[Equipment, ...]]:
    """Return the traffic and definitions of one file, without the files that it includes, and its other elements."""
    data = _data(file)
    pieces: list[Piece] = []
    others: list[Equipment] = []
    parser = xml.parsers.expat.ParserCreate()
    depth, begun = 0, (0, "", {}, "")  # type: tuple[int, tuple[int, str, Mapping[str, str], str]]
    names: set[str] = set()
    defines: set[str] = set()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, begun
        if depth == 1:
            names.clear()
            defines.clear()
            place = place_in(file.path, parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
            begun = (parser.CurrentByteIndex, tag, attributes, place)
        if depth >= 1:
            names.update(name for key in _NAMING if key in attributes for name in (attributes[key], *attributes[key].split()))
            if "type" not in attributes and tag in DEFAULT_TYPES:
                names.add(DEFAULT_TYPES[tag])
            if tag in DEFINITIONS and "id" in attributes:
                defines.add(attributes["id"])
        depth += 1

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        if depth != 1:
            return
        first, _, attributes, place = begun
        last = parser.CurrentByteIndex  # of <trip .../> already its end, otherwise the beginning of </trip>
        closing = re.compile(rb"</%b\s*>" % re.escape(tag.encode())).match(data, last)  # not the </routes> after <route .../>
        last = last if closing is None else closing.end()
        varies = b"${" in data[first:last]
        if tag in DEPARTING or tag in DEFINITIONS:
            departs = attributes.get(DEPARTING.get(tag, ""))
            pieces.append(Piece(
                file, first, last, tag, attributes.get("id", ""), place, varies, departs, frozenset(names), frozenset(defines),
                _rate(attributes),
            ))  # fmt: skip
        elif tag != "include":
            others.append(Equipment(tag, place, varies))

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return tuple(pieces), tuple(others)


def expected_departures(piece: Piece, duration: float) -> float:
    """Return about how many departures a piece of traffic has in some time (s)."""
    return max(1.0, piece.rate * duration) if piece.tag.lower().endswith("flow") else 1.0


def _rate(attributes: Mapping[str, str]) -> float:
    """Return the departures a second that the attributes of a flow state, as far as they are numbers."""
    for name, text in attributes.items():
        value = seconds_of(text.removeprefix("exp(").removesuffix(")")) if name in _RATES else None
        if value is not None and value > 0:
            return _RATES[name](value) if not (name == "period" and text.startswith("exp(")) else value
    return 0.0


def excerpts(pieces: Iterable[Piece], values: Values, folder: Path) -> Iterator[bytes]:
    """Yield the text of each piece, as a run in a folder needs it."""
    for piece, data in _with_data(pieces):
        yield piece.file.excerpt(data, piece.start, piece.end, values, folder)


def texts_of(pieces: Iterable[Piece]) -> Iterator[tuple[Piece, bytes]]:
    """Yield pieces with their elements as they stand in their files."""
    for piece, data in _with_data(pieces):
        yield piece, data[piece.start : piece.end]


def _with_data(pieces: Iterable[Piece]) -> Iterator[tuple[Piece, bytes]]:
    """Yield pieces with the bytes of their files, each file read once."""
    read: dict[Path, bytes] = {}
    for piece in pieces:
        if piece.file.path not in read:
            read[piece.file.path] = _data(piece.file)
        yield piece, read[piece.file.path]


def without_pieces(file: Template, folder: Path) -> bytes:
    """Return a file without traffic and definitions, and without the files that it includes."""
    data = _data(file)
    left_out = [(piece.start, piece.end) for piece in pieces_of(file)[0]]
    left_out += [(match.start(), match.end()) for match in re.finditer(rb"<include\b[^>]*?(?:/>|>\s*</include>)", data)]
    text, at = [], 0
    for start, end in sorted(left_out):
        text.append(file.excerpt(data, at, start, {}, folder))
        at = end
    return b"".join([*text, file.excerpt(data, at, len(data), {}, folder)])


def _data(file: Template) -> bytes:
    if file.data:
        return file.data
    with template(file.path).opened() as stream:
        return stream.read()
