"""One input of a logical scenario: its range, unit and distribution, or its choices and their probabilities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from sbt.errors import InputError, did_you_mean, must_be
from sbt.problem.arrays import FARTHEST, NEAREST, Mask, Vector
from sbt.problem.distribution import Distribution, TruncatedDistribution
from sbt.problem.plain import Value

__all__ = ["TAIL", "Choices", "Kind", "Parameter"]

TAIL = 1e-6
"""An infinite range is searched between these quantiles of its distribution."""
_APART = 1e-12
"""Least width of a range relative to its ends: below, its values are all the same to a metamodel and a figure."""
_FARTHEST_SCORE = 37.5
"""Normal score beyond which a probability is below the smallest number: of an infinite range the value there stands for all."""
_DECADES = 100.0
"""High over low end of a range, from which on `logarithmic` is asked."""
_SUM = 1e-6  # by which probabilities that were written with six digits may miss 1

Kind = Literal["continuous", "integer", "categorical"]
Choices = Sequence[str] | Mapping[str, float]
"""Equally likely choices, or choices with their probabilities."""


@dataclass(frozen=True, init=False)
class Parameter:
    """One input: a range with a unit and the distribution of the values in it (None: uniform), or named choices.

    In arrays a choice stands as its position (0.0, 1.0, ...); wherever an input has its name beside it, a run, a formula, a
    store, a table, it is the choice itself, as text. Choices have no order: none is nearer to one than to another.

    Args:
        name: an identifier.
        low, high: ends of the range in `unit`, both included; infinite only with a distribution.
        unit: as printed, "" for a pure number.
        distribution: distribution of the input, truncated to the range.
        kind: "integer" inputs take the whole numbers of the range; inputs with choices are "categorical".
        description: one line for reports.
        choices: at least two different texts, or a mapping of such texts to their probabilities; () for an input with a range.
        probabilities: of the choices, in their order; () where they are equally likely, or stand in `choices`.

    Raises:
        InputError: not low < high, a NaN, an infinite range without a distribution, an integer range whose ends are not
            whole numbers, or choices that are no such texts, stand beside a range, or have probabilities that do not sum to 1.

    >>> Parameter("kind", choices={"car": 0.7, "truck": 0.3}).range
    '{car, truck}'
    """

    name: str
    low: float
    high: float
    unit: str = ""
    distribution: Distribution | None = None
    kind: Kind = "continuous"
    description: str = ""
    choices: tuple[str, ...] = ()
    probabilities: tuple[float, ...] = ()

    def __init__(
        self, name: str, low: float | None = None, high: float | None = None, unit: str = "",
        distribution: Distribution | None = None, kind: Kind | None = None, description: str = "", choices: Choices = (),
        probabilities: Sequence[float] = (),
    ):  # fmt: skip
        if isinstance(choices, Mapping):
            probabilities = tuple(choices.values())
            choices = tuple(choices)
        if not isinstance(choices, list | tuple):
            raise InputError(f"input {name}: choices must be a list of texts, or texts with probabilities, but got {choices!r}")
        if len(choices) or kind == "categorical":
            given = {"low": low not in (None, 0.0), "high": high not in (None, len(choices) - 1.0),
                     "distribution": distribution is not None}  # fmt: skip
            if any(given.values()):
                surplus = ", ".join(key for key, there in given.items() if there)
                raise InputError(f"input {name}: an input has a range or choices, not both, but got choices and {surplus}")
            low, high, kind = 0.0, len(choices) - 1.0, "categorical" if kind is None else kind
        if low is None or high is None:
            raise InputError(f"input {name}: a range (low, high) or choices are needed")
        low, high = (end.item() if isinstance(end, np.generic) else end for end in (low, high))
        values = {
            "name": name, "low": low, "high": high, "unit": unit, "distribution": distribution,
            "kind": "continuous" if kind is None else kind, "description": description, "choices": tuple(choices),
            "probabilities": tuple(probabilities),
        }  # fmt: skip
        if distribution is not None and not hasattr(distribution, "truncated"):
            raise InputError(f"input {name}: a distribution is one such as Normal(0, 1), but got {distribution!r}")
        for key, value in values.items():
            object.__setattr__(self, key, value)
        self._check()

    def _check(self) -> None:
        for end in ("low", "high"):
            must_be(f"input {self.name}: {end} must be a number", getattr(self, end), Real)
        must_be(f"input {self.name}: a unit must be text (a distribution comes after it)", self.unit, str)
        must_be("an input's name must be an identifier", self.name, str)
        if not self.name.isidentifier():
            raise InputError(f"an input's name must be an identifier, but got '{self.name}'")
        if self.kind not in ("continuous", "integer", "categorical"):
            raise InputError(f"input {self.name}: kind must be continuous, integer or categorical, but got '{self.kind}'")
        if self.kind == "categorical" or self.choices:
            self._check_choices()
            return
        if not self.low < self.high:
            raise InputError(f"input {self.name}: low < high must hold, but got low {self.low}, high {self.high}")
        ends = [end for end in (self.low, self.high) if math.isfinite(end)]
        near = self.high - self.low < max(NEAREST, _APART * max(map(abs, ends), default=0.0))
        if near or any(abs(end) > FARTHEST for end in ends):
            rule = f"ends must be within {FARTHEST:g}, {NEAREST:g} and a {1 / _APART:g}th of themselves apart"
            raise InputError(f"input {self.name}: {rule}, but got low {self.low}, high {self.high}")
        finite = math.isfinite(self.low) and math.isfinite(self.high)
        if not finite and (self.distribution is None or self.distribution.kind == "uniform"):
            raise InputError(f"input {self.name}: an infinite range needs a distribution, but got none")
        if self.kind == "integer" and not (finite and self.low % 1 == 0 and self.high % 1 == 0):
            raise InputError(f"input {self.name}: an integer range needs whole ends, but got [{self.low}, {self.high}]")
        if self.distribution is not None:
            try:
                self.distribution.truncated(*self._support)
            except InputError as error:
                raise InputError(f"{error} (input {self.name})") from None

    def _check_choices(self) -> None:
        """Refuse what are no choices with probabilities."""
        name = self.name
        if self.kind != "categorical":
            raise InputError(f"input {name}: an input with choices is categorical, but got kind '{self.kind}'")
        for choice in self.choices:
            if not isinstance(choice, str):
                raise InputError(f"input {name}: a choice must be text (write a number in quotes), but got {choice!r}")
            if not choice.strip() or choice != choice.strip() or not choice.isprintable():
                rule = "a choice must be text on one line without blanks around it"
                raise InputError(f"input {name}: {rule}, but got {choice!r}")
        doubled = next((c for k, c in enumerate(self.choices) if c in self.choices[:k]), None)
        if doubled is not None:
            raise InputError(f"input {name}: choices must differ, but '{doubled}' stands twice")
        if len(self.choices) < 2:
            raise InputError(f"input {name}: at least two choices are needed, but got {', '.join(self.choices) or 'none'}")
        if not self.probabilities:
            return
        if len(self.probabilities) != len(self.choices):
            counts = f"{len(self.choices)} choices and {len(self.probabilities)} probabilities"
            raise InputError(f"input {name}: every choice needs its probability, but got {counts}")
        for choice, p in zip(self.choices, self.probabilities, strict=True):
            number = isinstance(p, int | float | np.integer | np.floating) and not isinstance(p, bool | np.bool_)
            if not number or not 0.0 < p < 1.0:
                raise InputError(f"input {name}: a probability must be a number between 0 and 1, but '{choice}' has {p!r}")
        total = math.fsum(self.probabilities)
        if abs(total - 1.0) > _SUM:
            raise InputError(f"input {name}: the probabilities of the choices must sum to 1, but sum to {total:.6g}")

    @property
    def range(self) -> str:
        """The range as printed, with its unit; the choices of a categorical input."""
        if self.choices:
            return f"{{{', '.join(self.choices)}}}"
        return f"[{self.low:g}, {self.high:g}] {self.unit}".rstrip()

    @property
    def discrete(self) -> bool:
        """Whether single values are taken: whole numbers, or choices."""
        return self.kind != "continuous"

    @cached_property
    def shares(self) -> Vector:
        """(k,) probabilities of the choices, summing to 1; empty for an input with a range."""
        given = np.asarray(self.probabilities or [1.0] * len(self.choices), dtype=np.float64)
        return given / max(given.sum(), 1e-300)

    @cached_property
    def edges(self) -> Vector:
        """(k - 1,) normal scores between the k choices: a choice owns as much of the normal distribution as it is likely."""
        below, above = np.cumsum(self.shares)[:-1], np.cumsum(self.shares[::-1])[::-1][1:]
        return np.where(below <= above, ndtri(below), -ndtri(above))

    def value(self, x: float) -> Value:
        """Return what stands for a number of an array where the input is named: the choice, or the number itself."""
        return self.choices[int(x)] if self.choices else float(x)

    def number(self, value: object) -> float:
        """Return the number that stands for a value in arrays: the position of a choice, or the value itself.

        Raises:
            InputError: it is no choice, or no number.
        """
        if not self.choices:
            must_be(f"input {self.name} must be a number", value, Real)
            return float(value)  # type: ignore[arg-type]
        if value not in self.choices:
            hint = did_you_mean(value, self.choices) if isinstance(value, str) else ""
            raise InputError(f"input {self.name} must be one of {', '.join(self.choices)}, but got {value!r}{hint}")
        return float(self.choices.index(str(value)))

    @property
    def _support(self) -> tuple[float, float]:
        """Return the range of the distribution; whole numbers own half a unit on each side."""
        half = 0.5 if self.discrete else 0.0
        return self.low - half, self.high + half

    @cached_property
    def truncated(self) -> TruncatedDistribution | None:
        """The truncated distribution, None where the input is uniform on its range, or has choices."""
        if self.distribution is None or self.distribution.kind == "uniform":
            return None
        return self.distribution.truncated(*self._support)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Finite ends for designs: the range, or its 1e-6 quantiles where it is infinite."""
        if self.truncated is None or (math.isfinite(self.low) and math.isfinite(self.high)):
            return self.low, self.high
        low = self.low if math.isfinite(self.low) else float(self.truncated.ppf(np.array(TAIL)))
        high = self.high if math.isfinite(self.high) else float(self.truncated.isf(np.array(TAIL)))
        return low, high

    @cached_property
    def logarithmic(self) -> bool:
        """Whether designs, searches and axes are even in the logarithm: the values that are usual fill no tenth of the bounds.

        A range over two decades or more, of whose distribution half lies in the lowest tenth, would hardly be searched there.
        """
        low, high = self.bounds
        if self.discrete or self.truncated is None or not 0.0 < low * _DECADES <= high or math.isinf(high / low):
            return False
        return float(self.truncated.cdf(np.array(low + 0.1 * (high - low)))) >= 0.5

    @property
    def centre(self) -> float:
        """Middle of the bounds, a whole number for integer inputs; the likeliest choice, of equally likely ones the first."""
        low, high = self.bounds
        if self.logarithmic:
            return math.sqrt(low * high)
        if self.choices:
            return float(np.argmax(self.shares))
        return float(math.floor((low + high) / 2)) if self.kind == "integer" else (low + high) / 2

    def contains(self, x: Vector) -> Mask:
        """Return (n,) booleans: the value is in the range (and whole, for integers and choices)."""
        x = np.asarray(x, dtype=np.float64)
        inside = (x >= self.low) & (x <= self.high)
        return inside & (x % 1 == 0) if self.discrete else inside

    def from_unit(self, u: Vector) -> Vector:
        """Map [0, 1] onto the bounds: linearly, evenly in the logarithm where `logarithmic`, in equal cells of whole numbers."""
        low, high = self.bounds
        if self.logarithmic:
            return np.clip(low * (high / low) ** np.asarray(u), low, high)
        if self.discrete:
            return np.clip(np.floor(low + u * (high - low + 1)), low, high)
        return np.clip(low + u * (high - low), low, high)

    def to_unit(self, x: Vector) -> Vector:
        """Map the bounds onto [0, 1]; integers and choices to the middle of their cell."""
        low, high = self.bounds
        if self.logarithmic:
            return np.log(np.maximum(x, np.finfo(np.float64).tiny) / low) / math.log(high / low)
        if self.discrete:
            return (x - low + 0.5) / (high - low + 1)
        return (x - low) / (high - low)

    def from_normal(self, z: Vector) -> Vector:
        """Map a standard-normal score to the value of the same probability, finite also of an infinite range."""
        z = np.asarray(z, dtype=np.float64)
        if self.choices:
            return np.searchsorted(self.edges, z, side="right").astype(np.float64)
        low, high = self._support
        if self.truncated is None:
            x = np.where(z <= 0, low + (high - low) * ndtr(z), high - (high - low) * ndtr(-z))
        else:
            z = np.clip(z, -_FARTHEST_SCORE, _FARTHEST_SCORE)
            x = np.where(z <= 0, self.truncated.ppf(ndtr(z)), self.truncated.isf(ndtr(-z)))
            x = np.clip(x, -FARTHEST, FARTHEST)
        if self.kind == "integer":
            return np.clip(np.floor(x + 0.5), self.low, self.high)
        return np.clip(x, self.low, self.high)

    def to_normal(self, x: Vector) -> Vector:
        """Map a value to its standard-normal score (integers and choices: of their cell's middle)."""
        if self.choices:
            k = np.clip(np.asarray(x), self.low, self.high).astype(np.intp)
            middle = 0.5 * self.shares[k]
            below = np.concatenate([[0.0], np.cumsum(self.shares)])[k] + middle
            return _score(below, np.concatenate([np.cumsum(self.shares[::-1])[::-1], [0.0]])[k + 1] + middle)
        if self.truncated is None or not self.discrete:
            return _score(*self._beside(x))
        x = np.clip(np.asarray(x, dtype=np.float64), self.low, self.high)
        return _score(*(0.5 * (a + b) for a, b in zip(self._beside(x - 0.5), self._beside(x + 0.5), strict=True)))

    def _beside(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the probabilities (n,) below and above a number, of its range."""
        low, high = self._support
        if self.truncated is None:
            return (x - low) / (high - low), (high - x) / (high - low)
        return self.truncated.cdf(x), self.truncated.sf(x)

    def cell(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the standard-normal scores (n,) between which the whole number x is taken; that of the range next to others."""
        x = np.clip(np.asarray(x, dtype=np.float64), self.low, self.high)
        lower = np.where(x <= self.low, -np.inf, _score(*self._beside(x - 0.5)))
        return lower, np.where(x >= self.high, np.inf, _score(*self._beside(x + 0.5)))

    def log_density(self, x: Vector) -> Vector:
        """Return (n,) log density of the value, log mass for integers and choices, -inf outside the range."""
        x = np.asarray(x, dtype=np.float64)
        with np.errstate(divide="ignore"):
            if self.discrete:
                log_p = np.log(self._cell_mass(x))
            elif self.truncated is None:
                log_p = np.full(x.shape, -math.log(self.high - self.low))
            else:
                log_p = self.truncated.log_density(x)
        return np.where(self.contains(x), log_p, -np.inf)

    def _cell_mass(self, x: Vector) -> Vector:
        """Return the probability of the whole number or choice x."""
        if self.choices:
            return self.shares[np.clip(x, self.low, self.high).astype(np.intp)]
        if self.truncated is None:
            return np.full(x.shape, 1.0 / (self.high - self.low + 1))
        upper = self.truncated.sf(x - 0.5) - self.truncated.sf(x + 0.5)
        lower = self.truncated.cdf(x + 0.5) - self.truncated.cdf(x - 0.5)
        return np.where(self.truncated.cdf(x) > 0.5, upper, lower)


def _score(below: Vector, above: Vector) -> Vector:
    """Return standard-normal scores (n,) from the probabilities below and above; at an end of the range the farthest one."""
    z = np.where(below <= above, ndtri(below), -ndtri(above))
    return np.clip(z, -_FARTHEST_SCORE, _FARTHEST_SCORE)
