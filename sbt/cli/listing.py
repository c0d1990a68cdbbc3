"""What is installed, with a line on each, remembered between calls: to read the lines every module is imported."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path

from sbt import __version__
from sbt.plugins import KINDS

__all__ = ["listed"]

_PACKAGE = Path(__file__).resolve().parent.parent


def listed(kind: str) -> dict[str, str]:
    """Return a line on each installed part of a kind, by name; those that cannot be loaded are looked at anew each time.

    Raises:
        InputError: there is no such kind.
    """
    path = _folder() / f"{kind}.{_state(kind)}.json" if kind in KINDS else None
    if path is not None:
        with suppress(OSError, ValueError):
            found = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(found, dict) and all(isinstance(line, str) for line in found.values()):
                return found
    from sbt.workflows.front import installed

    lines = installed(kind)
    if path is not None and not any(line.startswith("cannot be loaded") for line in lines.values()):
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            for old in path.parent.glob(f"{kind}.*.json"):
                old.unlink()
            path.write_text(json.dumps(lines), encoding="utf-8")
    return lines


def _folder() -> Path:
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (cache if cache.is_absolute() else Path("~/.cache").expanduser()) / "sumo-sbt"


def _state(kind: str) -> str:
    """Return a text that changes with what is installed, and with this package's own files."""
    entries = sorted((e.name, e.value, e.dist.version if e.dist else "") for e in entry_points(group=f"sbt.{kind}"))
    files = [(str(path), path.stat().st_mtime_ns) for path in sorted(_PACKAGE.rglob("*.py"))]
    return hashlib.sha256(json.dumps([__version__, entries, files]).encode()).hexdigest()[:16]
