"""Copies of a user's SUMO files with changes: a vehicle left out, an attribute replaced; all other bytes as they are."""

from __future__ import annotations

import gzip
import os
import re
import xml.etree.ElementTree as ET
import xml.parsers.expat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sbt.errors import InputError
from sbt.sumo.template import Template

__all__ = ["Changes", "changed_copy", "definitions"]

_START_TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")


@dataclass(frozen=True)
class Changes:
    """What a copy of a file has otherwise.

    Args:
        without: id of the vehicle or trip that is left out; "": none.
        attributes: by the id of a flow, the new values of attributes that it has.
    """

    without: str = ""
    attributes: Mapping[str, Mapping[str, str]] | None = None


def definitions(template: Template, *tags: str) -> Iterator[ET.Element]:
    """Yield the elements with these tags of one file, whole, at any depth."""
    with template.opened() as file:
        above: list[ET.Element] = []
        for event, element in ET.iterparse(file, ("start", "end")):
            if event == "start":
                above.append(element)
                continue
            above.pop()
            if element.tag in tags:
                yield element
            if len(above) == 1:
                above[0].clear()  # route files are large


def changed_copy(template: Template, changes: Changes, folder: Path) -> bytes:
    """Return the bytes of a file with changes, packed if the file is; files that it names are named relative to `folder`.

    Raises:
        InputError: it has no such vehicle or flow.
    """
    with template.opened() as file:
        data = file.read()
    named = [(p, os.path.relpath(p.target, folder)) for p in template.parts if p.target is not None]
    edits = [(part.start, part.end, quoteattr(name).encode()) for part, name in named]
    attributes = changes.attributes or {}
    wanted = {name for name in (changes.without, *attributes) if name}
    for name, tag, start, end in _spans(data):
        if name == changes.without and tag in ("vehicle", "trip"):
            edits.append((start, end, b""))
            wanted.discard(name)
        elif name in attributes and tag == "flow":
            edits += _replaced(data, start, attributes[name])
            wanted.discard(name)
    if wanted:
        raise InputError(f"{template.path} must have the vehicles and flows {', '.join(sorted(wanted))}, but has not")
    for start, end, text in sorted(edits, reverse=True):
        data = data[:start] + text + data[end:]
    return gzip.compress(data, mtime=0) if template.path.suffix == ".gz" else data


def _spans(data: bytes) -> Iterator[tuple[str, str, int, int]]:
    """Yield id, tag, and the first and last byte of every vehicle, trip and flow."""
    parser = xml.parsers.expat.ParserCreate()
    open_elements: list[tuple[str, str, int]] = []
    found: list[tuple[str, str, int, int]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("vehicle", "trip", "flow"):
            open_elements.append((attributes.get("id", ""), tag, parser.CurrentByteIndex))

    def end(tag: str) -> None:
        if open_elements and tag == open_elements[-1][1]:
            name, _, first = open_elements.pop()
            last = parser.CurrentByteIndex  # of <trip .../> already its end, otherwise the beginning of </trip>
            found.append((name, tag, first, data.index(b">", last) + 1 if data.startswith(b"</" + tag.encode(), last) else last))

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    yield from found


def _replaced(data: bytes, at: int, attributes: Mapping[str, str]) -> Iterator[tuple[int, int, bytes]]:
    """Yield the edits that give the element at a byte offset new values of its attributes."""
    tag = _START_TAG.match(data, at)
    for name, value in attributes.items():
        old = re.compile(rb"\s" + name.encode() + rb"\s*=\s*(\"[^\"]*\"|'[^']*')").search(tag.group() if tag is not None else b"")
        if old is not None:
            yield at + old.start(1), at + old.end(1), quoteattr(value).encode()
