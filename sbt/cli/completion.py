"""What a shell completes: names of scenarios, configurations, and stores; nothing heavy is imported for it."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

__all__ = ["complete_scenarios", "complete_stores"]

_DEEP = 3
"""Folders below the working one in which stores are looked for."""
_MOST = 200
_DATABASE = "campaign.sqlite"


def complete_scenarios(incomplete: str) -> list[str]:
    """Return the scenarios whose name begins so, and the files that may be one."""
    names = sorted({entry.name for entry in entry_points(group="sbt.scenarios")})
    found = [name for name in names if name.startswith(incomplete)]
    folder, _, begun = incomplete.rpartition("/")
    beside = Path(folder) if folder else Path()
    files = sorted(path for path in beside.glob("*.yaml") if path.name.startswith(begun))
    return [*found, *map(str, files[:_MOST])]


def complete_stores(incomplete: str) -> list[str]:
    """Return the folders of campaigns whose path begins so."""
    folder = incomplete.rpartition("/")[0]
    start = Path(folder or ".")
    found = (str(path) for path in _stores(start, _DEEP))
    return sorted(path for path in found if path.startswith(incomplete))[:_MOST]


def _stores(folder: Path, deep: int) -> Iterator[Path]:
    if (folder / _DATABASE).is_file():
        yield folder
        return
    if deep == 0:
        return
    try:
        below = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    except OSError:
        return
    for path in below[:_MOST]:
        yield from _stores(path, deep - 1)
