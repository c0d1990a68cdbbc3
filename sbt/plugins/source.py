"""Imports of the user's folders from the source that is approved: byte code beside it may say something else."""

from __future__ import annotations

import sys
import sysconfig
from collections.abc import Sequence
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, ExtensionFileLoader, FileFinder, SourceFileLoader
from pathlib import Path
from types import CodeType

__all__ = ["FromSource", "import_from_source", "is_installed"]

_folders: set[Path] = set()
"""Folders of the user's files that this process has imported; what lies in them is imported from source."""


class FromSource(SourceFileLoader):
    """Compiles the source whenever it is imported, and neither reads nor writes `__pycache__`."""

    def get_code(self, fullname: str) -> CodeType:
        """Return the code of the source."""
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


def import_from_source(folder: Path) -> None:
    """Let all modules in a folder, and in those below it, be imported from their source in this process, now and later.

    What is installed below it (a virtual environment) is imported as ever.
    """
    folder = folder.resolve()
    if folder in _folders:
        return
    _folders.add(folder)
    if _finder not in sys.path_hooks:
        sys.path_hooks.insert(0, _finder)
    for known in [place for place in sys.path_importer_cache if _is_ours(place)]:
        del sys.path_importer_cache[known]


def is_installed(path: Path) -> bool:
    """Return whether a file or folder came with Python, this package or another one."""
    return any(place == path or place in path.parents for place in _installed())


@cache
def _installed() -> Sequence[Path]:
    own = Path(__file__).parents[1]
    return [place.resolve() for place in (own, *(Path(sysconfig.get_path(kind)) for kind in ("stdlib", "purelib", "platlib")))]


def _is_ours(place: str) -> bool:
    path = Path(place).resolve()
    return path.is_dir() and any(folder == path or folder in path.parents for folder in _folders) and not is_installed(path)


def _finder(place: str) -> FileFinder:
    """Return what finds modules in one of the user's folders (a hook of `sys.path_hooks`)."""
    if not _is_ours(place):
        raise ImportError("not a folder of the user's files", path=place)
    return FileFinder(place, (ExtensionFileLoader, EXTENSION_SUFFIXES), (FromSource, SOURCE_SUFFIXES))
