"""Runs that are asked for, and how a store writes numbers: without a Python object more a run than it takes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

from sbt.problem.arrays import Points, Vector
from sbt.problem.plain import Value, Values
from sbt.store.history import PLANNED
from sbt.store.layout import checksum_of

__all__ = ["PlannedPoints", "PlannedRun", "dump", "dump_inputs", "dump_metrics", "plan_rows", "storable", "storable_reason"]

_MOST = 10_000
"""Characters of a message that a store keeps: one with a whole dump in it says no more."""

dump: Callable[[Any], str] = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode
"""JSON without spaces, of finite numbers."""


@dataclass(frozen=True)
class PlannedRun:
    """A run that a stage asks for, before it has an index and a seed.

    Args:
        stage: what asks for it.
        inputs: values by name, numbers in their units, choices as text.
        log_q: log density that they were drawn with; None: they were chosen.
        seed: where it was chosen for what it draws; None: it is drawn.
        level: of fidelity, 0 the scenario's own.
        warm_up: number of the warm-up to start from; None: that of its seed, where the campaign has warm-ups.
        blind: the seed is given, but was drawn like any other, without a look at what it draws.
    """

    stage: str
    inputs: Values
    log_q: float | None = None
    seed: int | None = None
    level: int = 0
    warm_up: int | None = None
    blind: bool = False


@dataclass(frozen=True, eq=False)
class PlannedPoints(Sequence[PlannedRun]):
    """The runs of a design, which may be a million: an array, whose rows become runs one by one.

    Args:
        stage: what asks for them.
        x: (n, d) inputs in their units.
        named: (d,) -> values by name.
    """

    stage: str
    x: Points
    named: Callable[[Vector], Mapping[str, Value]]

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.x)

    @overload
    def __getitem__(self, k: int) -> PlannedRun: ...
    @overload
    def __getitem__(self, k: slice) -> PlannedPoints: ...
    def __getitem__(self, k: int | slice) -> PlannedRun | PlannedPoints:
        """Return one run, or the runs of a slice."""
        if isinstance(k, slice):
            return PlannedPoints(self.stage, self.x[k], self.named)
        return PlannedRun(self.stage, self.named(self.x[k]))

    def __iter__(self) -> Iterator[PlannedRun]:
        """Yield the runs."""
        return (PlannedRun(self.stage, self.named(row)) for row in self.x)


def storable(text: str) -> str:
    r"""Return a text as a store can keep it: what is no Unicode (half a surrogate, in the name of a file) is escaped.

    >>> storable("no file 'r\udcfcck.xml'")
    "no file 'r\\udcfcck.xml'"
    """
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode("utf-8")


def storable_reason(text: str) -> str:
    """Return a `storable` message of a run, its end left out where it is very long.

    >>> storable_reason("x" * 10_001)[-27:]
    'xxx ... (10,001 characters)'
    """
    return storable(text if len(text) <= _MOST else f"{text[:_MOST]} ... ({len(text):,} characters)")


def plan_rows(
    iteration: int, runs: Iterable[tuple[int, PlannedRun, int]], names: Sequence[str], warm_ups: int
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of planned runs with their index and drawn seed, for a store with these inputs and warm-ups."""
    for index, run, drawn in runs:
        values = run.inputs
        inputs = dump_inputs([values[name] for name in names])
        chosen, seed = run.seed is not None and not run.blind, drawn if run.seed is None else run.seed
        log_q = None if run.log_q is None else float(run.log_q) + 0.0  # SQLite keeps no negative zero
        warm_up = int(seed) % warm_ups if warm_ups and run.warm_up is None else run.warm_up
        row = (int(index), run.stage, int(iteration), inputs, int(seed), int(chosen), run.level, warm_up, log_q)
        yield (*row, checksum_of(*row), PLANNED)


def dump_inputs(values: Sequence[Value]) -> str:
    """Return the values of a run's inputs as JSON, which has finite numbers only.

    >>> dump_inputs([0.1, 2.0, "left"])
    '[0.1,2.0,"left"]'
    """
    if not all(type(value) is float and math.isfinite(value) for value in values):
        return dump(values)
    return f"[{','.join(map(repr, values))}]"  # as JSON writes them, in a third of the time


def dump_metrics(metrics: Mapping[str, float]) -> str:
    """Return metrics as JSON, in which infinity is a number too large for a float: every reader takes it for infinity."""
    return f"{{{','.join([f'{dump(name)}:{_number(value)}' for name, value in metrics.items()])}}}"


def _number(value: float) -> str:
    if math.isfinite(value):
        return repr(value) if type(value) is float else dump(value)
    return "-1e999" if value < 0 else "1e999"
