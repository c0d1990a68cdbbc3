"""The structure of a testbed: inputs with their distributions, a vectorised function, a critical interval and the truth."""

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
from sbt.problem.metric import Metric
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.requirement import CriticalInterval, Requirement
from sbt.problem.scenario import LogicalScenario
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream

__all__ = [
    "METRIC", "NEGATIVE", "Function", "Input", "Problem", "Truth", "analytic", "lognormal", "noisy", "normal", "parameters_of",
    "uniform",
]  # fmt: skip

METRIC = "y"
"""The only metric of an analytic scenario."""
NEGATIVE = CriticalInterval(high=0.0)
"""The critical interval of a limit-state function."""
_COARSE = 0.4
"""Error of a coarse level of fidelity, of the noise: what both levels draw correlates by 0.93."""

Function = Callable[[Points], Vector]
"""(n, d) physical values to (n,) metrics; a row does not depend on the others."""
Input = tuple[float, float] | Distribution | Parameter
"""An input: uniform between two bounds, a distribution on its whole support, or a parameter (its name is replaced)."""


@dataclass(frozen=True)
class Truth:
    """The reference values of a testbed.

    Args:
        probability: P(y in M_c) under the distribution of the inputs, and of the noise if there is any.
        std_error: its standard error; 0 for a closed form or a quadrature.
        modes: number of separate failures: local maxima of the density within the critical region or, for uniform
            inputs, its connected components; None: not counted.
        box_fraction: critical fraction of the box under the uniform distribution.
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
        parameters: the inputs; unbounded distributions are not truncated.
        function: vectorised metric; its docstring has the formula and the source.
        critical: M_c.
        truth: reference values.
        noise: standard deviation of normal noise on y, drawn from the seed of the run, or a function of x.
        box: (low, high) of each input for searches that do not use the distribution; None: the bounds of the
            parameters, which are the 1e-6 quantiles if an input is unbounded.
        error: standard deviation of a further normal error, drawn from the seed of the run: that of a coarse level of fidelity.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    function: Function
    critical: CriticalInterval
    truth: Truth
    noise: float | Function = 0.0
    box: tuple[tuple[float, float], ...] | None = None
    error: float = 0.0

    def in_box(self) -> Problem:
        """Return the same problem with all inputs uniform in the box, for boundary identification and falsification."""
        ends = self.box if self.box is not None else tuple(p.bounds for p in self.parameters)
        parameters = tuple(
            replace(p, low=low, high=high, distribution=None) for p, (low, high) in zip(self.parameters, ends, strict=True)
        )
        uniform = all(p.distribution is None for p in self.parameters)
        share, error = self.truth.box_fraction, self.truth.box_std_error
        truth = replace(self.truth, probability=share, std_error=error, modes=self.truth.modes if uniform else None)
        return replace(self, name=f"{self.name}:box", parameters=parameters, truth=truth, box=None)

    def coarse(self) -> Problem:
        """Return a coarse level of fidelity of a noisy problem: the same noise for the same seed, and an error of 40 % of it.

        Raises:
            InputError: the noise is not everywhere equal.
        """
        if callable(self.noise):
            raise InputError(f"a coarse level needs noise that is everywhere equal, but that of {self.name} is not")
        return replace(self, error=_COARSE * self.noise)

    def scenario(self) -> LogicalScenario:
        """Return the logical scenario `testbed:NAME`."""
        space = ParameterSpace(self.parameters)
        return LogicalScenario(
            name=f"testbed:{self.name}", space=space, requirement=Requirement(METRIC, self.critical.low, self.critical.high),
            evaluate=_Pointwise(self.name, space.names, self.function, self.noise, self.error),
            metrics=(Metric(METRIC, direction="high" if math.isinf(self.critical.high) else "low"),),
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
        function: (n, d) physical values, columns in the order of `inputs`, to (n,) metrics.
        inputs: by name: (low, high) for a uniform distribution, a `Distribution` on its whole support, or a
            `Parameter` with range, unit and distribution (the key is its name).
        critical: (low, high) of M_c, closed; either bound may be infinite.
        name: of the scenario, for reports.
        correlation: (d, d) correlation of the normal scores (Gaussian copula); None: independent.
        noise: standard deviation >= 0 of normal noise on y, drawn from the seed of the run.
        description: for people; default: the function's docstring.

    Raises:
        InputError: an input, the interval, the correlation or the noise is invalid.

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
    """Return the docstring of a function or of a partial of one."""
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
    noise: float | Function
    error: float = 0.0

    def __call__(self, values: Values, seed: int) -> dict[str, float]:
        x = as_points([[values[name] for name in self.inputs]], len(self.inputs))
        rng = stream(seed, "testbed", self.name) if self.noise else None
        y = float(noisy(as_vector(self.function(x), 1), x, self.noise, rng)[0])
        if self.error:
            y += self.error * float(stream(seed, "coarse", self.name).standard_normal())
        return {METRIC: y}


def normal(mean: float, std: float) -> Distribution:
    """Return a normal distribution."""
    return Distribution.of(kind="normal", mean=mean, std=std)


def lognormal(mean: float, std: float) -> Distribution:
    """Return a lognormal distribution with this mean and standard deviation."""
    return Distribution.of(kind="lognormal", mean=mean, std=std)


def uniform(name: str, title: str, d: int, function: Function, share: float, error: float = 0.0) -> Problem:
    """Return a testbed with d uniform inputs on the unit cube, one region and y <= 0 critical in this share of it."""
    inputs = parameters_of({f"x{k + 1}": (0.0, 1.0) for k in range(d)})
    return Problem(name, title, inputs, function, NEGATIVE, Truth(share, error, 1, share, error))


def noisy(y: Vector, x: Points, noise: float | Function, rng: np.random.Generator | None) -> Vector:
    """Return y (n,) at x (n, d) with normal noise; without an rng, y itself."""
    if rng is None or not noise:
        return y
    return y + (noise(x) if callable(noise) else noise) * rng.standard_normal(y.shape)
