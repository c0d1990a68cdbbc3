"""Whose code may run: what the user names does, what a store names does once it is approved.

A store names files of Python by their paths, and a store may come from anybody. What `run`, `check` or `simulate` is given
by the user is approved by that; what only a store names has to have been approved before, with the same content. Approvals
are kept in the user's state folder, as hashes of the file and of the modules beside it that it imports.
"""

from __future__ import annotations

import ast
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from sbt.errors import PluginError
from sbt.plugins.source import is_installed

__all__ = ["TRUST", "UntrustedError", "check_approved", "digest_of", "is_trusted", "modules_of", "named_by", "trust_store"]

TRUST = "SBT_TRUST"
"""Variable of the environment: 1 approves all code, folders (as in PATH) that which lies in them."""

_SUFFIXES = (".py", *EXTENSION_SUFFIXES)
_STORE: ContextVar[Path | None] = ContextVar("store", default=None)
_trusted: set[Path] = set()
"""Stores whose code the user has approved in this process."""


class UntrustedError(PluginError):
    """Code that a store names, and that nobody has approved."""


def trust_store(folder: Path) -> None:
    """Approve the code that a store names, in this process as far as it is loaded, and its content from then on."""
    _trusted.add(Path(folder).resolve())


def is_trusted(folder: Path) -> bool:
    """Return whether the user has said in this process, or for all processes, that the code of a store may run."""
    return Path(folder).resolve() in _trusted or os.environ.get(TRUST) == "1"


@contextmanager
def named_by(store: Path | None) -> Iterator[None]:
    """Say that what is loaded meanwhile is named by a store; None: by the user, unless a store has named the user's name."""
    token = _STORE.set(_STORE.get() if store is None else Path(store))
    try:
        yield
    finally:
        _STORE.reset(token)


def check_approved(path: Path) -> None:
    """Approve a file that is about to be imported where the user names it; refuse it where a store does and nobody has.

    Raises:
        UntrustedError: a store names it, and its content is not approved.
    """
    store = _STORE.get()
    if not path.is_file() or (store is not None and _lies_in_trusted(path)):
        return
    digest = digest_of(path)
    if digest in _approved(_state_file()):
        return
    if store is not None and not is_trusted(store):
        raise UntrustedError(
            f"the code that a store names must be approved before it runs, but {store} names {path}, which nobody has, as it is"
            f" now: read it, then say --trust (in Python sbt.open(..., trust=True); for a machine of CI {TRUST}=1, or folders)"
        )
    _approve(digest, path)


def digest_of(path: Path) -> str:
    """Return a hash of a file of Python and of the modules beside it that it imports, and those import."""
    found = modules_of(path)
    of = {file: hashlib.sha256(data).hexdigest() for file, data in found.items()}
    beside = sorted(f"{file.relative_to(path.parent)}:{digest}" for file, digest in of.items() if file != path)
    return hashlib.sha256("\n".join([of[path], *beside]).encode()).hexdigest()


def modules_of(path: Path) -> dict[Path, bytes]:
    """Return a file of Python, and the modules beside it that it imports, and those import; without what is installed."""
    found: dict[Path, bytes] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file not in found and (file == path or not is_installed(file)):
            found[file] = file.read_bytes()
            waiting += _imported(found[file], file.parent, path.parent)
    return found


def _imported(data: bytes, folder: Path, root: Path) -> Iterator[Path]:
    """Yield the modules in a folder, or in that of the scenario's file, which code imports; packages with what is above them.

    Nothing where it is no Python, which is told when it is imported.
    """
    try:
        nodes = list(ast.walk(ast.parse(data)))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _named(alias.name, (folder, root))
        elif isinstance(node, ast.ImportFrom):
            above = (folder, *folder.parents)[: node.level][-1:]
            bases = [base for base in above or (folder, root) if base == root or root in base.parents]
            module = node.module or ""
            for alias in node.names:
                yield from _named(".".join(filter(None, (module, alias.name))), bases)


def _named(name: str, bases: Iterable[Path]) -> Iterator[Path]:
    """Yield the files of a dotted name of a module in folders, and of the packages that it lies in; `*`: of all in a package."""
    for base in dict.fromkeys(bases):
        place = base
        for part in name.split("."):
            if part == "*":
                yield from (file for file in sorted(place.glob("*")) if file.is_file() and file.name.endswith(_SUFFIXES))
                yield from (file for file in sorted(place.glob("*/__init__.*")) if file.name.endswith(_SUFFIXES))
                break
            place = place / part
            files = (where.with_name(where.name + suffix) for where in (place, place / "__init__") for suffix in _SUFFIXES)
            yield from (file for file in files if file.is_file())


def _lies_in_trusted(path: Path) -> bool:
    """Return whether a file lies in a folder that the environment trusts."""
    folders = [Path(text).resolve() for text in os.environ.get(TRUST, "").split(os.pathsep) if text not in ("", "0", "1")]
    return any(folder in path.parents for folder in folders)


def _state_file() -> Path:
    """Return where approvals are kept, a line each: hash and path."""
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (state if state.is_absolute() else Path.home() / ".local" / "state") / "sumo-sbt" / "approved"


@cache
def _approved_in(file: Path, size: int, changed: int) -> frozenset[str]:
    return frozenset(line.partition(" ")[0] for line in file.read_text(encoding="utf-8", errors="replace").splitlines())


def _approved(file: Path) -> frozenset[str]:
    """Return the hashes that are approved; others' approvals do not count."""
    try:
        state = file.stat()
        if state.st_uid != os.getuid():
            return frozenset()
        return _approved_in(file, state.st_size, state.st_mtime_ns)
    except OSError:
        return frozenset()


def _approve(digest: str, path: Path) -> None:
    """Keep an approval; where the state folder cannot be written it holds for this process, and a store asks again."""
    file = _state_file()
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with file.open("a", encoding="utf-8", errors="replace") as out:
            out.write(f"{digest} {path}\n".replace("\n", " ").rstrip() + "\n")
    except OSError:
        return
