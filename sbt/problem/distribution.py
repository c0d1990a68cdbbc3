"""The distribution of one input: one of SciPy, truncated to the input's range.

Named kinds take the parameters engineers know (mean and standard deviation of the variable itself);
`kind: scipy` takes any continuous distribution of `scipy.stats` with its own arguments; `kind: empirical` is the
kernel density of a recorded sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from sbt.errors import InputError, did_you_mean, must_be
from sbt.problem.arrays import Vector

__all__ = [
    "KINDS", "Beta", "Distribution", "Empirical", "Exponential", "Gumbel", "LogNormal", "Normal", "SciPy", "Triangular",
    "TruncatedDistribution", "Uniform", "Weibull",
]  # fmt: skip


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
    """A distribution before truncation; `parameters` are (name, value) pairs.

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
        for name, value in parameters.items() if kind in KINDS else ():
            must_be(f"distribution '{kind}': {name} must be a number", value, Real)
        given = {name: float(value) if isinstance(value, Real) else value for name, value in parameters.items()}
        distribution = cls(kind, tuple(sorted(given.items())))
        distribution.frozen()
        return distribution

    def frozen(self) -> Any:
        """Return SciPy's frozen distribution, None for `uniform` (the range itself is the distribution)."""
        from scipy import stats

        given = dict(self.parameters)
        if self.kind == "empirical":
            from sbt.problem.empirical import kernel_density

            return kernel_density(given)
        if self.kind == "scipy":
            name = given.pop("name", None)
            family = getattr(stats, str(name), None)
            if not isinstance(family, stats.rv_continuous):
                raise InputError(f"kind scipy needs the name of a continuous distribution of scipy.stats, but got {name}")
            return self._built(lambda: family(**given))
        if self.kind not in KINDS:
            known, hint = ", ".join((*KINDS, "empirical", "scipy")), did_you_mean(self.kind, (*KINDS, "empirical", "scipy"))
            raise InputError(f"a distribution's kind must be one of {known}, but got '{self.kind}'{hint}")
        names, build = KINDS[self.kind]
        if set(given) != set(names):
            raise InputError(
                f"distribution '{self.kind}' takes {', '.join(names) or 'no parameters'}, but got {', '.join(given) or 'none'}"
            )
        return self._built(lambda: build(stats, **given))

    def _built(self, build: Callable[[], Any]) -> Any:
        """Return what SciPy makes of the parameters, where that has a finite median."""
        rule = f"distribution '{self.kind}' cannot have the parameters {dict(self.parameters)}"
        try:
            with np.errstate(all="ignore"):
                distribution = build()
                fine = distribution is None or np.isfinite(distribution.ppf(0.5))
        except (ArithmeticError, ValueError, TypeError) as error:
            raise InputError(f"{rule}: {error}") from None
        if not fine:
            raise InputError(rule)
        return distribution

    def truncated(self, low: float, high: float) -> TruncatedDistribution:
        """Return this distribution given that the variable lies in [low, high].

        Raises:
            InputError: the distribution has no mass there, or is uniform on an infinite range.
        """
        distribution = self.frozen()
        if distribution is None:
            if not math.isfinite(low + high):
                raise InputError(f"a uniform input needs a finite range, but got [{low}, {high}]")
            from scipy import stats

            distribution = stats.uniform(low, high - low)
        return TruncatedDistribution(distribution, low, high)


@dataclass(frozen=True)
class TruncatedDistribution:
    """A SciPy distribution given [low, high]; every method maps (n,) to (n,) and keeps precision in both tails."""

    base: Any
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.mass > 0:
            raise InputError(f"a distribution must have mass in its range [{self.low}, {self.high}], but it has none")

    @cached_property
    def _upper(self) -> bool:
        """Work with survival functions: the range lies above the median."""
        return bool(self.low > self.base.ppf(0.5))

    @cached_property
    def _lower(self) -> bool:
        """Work with distribution functions: the range lies below the median."""
        return bool(self.high < self.base.ppf(0.5))

    @cached_property
    def mass(self) -> float:
        """Probability of the range under the distribution before truncation."""
        if self._upper:
            return float(self.base.sf(self.low) - self.base.sf(self.high))
        return float(self.base.cdf(self.high) - self.base.cdf(self.low))

    def cdf(self, x: Vector) -> Vector:
        """Return P(X <= x)."""
        x = np.clip(x, self.low, self.high)
        part = self.base.sf(self.low) - self.base.sf(x) if self._upper else self.base.cdf(x) - self.base.cdf(self.low)
        return np.clip(part / self.mass, 0.0, 1.0)

    def sf(self, x: Vector) -> Vector:
        """Return P(X > x)."""
        x = np.clip(x, self.low, self.high)
        part = self.base.cdf(self.high) - self.base.cdf(x) if self._lower else self.base.sf(x) - self.base.sf(self.high)
        return np.clip(part / self.mass, 0.0, 1.0)

    def ppf(self, q: Vector) -> Vector:
        """Return the q quantile, q in [0, 1]."""
        if self._upper:
            x = self.base.isf(self.base.sf(self.low) - np.asarray(q) * self.mass)
        else:
            x = self.base.ppf(self.base.cdf(self.low) + np.asarray(q) * self.mass)
        return np.clip(x, self.low, self.high)

    def isf(self, q: Vector) -> Vector:
        """Return the value that is exceeded with probability q: precise where q is tiny."""
        if self._lower:
            x = self.base.ppf(self.base.cdf(self.high) - np.asarray(q) * self.mass)
        else:
            x = self.base.isf(self.base.sf(self.high) + np.asarray(q) * self.mass)
        return np.clip(x, self.low, self.high)

    def log_density(self, x: Vector) -> Vector:
        """Return the log density, -inf outside the range."""
        inside = (x >= self.low) & (x <= self.high)
        with np.errstate(divide="ignore"):
            return np.where(inside, self.base.logpdf(x) - math.log(self.mass), -np.inf)


def Uniform() -> Distribution:  # noqa: N802  (it stands where a class would)
    """Return the uniform distribution on the input's range."""
    return Distribution.of("uniform")


def Normal(mean: float, std: float) -> Distribution:  # noqa: N802
    """Return a normal distribution by mean and standard deviation, truncated to the input's range."""
    return Distribution.of("normal", mean=mean, std=std)


def LogNormal(mean: float, std: float) -> Distribution:  # noqa: N802
    """Return a lognormal distribution by mean and standard deviation of the variable itself."""
    return Distribution.of("lognormal", mean=mean, std=std)


def Exponential(mean: float) -> Distribution:  # noqa: N802
    """Return an exponential distribution by its mean."""
    return Distribution.of("exponential", mean=mean)


def Gumbel(mean: float, std: float) -> Distribution:  # noqa: N802
    """Return a Gumbel distribution of maxima by mean and standard deviation."""
    return Distribution.of("gumbel", mean=mean, std=std)


def Weibull(shape: float, scale: float) -> Distribution:  # noqa: N802
    """Return a Weibull distribution by shape and scale."""
    return Distribution.of("weibull", shape=shape, scale=scale)


def Beta(a: float, b: float) -> Distribution:  # noqa: N802
    """Return a beta distribution on [0, 1]."""
    return Distribution.of("beta", a=a, b=b)


def Triangular(low: float, mode: float, high: float) -> Distribution:  # noqa: N802
    """Return a triangular distribution."""
    return Distribution.of("triangular", low=low, mode=mode, high=high)


def SciPy(name: str, **parameters: float) -> Distribution:  # noqa: N802
    """Return any continuous distribution of `scipy.stats` by its name, with SciPy's own parameters."""
    return Distribution.of("scipy", name=name, **parameters)


def Empirical(file: str, **parameters: float | str) -> Distribution:  # noqa: N802
    """Return the kernel density of a recorded sample; parameters as in configurations (`kind: empirical`)."""
    return Distribution.of("empirical", file=file, **parameters)
