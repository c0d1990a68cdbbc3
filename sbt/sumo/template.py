"""SUMO files with placeholders `${...}` in attribute values, which are replaced by numbers, or by a choice.

A placeholder is a formula over the inputs (`${gap}`, `${100 + gap}`, `${v / 3.6}`, `${4 + 8 * (kind == 'truck')}`), or the
name of an input with choices (`${kind}`), whose text is filled in, escaped; all other bytes of a file are copied
unchanged. Files without placeholders, also in the files they include, are used in place; of the others, filled copies
are written. Document types and entities are refused, as they could make SUMO read files that the user does not know of.
"""

from __future__ import annotations

import gzip
import io
import math
import os
import re
import xml.parsers.expat
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NamedTuple
from xml.sax.saxutils import escape, quoteattr, unescape

import numpy as np

from sbt.errors import InputError, RunError
from sbt.plugins import kept, noted
from sbt.problem.expression import Expression
from sbt.problem.outcome import Status
from sbt.problem.plain import Values
from sbt.sumo.outputs import MARKS, in_signals, names_output, output_names, run_file
from sbt.sumo.places import made_here, place_in

__all__ = ["Placeholder", "Template", "Vehicle", "fill", "linked", "placeholders", "template", "tried"]

_PLACEHOLDER = re.compile(r"\$\{([^{}]*)\}")
_ALONE = re.compile(rb"([\w.:-]+)\s*=\s*[\"']\s*$")
"""What stands before a placeholder that begins the value of an attribute."""
_START_TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_REFERENCE = re.compile(rb"(\s(?:href|file)\s*=\s*)(\"[^\"]*\"|'[^']*')")
_REFERRING = ("include", "variableSpeedSign", "rerouter")
"""Elements whose `href` or `file` names another file, relative to the file that contains the element."""
_ENCODING = re.compile(rb"(<\?xml\s[^>]*?\bencoding\s*=\s*[\"'])([A-Za-z][\w.-]*)")
_HEAD = 64
"""Bytes in which a file shows that it is not encoded byte by byte."""
_SMALL, _TIMES_SMALLER = 2**25, 100
"""Bytes to which any packed file may unpack, and how much larger than packed; SUMO's XML is packed to a tenth or thirtieth."""
_VEHICLES = ("vehicle", "trip", "flow")
_PERSONS = ("person", "personFlow")
_QUOTES = {'"': "&quot;", "'": "&apos;"}


@dataclass(frozen=True)
class Placeholder:
    """A placeholder: its formula, its place as `file:line:column`, and the attribute or option whose whole value it is, or ""."""

    formula: Expression
    place: str
    attribute: str = ""


@dataclass(frozen=True)
class _Part:
    """Bytes of a file that are replaced in a copy: a placeholder, or the name of another file or of one that SUMO writes."""

    start: int
    end: int
    placeholder: Placeholder | None = None
    target: Path | None = None
    output: str | None = None
    within: tuple[Placeholder, ...] = ()
    """The placeholders in the name of an output."""

    @property
    def holes(self) -> tuple[Placeholder, ...]:
        """Its placeholders."""
        return self.within if self.placeholder is None else (self.placeholder,)


class Vehicle(NamedTuple):
    """Departure attributes, and those of the arrival, of a vehicle, trip or flow as text; None for those that are not given.

    `place` is its line and column, `varies` whether any of its attributes contains a placeholder.
    """

    tag: str
    place: tuple[int, int]
    varies: bool
    depart: str | None
    position: str | None
    speed: str | None
    lane: str | None
    begin: str | None
    arrival: str | None
    arrival_edge: str | None


@dataclass(frozen=True, eq=False)
class Template:
    """One XML file.

    Attributes:
        path: absolute.
        root: name and attributes of the root element.
        parts: what is replaced in a copy, in order.
        vehicles: vehicles, trips and flows by id.
        persons: line and column of persons and flows of them, by id.
        data: the bytes of the file in UTF-8; empty if there is nothing to replace.
    """

    path: Path
    root: tuple[str, Mapping[str, str]]
    parts: tuple[_Part, ...]
    vehicles: Mapping[str, Vehicle]
    persons: Mapping[str, tuple[int, int]]
    data: bytes = b""

    @cached_property
    def varying(self) -> tuple[str, ...]:
        """Ids of the vehicles with placeholders."""
        return tuple(name for name, vehicle in self.vehicles.items() if vehicle.varies)

    def opened(self) -> BinaryIO:
        """Open the file for reading, unpacked and in UTF-8."""
        return io.BytesIO(_read(self.path))

    @cached_property
    def includes(self) -> tuple[Template, ...]:
        """The included files."""
        return tuple(template(p.target) for p in self.parts if p.target is not None)

    def tree(self, ancestors: tuple[Path, ...] = ()) -> Iterator[Template]:
        """Yield this file and all files that it includes, directly or not.

        Raises:
            InputError: a file includes itself, or a file is not as required.
        """
        if self.path in ancestors:
            raise InputError(f"a SUMO file must not include itself, but {self.path} does")
        yield self
        for inner in self.includes:
            yield from inner.tree((*ancestors, self.path))

    @cached_property
    def placeholders(self) -> tuple[Placeholder, ...]:
        """All placeholders, including those of included files."""
        return tuple(hole for t in self.tree() for p in t.parts for hole in p.holes)

    @cached_property
    def copied(self) -> bool:
        """Whether a run needs a copy: a placeholder is to be filled, or SUMO would write beside this file or an included one."""
        return any(p.target is None for t in self.tree() for p in t.parts)

    def write(self, values: Values, folder: Path) -> Path:
        """Return the file as a run in `folder` uses it: a copy with placeholders filled and outputs there, or the file itself.

        Raises:
            RunError: a formula is not finite for these values.
        """
        if not self.copied:
            return self.path
        target = folder / f"{abs(hash(self.path)):x}" / self.path.name.removesuffix(".gz")
        target.parent.mkdir(exist_ok=True)
        target.unlink(missing_ok=True)  # the previous simulation may still have the old copy open
        target.write_bytes(self.excerpt(self.data, 0, len(self.data), values, folder))
        return target

    def excerpt(self, data: bytes, start: int, end: int, values: Values, folder: Path) -> bytes:
        """Return some bytes of the file, which are `data`, with everything in them replaced as a run in `folder` needs it."""
        pieces, at = [], start
        for part in self.parts:
            if start <= part.start and part.end <= end:
                pieces += [data[at : part.start], self._replacement(part, values, folder)]
                at = part.end
        return b"".join([*pieces, data[at:end]])

    def _replacement(self, part: _Part, values: Values, folder: Path) -> bytes:
        if part.placeholder is not None:
            written = escape(text_of(part.placeholder, values), _QUOTES)
            return written.encode("ascii", "xmlcharrefreplace")  # whatever the file's encoding is
        if part.output is not None:
            return quoteattr(str(run_file(folder, self.path, fill(part.output, values)))).encode()
        if part.target is None:
            raise InputError(f"a part of {self.path} must have a value or a file")
        target = template(part.target).write(values, folder)
        return b'"' + str(target).encode() + b'"'


def placeholders(text: str, place: str) -> tuple[Placeholder, ...]:
    """Return the placeholders in a text.

    Raises:
        InputError: one of them is not a formula; the message begins with the place.
    """
    alone = _PLACEHOLDER.fullmatch(text.strip()) is not None
    attribute = place.rpartition(": ")[2] if alone else ""
    return tuple(_placeholder(match.group(1), place, attribute) for match in _PLACEHOLDER.finditer(text))


def tried(text: str) -> str:
    """Return a text with 1 for each placeholder: whether it may be a number or a time is known before any run."""
    return _PLACEHOLDER.sub("1", text)


def fill(text: str, values: Values, place: str = "") -> str:
    """Return a text with its placeholders filled; errors begin with the place, which may end with a colon already."""
    return _PLACEHOLDER.sub(lambda match: text_of(_placeholder(match.group(1), place.removesuffix(": ")), values), text)


def text_of(placeholder: Placeholder, values: Values) -> str:
    """Return the value of a placeholder as text; whole numbers have no decimal point, so that they can be lanes and counts.

    Raises:
        RunError: it is not finite, or takes a choice for a number.
    """
    if placeholder.formula.is_name and isinstance(found := placeholder.formula(values), str):
        return found
    for name in placeholder.formula.numbers():
        if isinstance(values.get(name), str):
            rule = f"'{name}' is an input with choices and no number"
            raise RunError(Status.INVALID, f"{placeholder.place}: ${{{placeholder.formula.text}}} must be a formula, but {rule}")
    with np.errstate(all="ignore"):
        value = float(placeholder.formula(values))
    if not math.isfinite(value):
        raise RunError(Status.INVALID, f"{placeholder.place}: ${{{placeholder.formula.text}}} must be finite, but got {value}")
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def _placeholder(text: str, place: str, attribute: str = "") -> Placeholder:
    try:
        formula = Expression(text)
    except InputError as error:
        raise InputError(f"{place}: ${{{text}}} must be a formula over inputs, but {error}") from None
    if not formula.names():
        raise InputError(f"{place}: ${{{text}}} must use at least one input, but it uses none")
    return Placeholder(formula, place, attribute)


def _read(path: Path) -> bytes:
    """Return the bytes of a file in UTF-8, decompressed if it is gzipped."""
    try:
        text = path.read_bytes()
        most = max(_SMALL, _TIMES_SMALLER * len(text))
        if packed := text[:2] == b"\x1f\x8b":
            with gzip.open(io.BytesIO(text)) as file:
                text = file.read(most + 1)
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise InputError(f"a SUMO file must be readable, but {path} is not: {error}") from None
    if packed and len(text) > most:
        raise InputError(f"a packed SUMO file may unpack to {_TIMES_SMALLER} times its size, but {path} unpacks to more")
    return _in_utf8(text, path)


def _in_utf8(data: bytes, path: Path) -> bytes:
    """Return the bytes of a file in UTF-8, and its declaration with them: parts of it are put into other files."""
    declared = _ENCODING.match(data)
    if declared is None or b"\0" in data[:_HEAD] or declared[2].lower() in (b"utf-8", b"utf8", b"us-ascii"):
        return data
    encoding = declared[2].decode()
    try:
        text = data.decode(encoding)
        if not text.startswith("<?xml"):
            raise ValueError("its declaration is in another one")
    except (LookupError, ValueError) as error:
        raise InputError(f"{path}:1:1: a SUMO file must be in the encoding that it declares, {encoding}, but: {error}") from None
    return declared[1] + b"UTF-8" + text.encode()[declared.end(2) :]


def linked(path: Path) -> Path:
    """Return the file that a path names; where links lead there, SUMO's file is another one once these are changed."""
    target = path.resolve()
    if target.is_file() and not made_here(target) and target != Path(os.path.normpath(path.absolute())):
        noted(path, loaded_anew=True)
    return target


@kept
def template(path: Path) -> Template:
    """Parse an XML file; each file is read once per process.

    Raises:
        InputError: it cannot be read, is not well-formed XML, declares a document type or entities, or has a
            placeholder that is not a formula; the message begins with file, line and column.
    """
    data = _read(path if made_here(path) else noted(path, loaded_anew=True))
    if b"\0" in data[:_HEAD]:
        raise InputError(f"{path}: a SUMO file must be encoded byte by byte (UTF-8), but it has zero bytes")
    parser = xml.parsers.expat.ParserCreate()
    roots: list[tuple[str, Mapping[str, str]]] = []
    parts: list[_Part] = []
    vehicles: dict[str, Vehicle] = {}
    persons: dict[str, tuple[int, int]] = {}
    marks = (b"${", *(b"<" + tag.encode() for tag in _REFERRING), *MARKS)
    has_parts = any(mark in data for mark in marks)

    def place() -> str:
        return place_in(path, parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)

    def refuse(*_: object) -> None:
        raise InputError(f"{place()}: a SUMO file must not declare a document type or entities, but it does")

    signals = False

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal signals
        if not roots:
            roots.append((tag, attributes))
            if tag == "net" and not has_parts:  # networks are large, and only the root is needed
                parser.StartElementHandler = None
        if tag in _VEHICLES and "id" in attributes:
            at = (parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
            varies = has_parts and any("${" in value for value in attributes.values())
            asked = ("depart", "departPos", "departSpeed", "departLane", "begin", "arrivalPos", "arrivalEdge")
            vehicles[attributes["id"]] = Vehicle(tag, at, varies, *map(attributes.get, asked))
        elif tag in _PERSONS and "id" in attributes:
            persons[attributes["id"]] = (parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
        if not has_parts:
            return
        signals = in_signals(tag, before=signals)
        writes = names_output(tag, attributes, signals=signals)
        if writes or tag in _REFERRING or any("${" in value for value in attributes.values()):
            parts.extend(_parts(path, data, parser.CurrentByteIndex, tag, place(), writes=writes))

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    try:
        parser.Parse(data, True)
    except xml.parsers.expat.ExpatError as error:
        raise InputError(f"{path}:{error.lineno}:{error.offset + 1}: a SUMO file must be well-formed XML, but: {error}") from None
    return Template(path, roots[0], tuple(parts), vehicles, persons, data if parts else b"")


def _parts(path: Path, data: bytes, at: int, tag: str, place: str, *, writes: bool) -> Iterator[_Part]:
    """Yield the placeholders and file names of the start tag at a byte offset."""
    start_tag = _START_TAG.match(data, at)
    if start_tag is None:
        return
    text = start_tag.group()
    parts: list[_Part] = []
    if tag in _REFERRING:
        for match in _REFERENCE.finditer(text):
            name = match.group(2)[1:-1].decode()
            target = linked(path.parent / name)
            if tag == "include" and not target.is_file():
                raise InputError(f"{place}: an included file must exist, but got '{name}'")
            if target.is_file():
                parts.append(_Part(at + match.start(2), at + match.end(2), target=target))
    if writes:
        for start, end, name in output_names(tag, text):
            parts.append(_Part(at + start, at + end, output=name, within=placeholders(name, place)))
    outputs = [range(part.start, part.end) for part in parts if part.output is not None]
    for match in re.finditer(_PLACEHOLDER.pattern.encode(), text):
        if any(at + match.start() in span for span in outputs):
            continue
        before = _ALONE.search(text, 0, match.start())
        alone = before is not None and text[match.end() : match.end() + 1] in (b'"', b"'")
        attribute = before.group(1).decode() if before is not None and alone else ""
        written = unescape(match.group(1).decode(), {text: quote for quote, text in _QUOTES.items()})
        hole = _placeholder(written, place, attribute)
        parts.append(_Part(at + match.start(), at + match.end(), placeholder=hole))
    yield from sorted(parts, key=lambda part: part.start)
