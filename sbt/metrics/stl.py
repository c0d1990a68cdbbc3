"""Signal temporal logic (STL): requirements over time as a formula, and its robustness on a trace.

    G[0,20](gap > 2 and ttc > 1.5)         always, from 0 to 20 s
    F[0,5](speed < 0.1)                    at some time within 5 s
    (distance > 1) U[0,8] (co.speed < 1)   the first holds until the second holds, within 8 s
    G(ttc < 2 -> F[0,1](acceleration < -4))

Signals are those of `sbt.metrics.signals`, times are in seconds, and `G` and `F` without bounds extend to the end
of the trace. The robustness of a formula is the signed margin by which it holds (> 0) or is violated (< 0):

    f > g: f - g     not p: -p      p and q: min      p or q: max      p -> q: max(-p, q)
    G[a,b] p: min over [t + a, t + b]     F[a,b] p: max over it
    p U[a,b] q: max over s in [t + a, t + b] of min(q at s, p over [t, s))

A sample is valid until the next one, and the last one for ever, which defines the windows that end between two
samples or beyond the end of the trace. A requirement that extends beyond the end is thus evaluated with the last
state: `F[0,20]` fails on a run that ends at 6 s without fulfilling it. For bounds that are multiples of the step this
is the usual discrete-time semantics. Each operator takes O(n log n) for n samples.

Source:
    Donze and Maler (2010), Robust satisfaction of temporal logic over real-valued signals.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RunError
from sbt.metrics.pairwise import worst_signal
from sbt.metrics.signals import check_signal, signal
from sbt.metrics.stl_grammar import Binary, Number, Signal, Term, Unary, parse
from sbt.problem.arrays import Vector
from sbt.problem.metric import Metric
from sbt.problem.outcome import Status
from sbt.problem.trace import Trace

__all__ = ["FORMULA", "parse", "robustness", "stl"]

Indices = NDArray[np.intp]
_TIME_TOLERANCE = 1e-9
"""Rounding error of sums of times that is accepted (s)."""

_POINTWISE: dict[str, Callable[[Vector, Vector], Vector]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide,
    ">": np.subtract, ">=": np.subtract, "<": lambda f, g: g - f, "<=": lambda f, g: g - f,
    "and": np.minimum, "or": np.maximum, "->": lambda p, q: np.maximum(-p, q),
}  # fmt: skip


FORMULA = "robustness of "
"""How the description of a formula's metric begins; the formula follows."""


def stl(text: str, name: str = "stl", ego: str = "ego", other: str | None = "co", margin: float = 0.0) -> Metric:
    """Return the robustness of a formula at the start of the trace as a metric; < 0 where it is violated.

    Args:
        text: the formula.
        name: of the metric.
        ego: the road user under test.
        other: the other road user of bare signals of two; None: all others, the worst at every instant.
        margin: lateral clearance below which the other is in the ego's path (m).

    Raises:
        InputError: the text is not a formula, or a signal does not exist; the message points at the column.
    """
    formula = parse(text, check_signal)

    def function(trace: Trace) -> float:
        def read(what: str) -> Vector:
            values = worst_signal(trace, what, ego, margin) if other is None else signal(trace, what, ego, other, margin)
            if np.isnan(values).any():
                raise RunError(Status.FAILED, f"{what} must be defined at every instant, but its road user is absent at some")
            return values

        return float(robustness(formula, read, trace.time)[0])

    return Metric(
        name, function, "", "low", description=f"{FORMULA}{text}",
        source="Donze and Maler (2010), Robust satisfaction of temporal logic over real-valued signals",
    )  # fmt: skip


def robustness(term: Term, signals: Callable[[str], Vector], time: Vector) -> Vector:
    """Return the robustness of a formula, or the value of a numeric term, at every sample.

    Args:
        term: as returned by `parse`.
        signals: name to (n,) samples.
        time: (n,) increasing times of the samples (s).

    Returns:
        (n,) numbers, in the unit of the signals.
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
            held = np.where(time[first] < time + low - _TIME_TOLERANCE, first, first - 1)
            return _until(robustness(left, signals, time), robustness(right, signals, time), first, last, held)
        case Binary(op, left, right):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # Metric refuses infinity and NaN
                return _POINTWISE[op](robustness(left, signals, time), robustness(right, signals, time))
    raise TypeError(f"a formula must be a term that parse returns, but got {term!r}")


def _window(time: Vector, low: float, high: float) -> tuple[Indices, Indices]:
    """Return (n,) indices of the first and the last sample that are valid within [t + low, t + high]."""
    first = np.searchsorted(time, time + low + _TIME_TOLERANCE, side="right") - 1
    last = np.searchsorted(time, time + high + _TIME_TOLERANCE, side="right") - 1
    return first, last


def _highest(values: Vector, first: Indices, last: Indices) -> Vector:
    """Return (n,) the maximum of values[first : last + 1] of each window, by a sparse table.

    Every window is covered by two blocks whose length is the largest power of two that fits; the maxima of all blocks
    of one length follow from those of half the length.
    """
    level = np.frexp(last - first + 1)[1] - 1  # (n,) floor of log2
    result = np.empty(len(values))
    block = values
    for k in range(int(level.max()) + 1):
        if k:
            half = 1 << (k - 1)
            block = np.maximum(block[:-half], block[half:])  # block[i] = max of values[i : i + 2^k]
        windows = level == k
        result[windows] = np.maximum(block[first[windows]], block[last[windows] + 1 - (1 << k)])
    return result


def _until(left: Vector, right: Vector, first: Indices, last: Indices, held: Indices) -> Vector:
    """Return the (n,) robustness of `left U right` as the minimum of three simpler terms.

    `right` somewhere in the window, `left` over the samples up to its start, the last of which is `held` (n,), and an
    unbounded until from there on.
    """
    pairs = zip(left[::-1].tolist(), right[::-1].tolist(), strict=True)
    backwards = accumulate(pairs, lambda after, now: max(now[1], min(now[0], after)), initial=-np.inf)
    unbounded = np.array(list(backwards)[:0:-1])
    result = np.minimum(_highest(right, first, last), unbounded[first])
    now = np.arange(len(left))
    before = -_highest(-left, now, np.maximum(held, now))
    return np.where(held >= now, np.minimum(result, before), result)
