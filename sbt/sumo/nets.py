"""Network files: the built-in ones, in the source tree or in the installed package, and those of the user."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
import xml.parsers.expat
from functools import cache
from pathlib import Path
from typing import NamedTuple

from sbt.errors import InputError

__all__ = ["Lane", "lanes", "net_file", "nets_folder"]


class Lane(NamedTuple):
    """The geometry of a lane: its centre line, (n, 2) points, and its width (m)."""

    shape: tuple[tuple[float, float], ...]
    width: float


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


@cache
def net_file(net: str) -> Path:
    """Return the file of a network, given by a built-in name or the path of a `.net.xml`.

    Raises:
        InputError: there is no such file, or it is not a network.
    """
    path = nets_folder() / net / f"{net}.net.xml" if "." not in net else Path(net)
    if not path.is_file():
        known = ", ".join(sorted(p.name for p in nets_folder().iterdir() if p.is_dir()))
        raise InputError(f"a network must be one of {known}, or an existing .net.xml file, but got '{net}'")
    _check_well_formed(path)
    return path.resolve()


def lanes(net: str) -> tuple[Lane, ...]:
    """Return all lanes of a network, including internal lanes of junctions.

    Raises:
        InputError: there is no such network.
    """
    path = net_file(net)
    found = []
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        for _, element in ET.iterparse(file):
            if element.tag == "lane":
                points = [tuple(map(float, pair.split(",")[:2])) for pair in element.get("shape", "").split()]
                found.append(Lane(tuple((x, y) for x, y in points), float(element.get("width", "3.2"))))
    return tuple(found)


def _check_well_formed(path: Path) -> None:
    """Refuse a file that is not a network: libsumo would not raise an error, but end the process."""
    roots: list[tuple[str, dict[str, str]]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if not roots:
            roots.append((tag, attributes))

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            parser.ParseFile(file)
    except (xml.parsers.expat.ExpatError, OSError, EOFError) as error:
        raise InputError(f"a network must be well-formed XML, but {path} is not: {error}") from None
    if not roots or roots[0][0] != "net" or "version" not in roots[0][1]:
        raise InputError(f"a network must have the root <net version=...>, but {path} has not; make it with netconvert")
