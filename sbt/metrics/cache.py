"""Results kept as long as the trace they were computed from, for what several metrics of one run share."""

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

    Traces are told apart by identity and referenced weakly: the results go with the trace. The result
    must therefore not refer to the trace itself, and must not be changed by the caller.
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
