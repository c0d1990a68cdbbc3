"""How scenarios, metamodels, acquisitions, metrics and controllers are found: built-ins and strangers alike.

A name is an entry point (groups `sbt.scenarios`, `sbt.metamodels`, ...), `file.py:NAME` runs the
user's own file, and only because the user names it: what a store names is asked for (`sbt.plugins.approval`).
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, partial, wraps
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar, cast

from sbt import interruption
from sbt.errors import InputError, PluginError, did_you_mean
from sbt.plugins.approval import check_approved, modules_of, named_by
from sbt.plugins.source import FromSource, import_from_source

__all__ = [
    "KINDS", "OBJECT", "LoadedAnew", "Objects", "Scope", "contents_read", "forget_changed", "forget_files", "kept", "load",
    "names", "newer", "noted", "read_files",
]  # fmt: skip

OBJECT = "object:"
"""Before the name of an object that was given in Python, where a name is asked for."""

Objects = Mapping[tuple[str, str], Any]
"""What was given in Python: (kind, name) -> object, such as ("scenarios", "object:disc")."""

KINDS = ("scenarios", "sources", "metamodels", "acquisitions", "metrics", "controllers", "campaigns")
"""`sources` are prefixes of scenario names: `table:FOLDER` is what the source `table` makes of FOLDER"""
_LOCK = threading.Lock()
_LARGE = 2**22
"""Size (bytes) from which on a file is read once a state for its hash."""
_SHORT = 8
"""Digits of a hash that people are shown."""
_USER = "sbt_user_"
"""How the names of modules begin that a file of the user's was imported as."""
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
_stamps: dict[Path, tuple[int, int]] = {}
_loaded_anew: ContextVar[set[Path]] = ContextVar("_loaded_anew", default=set())  # noqa: B039  (what nobody collects)
_forgetters: list[Callable[[], None]] = []
_scenarios_of: dict[tuple[Path, str], tuple[Path, ...]] = {}


def noted(path: Path, *, loaded_anew: bool = False) -> Path:
    """Return the path of a user's file, and remember its state as what `kept` functions made of it belongs to that state.

    Args:
        path: of the file, or of a link to it.
        loaded_anew: SUMO loads it in every run, whatever this process has read of it.
    """
    place = path.absolute()
    _stamps.setdefault(place, _stamp(place))
    if loaded_anew:
        _loaded_anew.get().add(place)
    return path


def kept(function: F) -> F:
    """Keep what a function made of the user's files, once a process and arguments, until one of the files changes."""

    @cache
    def made(*args: Any, **kwargs: Any) -> tuple[Any, set[Path]]:
        with _collected() as files:
            value = function(*args, **kwargs)
        return value, files

    @wraps(function)
    def asked(*args: Any, **kwargs: Any) -> Any:
        value, files = made(*args, **kwargs)
        if files:
            _loaded_anew.get().update(files)
        return value

    _forgetters.append(made.cache_clear)
    return cast("F", asked)


@contextmanager
def _collected() -> Iterator[set[Path]]:
    """Yield the files that SUMO loads in every run, of those that are read in this context, or were for what is kept."""
    files: set[Path] = set()
    before = _loaded_anew.set(files)
    try:
        yield files
    finally:
        _loaded_anew.reset(before)
        _loaded_anew.get().update(files)


def forget_changed() -> None:
    """Forget everything that was made of the user's files where one of them has changed since: files edited in a session.

    Called where a command begins, not within one: a campaign runs what it began with.
    """
    if any(_stamp(path) != state for path, state in _stamps.items()):
        forget_files()


def forget_files() -> None:
    """Forget everything that was made of the user's files, so that `read_files` knows what is read from now on."""
    _stamps.clear()
    for forget in _forgetters:
        forget()


def newer(file: Path) -> list[Path]:
    """Return the user's files, of those that this process has read, that were changed later than a file."""
    state = _stamp(file)
    return sorted(path for path in _stamps if _stamp(path) > state)


def read_files() -> list[Path]:
    """Return the user's files that this process has read, and the modules beside them that they import."""
    found = {path.resolve() for path in _stamps if path.is_file()}
    return sorted({file for path in found for file in (modules_of(path) if path.suffix == ".py" else (path,))})


def contents_read() -> dict[str, str]:
    """Return what is in the user's files that this process has read: a hash by their paths."""
    return {str(path): _content(path) for path in read_files()}


class LoadedAnew:
    """The files of a campaign that SUMO loads in every run, each as it was when the campaign first read it.

    Files that runs read, and may write, are none of them.
    """

    def __init__(self) -> None:
        self._begun: dict[Path, tuple[tuple[int, int], str]] = {}

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Let the campaign resolve or prepare its scenario, and remember what is read for it."""
        with _collected() as files:
            yield
        self._begun |= {path: (_stamp(path), _content(path)) for path in files - self._begun.keys()}

    def check(self) -> None:
        """Check that the files are what they were.

        Raises:
            InputError: one has changed, or is not there any more.
        """
        known = self._begun.items()
        changed = {path for path, (stamp, was) in known if _stamp(path) != stamp and _content(path) != was}
        if changed:
            rule = "SUMO's files must stay as they are while a campaign runs, as its runs load them"
            linked = {path.resolve() for path in changed if path.resolve() != path}
            told = ", ".join(sorted(map(str, changed - linked)))
            raise InputError(f"{rule}, but changed: {told}; put it back and run again, or choose another store")


def _print(path: Path) -> str:
    """Return a print of a file that people are shown: of what is in it, of a large one of when it was changed."""
    state = _stamp(path)
    return (hashlib.blake2b(repr(state).encode(), digest_size=16).hexdigest() if state[1] > _LARGE else _content(path))[:_SHORT]


def _content(path: Path) -> str:
    """Return a hash of what is in a file; "" where there is none."""
    state = _stamp(path)
    try:
        return _hash(path) if state[1] <= _LARGE else _hash_of_state(path.resolve(), state)
    except OSError:
        return ""


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, partial(hashlib.blake2b, digest_size=16)).hexdigest()


@cache
def _hash_of_state(path: Path, state: tuple[int, int]) -> str:
    """Return the hash of a large file, which is read once a state."""
    del state
    return _hash(path)


def _stamp(path: Path) -> tuple[int, int]:
    """Return when a file was changed (ns) and its size (bytes); zeros where there is none."""
    try:
        state = path.stat()
    except OSError:
        return (0, 0)
    return (state.st_mtime_ns, state.st_size)


@dataclass(frozen=True)
class Scope:
    """Where the names of a configuration are looked up: its folder, and the objects that were given beside it.

    Args:
        folder: where a relative `file.py:NAME` is looked up.
        objects: (kind, name) -> object, such as ("scenarios", "object:disc").
        store: folder of the store that the names come from; their code runs only where it is approved. None: from the user.
    """

    folder: Path = field(default_factory=Path.cwd)
    objects: Objects = field(default_factory=dict)
    store: Path | None = None

    def naming(self) -> AbstractContextManager[None]:
        """Return the context in which code is loaded that these names stand for."""
        return named_by(self.store)

    def prints(self, names: Iterable[str]) -> dict[str, str]:
        """Return prints of the user's own files that names stand for, by their paths.

        Those of code with the modules beside it, of a scenario with its files of SUMO, of a table.
        """
        files: set[Path] = set()
        for name in names:
            if ".py:" in name:
                file = (self.folder / Path(name.rpartition(":")[0]).expanduser()).resolve()
                files |= set(modules_of(file)) if file.is_file() else set()
            elif name.endswith((".yaml", ".yml")) or name.startswith("table:"):
                files |= set(self._read_for(name))
        return {os.path.relpath(each, self.folder.resolve()): _print(each) for each in sorted(files)}

    def _read_for(self, scenario: str) -> tuple[Path, ...]:
        """Return the files that a scenario is made of; found out once a process."""
        if (self.folder, scenario) not in _scenarios_of:
            forget_files()
            self.load("scenarios", scenario)
            _scenarios_of[self.folder, scenario] = tuple(read_files())
        return _scenarios_of[self.folder, scenario]

    def load(self, kind: str, name: str) -> Any:
        """Return the object with this name; as `load`, and the objects of the scope.

        Raises:
            PluginError: nothing has this name, it was defined in Python and is not given here, or it is not approved.
        """
        if (kind, name) in self.objects:
            return self.objects[kind, name]
        if name.startswith(OBJECT):
            one, own = kind.removesuffix("s"), name.removeprefix(OBJECT)
            raise PluginError(f"the {one} '{own}' was defined in Python and must be given again: {one}={own}")
        with self.naming():
            return load(kind, name, self.folder)


@cache
def _entries(kind: str) -> dict[str, list[EntryPoint]]:
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, but got '{kind}'")
    found: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=f"sbt.{kind}"):
        found.setdefault(entry.name, []).append(entry)
    return found


def names(kind: str) -> list[str]:
    """Return what is installed of one kind, sorted."""
    return sorted(_entries(kind))


def load(kind: str, name: str, folder: Path | None = None) -> Any:
    """Return the object with this name.

    Args:
        kind: one of `KINDS`.
        name: an installed name, or `file.py:NAME`; of scenarios also `folder/scenario.yaml`.
        folder: where a relative file is looked up; default the working directory.

    Raises:
        PluginError: nothing has this name, or its code raises when it is imported.
    """
    if ".py:" in name:
        path, _, attribute = name.rpartition(":")
        return _from_file(str((folder or Path.cwd()) / Path(path).expanduser()), attribute)
    if kind == "scenarios" and name.endswith((".yaml", ".yml")):
        return load("sources", "yaml")(name, folder or Path.cwd())
    source, _, rest = name.partition(":")
    if kind == "scenarios" and rest and source in _entries("sources"):
        _note_table(((folder or Path.cwd()) / rest).resolve())
        return load("sources", source)(rest, folder or Path.cwd())
    entries = _entries(kind)
    if name not in entries:
        known = ", ".join(sorted(entries)) or "nothing is installed"
        raise PluginError(f"{kind} must be one of {known}, or file.py:NAME, but got '{name}'{did_you_mean(name, entries)}")
    if len(values := sorted({entry.value for entry in entries[name]})) > 1:
        raise PluginError(f"{kind} must have names of their own, but packages offer '{name}' as {' and as '.join(values)}")
    return _guarded(entries[name][0].load, lambda _: f"{kind[:-1]} '{name}' cannot be imported", InputError)


def _note_table(place: Path) -> None:
    """Note the files of a recorded table, given by its folder or file; what else is there is nobody's business."""
    folder = place.parent if place.is_file() else place
    tables = [place] if place.is_file() else [file for kind in ("*.csv", "*.parquet") for file in folder.glob(kind)]
    for file in (*tables, folder / "config.yml"):
        if file.is_file():
            noted(file)


@kept
def _module(path: str) -> Any:
    """Import one file under a name of its own, once a process while it stays as it is."""
    noted(Path(path))
    name = f"{_USER}{abs(hash(path)):x}_{Path(path).stem}"
    spec = importlib.util.spec_from_file_location(name, path, loader=FromSource(name, path))
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise PluginError(f"a plug-in file must exist, but got '{path}'")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    import_from_source(Path(path).parent)
    try:
        with _modules_beside(Path(path).resolve().parent):
            _guarded(
                partial(spec.loader.exec_module, module),
                lambda error: f"plug-in file {path}{_line_of(error, path)} raised on import",
            )
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextmanager
def _modules_beside(folder: Path) -> Iterator[None]:
    """Let a file import the modules in its folder, after all that are installed; each file has its own.

    Other folders may have modules of the same names. Where the folder is on Python's path anyway, they are as ever.
    """
    if folder in {Path(place or ".").resolve() for place in sys.path}:
        yield
        return
    before = set(sys.modules)
    sys.path.append(str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        own: list[str] = []
        for name in set(sys.modules) - before:
            top = sys.modules.get(name.partition(".")[0])
            if _file_of(top).parent in (folder, folder / name.partition(".")[0]) and not name.startswith(_USER):
                noted(_file_of(sys.modules[name]))
                own.append(name)
        for name in own:
            del sys.modules[name]


def _file_of(module: Any) -> Path:
    """Return the file of a module; the root where it has none."""
    return Path(getattr(module, "__file__", None) or "/").resolve()


def _guarded(action: Callable[[], T], what: Callable[[BaseException], str], *passing: type[BaseException]) -> T:
    """Return what an import returns; what it raises is a PluginError, SystemExit too, which would end the program silently."""
    with interruption.handled():
        try:
            return action()
        except passing:
            raise
        except BaseException as error:
            if interruption.is_interruption(error):
                raise
            raise PluginError(f"{what(error)}: {type(error).__name__}: {error}".removesuffix(": ")) from error


def _line_of(error: BaseException, path: str) -> str:
    """Return ':line' of the last frame in the user's own file."""
    found, trace = "", error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == path:
            found = f":{trace.tb_lineno}"
        trace = trace.tb_next
    return f":{error.lineno}" if isinstance(error, SyntaxError) else found


def _from_file(path: str, attribute: str) -> Any:
    with _LOCK:
        check_approved(Path(path).resolve())
        module = _module(str(Path(path).resolve()))
    if not hasattr(module, attribute):
        offered = ", ".join(n for n in vars(module) if n.isupper() or not n.startswith("_")) or "nothing"
        raise PluginError(f"plug-in file {path} must define {attribute}, but it defines {offered}")
    return getattr(module, attribute)
