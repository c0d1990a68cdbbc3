"""Copies of a small network in one file, so that several runs drive in one simulation and never meet.

The copies lie on each other: same coordinates, other ids. No edge leads from one to the other and a vehicle
sees only its own and connected lanes, so that nobody meets anybody of another copy; and because every
coordinate is the one of the network itself, every number SUMO computes is the same to the last bit (copies
beside each other would round differently).
"""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from pathlib import Path

from sbt.errors import InputError

__all__ = ["copied", "prefix"]

_SHARED = {"location", "type"}
_KNOWN = {"edge", "lane", "junction", "request", "connection", "param"}
_NAMES = {"id", "from", "to", "via"}
_LISTS = {"incLanes", "intLanes", "crossingEdges"}


def prefix(copy: int) -> str:
    """Return what stands before the ids of a copy: of edges, lanes, vehicles."""
    return f"r{copy}."


def copied(net: Path, copies: int) -> str:
    """Return the text of a network file that holds `copies` copies of a network, apart by their ids.

    Raises:
        InputError: the network has parts with a state of their own, such as traffic lights.
    """
    with gzip.open(net) if net.suffix == ".gz" else net.open("rb") as file:
        root = ET.parse(file).getroot()
    shared = [part for part in root if part.tag in _SHARED]
    for part in (part for top in root if top not in shared for part in top.iter()):
        if part.tag not in _KNOWN or "bidi" in part.attrib:
            raise InputError(f"isolation replicas needs a network of edges and junctions alone, but {net.name} has <{part.tag}>")
    parts = [ET.tostring(part, encoding="unicode") for part in shared]
    for tag in ("edge", "junction", "connection"):  # the order SUMO reads them in
        for copy in range(copies):
            parts += [_renamed(part, prefix(copy)) for part in root.iter(tag)]
    head = " ".join(f'{name}="{value}"' for name, value in root.attrib.items() if "}" not in name)
    return f"<net {head}>\n{''.join(parts)}</net>\n"


def _renamed(part: ET.Element, before: str) -> str:
    """Return one element of a copy as text."""
    twin = ET.fromstring(ET.tostring(part))
    for element in twin.iter():
        for name, value in element.attrib.items():
            if name in _NAMES:
                element.set(name, _name(value, before))
            elif name in _LISTS:
                element.set(name, " ".join(_name(word, before) for word in value.split()))
    return ET.tostring(twin, encoding="unicode")


def _name(name: str, before: str) -> str:
    """Return the id in a copy; ids inside a junction keep the colon in front."""
    return f":{before}{name[1:]}" if name.startswith(":") else f"{before}{name}"
