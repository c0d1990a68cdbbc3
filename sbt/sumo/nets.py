"""Network files: the built-in ones, in the source tree or in the installed package, and those of the user."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
import xml.parsers.expat
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sbt.errors import InputError
from sbt.plugins import kept, noted
from sbt.problem.arrays import Points
from sbt.sumo.places import made_here

__all__ = ["Lane", "Roads", "lanes", "net_file", "nets_folder", "opened", "pavements", "roads", "unregulated"]


class Lane(NamedTuple):
    """The geometry of a lane, or of an area such as a junction.

    Attributes:
        shape: (n, 2) points of its centre line; of an area, its outline.
        width: of a lane (m).
        kind: `road`, `internal` (a road across a junction), `walk`, `bike`, `crossing` (of people), or `area` and
            `walking_area`, where the shape is an outline.
        height: mean of the points (m); 0 in a network without heights.
    """

    shape: tuple[tuple[float, float], ...]
    width: float
    kind: str = "road"
    height: float = 0.0


class Roads(NamedTuple):
    """The edges of a network, without those inside of junctions.

    Attributes:
        lengths: of the lanes of each edge, from the right (m).
        connected: pairs of edges of which the first leads to the second.
    """

    lengths: dict[str, list[float]]
    connected: set[tuple[str, str]]


@cache
def nets_folder() -> Path:
    """Return the folder of the built-in networks.

    Raises:
        InputError: the installation is incomplete.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "_nets", package.parent / "sumo_nets"):
        if folder.is_dir():
            return folder
    raise InputError(f"the built-in networks must be in {package / '_nets'}, but they are not: install the package again")


@kept
def net_file(net: str) -> Path:
    """Return the file of a network, given by a built-in name or the path of a `.net.xml`.

    Raises:
        InputError: there is no such file, or it is not a network.
    """
    path = nets_folder() / net / f"{net}.net.xml" if "." not in net else Path(net)
    if not path.is_file():
        known = ", ".join(sorted(p.name for p in nets_folder().iterdir() if p.is_dir()))
        raise InputError(f"a network must be one of {known}, or an existing .net.xml file, but got '{net}'")
    _check_well_formed(path if made_here(path) else noted(path, loaded_anew=True))
    return path.resolve()


def lanes(net: str) -> tuple[Lane, ...]:
    """Return all lanes of a network, including internal lanes of junctions, and the areas of junctions.

    Raises:
        InputError: there is no such network.
    """
    path = net_file(net)
    found: list[Lane] = []
    function = ""
    with opened(path) as file:
        for event, element in ET.iterparse(file, events=("start", "end")):
            if event == "start":
                function = element.get("function", "") if element.tag == "edge" else function
                continue
            if element.tag in ("lane", "junction"):
                found += _lane(element, function)
            if element.tag != "lane":
                element.clear()  # networks are large
    return tuple(found)


@kept
def pavements(file: str) -> dict[str, Points]:
    """Return the (n, 2) shape of the rightmost lane of every edge of a network file, where people walk, by the edge's id."""
    with opened(Path(file)) as net:
        rightmost = {e.attrib["id"][:-2]: e.attrib["shape"] for e in ET.parse(net).iter("lane") if e.get("index") == "0"}
    return {
        edge: np.array([[float(v) for v in pair.split(",")[:2]] for pair in shape.split()]) for edge, shape in rightmost.items()
    }


@kept
def roads(net: Path) -> Roads:
    """Return the edges of a network file and how they are connected; each file is read once per process."""
    found = Roads({}, set())

    def start(tag: str, attributes: dict[str, str]) -> None:
        edge = attributes.get("id", "").rpartition("_")[0]
        if tag == "edge" and attributes.get("function") is None:
            found.lengths[attributes["id"]] = []
        elif tag == "lane" and edge in found.lengths:
            found.lengths[edge].append(float(attributes.get("length", "inf")))
        elif tag == "connection" and "from" in attributes and "to" in attributes:
            found.connected.add((attributes["from"], attributes["to"]))

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    with opened(net) as file:
        parser.ParseFile(file)
    return found


@kept
def unregulated(net: Path) -> tuple[str, ...]:
    """Return the junctions of a network file at which roads meet and nobody has right of way, as their type says.

    SUMO lets crossing streams drive through each other there. A place where a single road bends, ends or splits is none.
    """
    junctions: list[str] = []
    beside: dict[str, set[str]] = {}
    entered: Counter[str] = Counter()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "junction" and attributes.get("type") == "unregulated":
            junctions.append(attributes["id"])
        elif tag == "edge" and "from" in attributes and "to" in attributes:
            ends = attributes["from"], attributes["to"]
            entered[ends[1]] += 1
            for here, there in (ends, ends[::-1]):
                beside.setdefault(here, set()).add(there)

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    with opened(net) as file:
        parser.ParseFile(file)
    return tuple(name for name in junctions if len(beside.get(name, ())) > 2 and entered[name] > 1)


def _lane(element: ET.Element, function: str) -> list[Lane]:
    """Return a lane or the area of a junction; nothing where it has no shape."""
    points = [tuple(map(float, point.split(","))) for point in element.get("shape", "").split()]
    if len(points) < (3 if element.tag == "junction" else 2):  # a dead end has no area
        return []
    height = sum(p[2] for p in points if len(p) > 2) / len(points)  # netconvert leaves out a height of 0
    allowed = set(element.get("allow", "").split())
    if element.tag == "junction":
        kind = "area"
    elif function in ("crossing", "walkingarea"):
        kind = "crossing" if function == "crossing" else "walking_area"
    elif function == "internal" and (not allowed or "passenger" in allowed):
        kind = "internal"
    else:
        kind = "walk" if allowed == {"pedestrian"} else "bike" if allowed and allowed <= {"pedestrian", "bicycle"} else "road"
    return [Lane(tuple((p[0], p[1]) for p in points), float(element.get("width", "3.2")), kind, height)]


def opened(path: Path) -> Any:
    """Open a file, which may be gzipped whatever its name is."""
    with path.open("rb") as file:
        zipped = file.read(2) == b"\x1f\x8b"
    return gzip.open(path) if zipped else path.open("rb")


def _check_well_formed(path: Path) -> None:
    """Refuse a file that is not a network: libsumo would not raise an error, but end the process."""
    roots: list[tuple[str, dict[str, str]]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if not roots:
            roots.append((tag, attributes))

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        with opened(path) as file:
            parser.ParseFile(file)
    except (xml.parsers.expat.ExpatError, OSError, EOFError) as error:
        raise InputError(f"a network must be well-formed XML, but {path} is not: {error}") from None
    if not roots or roots[0][0] != "net" or "version" not in roots[0][1]:
        raise InputError(f"a network must have the root <net version=...>, but {path} has not; make it with netconvert")
