"""Signal temporal logic: requirements over time as one formula, and how clearly a trace keeps them.

    G[0,20](gap > 2 and ttc > 1.5)         always, from 0 to 20 s
    F[0,5](speed < 0.1)                    at some time within 5 s
    (distance > 1) U[0,8] (co.speed < 1)   the first holds until the second does, which is within 8 s
    G(ttc < 2 -> F[0,1](acceleration < -4))

Signals are those of `sbt.metrics.signals`; times are seconds; `G` and `F` without bounds look to the
end of the trace. The robustness of a formula is a number: how far the trace could move before the
formula's truth changed, > 0 where it holds, < 0 where it is violated:

    f > g: f - g     not p: -p      p and q: min      p or q: max      p -> q: max(-p, q)
    G[a,b] p: min over [t + a, t + b]     F[a,b] p: max over it
    p U[a,b] q: max over s in [t + a, t + b] of min(q at s, p over [t, s))

Every sample holds until the next one, and the last one for ever: this decides what a window sees that
ends within a step, between two samples, or beyond the end of the trace. So a requirement that reaches
past the end is judged by the last state: `F[0,20]` fails on a run that stops at 6 s without it. Where
the bounds are multiples of the step this is the usual semantics in discrete time. A robustness at a
time costs O(n log n) for n samples and each operator.

Source:
    Donze and Maler (2010), Robust satisfaction of temporal logic over real-valued signals.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RunError
from sbt.metrics.others import worst_signal
from sbt.metrics.signals import check_signal, signal
from sbt.metrics.stl_grammar import Binary, Number, Signal, Term, Unary, parse
from sbt.problem.arrays import Vector
from sbt.problem.outcome import Status
from sbt.problem.scenario import Metric
from sbt.problem.trace import Trace

__all__ = ["parse", "robustness", "stl"]

Indices = NDArray[np.intp]
_EARLY = 1e-9
"""How far a sum of floats may fall short of a sample's time and still reach it (s)."""

_POINTWISE: dict[str, Callable[[Vector, Vector], Vector]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide,
    ">": np.subtract, ">=": np.subtract, "<": lambda f, g: g - f, "<=": lambda f, g: g - f,
    "and": np.minimum, "or": np.maximum, "->": lambda p, q: np.maximum(-p, q),
}  # fmt: skip


def stl(text: str, name: str = "stl", ego: str = "ego", other: str | None = "co", margin: float = 0.0) -> Metric:
    """Return the robustness of a formula at the start of the trace as a metric; < 0 violates it.

    Args:
        text: the formula.
        name: of the metric.
        ego: the road user under test.
        other: the one that bare signals of two road users speak of; None: all others, the worst at every instant.
        margin: lateral clearance below which the other is in ego's path (m).

    Raises:
        InputError: the text is no formula, or names what is no signal; the message points at the column.
    """
    formula = parse(text, check_signal)

    def function(trace: Trace) -> float:
        def read(what: str) -> Vector:
            values = worst_signal(trace, what, ego, margin) if other is None else signal(trace, what, ego, other, margin)
            if np.isnan(values).any():
                raise RunError(Status.FAILED, f"{what} must be there at every instant, but its road user is not")
            return values

        return float(robustness(formula, read, trace.time)[0])

    return Metric(
        name, function, "", "low", description=f"robustness of {text}",
        source="Donze and Maler (2010), Robust satisfaction of temporal logic over real-valued signals",
    )  # fmt: skip


def robustness(term: Term, signals: Callable[[str], Vector], time: Vector) -> Vector:
    """Return the robustness of a formula, or the value of a number, at every sample.

    Args:
        term: what `parse` returns.
        signals: name to (n,) samples.
        time: (n,) increasing times of the samples (s).

    Returns:
        (n,) numbers, in the unit of the signal that decides.
    """
    match term:
        case Number(value):
            return np.full(len(time), value)
        case Signal(name):
            return signals(name)
        case Unary("neg" | "not", of):
            return -robustness(of, signals, time)
        case Unary("G", of, low, high):
            return -_highest(-robustness(of, signals, time), *_window(time, low, high))
        case Unary("F", of, low, high):
            return _highest(robustness(of, signals, time), *_window(time, low, high))
        case Binary("U", left, right, low, high):
            first, last = _window(time, low, high)
            return _until(robustness(left, signals, time), robustness(right, signals, time), first, last)
        case Binary(op, left, right):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # the metric refuses what is not finite
                return _POINTWISE[op](robustness(left, signals, time), robustness(right, signals, time))
    raise TypeError(f"a formula must be what parse returns, but got {term!r}")


def _window(time: Vector, low: float, high: float) -> tuple[Indices, Indices]:
    """Return (n,) indices of the first and the last sample that holds in [t + low, t + high]."""
    first = np.searchsorted(time, time + low + _EARLY, side="right") - 1
    last = np.searchsorted(time, time + high + _EARLY, side="right") - 1
    return first, last


def _highest(values: Vector, first: Indices, last: Indices) -> Vector:
    """Return (n,) the largest of values[first : last + 1] for each window.

    Every window is covered by two blocks whose length is the largest power of two that fits; the
    maxima of all blocks of one length come from those of half the length.
    """
    level = np.frexp(last - first + 1)[1] - 1  # (n,) floor of log2
    result = np.empty(len(values))
    block = values
    for k in range(int(level.max()) + 1):
        if k:
            half = 1 << (k - 1)
            block = np.maximum(block[:-half], block[half:])  # block[i] = max of values[i : i + 2^k]
        here = level == k
        result[here] = np.maximum(block[first[here]], block[last[here] + 1 - (1 << k)])
    return result


def _until(left: Vector, right: Vector, first: Indices, last: Indices) -> Vector:
    """Return the (n,) robustness of `left U right`: the bounded until as three parts that are easier.

    `right` somewhere in the window, `left` up to its start, and an unbounded until from there on.
    """
    pairs = zip(left[::-1].tolist(), right[::-1].tolist(), strict=True)
    backwards = accumulate(pairs, lambda after, here: max(here[1], min(here[0], after)), initial=-np.inf)
    unbounded = np.array(list(backwards)[:0:-1])
    result = np.minimum(_highest(right, first, last), unbounded[first])
    here = np.arange(len(left))
    some = first > here
    before = -_highest(-left, here, np.maximum(first - 1, here))
    return np.where(some, np.minimum(result, before), result)
