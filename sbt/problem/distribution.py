"""The law of one input: a distribution of SciPy, truncated to the input's range.

Named kinds take the parameters engineers know (mean and standard deviation of the variable itself);
`kind: scipy` takes any continuous law of `scipy.stats` with its own arguments; `kind: empirical` is the
kernel density of a recorded sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Vector

__all__ = ["KINDS", "Distribution", "TruncatedLaw"]


def _lognormal(stats: Any, mean: float, std: float) -> Any:
    variance = math.log1p((std / mean) ** 2)
    return stats.lognorm(s=math.sqrt(variance), scale=mean * math.exp(-variance / 2))


def _gumbel(stats: Any, mean: float, std: float) -> Any:
    scale = std * math.sqrt(6.0) / math.pi
    return stats.gumbel_r(loc=mean - float(np.euler_gamma) * scale, scale=scale)


KINDS: Mapping[str, tuple[tuple[str, ...], Callable[..., Any]]] = {
    "uniform": ((), lambda stats: None),
    "normal": (("mean", "std"), lambda stats, mean, std: stats.norm(mean, std)),
    "lognormal": (("mean", "std"), _lognormal),
    "exponential": (("mean",), lambda stats, mean: stats.expon(scale=mean)),
    "gumbel": (("mean", "std"), _gumbel),
    "weibull": (("shape", "scale"), lambda stats, shape, scale: stats.weibull_min(shape, scale=scale)),
    "beta": (("a", "b"), lambda stats, a, b: stats.beta(a, b)),
    "triangular": (("low", "mode", "high"), lambda stats, low, mode, high: stats.triang(
        (mode - low) / (high - low), loc=low, scale=high - low)),
}  # fmt: skip
"""kind: the names of its parameters, and how SciPy spells it; mean and std are the variable's own"""


@dataclass(frozen=True)
class Distribution:
    """A law before truncation; `parameters` are (name, value) pairs.

    Raises:
        InputError: unknown kind, or missing, surplus or impossible parameters.

    >>> Distribution.of(kind="normal", mean=40, std=15).truncated(0, 120).ppf(np.array([0.5])).round(2)
    array([40.07])
    """

    kind: str
    parameters: tuple[tuple[str, float | str], ...] = ()

    @classmethod
    def of(cls, kind: str, **parameters: float | str) -> Distribution:
        """Return the distribution of this kind with these parameters, checked."""
        law = cls(kind, tuple(sorted(parameters.items())))
        law.frozen()
        return law

    def frozen(self) -> Any:
        """Return SciPy's frozen distribution, None for `uniform` (the range itself is the law)."""
        from scipy import stats

        given = dict(self.parameters)
        if self.kind == "empirical":
            from sbt.problem.empirical import kernel_density

            return kernel_density(given)
        if self.kind == "scipy":
            name = given.pop("name", None)
            family = getattr(stats, str(name), None)
            if not isinstance(family, stats.rv_continuous):
                raise InputError(f"kind scipy needs the name of a continuous law of scipy.stats, but got {name}")
            return self._checked(family(**given))
        if self.kind not in KINDS:
            known = ", ".join([*KINDS, "scipy", "empirical"])
            raise InputError(f"a distribution's kind must be one of {known}, but got '{self.kind}'")
        names, build = KINDS[self.kind]
        if set(given) != set(names):
            raise InputError(
                f"distribution '{self.kind}' takes {', '.join(names) or 'no parameters'}, but got {', '.join(given) or 'none'}"
            )
        try:
            return self._checked(build(stats, **given))
        except (ZeroDivisionError, ValueError) as error:
            raise InputError(f"distribution '{self.kind}' cannot have the parameters {given}: {error}") from None

    def _checked(self, law: Any) -> Any:
        if law is not None and not np.isfinite(law.ppf(0.5)):
            raise InputError(f"distribution '{self.kind}' cannot have the parameters {dict(self.parameters)}")
        return law

    def truncated(self, low: float, high: float) -> TruncatedLaw:
        """Return this law given that the variable lies in [low, high].

        Raises:
            InputError: the law has no mass there, or is uniform on an infinite range.
        """
        law = self.frozen()
        if law is None:
            if not math.isfinite(low + high):
                raise InputError(f"a uniform input needs a finite range, but got [{low}, {high}]")
            from scipy import stats

            law = stats.uniform(low, high - low)
        return TruncatedLaw(law, low, high)


@dataclass(frozen=True)
class TruncatedLaw:
    """A SciPy law given [low, high]; every method maps (n,) to (n,) and keeps precision in both tails."""

    law: Any
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.mass > 0:
            raise InputError(f"a distribution must have mass in its range [{self.low}, {self.high}], but it has none")

    @cached_property
    def _upper(self) -> bool:
        """Work with survival functions: the range lies above the median."""
        return bool(self.low > self.law.ppf(0.5))

    @cached_property
    def _lower(self) -> bool:
        """Work with distribution functions: the range lies below the median."""
        return bool(self.high < self.law.ppf(0.5))

    @cached_property
    def mass(self) -> float:
        """Probability of the range under the law before truncation."""
        if self._upper:
            return float(self.law.sf(self.low) - self.law.sf(self.high))
        return float(self.law.cdf(self.high) - self.law.cdf(self.low))

    def cdf(self, x: Vector) -> Vector:
        """Return P(X <= x)."""
        x = np.clip(x, self.low, self.high)
        part = self.law.sf(self.low) - self.law.sf(x) if self._upper else self.law.cdf(x) - self.law.cdf(self.low)
        return np.clip(part / self.mass, 0.0, 1.0)

    def sf(self, x: Vector) -> Vector:
        """Return P(X > x)."""
        x = np.clip(x, self.low, self.high)
        part = self.law.cdf(self.high) - self.law.cdf(x) if self._lower else self.law.sf(x) - self.law.sf(self.high)
        return np.clip(part / self.mass, 0.0, 1.0)

    def ppf(self, q: Vector) -> Vector:
        """Return the q quantile, q in [0, 1]."""
        if self._upper:
            x = self.law.isf(self.law.sf(self.low) - np.asarray(q) * self.mass)
        else:
            x = self.law.ppf(self.law.cdf(self.low) + np.asarray(q) * self.mass)
        return np.clip(x, self.low, self.high)

    def isf(self, q: Vector) -> Vector:
        """Return the value that is exceeded with probability q: precise where q is tiny."""
        if self._lower:
            x = self.law.ppf(self.law.cdf(self.high) - np.asarray(q) * self.mass)
        else:
            x = self.law.isf(self.law.sf(self.high) + np.asarray(q) * self.mass)
        return np.clip(x, self.low, self.high)

    def log_density(self, x: Vector) -> Vector:
        """Return the log density, -inf outside the range."""
        inside = (x >= self.low) & (x <= self.high)
        with np.errstate(divide="ignore"):
            return np.where(inside, self.law.logpdf(x) - math.log(self.mass), -np.inf)
