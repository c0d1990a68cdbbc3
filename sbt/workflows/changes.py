"""What was changed since a campaign last began, of the user's files and of this package: its store remembers what was in them."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from sbt.execution.worker import versions
from sbt.plugins import contents_read, newer
from sbt.plugins.source import is_installed
from sbt.problem.plain import Json, JsonMapping
from sbt.workflows.portable import place_of
from sbt.workflows.study import PACKAGE, RESOLVED

__all__ = ["CONTENTS", "changed_files", "changed_since", "contents_in", "package_changed", "package_print",
           "told"]  # fmt: skip

CONTENTS = "contents"
"""Key under which a store remembers a hash of each file, by its path seen from where the names of the configuration start."""

_SIMULATES = ("execution", "metrics", "plugins", "problem", "scenarios", "sumo", "testbeds", "seeds.py")
"""What of this package decides how a run goes."""


@cache
def package_print() -> str:
    """Return a digest of what runs depend on beside the user's files: of this package, its networks, the version of SUMO."""
    from sbt.sumo.nets import nets_folder

    digest, package = hashlib.blake2b(versions().encode(), digest_size=16), Path(__file__).resolve().parents[1]
    nets = nets_folder()
    code = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] in _SIMULATES]
    for folder, files in ((package, code), (nets, nets.rglob("*.xml"))):
        for path in sorted(files):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def contents_in(folder: Path) -> Json:
    """Return what a store remembers of the files that this process has read, by their paths seen from a folder."""
    found = contents_read()
    return {os.path.relpath(path, folder.resolve()): was for path, was in found.items() if not is_installed(Path(path))}


def changed_files(folder: Path, kept: JsonMapping) -> list[Path]:
    """Return the user's files, of those that this process has read, that were changed after a campaign last began.

    Of files that its store does not know, since its runs alone read them, the time tells.

    Args:
        folder: of the store.
        kept: what it remembers.
    """
    place = place_of(kept, folder)[0].resolve()
    known = {os.path.normpath(place / name): was for name, was in kept.get(CONTENTS, {}).items()}
    differing = [Path(path) for path, now in contents_read().items() if known.get(path, now) != now]
    later = newer(folder / RESOLVED) if (folder / RESOLVED).is_file() else []
    unknown = {path.resolve() for path in later if not is_installed(path)}
    return sorted({*differing, *(path for path in unknown if str(path) not in known)})


def changed_since(folder: Path, kept: JsonMapping) -> str:
    """Return in words what was changed after the campaign in a folder last began, for an error; "" for nothing."""
    return told(changed_files(folder, kept)) + package_changed(kept)


def package_changed(kept: JsonMapping) -> str:
    """Return in words, for an error, that a store was made with another package; "" where it was not."""
    return "" if kept.get(PACKAGE) == package_print() else "; this package or SUMO was another one then"


def told(changed: Sequence[Path]) -> str:
    """Return changed files in words, for an error; "" for none."""
    return f"; changed since: {', '.join(map(str, changed))}" if changed else ""
