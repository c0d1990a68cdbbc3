"""The elements of a user's route and additional files with their places, read again where a message must name one."""

from __future__ import annotations

import xml.parsers.expat
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from sbt.plugins import kept
from sbt.sumo.files import SumoFiles
from sbt.sumo.places import place_in
from sbt.sumo.template import Template

__all__ = ["PEOPLE", "Element", "element", "elements", "person", "type_of"]

PEOPLE = ("person", "personFlow")
"""Elements that put persons on the road."""
_DEPARTING = {"vehicle": "depart", "trip": "depart", "person": "depart", "container": "depart", "flow": "begin",
              "personFlow": "begin", "containerFlow": "begin"}  # fmt: skip
"""Elements that depart, and their attribute for it."""


@dataclass(frozen=True)
class Element:
    """An XML element as it stands in a file, with its placeholders.

    Attributes:
        tag: its name.
        attributes: their text.
        file: that it stands in.
        line, column: where, from 1.
    """

    tag: str
    attributes: Mapping[str, str]
    file: str
    line: int
    column: int

    @property
    def place(self) -> str:
        """`file:line:column: `, as messages begin."""
        return f"{place_in(self.file, self.line, self.column)}: "

    @property
    def depart(self) -> str | None:
        """The text of its departure; None for what does not depart, such as a route."""
        return self.attributes.get(_DEPARTING.get(self.tag, ""))


def elements(files: SumoFiles) -> Iterator[Element]:
    """Yield all elements with an id of all files but the network, in the order in which they stand."""
    for one in files.templates:
        if one.root[0] != "net":
            yield from _elements_of(one)


def _elements_of(one: Template) -> list[Element]:
    """Return the elements with an id of one file."""
    found: list[Element] = []
    parser = xml.parsers.expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if "id" in attributes:
            found.append(Element(tag, attributes, str(one.path), parser.CurrentLineNumber, parser.CurrentColumnNumber + 1))

    parser.StartElementHandler = start
    parser.Parse(one.opened().read(), True)
    return found


@kept
def person(templates: tuple[Template, ...], name: str) -> Element | None:
    """Return the person of this id, or for `f.3` the flow `f` of persons; None if there is none; looked for once per process."""
    people = [one for each in templates if each.root[0] != "net" for one in _elements_of(each) if one.tag in PEOPLE]
    found = next((one for one in people if one.tag == "person" and one.attributes["id"] == name), None)
    flow, _, rank = name.rpartition(".")
    of_flow = (one for one in people if one.tag == "personFlow" and one.attributes["id"] == flow and rank.isdigit())
    return found if found is not None else next(of_flow, None)


@kept
def type_of(templates: tuple[Template, ...], name: str) -> Element | None:
    """Return the vehicle type of a vehicle, trip or flow; None where it is of a distribution, or is not in the files."""
    known = [one for each in templates if each.root[0] != "net" for one in _elements_of(each)]
    found = _named(known, name, ("vehicle", "trip", "flow"))
    kind = None if found is None else found.attributes.get("type")
    return next((one for one in known if one.tag == "vType" and one.attributes["id"] == kind), None)


def element(files: SumoFiles, name: str, tags: Collection[str]) -> Element | None:
    """Return the element of this id, or for `f.3` the flow `f`; None if there is none."""
    return _named(elements(files), name, tags)


def _named(known: Iterable[Element], name: str, tags: Collection[str]) -> Element | None:
    known = [one for one in known if one.tag in tags]
    for wanted in (name, name.rpartition(".")[0]):
        for one in known:
            if one.attributes["id"] == wanted:
                return one
    return None
