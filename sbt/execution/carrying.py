"""Scenarios by value: what a script or a notebook defines reaches other processes as bytes.

A function of a script is not importable elsewhere, so it travels as its code, with the variables that it uses
(cloudpickle). What is installed travels by name.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import os
import subprocess
import sys
import sysconfig
import threading
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sbt.errors import InputError, described
from sbt.problem.scenario import LogicalScenario

__all__ = ["carry", "delivered", "keep_here", "packed", "unpacked"]

_LOCK = threading.Lock()
_ORIGINALS: dict[bytes, LogicalScenario] = {}
"""In the process that carried them: runs there use the scenario itself, not a copy."""
_DEPTH = 12
"""So deep it is searched for what cannot travel."""
_FIND = """
import importlib.util, json, sys
found = {}
for name in json.load(sys.stdin):
    try:
        spec = importlib.util.find_spec(name)
        found[name] = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
    except Exception:
        found[name] = []
json.dump(found, sys.stdout)
"""


def carry(scenario: LogicalScenario) -> bytes:
    """Return a scenario as bytes, with the code and the variables that it uses.

    Everything that another process could not import travels by value: what the script or notebook defines, plug-in
    files, and modules that lie beside the script. The bytes of equal scenarios need not be equal.

    Raises:
        InputError: something in it cannot leave the process, such as an open file or a lock.
    """
    with _LOCK, _by_value():
        try:
            data = _dumps(scenario)
        except Exception as error:
            raise InputError(
                f"a scenario must be made of plain data and code to reach its workers, but in scenario {scenario.name} "
                f"{_culprit(scenario, error)}; make such an object inside the function that uses it"
            ) from None
    _ORIGINALS[data] = scenario
    return data


def packed(objects: Mapping[tuple[str, str], Any]) -> dict[tuple[str, str], bytes]:
    """Return objects as bytes, as `carry` does a scenario; what cannot leave the process is left out."""
    found = {}
    with _LOCK, _by_value():
        for key, value in objects.items():
            with suppress(Exception):
                found[key] = _dumps(value)
    return found


def unpacked(objects: Mapping[tuple[str, str], bytes]) -> dict[tuple[str, str], Any]:
    """Return the objects of `packed`, without those that cannot be loaded here."""
    found = {}
    for key, data in objects.items():
        with suppress(Exception):
            found[key] = _cloudpickle().loads(data)
    return found


def keep_here(scenario: LogicalScenario) -> bytes:
    """Return what stands for a scenario that stays in this process; nothing of it need be able to travel."""
    data = f"scenario {scenario.name} stays in process {os.getpid()}: {id(scenario)}".encode()
    _ORIGINALS[data] = scenario
    return data


@functools.cache
def delivered(data: bytes, name: str) -> LogicalScenario:
    """Return the scenario that was carried; loaded once a process.

    Raises:
        InputError: the process lacks a package that the scenario uses, or the bytes are those of something else.
    """
    if data in _ORIGINALS:
        return _ORIGINALS[data]
    try:
        found = _cloudpickle().loads(data)
    except BaseException as error:
        raise InputError(f"scenario {name} must be loadable in its worker, but loading it raised {described(error)}") from None
    if not isinstance(found, LogicalScenario):
        raise InputError(f"a scenario must be a LogicalScenario, but '{name}' is a {type(found).__name__}")
    return found


def _cloudpickle() -> Any:
    try:
        import cloudpickle
    except ImportError:  # joblib before 1.6 brings its own
        from joblib.externals import cloudpickle
    return cloudpickle


def _dumps(part: Any) -> bytes:
    """Return an object as bytes; an open file is refused, which cloudpickle would replace by its text."""
    file = io.BytesIO()
    base = _cloudpickle().CloudPickler

    class Pickler(base):  # type: ignore[misc, valid-type]  # cloudpickle has no types
        def reducer_override(self, value: Any) -> Any:
            if isinstance(value, io.TextIOWrapper) and value not in (sys.stdout, sys.stderr):
                raise TypeError("an open file belongs to its process")
            return super().reducer_override(value)

    Pickler(file).dump(part)
    return file.getvalue()


@contextmanager
def _by_value() -> Iterator[None]:
    """Let modules that other processes cannot import travel by value."""
    pickle = _cloudpickle()
    before = pickle.list_registry_pickle_by_value()
    added = [module for module in _own_modules() if module.__name__ not in before]
    for module in added:
        pickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in added:
            pickle.unregister_pickle_by_value(module)


def _own_modules() -> list[types.ModuleType]:
    """Return the modules that a fresh process could not import."""
    here = {name: module for name, module in sys.modules.items() if getattr(module, "__name__", None) == name}
    candidates = {
        name: module for name, module in here.items()
        if isinstance(module, types.ModuleType) and _maybe_own(name, module)
    }  # fmt: skip
    packages = {name.partition(".")[0] for name in candidates if not name.startswith("sbt_user_")}
    found = _importable(packages) if packages else {}
    return [m for name, m in candidates.items() if not _lies_in(m, found.get(name.partition(".")[0], ()))]


def _maybe_own(name: str, module: types.ModuleType) -> bool:
    """Return whether a module may be a user's own: not of Python, not installed, not of this package."""
    package = name.partition(".")[0]
    if package in sys.stdlib_module_names or package in ("sbt", "__main__", "__mp_main__"):
        return False
    file = getattr(module, "__file__", None)
    if file is None or name.startswith("sbt_user_"):
        return name.startswith("sbt_user_")
    return not _is_installed(str(file))


@functools.cache
def _is_installed(file: str) -> bool:
    """Return whether a file lies where Python and packages are installed; asked of thousands of modules at every carrying."""
    places = (Path(sysconfig.get_path(kind)).resolve() for kind in ("stdlib", "platstdlib", "purelib", "platlib"))
    return not set(Path(file).resolve().parents).isdisjoint(places)


def _importable(packages: set[str]) -> dict[str, list[str]]:
    """Return where a fresh interpreter finds these modules."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _FIND], input=json.dumps(sorted(packages)), capture_output=True, text=True, timeout=30,
            check=True,
        )  # fmt: skip
        found: dict[str, list[str]] = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return found


def _lies_in(module: types.ModuleType, places: list[str] | tuple[str, ...]) -> bool:
    file = Path(str(module.__file__)).resolve()
    return any(place and (file == Path(place).resolve() or Path(place).resolve() in file.parents) for place in places)


def _culprit(scenario: LogicalScenario, error: Exception) -> str:
    """Return which innermost part cannot travel, and why."""
    where, part, seen = "a part", scenario, set[int]()
    for _ in range(_DEPTH):
        for name, child in _parts(part, where):
            if id(child) not in seen and (found := _refusal(child)) is not None:
                seen.add(id(child))
                where, part, error = name, child, found
                break
        else:
            break
    return f"{where} is a {type(part).__name__} ({type(error).__name__}: {error})"


def _refusal(part: Any) -> Exception | None:
    try:
        _dumps(part)
    except Exception as error:
        return error
    return None


def _parts(part: Any, where: str) -> Iterator[tuple[str, Any]]:
    """Yield what an object is made of, with names."""
    if isinstance(part, types.FunctionType):
        yield from _variables(part)
    elif isinstance(part, types.MethodType):
        yield f"the object of {where}", part.__self__
        yield where, part.__func__
    elif isinstance(part, functools.partial):
        yield where, part.func
        yield from ((f"argument {k} of {where}", value) for k, value in enumerate(part.args))
        yield from ((f"argument '{name}' of {where}", value) for name, value in part.keywords.items())
    elif isinstance(part, dict):
        yield from ((f"item {key!r} of {where}", value) for key, value in part.items())
    elif isinstance(part, list | tuple | set | frozenset):
        yield from ((f"item {k} of {where}", value) for k, value in enumerate(part))
    elif isinstance(part, types.ModuleType):
        yield from ((f"variable '{name}' of module {part.__name__}", value) for name, value in vars(part).items())
    elif dataclasses.is_dataclass(part) and isinstance(part, LogicalScenario):
        yield from ((field.name, getattr(part, field.name)) for field in dataclasses.fields(part))
    else:
        name = part.__name__ if isinstance(part, type) else type(part).__name__
        yield from ((f"attribute '{key}' of {name} ({where})", value) for key, value in getattr(part, "__dict__", {}).items())


def _variables(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the variables from outside that a function uses, and its defaults."""
    code = function.__code__
    name = f"{function.__qualname__} ({code.co_filename}:{code.co_firstlineno})"
    for variable, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            yield f"variable '{variable}' of {name}", cell.cell_contents
        except ValueError:  # not assigned yet
            continue
    for variable in _global_names(code):
        if variable in function.__globals__:
            yield f"variable '{variable}' of {name}", function.__globals__[variable]
    yield from ((f"default {k} of {name}", value) for k, value in enumerate(function.__defaults__ or ()))
    yield from ((f"default '{key}' of {name}", value) for key, value in (function.__kwdefaults__ or {}).items())
    yield from ((f"attribute '{key}' of {name}", value) for key, value in vars(function).items())


def _global_names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _global_names(constant)
