"""What a testbed is: inputs with their law, a vectorised function, a critical interval and the truth."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector, as_points, as_vector
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream

__all__ = ["METRIC", "Function", "Input", "Problem", "Truth", "analytic", "noisy", "parameters_of"]

METRIC = "y"
"""The only metric of an analytic scenario."""

Function = Callable[[Points], Vector]
"""(n, d) physical values to (n,) metrics, each from its own row alone."""
Input = tuple[float, float] | Distribution | Parameter
"""An input: uniform between two ends, a law on its whole support, or a parameter (its name is replaced)."""


@dataclass(frozen=True)
class Truth:
    """What is known about a testbed.

    Args:
        probability: P(y in M_c) under the law of the inputs, and of the noise where there is some.
        std_error: its standard error; 0 where it is a closed form or a quadrature.
        modes: number of separate failures: local maxima of the density within the critical region, where
            the law is uniform the region's connected parts; None: not counted.
        box_fraction: share of the box that is critical, uniform measure: what a random tester sees.
        box_std_error: its standard error.
    """

    probability: float
    std_error: float
    modes: int | None
    box_fraction: float
    box_std_error: float = 0.0


@dataclass(frozen=True)
class Problem:
    """An analytic problem with known truth.

    Args:
        name: as in `testbed:NAME`.
        title: one line for people.
        parameters: the inputs; unbounded laws are not cut off.
        function: vectorised metric; its docstring has the formula and the source.
        critical: M_c.
        truth: the known answers.
        noise: standard deviation of normal noise on y, drawn from the seed of the run.
        box: (low, high) of each input for searches that ignore the law; None: the bounds of the
            parameters, which are the 1e-6 quantiles where an input is unbounded.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    function: Function
    critical: CriticalInterval
    truth: Truth
    noise: float = 0.0
    box: tuple[tuple[float, float], ...] | None = None

    def in_box(self) -> Problem:
        """Return the same problem with every input uniform in the box, for boundary work and falsification."""
        ends = self.box if self.box is not None else tuple(p.bounds for p in self.parameters)
        parameters = tuple(
            replace(p, low=low, high=high, distribution=None) for p, (low, high) in zip(self.parameters, ends, strict=True)
        )
        uniform = all(p.distribution is None for p in self.parameters)
        share, error = self.truth.box_fraction, self.truth.box_std_error
        truth = replace(self.truth, probability=share, std_error=error, modes=self.truth.modes if uniform else None)
        return replace(self, name=f"{self.name}:box", parameters=parameters, truth=truth, box=None)

    def scenario(self) -> LogicalScenario:
        """Return the logical scenario `testbed:NAME`."""
        space = ParameterSpace(self.parameters)
        return LogicalScenario(
            name=f"testbed:{self.name}", space=space, requirement=Requirement(METRIC, self.critical.low, self.critical.high),
            evaluate=_Pointwise(self.name, space.names, self.function, self.noise), metric_names=(METRIC,),
            description=f"{self.title}\n{_documentation(self.function)}",
        )  # fmt: skip


def analytic(
    function: Function,
    *,
    inputs: Mapping[str, Input],
    critical: tuple[float, float],
    name: str,
    correlation: tuple[tuple[float, ...], ...] | None = None,
    noise: float = 0.0,
    description: str = "",
) -> LogicalScenario:
    """Return a vectorised function as a logical scenario with the metric `y`.

    Args:
        function: (n, d) physical values to (n,) metrics, a column an input in the order of `inputs`.
        inputs: by name: (low, high) for a uniform law, a `Distribution` on its whole support, or a
            `Parameter` with range, unit and law (the key is its name).
        critical: (low, high) of M_c, closed; either end may be infinite.
        name: as written in reports.
        correlation: (d, d) correlation of the normal scores (Gaussian copula); None: independent.
        noise: standard deviation >= 0 of normal noise on y, drawn from the seed of the run.
        description: for people; default: the function's docstring.

    Raises:
        InputError: an input, the interval, the correlation or the noise is impossible.

    >>> scenario = analytic(
    ...     lambda x: np.hypot(x[:, 0], x[:, 1]),
    ...     inputs={"east": (-1.0, 1.0), "north": Distribution.of(kind="normal", mean=0.0, std=0.5)},
    ...     critical=(-np.inf, 0.3),
    ...     name="near_the_origin",
    ... )
    >>> scenario.run({"east": 0.3, "north": 0.4}, seed=1)
    {'y': 0.5}
    """
    if not (math.isfinite(noise) and noise >= 0):
        raise InputError(f"noise must be a finite standard deviation >= 0, but got {noise}")
    space = ParameterSpace(parameters_of(inputs), correlation)
    return LogicalScenario(
        name=name, space=space, requirement=Requirement(METRIC, *critical),
        evaluate=_Pointwise(name, space.names, function, noise), metric_names=(METRIC,),
        description=description or _documentation(function) or name,
    )  # fmt: skip


def parameters_of(inputs: Mapping[str, Input]) -> tuple[Parameter, ...]:
    """Return the parameters that `inputs` describe, in their order."""
    return tuple(_parameter(name, given) for name, given in inputs.items())


def _documentation(function: Function) -> str:
    """Return the docstring of a function, also of a partial one."""
    return inspect.getdoc(function.func if isinstance(function, partial) else function) or ""


def _parameter(name: str, given: Input) -> Parameter:
    if isinstance(given, Parameter):
        return replace(given, name=name)
    if isinstance(given, Distribution):
        return Parameter(name, -math.inf, math.inf, distribution=given)
    low, high = given
    return Parameter(name, low, high)


@dataclass(frozen=True)
class _Pointwise:
    """One concrete scenario of a vectorised function."""

    name: str
    inputs: tuple[str, ...]
    function: Function
    noise: float

    def __call__(self, values: Mapping[str, float], seed: int) -> dict[str, float]:
        x = as_points([[values[name] for name in self.inputs]], len(self.inputs))
        y = float(as_vector(self.function(x), 1)[0])
        if self.noise:
            y += self.noise * float(stream(seed, "testbed", self.name).standard_normal())
        return {METRIC: y}


def noisy(y: Vector, noise: float, rng: np.random.Generator | None) -> Vector:
    """Return y with normal noise; without an rng, y itself."""
    return y if rng is None or not noise else y + noise * rng.standard_normal(y.shape)
