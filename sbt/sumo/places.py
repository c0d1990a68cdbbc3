"""Where something stands, as messages name it: also what this package has written into a file for the user's own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

__all__ = ["inserted_at", "made_here", "makes_in", "place_in", "said_at", "stands_for"]

_ELSEWHERE: dict[str, Mapping[int, str]] = {}
"""Of files of this process: line to where the user wrote what is there."""

_OWN: set[Path] = set()
"""Folders of files that this package writes."""
_KEYS = {"departPos": "position", "departLane": "lane", "departSpeed": "speed", "depart": "at"}
"""Of `insert`, for SUMO's attributes."""


def place_in(path: Path | str, line: int, column: int) -> str:
    """Return `file:line:column`; of a file that stands for the user's own, the place there."""
    return _ELSEWHERE.get(str(path), {}).get(line) or f"{path}:{line}:{column}"


def stands_for(path: Path, places: Mapping[int, str]) -> None:
    """Let the lines of a file be named by the places at which the user wrote them."""
    _ELSEWHERE[str(path)] = places


def makes_in(folder: Path) -> None:
    """Let all files in a folder be none of the user's."""
    _OWN.update((folder, folder.resolve()))


def made_here(path: Path) -> bool:
    """Return whether a file is none of the user's, as this package wrote it: it did not change when it is newer than a store."""
    return any(path.is_relative_to(folder) for folder in _OWN)


def inserted_at(place: str) -> bool:
    """Return whether a place is that of a vehicle that the scenario inserts."""
    return "insert." in place


def said_at(place: str, text: str) -> str:
    """Return a text about a departure in the words of its place: SUMO's attributes, or the keys of `insert`.

    >>> said_at("mine/scenario.yaml: insert.ego: ", "move its departPos")
    'move its position'
    """
    if not inserted_at(place):
        return text
    return re.sub(rf"\b({'|'.join(_KEYS)})\b", lambda found: _KEYS[found[1]], text)
