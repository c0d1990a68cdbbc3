"""A logical scenario: inputs, how a concrete one runs, what is measured, and what is required."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol, runtime_checkable

from sbt.errors import InputError, RunError, did_you_mean, must_be, must_take
from sbt.problem.evenness import spread_evenly
from sbt.problem.metric import Metric, meaningful, measured, metric_from
from sbt.problem.outcome import Status
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.pool import Pool
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

__all__ = ["Batched", "Configurable", "Evaluate", "LogicalScenario", "Metric", "Pool", "Roles", "Simulate", "metric_from"]

Evaluate = Callable[[Any, int], Mapping[str, float]]
"""(values, seed) -> metrics by name; values are a mapping of inputs by name, text where they are choices."""


class Simulate(Protocol):
    """Runs one concrete scenario; same values and seed, same trace, in any process."""

    def __call__(self, values: Values, seed: int) -> Trace:
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
        self, work: Sequence[tuple[Values, int]], at_work: Callable[[Sequence[int]], None] = ...
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


@runtime_checkable
class OnRoads(Protocol):
    """A `Simulate` whose vehicles drive on roads with a friction."""

    def with_friction(self, low: float, high: float) -> Simulate:
        """Return a copy on roads of this coefficient of friction, an input where it is a range."""
        ...


@dataclass(frozen=True)
class Roles:
    """Whom the bare signals of a formula speak of (`sbt.metrics.stl`).

    Args:
        ego: the road user under test.
        other: the other one; None: all others, the worst at every instant.
        margin: lateral clearance below which the other is in ego's path (m).
        not_judged: why reference drivers, which keep their lane and only brake, cannot stand in for ego; "": they can.
        also_tested: further vehicles under test, for which they stand in too.
    """

    ego: str = "ego"
    other: str | None = "co"
    margin: float = 0.0
    not_judged: str = ""
    also_tested: tuple[str, ...] = ()


@dataclass(frozen=True, init=False)
class LogicalScenario:
    """A parametrized traffic situation and its requirement.

    Args:
        name: as written in configurations.
        inputs: the parameter space, or its parameters where they are independent and unconstrained.
        requirement: default requirement.
        simulate: values and seed to a trace; None where `evaluate` is given.
        metrics: with `simulate`, what is computed from the trace: metrics, names of installed ones, or functions of a
            trace; with `evaluate`, what it returns: names, names with units (a mapping), or `Metric(name, unit=...)` (default:
            the requirement's metric alone).
        description: for people; the first line is a title.
        evaluate: values and seed to metrics directly (analytic functions, recorded tables), instead
            of `simulate`: there is no trace to look at.
        metric_names: the metrics that `evaluate` gives, as `metrics`.
        pool: recorded outcomes; campaigns then choose among these rows only.
        roles: of the actors, for formulas as requirements.
        space: the parameter space, in place of `inputs`.

    Raises:
        InputError: neither or both of simulate and evaluate, no inputs, or a requirement on an absent metric.

    >>> scenario = LogicalScenario("disc", [Parameter("a", -1, 1, "m")], Requirement("gap", high=0.0),
    ...                            evaluate=lambda values, seed: {"gap": values["a"] ** 2 - 0.5})
    >>> scenario.run({"a": 0.5}, seed=0)
    {'gap': -0.25}
    """

    name: str
    space: ParameterSpace
    requirement: Requirement
    simulate: Simulate | None = None
    metrics: tuple[Metric, ...] = ()
    description: str = ""
    evaluate: Evaluate | None = None
    metric_names: tuple[str, ...] = ()
    pool: Pool | None = None
    roles: Roles = Roles()

    def __init__(
        self, name: str, inputs: ParameterSpace | Sequence[Parameter] | None = None, requirement: Requirement | None = None,
        simulate: Simulate | None = None, metrics: Sequence[Metric | str | Callable[[Trace], float]] | Mapping[str, str] = (),
        description: str = "",
        evaluate: Evaluate | None = None, metric_names: Sequence[str] = (), pool: Pool | None = None, roles: Roles = Roles(), *,
        space: ParameterSpace | None = None,
    ):  # fmt: skip
        if not (isinstance(name, str) and name.strip() and name.isprintable()):
            raise InputError(f"a scenario's name must be text on one line, but got {name!r}")
        given = space if inputs is None else inputs
        if (inputs is None) == (space is None) or given is None:
            raise InputError(f"scenario {name}: give the inputs (or a space) once")
        if not isinstance(requirement, Requirement):
            raise InputError(f"scenario {name}: a requirement is needed, such as Requirement('ttc_min', high=1.0)")
        if isinstance(given, Parameter) or not isinstance(given, ParameterSpace | Iterable):
            got = f"the parameter {given.name}" if isinstance(given, Parameter) else repr(given)
            raise InputError(f"scenario {name}: inputs must be a list of parameters, but got {got}")
        if (simulate is None) == (evaluate is None):
            raise InputError(f"scenario {name}: give either simulate or evaluate")
        runs = simulate if evaluate is None else evaluate
        if not callable(runs):
            raise InputError(f"scenario {name}: what simulates or evaluates must be a function of values and seed")
        must_take(f"scenario {name}: what simulates or evaluates must take values and seed", runs, 2)
        must_be(f"scenario {name}: metrics must be a list", metrics, list, tuple, Mapping)
        if evaluate is not None:
            metrics = _returned(name, metrics, tuple(metric_names) or tuple(part.metric for part in requirement.parts))
            metric_names = [m.name for m in metrics]
        values = {
            "name": name, "space": given if isinstance(given, ParameterSpace) else ParameterSpace(tuple(given)),
            "requirement": requirement, "simulate": simulate, "metrics": tuple(map(_directed, metrics)),
            "description": description, "evaluate": evaluate, "metric_names": tuple(metric_names), "pool": pool, "roles": roles,
        }  # fmt: skip
        for key, value in values.items():
            object.__setattr__(self, key, value)
        doubled = [m for k, m in enumerate(self.measured) if m in self.measured[:k]]
        if doubled:
            raise InputError(f"scenario {name}: metrics must have different names, but got '{doubled[0]}' twice")
        for part in requirement.parts:
            if part.metric not in self.measured:
                known, hint = ", ".join(self.measured), did_you_mean(part.metric, self.measured)
                raise InputError(f"requirement.metric must be one of {known}, but got '{part.metric}'{hint}")

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the metrics that every run gives."""
        return self.metric_names if self.evaluate is not None else tuple(m.name for m in self.metrics)

    @property
    def unit(self) -> str:
        """Unit of the requirement's metric, "" where it is not known."""
        return next((m.unit for m in self.metrics if m.name == self.requirement.metric), "")

    @property
    def units(self) -> dict[str, str]:
        """Units of inputs and metrics, by name; of a metric with the name of an input as `y.NAME` (`unit_of`)."""
        inputs = {p.name: p.unit for p in self.space.parameters}
        return inputs | {f"y.{m.name}" if m.name in inputs else m.name: m.unit for m in self.metrics}

    @property
    def direction(self) -> str:
        """`low` where small values of the requirement's metric are bad, `high` where large ones are.

        Of a metric that `evaluate` gives the requirement says so, where M_c has no upper end.
        """
        need = self.requirement
        if self.evaluate is not None and not need.combined and need.critical.one_sided and need.critical.outward < 0.0:
            return "high"
        return next((m.direction for m in self.metrics if m.name == need.metric), "low")

    @cached_property
    def uneven(self) -> str:
        """Why shares of a recorded table's rows are none of the space; "" where rows are spread evenly, or any run can be had."""
        if self.pool is None or self.pool.even:
            return ""
        if self.pool.even is False:
            return "they were chosen otherwise"
        crowd = "they seem to crowd in parts of it; spread_evenly: true in config.yml says that they do not"
        return "" if spread_evenly(self.space, self.pool.x) else crowd

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

    def with_friction(self, low: float, high: float) -> LogicalScenario:
        """Return a copy on roads of this coefficient of friction, an input where it is a range.

        Raises:
            InputError: the scenario has no roads.
        """
        if not isinstance(self.simulate, OnRoads):
            raise InputError(f"scenario {self.name} offers no choice of friction")
        if not 0 < low <= high < math.inf:
            raise InputError(f"friction must be > 0, in a range 0 < min <= max, but got {low:g} to {high:g}")
        simulate = self.simulate.with_friction(low, high)
        return replace(self, simulate=simulate, space=self._space_with(getattr(simulate, "inputs", ())))

    def _space_with(self, inputs: tuple[Parameter, ...]) -> ParameterSpace:
        """Return the space with these inputs of an AV under test in place of those of the present one."""
        return self.space.extended(inputs, without={p.name for p in getattr(self.simulate, "inputs", ())})

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
        seen = trace.measured
        return measured({metric.name: partial(metric, seen) for metric in self.metrics})

    def run(self, values: Values, seed: int) -> dict[str, float]:
        """Run one concrete scenario and return its metrics.

        Raises:
            RunError: it gives none; the error says which `Status` the run has.
        """
        values = {name: value if isinstance(value, str) else float(value) for name, value in values.items()}
        if self.simulate is not None:
            return self.measure(self.simulate(values, seed))
        if self.evaluate is None:
            raise InputError(f"scenario {self.name}: give either simulate or evaluate")
        return _checked(self.evaluate(values, seed), self.metric_names)


def _directed(given: Metric | str | Callable[[Trace], float]) -> Metric:
    """Return a metric that says on which side values are critical."""
    metric = metric_from(given)
    if metric.direction not in ("low", "high"):
        raise InputError(f"metric {metric.name}: direction must be 'low' or 'high', but got {metric.direction!r}")
    return metric


def _returned(
    scenario: str, metrics: Sequence[Metric | str | Callable[[Trace], float]] | Mapping[str, str], names: tuple[str, ...]
) -> tuple[Metric, ...]:
    """Return the metrics that `evaluate` gives, with their units where they are stated."""
    if isinstance(metrics, Mapping):
        return tuple(Metric(str(name), unit=str(unit)) for name, unit in metrics.items())
    found = []
    for given in metrics:
        if not isinstance(given, str | Metric) or (isinstance(given, Metric) and given.function is not None):
            raise InputError(f"scenario {scenario}: with evaluate, metrics are the names of what it returns, but got {given!r}")
        found.append(Metric(given) if isinstance(given, str) else given)
    return tuple(found) or tuple(Metric(name) for name in names)


def _checked(returned: Any, names: tuple[str, ...]) -> dict[str, float]:
    """Return the metrics of a run by name.

    Raises:
        RunError: what was returned is no mapping with exactly these names and finite numbers.
    """
    if not isinstance(returned, Mapping):
        raise RunError(Status.FAILED, f"a run must return its metrics by name, but got {type(returned).__name__}")
    if set(returned) != set(names):
        given = [str(name) for name in returned]
        hint = f"; declare all of them: metrics={given}" if set(names) < set(given) else ""
        rule = f"a run must give the metrics {', '.join(names)}"
        raise RunError(Status.FAILED, f"{rule}, but gave {', '.join(given) or 'none'}{hint}")
    return measured({name: partial(meaningful, name, returned[name]) for name in names})
