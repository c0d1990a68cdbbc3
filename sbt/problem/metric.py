"""A safety metric: a named function of a trace."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from sbt import plugins
from sbt.errors import InputError, RunError, must_be, must_take, shown
from sbt.problem.arrays import FARTHEST, Vector
from sbt.problem.outcome import Status, with_given
from sbt.problem.trace import Trace

__all__ = ["Metric", "meaningful", "metric_from"]

_WITHIN = f" and within {FARTHEST:g}"


@dataclass(frozen=True)
class Metric:
    """A named function of a trace.

    Args:
        name: as written in requirements and in the store (`y.<name>`).
        function: trace to a number, inf or -inf at an end of its scale; None: a scenario without traces gives it itself.
        unit: "" for a pure number or a flag.
        direction: "low" where small values are critical, "high" where large ones are.
        without: the value where there was no interaction to measure.
        description: one sentence.
        source: reference of the definition.
        alone: it measures the ego alone, whoever else is there.
        over_time: trace to (t,) values whose worst is the metric; for one that knows, of an instant, what came after it, and
            that therefore cannot be told from the trace up to there.
        lagged: it compares where two road users were at different times: the one may come when the other has gone.
    """

    name: str
    function: Callable[[Trace], float] | None = None
    unit: str = ""
    direction: str = "low"
    without: float = math.inf
    description: str = ""
    source: str = ""
    alone: bool = False
    over_time: Callable[[Trace], Vector] | None = None
    lagged: bool = False

    def __post_init__(self) -> None:
        must_be("a metric's name must be text", self.name, str)
        must_be(f"metric {self.name}: a unit must be text", self.unit, str)
        must_be(f"metric {self.name}: what stands for no interaction (without) must be a number", self.without, Real)
        if math.isnan(self.without):
            raise InputError(f"metric {self.name}: what stands for no interaction (without) must be a number, but got nan")
        if not self.name.strip() or not self.name.isprintable():
            raise InputError(f"a metric's name must be text on one line, but got {self.name!r}")
        if self.function is not None and not callable(self.function):
            raise InputError(f"metric {self.name} must have a function of a trace, but got {self.function!r}")
        if self.function is not None:
            must_take(f"metric {self.name} must have a function of one argument, the trace", self.function, 1)

    def __call__(self, trace: Trace) -> float:
        """Return the metric of a trace.

        Raises:
            RunError: the value is no number.
        """
        return meaningful(self.name, self.value(trace))

    def value(self, trace: Trace) -> float:
        """Return its value on a trace, finite or not."""
        if self.function is None:
            raise InputError(f"metric {self.name} is given by its scenario: it cannot be measured on a trace")
        return as_number(self.name, self.function(trace))


def metric_from(given: Metric | str | Callable[[Trace], float]) -> Metric:
    """Return a metric: itself, the installed one of this name, or a function of a trace under its own name.

    Raises:
        InputError: it is none of these.
    """
    if isinstance(given, Metric):
        return given
    if isinstance(given, str):
        found = plugins.load("metrics", given)
        if isinstance(found, str):
            raise InputError(f"a metric must be a Metric or a function of a trace, but '{given}' is text")
        return metric_from(found)
    if not callable(given):
        raise InputError(f"a metric must be a Metric, the name of one, or a function of a trace, but got {given!r}")
    lines = (getattr(given, "__doc__", None) or "").strip().splitlines()
    return Metric(getattr(given, "__name__", type(given).__name__), given, description=lines[0] if lines else "")


def meaningful(name: str, value: object) -> float:
    """Return a metric's value: inf, -inf, or a number whose square is still one.

    Raises:
        RunError: it is no such number.
    """
    number = as_number(name, value)
    if abs(number) <= FARTHEST or math.isinf(number):
        return number
    raise _unbounded(name, "" if math.isnan(number) else _WITHIN, str(number))


def measured(values: Mapping[str, Callable[[], float]]) -> dict[str, float]:
    """Return metrics by name; all are tried, so that a run that fails says what it gave beside the metric that it did not.

    Raises:
        RunError: one is no number.
    """
    found: dict[str, float] = {}
    failed: RunError | None = None
    for name, value in values.items():
        try:
            found[name] = value()
        except RunError as error:
            if error.status != Status.FAILED:
                raise
            failed = failed or error
    if failed is not None:
        raise RunError(failed.status, with_given(failed.reason, found)) from failed
    return found


def as_number(name: str, value: Any) -> float:
    """Return a metric's value as a number; text is none.

    Raises:
        RunError: it is no number.
    """
    try:
        number = None if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError):
        number = None
    except OverflowError:  # a whole number beyond all floats
        raise _unbounded(name, _WITHIN, shown(value)) from None
    if number is None:
        raise RunError(Status.FAILED, f"metric {name} must be one number, but got {shown(value)}")
    return number


def _unbounded(name: str, limit: str, got: str) -> RunError:
    return RunError(Status.FAILED, f"metric {name} must be finite{limit}, inf or -inf, but got {got}")
