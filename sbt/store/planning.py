"""Runs that are asked for, and how a store writes numbers: without a Python object more a run than it takes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, overload

from sbt.problem.arrays import Points
from sbt.problem.outcome import Job
from sbt.problem.plain import Value, Values
from sbt.store.history import PLANNED
from sbt.store.layout import checksum_of

__all__ = ["PlannedPoints", "PlannedRun", "dump", "dump_inputs", "dump_metrics", "plan_rows", "storable", "storable_reason"]

_ROWS = 10_000
"""Rows of a design that become Python numbers at once."""
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
        x: (n, d) inputs in their units, a choice as its position.
        names: (d,) of the inputs.
        choices: of the inputs that have some, by name.
    """

    stage: str
    x: Points
    names: tuple[str, ...]
    choices: Mapping[str, Sequence[str]] = field(default_factory=dict)

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
            return replace(self, x=self.x[k])
        return next(iter(replace(self, x=self.x[[k]])))

    def __iter__(self) -> Iterator[PlannedRun]:
        """Yield the runs."""
        return (PlannedRun(self.stage, inputs) for inputs in self.inputs())

    def values(self) -> Iterator[list[Value]]:
        """Yield the inputs of each run, choices as text."""
        chosen = [(self.names.index(name), choices) for name, choices in self.choices.items()]
        for start in range(0, len(self.x), _ROWS):
            for row in self.x[start : start + _ROWS].tolist():
                for k, choices in chosen:
                    row[k] = choices[int(row[k])]
                yield row

    def inputs(self) -> Iterator[dict[str, Value]]:
        """Yield the inputs of each run by name, choices as text."""
        return (dict(zip(self.names, row, strict=True)) for row in self.values())

    def jobs(self, first: int, seeds: Iterable[int]) -> Iterator[Job]:
        """Yield the runs as jobs of these seeds, the first one with this index: what a store gives back of them."""
        return (Job(first + k, inputs, seed) for k, (inputs, seed) in enumerate(zip(self.inputs(), seeds, strict=True)))


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
    iteration: int, indices: Sequence[int], runs: Sequence[PlannedRun], seeds: Sequence[int], names: Sequence[str], warm_ups: int
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of planned runs with their indices and drawn seeds, for a store with these inputs and warm-ups."""
    plain: Iterator[_Plain]
    if isinstance(runs, PlannedPoints) and runs.names == tuple(names):
        plain = ((runs.stage, row, seed, 0, 0, None, None) for row, seed in zip(runs.values(), seeds, strict=True))
    else:
        plain = (_plain(run, names, seed) for run, seed in zip(runs, seeds, strict=True))
    for index, (stage, values, seed, chosen, level, warm_up, log_q) in zip(indices, plain, strict=True):
        shared = int(seed) % warm_ups if warm_ups and warm_up is None else warm_up
        row = (int(index), stage, int(iteration), dump_inputs(values), int(seed), chosen, level, shared, log_q)
        yield (*row, checksum_of(*row), PLANNED)


_Plain = tuple[str, list[Value], int, int, int, int | None, float | None]
"""Stage, inputs, seed, whether that was chosen, level, warm-up, log density."""


def _plain(run: PlannedRun, names: Sequence[str], drawn: int) -> _Plain:
    """Return what a store keeps of a run; `drawn` is its seed where none was chosen."""
    chosen, seed = run.seed is not None and not run.blind, drawn if run.seed is None else run.seed
    log_q = None if run.log_q is None else float(run.log_q) + 0.0  # SQLite keeps no negative zero
    return run.stage, [run.inputs[name] for name in names], seed, int(chosen), run.level, run.warm_up, log_q


def dump_inputs(values: Sequence[Value]) -> str:
    """Return the values of a run's inputs as JSON, which has finite numbers only.

    >>> dump_inputs([0.1, 2.0, "left"])
    '[0.1,2.0,"left"]'
    """
    if set(map(type, values)) != {float} or not math.isfinite(sum(values)):  # type: ignore[arg-type]
        return dump(values)
    return f"[{','.join(map(repr, values))}]"  # as JSON writes them, in a third of the time


def dump_metrics(metrics: Mapping[str, float]) -> str:
    """Return metrics as JSON, in which infinity is a number too large for a float: every reader takes it for infinity."""
    return f"{{{','.join([f'{dump(name)}:{_number(value)}' for name, value in metrics.items()])}}}"


def _number(value: float) -> str:
    if math.isfinite(value):
        return repr(value) if type(value) is float else dump(value)
    return "-1e999" if value < 0 else "1e999"
