"""The parameter space of a logical scenario and its maps: physical x, unit cube u, standard normal z."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from sbt.errors import InputError, did_you_mean, must_be
from sbt.problem.arrays import Mask, Points, Vector, as_points
from sbt.problem.cells import JoinedCells
from sbt.problem.cube import Cube
from sbt.problem.expression import Expression
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Value, Values, written

__all__ = ["ParameterSpace"]

Formula = Callable[[Mapping[str, Any]], Any]
_MASS_POINTS, _MOST_MASS_POINTS = 2**15, 2**22
_ADMISSIBLE = 20_000  # points that a mass is told by: its error is below 1 %
_MIN_FEASIBLE = 1e-3
_FEW = 4096  # combinations that are kept account of
_SCORES_LEAST, _SCORES_MOST = 64, 2**17  # candidates of which admissible scores are kept, at once
_FAR_SCORES, _TOLD = np.arange(5.0, 38.01, 0.05), 0.5
"""Normal scores up to that from which on float64 knows no probability, and by how much a value may miss its own."""


@dataclass(frozen=True)
class ParameterSpace:
    """d inputs, joined by a Gaussian copula, restricted by constraints.

    Args:
        parameters: the inputs, in the order of the columns of every (n, d) array.
        correlation: (d, d) correlation of the inputs' normal scores as nested tuples; None:
            independent. This is the copula's matrix, not the correlation of the values.
        constraints: (text, predicate) pairs; a concrete scenario must satisfy all of them. Predicates and formulas get
            the (n,) column of each input by name, choices as text.
        features: (name, formula) pairs, quantities derived from the inputs that metamodels see as
            further columns; they change no range and no density.

    Raises:
        InputError: no or doubled names, a matrix that is no correlation matrix or correlates an input with choices, a formula
            that takes choices for numbers, or constraints that less than 1 in 1,000 points of the box satisfy.
    """

    parameters: tuple[Parameter, ...]
    correlation: tuple[tuple[float, ...], ...] | None = None
    constraints: tuple[tuple[str, Formula], ...] = ()
    features: tuple[tuple[str, Formula], ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.parameters:
            raise InputError("a parameter space needs at least one input, but got none")
        for one in self.parameters:
            must_be("inputs must be a list of parameters, such as [Parameter('gap', 5, 60, 'm')]", one, Parameter)
        for pair in (*self.constraints, *self.features):
            must_be("a constraint or feature is a pair of its text and a function of columns", pair, tuple)
        if len(set(self.names)) != len(self.names):
            raise InputError(f"inputs must have different names, but got {', '.join(self.names)}")
        if self.correlation is not None:
            self._check_correlation()
        for _, formula in (*self.constraints, *self.features):
            if isinstance(formula, Expression):
                self.check_formula(formula)
        if self.constraints and self._feasible_share < _MIN_FEASIBLE:
            raise InputError(f"constraints must leave at least {_MIN_FEASIBLE:g} of the box, but '{self.rules}' leave less")

    def _check_correlation(self) -> None:
        matrix = np.asarray(self.correlation, dtype=np.float64)
        d = self.dimension
        if matrix.shape != (d, d) or not np.allclose(matrix, matrix.T) or not np.allclose(np.diag(matrix), 1.0):
            raise InputError(f"correlation must be a symmetric ({d}, {d}) matrix with ones on its diagonal")
        if not np.linalg.eigvalsh(matrix)[0] > 1e-10:
            raise InputError("correlation must be positive definite, but it is not")
        for k, p in enumerate(self.parameters):
            if p.choices and np.count_nonzero(matrix[k]) > 1:
                raise InputError(f"an input with choices has no order to correlate by, but {p.name} is in a correlation")

    def check_formula(self, formula: Expression) -> None:
        """Refuse a formula that takes choices for numbers, numbers for choices, or compares with an unknown choice.

        Raises:
            InputError: it does.
        """
        known = {p.name: p for p in self.parameters}
        for name in formula.numbers():
            if name in known and known[name].choices:
                rule = f"it can only be compared with one of them, such as {name} == '{known[name].choices[0]}'"
                raise InputError(f"'{name}' in '{formula.text}' is an input with choices: {rule}")
        for name, choice in formula.choices():
            if name in known and not known[name].choices:
                raise InputError(f"'{name}' in '{formula.text}' is a number, but is compared with the text '{choice}'")
            if name in known:
                known[name].number(choice)

    def extended(self, inputs: tuple[Parameter, ...], without: Collection[str] = ()) -> ParameterSpace:
        """Return the space with further inputs, independent of the others, and without some.

        Raises:
            InputError: there would be two inputs of one name.
        """
        kept = [k for k, name in enumerate(self.names) if name not in without]
        if not inputs and len(kept) == self.dimension:
            return self
        correlation = None
        if self.correlation is not None:
            matrix = np.eye(len(kept) + len(inputs))
            matrix[: len(kept), : len(kept)] = np.asarray(self.correlation)[np.ix_(kept, kept)]
            correlation = tuple(map(tuple, matrix.tolist()))
        return replace(self, parameters=(*(self.parameters[k] for k in kept), *inputs), correlation=correlation)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of the columns."""
        return tuple(p.name for p in self.parameters)

    @property
    def dimension(self) -> int:
        """Number of inputs d."""
        return len(self.parameters)

    @cached_property
    def cube(self) -> Cube:
        """Where in the unit cube the values of whole-number inputs and choices lie."""
        counts = [(k, len(p.choices), round(p.high - p.low) + 1) for k, p in enumerate(self.parameters) if p.discrete]
        return Cube(tuple((k, n) for k, m, n in counts if not m), tuple((k, m) for k, m, _ in counts if m))

    @cached_property
    def combinations(self) -> Points | None:
        """The feasible combinations (m, d) of whole numbers and choices, in the unit cube; None where they are not few."""
        feasible = (lambda u: self.feasible(self.from_unit(u))) if self.constraints else None
        return self.cube.combinations(self.dimension, _FEW, feasible)

    @cached_property
    def choices(self) -> dict[str, tuple[str, ...]]:
        """The choices of the inputs that have some, by name."""
        return {p.name: p.choices for p in self.parameters if p.choices}

    def named(self, x: Vector) -> dict[str, Value]:
        """Return the (d,) numbers of a point as values by name, choices as text."""
        values = dict(zip(self.names, np.asarray(x, dtype=np.float64).tolist(), strict=True))
        return values | {name: choices[int(values[name])] for name, choices in self.choices.items()}

    def numbers(self, values: Values) -> Vector:
        """Return the (d,) numbers of values by name, a choice as its position.

        Raises:
            InputError: one is no choice, or no number.
        """
        return np.array([p.number(values[p.name]) for p in self.parameters])

    @cached_property
    def _factor(self) -> Points | None:
        return None if self.correlation is None else np.linalg.cholesky(np.asarray(self.correlation))

    @cached_property
    def _joined(self) -> JoinedCells | None:
        return None if self.correlation is None else JoinedCells.of(self.parameters, self.correlation)

    @property
    def joined(self) -> bool:
        """Whether a whole-number input is in a correlation."""
        return self._joined is not None

    @cached_property
    def correlated(self) -> frozenset[str]:
        """Names of the inputs that are in a correlation."""
        rows = np.eye(self.dimension) if self.correlation is None else np.asarray(self.correlation)
        return frozenset(name for name, row in zip(self.names, rows, strict=True) if np.count_nonzero(row) > 1)

    @property
    def uncounted(self) -> tuple[str, ...]:
        """Names of correlated whole-number inputs that are too many for the probability of a combination to be computed."""
        return () if self._joined is None else self._joined.too_many

    @cached_property
    def _feasible_share(self) -> float:
        """Share of the box (uniform measure) that satisfies the constraints."""
        u = _even_points(self.dimension, _MASS_POINTS)
        return float(self.feasible(self.from_unit(u)).mean())

    @cached_property
    def feasible_mass(self) -> float:
        """Probability of the constraints under the distribution (1 without constraints).

        By Sobol points: 32,768, and on until 20,000 are admissible, or there are four million.
        """
        if not self.constraints:
            return 1.0
        from scipy.special import ndtri
        from scipy.stats import qmc

        sobol, inside, n = qmc.Sobol(self.dimension, scramble=True, rng=0), 0, 0
        while n < _MASS_POINTS or (inside < _ADMISSIBLE and n < _MOST_MASS_POINTS):
            for _ in range(max(n // _MASS_POINTS, 1)):  # powers of two in all are even
                z = ndtri(np.clip(sobol.random(_MASS_POINTS), 1e-12, 1 - 1e-12))
                inside += int(self.feasible(self.from_normal(z)).sum())
            n = max(2 * n, _MASS_POINTS)
        if inside == 0:
            raise InputError("constraints must have mass under the inputs' distribution, but they have none")
        return inside / n

    def columns(self, x: Points) -> dict[str, Any]:
        """Return the (n,) column of each input by name, choices as text."""
        return {p.name: _column(p, x[:, k]) for k, p in enumerate(self.parameters)}

    def feasible(self, x: Points) -> Mask:
        """Return (n,) booleans: in the ranges and all constraints hold."""
        return np.asarray(np.all([p.contains(x[:, k]) for k, p in enumerate(self.parameters)], axis=0) & self.satisfied(x))

    def satisfied(self, x: Points) -> Mask:
        """Return (n,) booleans: all constraints hold."""
        mask = np.ones(len(x), dtype=bool)
        for _, predicate in self.constraints:
            mask &= np.asarray(predicate(self.columns(x)), dtype=bool)
        return mask

    @property
    def rules(self) -> str:
        """The constraints as text."""
        return "; ".join(text for text, _ in self.constraints)

    def from_unit(self, u: Points) -> Points:
        """Map (n, d) unit-cube coordinates to physical values, along the ranges (not the distribution)."""
        u = as_points(u, self.dimension)
        return np.column_stack([p.from_unit(u[:, k]) for k, p in enumerate(self.parameters)])

    def to_unit(self, x: Points) -> Points:
        """Map (n, d) physical values to the unit cube, the inverse of `from_unit`."""
        x = as_points(x, self.dimension)
        return np.column_stack([p.to_unit(x[:, k]) for k, p in enumerate(self.parameters)])

    def from_normal(self, z: Points) -> Points:
        """Map (n, d) independent standard-normal scores to physical values under the distribution."""
        z = as_points(z, self.dimension)
        if self._factor is not None:
            z = z @ self._factor.T
        return np.column_stack([p.from_normal(z[:, k]) for k, p in enumerate(self.parameters)])

    def to_normal(self, x: Points) -> Points:
        """Map (n, d) physical values to independent standard-normal scores, finite also at the ends of a range."""
        scores = self._scores(as_points(x, self.dimension))
        if self._factor is None:
            return scores
        return np.ascontiguousarray(solve_triangular(self._factor, scores.T, lower=True).T)

    def _scores(self, x: Points) -> Points:
        """Return the (n, d) normal scores of each input alone, none farther than values can tell.

        Near an end of a range all scores from about 8 on have the same value: that of the end is infinite, and a point that
        nothing comes near.
        """
        scores = np.column_stack([p.to_normal(x[:, k]) for k, p in enumerate(self.parameters)])
        return np.clip(scores, *self._told)

    @cached_property
    def _told(self) -> tuple[Vector, Vector]:
        """(d,) smallest and largest normal scores that an input's values tell to within a half."""
        ends = []
        for p in self.parameters:
            for z in (-_FAR_SCORES, _FAR_SCORES):
                told = np.zeros_like(z) if p.discrete else p.to_normal(p.from_normal(z)) - z
                lost = np.flatnonzero(np.abs(told) > _TOLD)
                ends.append(float(z[max(lost[0] - 1, 0)] if len(lost) else z[-1]))
        return np.array(ends[::2]), np.array(ends[1::2])

    def log_density(self, x: Points) -> Vector:
        """Return (n,) log p(x): the marginals, the copula, the constraints.

        -inf outside the ranges and constraints. With integer inputs and choices it is a density in the
        continuous and a mass in the others; of integers that are `uncounted` the copula term is that of the cell's middle.
        """
        x = as_points(x, self.dimension)
        if self._joined is not None and not self.uncounted:
            log_p = self._joined.log_density(x, self._scores(x))
        else:
            log_p = self._log_density(x)
        if self.constraints:
            log_p = np.where(self.feasible(x), log_p - np.log(self.feasible_mass), -np.inf)
        return log_p

    def log_density_in_cube(self, u: Points) -> Vector:
        """Return (n,) the log density of the inputs as one of the unit cube, but for a constant, at its points u (n, d)."""
        x = self.from_unit(u)
        return self.log_density(x) + self.log_stretch(x)

    def log_stretch(self, x: Points) -> Vector:
        """Return (n,) log dx/du at values x (n, d), but for what is the same everywhere: of inputs over decades their log."""
        decades = [k for k, p in enumerate(self.parameters) if p.logarithmic]
        return np.asarray(np.log(np.maximum(x[:, decades], np.finfo(np.float64).tiny)).sum(axis=1))

    def _log_density(self, x: Points) -> Vector:
        log_p = np.sum([p.log_density(x[:, k]) for k, p in enumerate(self.parameters)], axis=0)
        if self._factor is not None:
            scores = self._scores(x)
            whitened = solve_triangular(self._factor, scores.T, lower=True)
            log_p += 0.5 * (scores**2).sum(axis=1) - 0.5 * (whitened**2).sum(axis=0)
            log_p -= np.log(np.diag(self._factor)).sum()
        return np.asarray(log_p)

    def sample(self, n: int, rng: np.random.Generator) -> Points:
        """Return (n, d) values drawn from the distribution, constraints included (by rejection)."""
        kept: list[Points] = []
        missing = n
        while missing > 0:
            x = self.from_normal(rng.standard_normal((max(missing, 16), self.dimension)))
            x = x[self.feasible(x)][:missing] if self.constraints else x[:missing]
            kept.append(x)
            missing -= len(x)
        return np.vstack(kept) if kept else np.empty((0, self.dimension))

    def sample_scores(self, n: int, rng: np.random.Generator) -> Points:
        """Return (n, d) independent standard-normal scores of values drawn from the distribution, constraints included."""
        kept: list[Points] = []
        missing = n
        while self.constraints and missing > 0:
            z = rng.standard_normal((int(min(missing / self.feasible_mass + _SCORES_LEAST, _SCORES_MOST)), self.dimension))
            kept.append(z[self.feasible(self.from_normal(z))][:missing])
            missing -= len(kept[-1])
        return np.concatenate(kept) if kept else rng.standard_normal((n, self.dimension))

    def metamodel_inputs(self, u: Points) -> Points:
        """Return (n, e + f) columns for a metamodel: the embedded point (see `Cube`) and the derived features in [0, 1].

        A feature is scaled by its range over 4,096 Sobol points of the box.
        """
        own = self.cube.embedded(u)
        if not self.features:
            return own
        ranges = self._feature_ranges
        columns = self.columns(self.from_unit(u))
        derived = [(np.asarray(f(columns)) - lo) / (hi - lo) for (_, f), (lo, hi) in zip(self.features, ranges, strict=True)]
        return np.column_stack([own, *derived])

    def metamodel_inputs_at(self, x: Points) -> Points:
        """Return `metamodel_inputs` of values x (n, d); of values beyond a range, those at its end."""
        return self.metamodel_inputs(np.clip(self.to_unit(x), 0.0, 1.0))

    @cached_property
    def _feature_ranges(self) -> tuple[tuple[float, float], ...]:
        u = _even_points(self.dimension, 4096)
        columns = self.columns(self.from_unit(u))
        ranges = []
        for name, formula in self.features:
            values = np.asarray(formula(columns), dtype=np.float64)
            if not np.isfinite(values).all() or np.ptp(values) == 0:
                raise InputError(f"a derived feature must be finite and vary over the box, but '{name}' does not")
            ranges.append((float(values.min()), float(values.max())))
        return tuple(ranges)

    def values(self, given: Values) -> dict[str, Value]:
        """Return all inputs by name: the given ones checked, the others at their centre.

        Raises:
            InputError: an unknown name, or a value outside its range, choices or the constraints.
        """
        for name in given:
            if name not in self.names:
                hint = did_you_mean(name, self.names)
                raise InputError(f"an input must be one of {', '.join(self.names)}, but got '{name}'{hint}")
        x = np.array([p.number(given[p.name]) if p.name in given else p.centre for p in self.parameters])
        for p, value in zip(self.parameters, x, strict=True):
            if not bool(p.contains(value)):
                kind = "a whole number " if p.kind == "integer" else ""
                raise InputError(f"input {p.name} must be {kind}in {p.range}, but got {value:g}")
        full = self.named(x)
        if self.constraints and not bool(self.feasible(x[None])[0]):
            raise InputError(f"inputs must satisfy '{self.rules}', but got {written(full)}")
        return full


def _even_points(dimension: int, n: int) -> Points:
    """Return (n, d) points that fill the unit cube evenly, always the same."""
    from scipy.stats import qmc  # takes half of the time in which a worker starts

    return np.asarray(qmc.Sobol(dimension, scramble=True, rng=0).random(n))


def _column(parameter: Parameter, x: Vector) -> Any:
    """Return the (n,) values of an input: its numbers, or its choices as text."""
    if not parameter.choices:
        return x
    return np.array(parameter.choices)[np.clip(x, parameter.low, parameter.high).astype(np.intp)]
