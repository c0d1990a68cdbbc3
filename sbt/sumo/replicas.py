"""Several copies of a small network in one file, so that independent runs share one simulation.

The replicas have the same coordinates and different ids. No connection leads from one to another, and
SUMO's models look at the vehicles on their own and on connected lanes only, so that vehicles of different
replicas never interact. Because the coordinates are those of the original network, all of SUMO's floating-point
results are identical to those of a run alone; replicas side by side would round differently.
"""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ET
from pathlib import Path

from sbt.errors import InputError

__all__ = ["id_prefix", "replicated_net"]

_SHARED = {"location", "type"}
_SUPPORTED = {"edge", "lane", "junction", "request", "connection", "param"}
_ID_ATTRIBUTES = {"id", "from", "to", "via"}
_ID_LIST_ATTRIBUTES = {"incLanes", "intLanes", "crossingEdges"}


def id_prefix(replica: int) -> str:
    """Return the prefix of all ids in a replica: of edges, lanes and vehicles."""
    return f"r{replica}."


def replicated_net(net: Path, replicas: int) -> str:
    """Return the XML of a network that consists of `replicas` copies of another one.

    Raises:
        InputError: the network has elements with a state of their own, such as traffic lights.
    """
    with gzip.open(net) if net.suffix == ".gz" else net.open("rb") as file:
        root = ET.parse(file).getroot()
    shared = [part for part in root if part.tag in _SHARED]
    for part in (part for top in root if top not in shared for part in top.iter()):
        if part.tag not in _SUPPORTED or "bidi" in part.attrib:
            raise InputError(f"isolation replicas needs a network of edges and junctions alone, but {net.name} has <{part.tag}>")
    parts = [ET.tostring(part, encoding="unicode") for part in shared]
    for tag in ("edge", "junction", "connection"):  # the order SUMO expects
        for replica in range(replicas):
            parts += [_prefixed(part, id_prefix(replica)) for part in root.iter(tag)]
    attributes = " ".join(f'{name}="{value}"' for name, value in root.attrib.items() if "}" not in name)
    return f"<net {attributes}>\n{''.join(parts)}</net>\n"


def _prefixed(part: ET.Element, prefix: str) -> str:
    """Return an element as text, with the prefix before every id."""
    renamed = ET.fromstring(ET.tostring(part))
    for element in renamed.iter():
        for name, value in element.attrib.items():
            if name in _ID_ATTRIBUTES:
                element.set(name, _prefixed_id(value, prefix))
            elif name in _ID_LIST_ATTRIBUTES:
                element.set(name, " ".join(_prefixed_id(word, prefix) for word in value.split()))
    return ET.tostring(renamed, encoding="unicode")


def _prefixed_id(name: str, prefix: str) -> str:
    """Return an id with the prefix; ids of internal lanes and edges keep their leading colon."""
    return f":{prefix}{name[1:]}" if name.startswith(":") else f"{prefix}{name}"
