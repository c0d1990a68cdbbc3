"""The user's own SUMO files with `${...}` in their attributes, filled with numbers and nothing else.

What stands between the braces is a formula over inputs (`${gap}`, `${100 + gap}`, `${v / 3.6}`). Every
other byte stays as it is. A file without placeholders, also in what it includes, is used where it lies;
of the others a filled copy is written. Document types and entities are refused: a file must not make
SUMO read another one behind the user's back.
"""

from __future__ import annotations

import gzip
import math
import re
import xml.parsers.expat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

from sbt.errors import InputError, RunError
from sbt.problem.expression import Expression
from sbt.problem.outcome import Status

__all__ = ["Placeholder", "Template", "Vehicle", "fill", "placeholders", "template"]

_PLACEHOLDER = re.compile(r"\$\{([^{}]*)\}")
_TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_REFERENCE = re.compile(rb"(\s(?:href|file)\s*=\s*)(\"[^\"]*\"|'[^']*')")
_REFERRING = ("include", "variableSpeedSign", "rerouter")
"""Elements whose `href` or `file` SUMO reads, relative to the file they stand in."""
_VEHICLES = ("vehicle", "trip", "flow")


@dataclass(frozen=True)
class Placeholder:
    """One placeholder: its formula, and where it stands (`file:line:column`)."""

    formula: Expression
    place: str


@dataclass(frozen=True)
class _Part:
    """A stretch of a file that is not copied as it is: a placeholder, or the name of another file."""

    start: int
    end: int
    placeholder: Placeholder | None = None
    target: Path | None = None


class Vehicle(NamedTuple):
    """What a file says of the start of a vehicle, trip or flow, as it is written; None where it says nothing.

    `place` is its line and column, `varies` whether any of its attributes has a placeholder.
    """

    tag: str
    place: tuple[int, int]
    varies: bool
    depart: str | None
    position: str | None
    speed: str | None
    lane: str | None


@dataclass(frozen=True, eq=False)
class Template:
    """One XML file of the user.

    Attributes:
        path: absolute.
        root: name and attributes of its outermost element.
        parts: what is replaced in a copy, in order.
        vehicles: its vehicles, trips and flows by id.
        data: its bytes, kept only where there are parts to replace.
    """

    path: Path
    root: tuple[str, Mapping[str, str]]
    parts: tuple[_Part, ...]
    vehicles: Mapping[str, Vehicle]
    data: bytes = b""

    @cached_property
    def varying(self) -> tuple[str, ...]:
        """Ids of the vehicles with a placeholder."""
        return tuple(name for name, vehicle in self.vehicles.items() if vehicle.varies)

    @cached_property
    def includes(self) -> tuple[Template, ...]:
        """The files it includes, as templates."""
        return tuple(template(p.target) for p in self.parts if p.target is not None)

    def tree(self, above: tuple[Path, ...] = ()) -> Iterator[Template]:
        """Yield the file and all that it includes.

        Raises:
            InputError: a file includes itself, or one of them is no proper file.
        """
        if self.path in above:
            raise InputError(f"a SUMO file must not include itself, but {self.path} does")
        yield self
        for inner in self.includes:
            yield from inner.tree((*above, self.path))

    @cached_property
    def placeholders(self) -> tuple[Placeholder, ...]:
        """All placeholders, those of included files too."""
        return tuple(p.placeholder for t in self.tree() for p in t.parts if p.placeholder is not None)

    def write(self, values: Mapping[str, float], folder: Path) -> Path:
        """Return the file with the placeholders filled: a copy in `folder`, or the file itself where it has none.

        Raises:
            RunError: a formula is not finite for these values.
        """
        if not self.placeholders:
            return self.path
        copied, at = [], 0
        for part in self.parts:
            copied += [self.data[at : part.start], self._replaced(part, values, folder)]
            at = part.end
        name = self.path.name.removesuffix(".gz")
        target = folder / f"{abs(hash(self.path)):x}-{name}"
        target.unlink(missing_ok=True)  # a simulation that ends may still hold the old one open
        target.write_bytes(b"".join([*copied, self.data[at:]]))
        return target

    def _replaced(self, part: _Part, values: Mapping[str, float], folder: Path) -> bytes:
        if part.placeholder is not None:
            return number(part.placeholder, values).encode()
        if part.target is None:
            raise InputError(f"a part of {self.path} must have a value or a file")
        target = template(part.target).write(values, folder)
        return b'"' + str(target).encode() + b'"'


def placeholders(text: str, place: str) -> tuple[Placeholder, ...]:
    """Return the placeholders of one value.

    Raises:
        InputError: one is no formula; the message begins with the place.
    """
    return tuple(_placeholder(match.group(1), place) for match in _PLACEHOLDER.finditer(text))


def fill(text: str, values: Mapping[str, float], place: str = "") -> str:
    """Return a value with its placeholders filled."""
    return _PLACEHOLDER.sub(lambda match: number(_placeholder(match.group(1), place), values), text)


def number(placeholder: Placeholder, values: Mapping[str, float]) -> str:
    """Return the value of a placeholder as SUMO reads it; whole numbers without a point, for lanes and counts.

    Raises:
        RunError: it is not finite.
    """
    value = float(placeholder.formula(values))
    if not math.isfinite(value):
        raise RunError(Status.INVALID, f"{placeholder.place}: ${{{placeholder.formula.text}}} must be finite, but got {value}")
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def _placeholder(text: str, place: str) -> Placeholder:
    try:
        formula = Expression(text)
    except InputError as error:
        raise InputError(f"{place}: ${{{text}}} must be a formula over inputs, but {error}") from None
    if not formula.names():
        raise InputError(f"{place}: ${{{text}}} must use at least one input, but it uses none")
    return Placeholder(formula, place)


def _read(path: Path) -> bytes:
    """Return the bytes of a file, unpacked."""
    try:
        data = path.read_bytes()
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError) as error:
        raise InputError(f"a SUMO file must be readable, but {path} is not: {error}") from None


@cache
def template(path: Path) -> Template:
    """Return one file of the user; read once a process.

    Raises:
        InputError: it cannot be read, is no well-formed XML, declares a document type or entities, or has a
            placeholder that is no formula; the message begins with file, line and column.
    """
    data = _read(path)
    if b"\0" in data[:64]:
        raise InputError(f"{path}: a SUMO file must be encoded byte by byte (UTF-8), but it has zero bytes")
    parser = xml.parsers.expat.ParserCreate()
    roots: list[tuple[str, Mapping[str, str]]] = []
    parts: list[_Part] = []
    vehicles: dict[str, Vehicle] = {}
    every = b"${" in data or any(b"<" + tag.encode() in data for tag in _REFERRING)

    def place() -> str:
        return f"{path}:{parser.CurrentLineNumber}:{parser.CurrentColumnNumber + 1}"

    def refuse(*_: object) -> None:
        raise InputError(f"{place()}: a SUMO file must not declare a document type or entities, but it does")

    def start(tag: str, attributes: dict[str, str]) -> None:
        if not roots:
            roots.append((tag, attributes))
            if tag == "net" and not every:  # large, and only its root matters
                parser.StartElementHandler = None
        if tag in _VEHICLES and "id" in attributes:
            at = (parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
            varies = every and any("${" in value for value in attributes.values())
            asked = map(attributes.get, ("depart", "departPos", "departSpeed", "departLane"))
            vehicles[attributes["id"]] = Vehicle(tag, at, varies, *asked)
        if every and (tag in _REFERRING or any("${" in value for value in attributes.values())):
            parts.extend(_parts(path, data, parser.CurrentByteIndex, tag, place()))

    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    try:
        parser.Parse(data, True)
    except xml.parsers.expat.ExpatError as error:
        raise InputError(f"{path}:{error.lineno}:{error.offset + 1}: a SUMO file must be well-formed XML, but: {error}") from None
    return Template(path, roots[0], tuple(parts), vehicles, data if parts else b"")


def _parts(path: Path, data: bytes, at: int, tag: str, place: str) -> Iterator[_Part]:
    """Yield the placeholders and file names of the tag that begins at a byte."""
    found = _TAG.match(data, at)
    if found is None:
        return
    text = found.group()
    taken: list[_Part] = []
    if tag in _REFERRING:
        for match in _REFERENCE.finditer(text):
            name = match.group(2)[1:-1].decode()
            target = (path.parent / name).resolve()
            if tag == "include" and not target.is_file():
                raise InputError(f"{place}: an included file must exist, but got '{name}'")
            if target.is_file():
                taken.append(_Part(at + match.start(2), at + match.end(2), target=target))
    for match in re.finditer(_PLACEHOLDER.pattern.encode(), text):
        taken.append(_Part(at + match.start(), at + match.end(), placeholder=_placeholder(match.group(1).decode(), place)))
    yield from sorted(taken, key=lambda part: part.start)
