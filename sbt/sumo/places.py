"""Where something stands, as messages name it: also what this package has written into a file for the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

__all__ = ["place_in", "stands_for"]

_ELSEWHERE: dict[str, Mapping[int, str]] = {}
"""Of files of this process: line to where the user wrote what is there."""


def place_in(path: Path | str, line: int, column: int) -> str:
    """Return `file:line:column`; of a file that stands for the user's own, the place there."""
    return _ELSEWHERE.get(str(path), {}).get(line) or f"{path}:{line}:{column}"


def stands_for(path: Path, places: Mapping[int, str]) -> None:
    """Let the lines of a file be named by the places at which the user wrote them."""
    _ELSEWHERE[str(path)] = places
