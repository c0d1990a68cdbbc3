"""The numbers by which the distribution of the inputs is given, one by one: their scores, and densities with one changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Points, Vector
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.space import ParameterSpace

__all__ = ["SpaceParameter", "outside", "space_parameters"]

LogDensity = Callable[[Points], Vector]
T = TypeVar("T")

_STEP = 1e-4
"""Of a central difference of the log density, relative to the scale of the parameter: its error is about 1e-8."""
_SMALL = 1e-5
"""The same of a distribution function: what lies between an end and where it moves to is not to be told from its tail."""
_TENTH = 0.1
_EVEN = 2**14
_COVERED = 0.02
"""By which the mean of a density ratio may miss 1 under the density below: beyond, the one above has mass elsewhere."""
_SCORES = np.linspace(-6.0, 6.0, 4001)
"""Normal scores of an input where another distribution must have mass: 2e-9 lies beyond."""
_FARTHEST, _DIGITS = 30.0, 6
"""A normal score at which a distribution is at its end, and digits of the values between its ends."""
_NODES, _TOLD = np.linspace(-8.0, 8.0, 641), 5.0
"""Normal scores over which scores are summed, and up to which the sums must be how the distribution function moves ..."""
_EXPLAINED, _NOTHING = 0.03, 1e-3
"""... but for this share of them, and for this share of what lies beyond, for a parameter larger by its scale."""


@dataclass(frozen=True, eq=False)
class SpaceParameter:
    """A number by which the distribution p of the inputs is given.

    Args:
        space: with all of them as they are.
        input: whose; of a correlation, both inputs, joined by a comma.
        name: such as mean; of the probability of a choice, the choice; or "correlation".
        value: as it is.
        scale: |value| or the standard deviation of the input, whichever is smaller, but not 0.
        density: a value to the factor of log p that depends on it, constraints aside; raises InputError where there is none.
        changed: a value to the input with it, likewise; None: a probability of a choice, or a correlation.
    """

    space: ParameterSpace
    input: str
    name: str
    value: float
    scale: float
    density: Callable[[float], LogDensity]
    changed: Callable[[float], Parameter] | None = None

    @property
    def tenth(self) -> float:
        """10 % of the value, or of the standard deviation of the input where the value is 0."""
        return _TENTH * (abs(self.value) or self.scale)

    @cached_property
    def smooth(self) -> bool:
        """Whether the mean score of an event is the derivative of its probability: scores tell how the distribution moves.

        They do not where an end of the distribution moves at which it has a density, or a whole number gets its first mass.
        """
        if self.changed is None:
            return True
        (below, first), (above, last) = self._around(self.changed, _SMALL)
        now = self.changed(self.value)
        if now.discrete:
            return not any(len(outside(a, b)) for end in (first, last) for a, b in ((now, end), (end, now)))
        x = now.from_normal(_NODES)
        slope = _slope(first.log_density(x), last.log_density(x), above - below)
        near = np.abs(_NODES) <= _TOLD
        for side, function in ((1, "cdf"), (-1, "sf")):
            share = np.exp(-0.5 * _NODES**2)[::side] / math.sqrt(2.0 * math.pi)
            sums = [_cumulated(share * part)[::side] for part in (slope[::side], np.abs(slope[::side]))]
            moved = (getattr(last.truncated, function)(x) - getattr(first.truncated, function)(x)) / (above - below)
            free = _EXPLAINED * (sums[1] + np.abs(moved)) + _NOTHING * _cumulated(share)[::side] / self.scale
            if not (np.abs(moved - sums[0]) <= free)[near].all():
                return False
        return True

    def score(self, x: Points) -> Vector:
        """Return (n,) d log p(x) / d value; 0 where p ends.

        With constraints, p is the density given them; their mass depends on the value too: its part is the mean score.
        """
        score = self._slope(x)
        return score - float(self._slope(self._even).mean()) if self.space.constraints else score

    def ratio(self, x: Points, value: float) -> Vector | None:
        """Return (n,) p(x) with another value over p(x); None where there is no such p, or it has mass where p has none."""
        try:
            new, old = self.density(value), self.density(self.value)
            if self.changed is not None and len(outside(self.changed(self.value), self.changed(value))):
                return None
        except InputError:
            return None

        def free(at: Points) -> Vector:
            with np.errstate(invalid="ignore", over="ignore"):
                found = np.exp(new(at) - old(at))
            return np.where(np.isfinite(found), found, 0.0)

        mass = float(free(self._even).mean())
        if self.space.constraints:
            return free(x) / mass
        return free(x) if abs(mass - 1.0) <= _COVERED else None

    def _slope(self, x: Points) -> Vector:
        (below, first), (above, last) = self._around(self.density)
        return _slope(first(x), last(x), above - below)

    def _around(self, of: Callable[[float], T], share: float = _STEP) -> tuple[tuple[float, T], tuple[float, T]]:
        """Return two steps from the value, downwards and upwards, and what is had there."""
        ends = []
        for step in (-share * self.scale, share * self.scale):
            try:
                ends.append((step, of(self.value + step)))
            except InputError:  # at the end of what is possible: a difference to one side
                ends.append((0.0, of(self.value)))
        return ends[0], ends[1]

    @cached_property
    def _even(self) -> Points:
        """Points that follow p, from a Sobol sequence."""
        from scipy.special import ndtri
        from scipy.stats import qmc

        u = qmc.Sobol(self.space.dimension, scramble=True, rng=0).random(_EVEN)
        x = self.space.from_normal(ndtri(np.clip(u, 1e-12, 1.0 - 1e-12)))
        return x[self.space.feasible(x)] if self.space.constraints else x


def outside(old: Parameter, new: Parameter) -> Vector:
    """Return values that an input takes with a new distribution (or new probabilities) and never with the old one."""
    x = np.arange(len(new.choices), dtype=np.float64) if new.choices else new.from_normal(_SCORES)
    return np.asarray(x[~(old.log_density(x) > -np.inf)])


def drawn_between(parameter: Parameter) -> str:
    """Return the values between which an input is drawn, as printed: a distribution may end within the range."""
    if parameter.choices:
        return parameter.range
    low, high = parameter.from_normal(np.array([-_FARTHEST, _FARTHEST])).tolist()
    digits = _DIGITS - math.floor(math.log10(high - low)) if high > low else _DIGITS
    return f"[{round(low, digits):g}, {round(high, digits):g}] {parameter.unit}".rstrip()


def space_parameters(space: ParameterSpace) -> Iterator[SpaceParameter]:
    """Yield every number by which the distribution of the inputs is given, but the ends of ranges.

    None of correlated inputs where whole numbers among them are `uncounted`.
    """
    for k, p in enumerate(space.parameters):
        if space.uncounted and p.name in space.correlated:
            continue
        if p.choices:
            for choice, share in zip(p.choices, p.shares.tolist(), strict=True):
                yield SpaceParameter(space, p.name, choice, share, min(share, 1.0 - share), _chosen(space, k, choice))
        elif p.truncated is not None and p.distribution is not None:
            std = _std(p)
            for name, value in p.distribution.parameters:
                if isinstance(value, int | float):
                    scale = min(abs(value), std) or std
                    changed = partial(_changed, p, p.distribution, name)
                    yield SpaceParameter(space, p.name, name, float(value), scale, _distributed(space, k, changed), changed)
    known = space.correlation is not None and not space.uncounted
    matrix = np.asarray(space.correlation) if known else np.eye(space.dimension)
    for i, j in zip(*np.nonzero(np.tril(matrix, -1)), strict=True):
        pair, value = f"{space.names[j]}, {space.names[i]}", float(matrix[i, j])
        yield SpaceParameter(space, pair, "correlation", value, min(abs(value), 1.0 - abs(value)), _correlated(space, i, j))


def _slope(first: Vector, last: Vector, width: float) -> Vector:
    """Return the slope of a log density between two values of a parameter; 0 where either has none."""
    with np.errstate(invalid="ignore"):
        slope = (last - first) / width
    return np.where(np.isfinite(slope), slope, 0.0)


def _cumulated(values: Vector) -> Vector:
    """Return the integral over `_NODES` up to each, by the trapezoidal rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * (_NODES[1] - _NODES[0])
    return np.concatenate([[0.0], np.cumsum(steps)])


def _std(parameter: Parameter) -> float:
    """Return about the standard deviation of an input: half of the way between its normal scores -1 and 1."""
    low, high = parameter.from_normal(np.array([-1.0, 1.0]))
    return 0.5 * float(high - low) or 1.0


def _factor(space: ParameterSpace, k: int, parameter: Parameter) -> LogDensity:
    """Return the part of log p that depends on the distribution of an input."""
    if space.correlation is None:
        return lambda x: parameter.log_density(x[:, k])
    rows = [*space.parameters[:k], parameter, *space.parameters[k + 1 :]]
    return replace(space, parameters=tuple(rows), constraints=(), features=()).log_density


def _changed(parameter: Parameter, old: Distribution, name: str, value: float) -> Parameter:
    return replace(parameter, distribution=Distribution.of(old.kind, **{**dict(old.parameters), name: value}))


def _distributed(space: ParameterSpace, k: int, changed: Callable[[float], Parameter]) -> Callable[[float], LogDensity]:
    return lambda value: _factor(space, k, changed(value))


def _chosen(space: ParameterSpace, k: int, choice: str) -> Callable[[float], LogDensity]:
    p = space.parameters[k]
    at = p.choices.index(choice)

    def density(share: float) -> LogDensity:
        """The other choices keep their proportions."""
        rest = p.shares * (1.0 - share) / (1.0 - p.shares[at])
        rest[at] = share
        return _factor(space, k, replace(p, probabilities=tuple(rest.tolist())))

    return density


def _correlated(space: ParameterSpace, i: int, j: int) -> Callable[[float], LogDensity]:
    def density(value: float) -> LogDensity:
        matrix = np.array(space.correlation)
        matrix[i, j] = matrix[j, i] = value
        correlation = tuple(map(tuple, matrix.tolist()))
        return replace(space, correlation=correlation, constraints=(), features=()).log_density

    return density
