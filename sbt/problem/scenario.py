"""A logical scenario: inputs, how a concrete one runs, what is measured, and what is required."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sbt.errors import InputError, RunError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

__all__ = ["Batched", "Configurable", "LogicalScenario", "Metric", "Pool", "Roles", "Simulate"]


class Simulate(Protocol):
    """Runs one concrete scenario; same values and seed, same trace, in any process."""

    def __call__(self, values: Mapping[str, float], seed: int) -> Trace:
        """Return the trace; raise `RunError` where the run cannot give one."""
        ...


@runtime_checkable
class Batched(Protocol):
    """A `Simulate` that can run several concrete scenarios at once."""

    @property
    def batched(self) -> bool:
        """Whether it does, as it is configured."""
        ...

    def simulate_many(
        self, work: Sequence[tuple[Mapping[str, float], int]], at_work: Callable[[Sequence[int]], None] = ...
    ) -> list[Trace | BaseException]:
        """Return the trace, or the error, of each of these values and seeds: the same as one by one.

        `at_work` is told, again and again, which of them are being run.
        """
        ...


@runtime_checkable
class Configurable(Protocol):
    """A `Simulate` that offers choices: the AV under test, the isolation level, the step."""

    isolations: tuple[str, ...]
    step_length: float

    def prepare(self) -> None:
        """Load what is slow to load, before the first run."""
        ...

    def limited(self, timeout: float | None) -> Simulate:
        """Return a copy whose runs end as `timeout` after so many wall-clock seconds."""
        ...

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> Simulate:
        """Return a copy with these choices; None leaves one as it is, isolation `auto` is the fastest allowed."""
        ...


@dataclass(frozen=True)
class Metric:
    """A named function of a trace.

    Args:
        name: as written in requirements and in the store (`y.<name>`).
        function: trace to a finite number.
        unit: "" for a pure number or a flag.
        direction: "low" where small values are critical, "high" where large ones are.
        without: the value where there was no interaction to measure.
        description: one sentence.
        source: reference of the definition.
        alone: it measures the ego alone, whoever else is there.
        over_time: trace to (t,) values whose worst is the metric; for one that knows, of an instant, what came after it, and
            that therefore cannot be told from the trace up to there.
    """

    name: str
    function: Callable[[Trace], float]
    unit: str = ""
    direction: str = "low"
    without: float = math.inf
    description: str = ""
    source: str = ""
    alone: bool = False
    over_time: Callable[[Trace], Vector] | None = None

    def __call__(self, trace: Trace) -> float:
        """Return the metric of a trace.

        Raises:
            RunError: the value is not finite.
        """
        value = float(self.function(trace))
        if not math.isfinite(value):
            raise RunError(Status.FAILED, f"metric {self.name} must be finite, but got {value}")
        return value


@dataclass(frozen=True, eq=False)
class Pool:
    """Recorded outcomes to choose among instead of simulating: x (n, d), metrics of (n,) each."""

    x: Points
    metrics: Mapping[str, Vector]

    @cached_property
    def _rows(self) -> dict[bytes, int]:
        return {row.tobytes(): k for k, row in enumerate(self.x)}

    def row(self, x: Vector) -> int | None:
        """Return the index of the row with exactly these inputs, None where there is none."""
        return self._rows.get(np.ascontiguousarray(x, dtype=np.float64).tobytes())

    def taken(self, x: Points) -> Mask:
        """Return (n,) booleans: the row is among the points (m, d)."""
        mask = np.zeros(len(self.x), dtype=bool)
        mask[[k for k in map(self.row, x) if k is not None]] = True
        return mask


@dataclass(frozen=True)
class Roles:
    """Whom the bare signals of a formula speak of (`sbt.metrics.stl`).

    Args:
        ego: the road user under test.
        other: the other one; None: all others, the worst at every instant.
        margin: lateral clearance below which the other is in ego's path (m).
    """

    ego: str = "ego"
    other: str | None = "co"
    margin: float = 0.0


@dataclass(frozen=True)
class LogicalScenario:
    """A parametrized traffic situation and its requirement.

    Args:
        name: as written in configurations.
        space: the inputs.
        simulate: values and seed to a trace; None where `evaluate` is given.
        metrics: computed from the trace; the requirement's is one of them.
        requirement: default requirement.
        description: for people; the first line is a title.
        evaluate: values and seed to metrics directly (analytic functions, recorded tables), instead
            of `simulate`: there is no trace to look at.
        metric_names: the metrics that `evaluate` gives.
        pool: recorded outcomes; campaigns then choose among these rows only.
        roles: of the actors, for formulas as requirements.

    Raises:
        InputError: neither or both of simulate and evaluate, or a requirement on an absent metric.
    """

    name: str
    space: ParameterSpace
    requirement: Requirement
    simulate: Simulate | None = None
    metrics: tuple[Metric, ...] = ()
    description: str = ""
    evaluate: Callable[[Mapping[str, float], int], Mapping[str, float]] | None = None
    metric_names: tuple[str, ...] = ()
    pool: Pool | None = None
    roles: Roles = Roles()

    def __post_init__(self) -> None:
        if (self.simulate is None) == (self.evaluate is None):
            raise InputError(f"scenario {self.name}: give either simulate or evaluate")
        if self.requirement.metric not in self.measured:
            raise InputError(
                f"requirement.metric must be one of {', '.join(self.measured)}, but got '{self.requirement.metric}'"
            )

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the metrics that every run gives."""
        return self.metric_names if self.evaluate is not None else tuple(m.name for m in self.metrics)

    @property
    def isolations(self) -> tuple[str, ...]:
        """Isolation levels that are allowed, the fastest last; empty where there is no SUMO."""
        return self.simulate.isolations if isinstance(self.simulate, Configurable) else ()

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> LogicalScenario:
        """Return a copy with another AV under test, isolation level or step length.

        Raises:
            InputError: the scenario does not offer the choice.
        """
        if ego is None and step_length is None and (isolation in (None, "auto") or not self.isolations):
            return self
        if not isinstance(self.simulate, Configurable):
            raise InputError(f"scenario {self.name} offers no choice of ego or step length")
        simulate = self.simulate.configured(ego, isolation, step_length)
        return replace(self, simulate=simulate, space=self._space_with(getattr(simulate, "inputs", ())))

    def _space_with(self, inputs: tuple[Parameter, ...]) -> ParameterSpace:
        """Return the space with these inputs of an AV under test in place of those of the present one."""
        present = {p.name for p in getattr(self.simulate, "inputs", ())}
        kept = tuple(p for p in self.space.parameters if p.name not in present)
        if not present and not inputs:
            return self.space
        return replace(self.space, parameters=(*kept, *inputs))

    def limited(self, timeout: float | None) -> LogicalScenario:
        """Return a copy whose runs look at the clock, where the scenario can."""
        if timeout is None or not isinstance(self.simulate, Configurable):
            return self
        return replace(self, simulate=self.simulate.limited(timeout))

    def prepare(self) -> None:
        """Load what is slow to load, before the first run."""
        if isinstance(self.simulate, Configurable):
            self.simulate.prepare()

    def measure(self, trace: Trace) -> dict[str, float]:
        """Return every metric of a trace by name."""
        return {metric.name: metric(trace) for metric in self.metrics}

    def run(self, values: Mapping[str, float], seed: int) -> dict[str, float]:
        """Run one concrete scenario and return its metrics.

        Raises:
            RunError: it gives none; the error says which `Status` the run has.
        """
        if self.simulate is not None:
            return self.measure(self.simulate(values, seed))
        if self.evaluate is None:
            raise InputError(f"scenario {self.name}: give either simulate or evaluate")
        metrics = {name: float(value) for name, value in self.evaluate(values, seed).items()}
        for name, value in metrics.items():
            if not math.isfinite(value):
                raise RunError(Status.FAILED, f"metric {name} must be finite, but got {value}")
        return metrics
