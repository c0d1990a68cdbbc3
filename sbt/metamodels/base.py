"""What a metamodel is: settings with a `fit` that returns a function from points to beliefs.

There is no unfitted state. Points are coordinates in the unit cube (derived features, where a
scenario declares them, are further columns, scaled to about [0, 1]); y is the safety metric itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from sbt.errors import InputError, did_you_mean
from sbt.metamodels.prediction import Prediction
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "Metamodel", "Predictor", "Screened", "TargetAware", "build", "check_rows", "log_ambiguity_bound", "sample_paths", "simplest",
    "split_validation", "standardise", "with_target",
]  # fmt: skip

Predictor = Callable[[Points], Prediction]
"""A fitted metamodel: (n, d) points -> belief at them. Picklable."""


@runtime_checkable
class Screened(Protocol):
    """A predictor that can say quickly what P(y in M_c) at most and at least is."""

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and (n,) upper bounds of P(y in M_c) at u (n, d)."""
        ...


def log_ambiguity_bound(predictor: Screened, u: Points, critical: CriticalInterval) -> Vector:
    """Return (n,) upper bounds of log a_BI = log(1 - 2 |P(y in M_c) - 0.5|), at least -700."""
    low, high = predictor.probability_bounds(u, critical)
    return np.log(np.maximum(2.0 * np.minimum(np.minimum(high, 1.0 - low), 0.5), 1e-304))


def sample_paths(predictor: Predictor, u: Points, n: int, rng: np.random.Generator) -> Points:
    """Return (n, m) draws of y as a function, at u (m, d).

    A predictor with `sample_paths` (a process) draws functions; of a mixture one component stands for a function; a single
    Gaussian a point is drawn point by point.
    """
    joint: Any = getattr(predictor, "sample_paths", None)
    if joint is not None:
        return joint(u, n, rng)
    p = predictor(u)
    component = rng.choice(len(p.weight), n, p=p.weight)
    if len(p.weight) >= 5:
        return p.mean[component]
    return p.mean[component] + p.std[component] * rng.standard_normal((n, len(u)))


class Metamodel(Protocol):
    """Settings of a metamodel; a frozen dataclass, optionally with `PRESETS`."""

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> Predictor:
        """Return the predictor learned from n rows.

        Args:
            u: (n, d) points in the unit cube, n >= 2.
            y: (n,) finite values of the safety metric, in the order in which they were run.
            rng: the only source of randomness; the same state gives the same predictor, bit by bit.

        Raises:
            InputError: n < 2, or values that are not finite.
        """
        ...


@runtime_checkable
class TargetAware(Protocol):
    """Settings of a metamodel that learns otherwise where it knows what is critical."""

    def with_target(self, critical: CriticalInterval) -> Metamodel:
        """Return the same settings, told M_c in the unit of the y that it will learn (warped, where y is)."""
        ...


def with_target(metamodel: Metamodel, critical: CriticalInterval) -> Metamodel:
    """Return the metamodel told of M_c where it wants to know, else itself."""
    return metamodel.with_target(critical) if isinstance(metamodel, TargetAware) else metamodel


def simplest(metamodel: Metamodel) -> Metamodel:
    """Return what a metamodel that compares others falls back on (its attribute `simplest`), else itself."""
    found: Metamodel = getattr(metamodel, "simplest", metamodel)
    return found


M = TypeVar("M")


def build(kind: type[M], preset: str | None = None, settings: Mapping[str, Any] | None = None) -> M:
    """Return a metamodel with the values of a preset, then of `settings`, over its defaults.

    Args:
        kind: a frozen dataclass of settings; its class variable `PRESETS`, where there is one, maps the
            name of a preset to settings.
        preset: name of a preset, or None for the defaults.
        settings: values by name of the field; they win over the preset.

    Raises:
        InputError: an unknown preset or setting (with the valid ones), or a value the metamodel refuses.
    """
    presets: Mapping[str, Mapping[str, Any]] = getattr(kind, "PRESETS", {})
    if preset is not None and preset not in presets:
        raise InputError(_unknown(kind.__name__, "preset", preset, presets))
    fields = [f.name for f in dataclasses.fields(kind) if f.init]  # type: ignore[arg-type]
    values = {**presets.get(preset or "", {}), **(settings or {})}
    for name in values:
        if name not in fields:
            raise InputError(_unknown(kind.__name__, "setting", name, fields))
    try:
        return kind(**values)
    except TypeError as error:  # e.g. a comparison of text with a number
        raise InputError(f"{kind.__name__} does not take the settings {values}: {error}") from error


def split_validation(n: int) -> tuple[slice, slice]:
    """Return the rows that validate and those that train: the first 20 %, the last 80 %.

    At least one row validates and at least one trains; n >= 2.

    Source:
        Winkelmann et al. (2022), section V-A: preserves the distribution of the Sobol sequence.

    >>> split_validation(500)
    (slice(0, 100, None), slice(100, 500, None))
    """
    if n < 2:
        raise InputError(f"a split into validation and training needs n >= 2 rows, but got {n}")
    first = max(n // 5, 1)
    return slice(0, first), slice(first, n)


def check_rows(u: Points, y: Vector) -> tuple[Points, Vector]:
    """Return u (n, d) and y (n,) as contiguous float64 that a metamodel can learn from.

    Raises:
        InputError: shapes that do not match, n < 2, d < 1, or values that are not finite.
    """
    points, values = np.ascontiguousarray(u, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 1 or values.shape != points.shape[:1]:
        raise InputError(f"fit needs u (n, d) and y (n,), but got {points.shape} and {values.shape}")
    if len(values) < 2:
        raise InputError(f"fit needs n >= 2 rows, but got {len(values)}")
    if not (np.isfinite(points).all() and np.isfinite(values).all()):
        raise InputError("fit needs finite u and y, but got NaN or infinity")
    return points, values


def standardise(y: Vector) -> tuple[Vector, float, float]:
    """Return z (n,) with mean 0 and variance 1, and the shift and scale > 0 with y = shift + scale z.

    A constant y has no scale of its own: z is 0 and the scale is a thousandth of max(1, |y|), so that
    a belief keeps a small sigma > 0.
    """
    shift = float(y.mean())
    scale = float(y.std())
    size = float(np.abs(y).max())
    if scale <= 1e-12 * size or scale == 0.0:
        return np.zeros_like(y), shift, 1e-3 * max(1.0, size)
    return (y - shift) / scale, shift, scale


def _unknown(kind: str, what: str, name: str, valid: Iterable[str]) -> str:
    """Return the message about a name that is not among the valid ones."""
    names = sorted(valid)
    return f"{kind} takes a {what} of {', '.join(names) or '(none)'}, but got {name!r}{did_you_mean(name, names)}"
