"""A cache of intermediate results that several metrics of a trace share."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

from sbt.problem.trace import Trace

__all__ = ["per_trace"]

P = ParamSpec("P")
R = TypeVar("R")


def per_trace(function: Callable[Concatenate[Trace, P], R]) -> Callable[Concatenate[Trace, P], R]:
    """Decorate a function of a trace and hashable arguments so that it is computed once per trace.

    Traces are compared by identity and referenced weakly, so that the results are released together with the trace.
    A result must therefore not refer to the trace itself, and callers must not modify it.
    """
    results: WeakKeyDictionary[Trace, dict[Any, R]] = WeakKeyDictionary()

    @wraps(function)
    def cached(trace: Trace, /, *args: P.args, **kwargs: P.kwargs) -> R:
        of_trace = results.get(trace)
        if of_trace is None:
            of_trace = results[trace] = {}
        key = (args, tuple(kwargs.items())) if kwargs else args
        if key not in of_trace:
            of_trace[key] = function(trace, *args, **kwargs)
        return of_trace[key]

    return cached
