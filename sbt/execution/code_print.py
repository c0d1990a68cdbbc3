"""A print of the Python code that runs depend on, of objects that no file holds, such as functions of a notebook."""

from __future__ import annotations

import functools
import hashlib
import types
from collections.abc import Iterator
from typing import Any

from sbt.problem.scenario import LogicalScenario

__all__ = ["code_print"]

_PLAIN = (int, float, complex, str, bytes, bool, type(None))
_DEPTH = 8
"""Calls and objects that are followed from what the scenario names."""
_MOST = 1000
"""Values of a sequence that are looked at."""


def code_print(scenario: LogicalScenario) -> str:
    """Return a digest of the code of what simulates and measures, with the functions of the same module that it calls.

    It may differ where nothing has changed (another Python), and does not see what libraries, files or globals hold.
    """
    digest = hashlib.blake2b(digest_size=16)
    for value in (scenario.evaluate, scenario.simulate, *(metric.function for metric in scenario.metrics)):
        for part in _parts(value, set(), _DEPTH):
            digest.update(part.encode())
    return digest.hexdigest()


def _parts(value: Any, seen: set[int], depth: int) -> Iterator[str]:
    """Yield text that changes with the code behind a value."""
    if isinstance(value, _PLAIN):
        yield f"{type(value).__name__} {value!r};"
        return
    if id(value) in seen or depth == 0:
        return
    seen.add(id(value))
    if isinstance(value, functools.partial):
        inner = [value.func, *value.args, *value.keywords.items()]
    elif isinstance(value, types.MethodType):
        inner = [value.__func__, value.__self__]
    elif isinstance(value, types.FunctionType):
        inner = [*_function(value)]
    elif isinstance(value, types.CodeType):
        yield f"{value.co_code.hex()} {value.co_names} {value.co_varnames};"
        inner = list(value.co_consts)
    elif isinstance(value, tuple | list):
        inner = [len(value), *value[:_MOST]]
    elif isinstance(value, frozenset | set):
        inner = sorted(map(repr, value))
    elif isinstance(value, dict):
        inner = list(value.items())
    elif _of_the_user(type(value)):
        inner = [*vars(type(value)).values(), *getattr(value, "__dict__", {}).items()]
    else:
        yield f"{type(value).__module__}.{type(value).__qualname__};"
        return
    for each in inner:
        yield from _parts(each, seen, depth - 1)


def _function(function: types.FunctionType) -> Iterator[Any]:
    """Yield the code of a function, its defaults and closure, and the functions of its module that it names."""
    if not _of_the_user(function):
        yield f"{function.__module__}.{function.__qualname__}"
        return
    yield function.__code__
    yield function.__defaults__
    yield function.__kwdefaults__
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # empty
            continue
    for name in function.__code__.co_names:
        other = function.__globals__.get(name)
        if isinstance(other, types.FunctionType | type) and _of_the_user(other):
            yield other if isinstance(other, types.FunctionType) else list(vars(other).values())


def _of_the_user(thing: Any) -> bool:
    """Return whether a function or class is no part of a library: of a notebook, a script, or a file that was loaded by name."""
    module = getattr(thing, "__module__", None) or ""
    return module.partition(".")[0] not in _LIBRARIES


_LIBRARIES = {"sbt", "builtins", "numpy", "scipy", "torch", "pandas", "sklearn", "libsumo", "traci", "sumolib", "functools"}
