"""Stores that move: where the scenario's files lie from a store's point of view, and stores with these files in them."""

from __future__ import annotations

import io
import json
import os
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from sbt.config.source import read_yaml, yaml_reader
from sbt.errors import InputError
from sbt.files import scratch_in, write_atomically
from sbt.plugins import read_files
from sbt.plugins.source import is_installed
from sbt.problem.plain import Json, JsonMapping
from sbt.store.connection import copy_database
from sbt.store.database import DATABASE

__all__ = ["place_of", "where_it_is", "write_bundle"]

_BUNDLE, _FILES = "bundle.json", "files"
"""In a bundled store: where its files come from, and the folder that they are in."""
_BESIDE = ("config.resolved.yaml", "report.html")


def where_it_is(folder: Path, store: Path) -> Json:
    """Return where relative names of a configuration start: absolute, and seen from the store's folder."""
    folder = Path(folder).resolve()
    return {"folder": str(folder), "place": os.path.relpath(folder, Path(store).resolve())}


def place_of(kept: JsonMapping, store: Path) -> tuple[Path, str]:
    """Return the folder where the names of a stored configuration start now, and its YAML with names that hold now.

    A bundled store has its files with it. A store that was moved together with its configuration finds them as before,
    seen from itself; what it names absolutely inside of the old folder is looked up in the new one.
    """
    before, text = Path(kept["folder"]), str(kept["yaml"])
    with suppress(OSError, ValueError, KeyError, TypeError):
        bundle = json.loads((store / _BUNDLE).read_text(encoding="utf-8"))
        root = store.resolve() / _FILES
        folder = (root / bundle["folder"]).resolve()
        if folder == root or root in folder.parents:
            return folder, _moved(text, Path(bundle["root"]), root)
    if before.is_dir() or "place" not in kept:
        return before, text
    now = (store.resolve() / kept["place"]).resolve()
    return (now, _moved(text, before, now)) if now.is_dir() else (before, text)


def _moved(text: str, before: Path, now: Path) -> str:
    """Return YAML with the absolute names inside of one folder looked up in another."""
    if before == now:
        return text

    def there(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: there(item) for key, item in value.items()}
        if isinstance(value, list):
            return [there(item) for item in value]
        inside = isinstance(value, str) and value.startswith(f"{before}{os.sep}")
        return f"{now}{value.removeprefix(str(before))}" if inside else value

    data, _, _ = read_yaml(text, "config.resolved.yaml")
    stream = io.StringIO()
    yaml_reader().dump(there(data), stream)
    return stream.getvalue()


def write_bundle(store: Path, folder: Path, target: Path) -> list[Path]:
    """Write a zip with a store and the user's files that this process has read for it, which is a store wherever it is unpacked.

    Args:
        store: its folder.
        folder: where the names of its configuration start.
        target: the zip, replaced where it exists.

    Returns:
        The files in it beside the store's own.

    Raises:
        InputError: a file names another one absolutely, or the zip cannot be written.
    """
    files = [path for path in read_files() if not is_installed(path)]
    root = Path(os.path.commonpath([folder.resolve(), *(path.parent for path in files)]))
    absolute = [path for path in files if path.suffix != ".py" and f"{root}{os.sep}".encode() in path.read_bytes()]
    if absolute:
        named = ", ".join(map(str, absolute))
        raise InputError(f"files of a bundle must name each other relative to themselves, but these name {root}: {named}")
    about = {"root": str(root), "folder": str(folder.resolve().relative_to(root))}
    name = target.name.removesuffix(".zip")

    def write(part: Path) -> None:
        with scratch_in(target.parent, "bundle") as scratch:
            copy = Path(scratch) / DATABASE
            copy_database(store / DATABASE, copy)
            with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as bundle:
                bundle.write(copy, f"{name}/{DATABASE}")
                bundle.writestr(f"{name}/{_BUNDLE}", json.dumps(about))
                for path in (store / beside for beside in _BESIDE):
                    if path.is_file():
                        bundle.write(path, f"{name}/{path.name}")
                for path in files:
                    bundle.write(path, f"{name}/{_FILES}/{path.relative_to(root)}")

    try:
        write_atomically(target, write)
    except OSError as error:
        raise InputError(f"a bundle must be written into a folder that may be written, but {target}: {error.strerror}") from None
    return files
