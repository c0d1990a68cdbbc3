"""What a metamodel is: an object with a `fit` that returns a function from points to predictions.

There is no unfitted state. Points are coordinates in the unit cube (derived features, where a
scenario declares them, are further columns, scaled to about [0, 1]); y is the safety metric itself.

A metamodel of one's own is any class with `fit(u, y, rng)`; its settings are the keyword arguments of its constructor.

>>> class Nearest:
...     def __init__(self, sigma=0.1):
...         self.sigma = sigma
...
...     def fit(self, u, y, rng):
...         def predict(points):
...             distance = np.linalg.norm(points[:, None] - u, axis=2)
...             return Prediction.gaussian(y[distance.argmin(axis=1)], self.sigma + distance.min(axis=1))
...
...         return predict
>>> predict = build(Nearest, settings={"sigma": 0.2}).fit(np.array([[0.1], [0.9]]), np.array([1.0, 2.0]), None)
>>> predict(np.array([[0.2], [0.9]])).mu.tolist()
[1.0, 2.0]
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, overload, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RAISED, InputError, SbtError, did_you_mean, naming
from sbt.metamodels.prediction import Prediction, PredictionError
from sbt.problem.arrays import Points, Vector
from sbt.problem.requirement import CriticalInterval

__all__ = [
    "Metamodel", "Predictor", "Screened", "TargetAware", "build", "call", "check_rows", "fitted", "gives_different", "is_flag",
    "log_ambiguity_bound", "named_errors", "once", "predicted", "sample_paths", "simplest", "sketched", "split_validation",
    "standardise", "with_target", "without_repetitions",
]  # fmt: skip

Predictor = Callable[[Points], Prediction]
"""A fitted metamodel: (n, d) points -> prediction at them."""

_SMALLEST = 1e-304  # of an upper bound of a_BI, before the logarithm: about the smallest normal number
_MIXED = 5  # components from which on one of them stands for a function (an ensemble, a forest)
_CONSTANT = 1e-12  # standard deviation relative to |y|: below it, y is constant but for rounding
_LARGER = 100  # times its default that a whole number may be: what is larger never ends, or takes all memory
_CONSTANT_SCALE = 1e-3  # scale of a constant y, relative to max(1, |y|)


class Metamodel(Protocol):
    """A metamodel, not fitted; the built-in ones are frozen dataclasses, with `PRESETS` by name."""

    def fit(self, u: Points, y: Vector, rng: np.random.Generator) -> Predictor:
        """Return the predictor learned from n rows.

        Args:
            u: (n, d) points in the unit cube, n >= 2.
            y: (n,) finite values of the safety metric, in the order in which they were run.
            rng: the only source of randomness; the same state gives the same predictor, bit by bit.

        Returns:
            A function from (m, d) points to their `Prediction`, such as `Prediction.gaussian(mu, sigma)`. It may have
            the methods of `Screened`, and `sample_paths(u, n, rng)`: (n, m) draws of y as a function at u (m, d).

        Raises:
            InputError: n < 2, or values that are not finite.
        """
        ...


@runtime_checkable
class TargetAware(Protocol):
    """A metamodel that learns otherwise where it knows the critical interval."""

    def with_target(self, critical: CriticalInterval) -> Metamodel:
        """Return the same settings for a known M_c, in the unit of the y that will be learned (warped, where y is)."""
        ...


@runtime_checkable
class Screened(Protocol):
    """A predictor with quick bounds of P(y in M_c)."""

    def probability_bounds(self, u: Points, critical: CriticalInterval) -> tuple[Vector, Vector]:
        """Return (n,) lower and (n,) upper bounds of P(y in M_c) at u (n, d)."""
        ...


def with_target(metamodel: Metamodel, critical: CriticalInterval) -> Metamodel:
    """Return the metamodel for a known M_c where it is `TargetAware`, else itself."""
    return metamodel.with_target(critical) if isinstance(metamodel, TargetAware) else metamodel


def simplest(metamodel: Metamodel) -> Metamodel:
    """Return what a metamodel that compares others falls back on (its attribute `simplest`), else itself."""
    found: Metamodel = getattr(metamodel, "simplest", metamodel)
    return found


def log_ambiguity_bound(predictor: Screened, u: Points, critical: CriticalInterval) -> Vector:
    """Return (n,) upper bounds of log a_BI = log(1 - 2 |P(y in M_c) - 0.5|), at least -700."""
    low, high = predictor.probability_bounds(u, critical)
    return np.log(np.maximum(2.0 * np.minimum(np.minimum(high, 1.0 - low), 0.5), _SMALLEST))


def sketched(predictor: Predictor, rows: int) -> Predictor:
    """Return what predicts about the same from so many rows (the predictor's `sketch`); itself where that would gain nothing."""
    sketch: Any = getattr(predictor, "sketch", None)
    return predictor if sketch is None else sketch(rows)


def sample_paths(predictor: Predictor, u: Points, n: int, rng: np.random.Generator) -> Points:
    """Return (n, m) draws of y as a function, at u (m, d).

    By the predictor's own `sample_paths` where it has one (a process, a mixture of processes). Otherwise a component of
    its mixture stands for a function; of a mixture of few components the noise is added point by point.
    """
    own: Any = getattr(predictor, "sample_paths", None)
    if own is not None:
        return own(np.array(u), n, rng)
    p = predicted(predictor, u)
    component = rng.choice(len(p.weight), n, p=p.weight)
    if len(p.weight) >= _MIXED:
        return p.mean[component]
    return p.mean[component] + p.std[component] * rng.standard_normal((n, len(u)))


M = TypeVar("M")
_called: WeakKeyDictionary[type, str] = WeakKeyDictionary()
"""What classes of metamodels are called in configurations, which errors tell: a function may have made them."""


def call(metamodel: Metamodel, name: str) -> None:
    """Let errors of a metamodel of a user's own name it as a configuration does: `file.py:NAME` as NAME."""
    if not type(metamodel).__module__.startswith("sbt."):
        _called[type(metamodel)] = name.rpartition(":")[2]


@overload
def build(kind: type[M], preset: str | None = None, settings: Mapping[str, Any] | None = None) -> M: ...
@overload
def build(kind: Metamodel, preset: str | None = None, settings: Mapping[str, Any] | None = None) -> Metamodel: ...
def build(kind: Any, preset: str | None = None, settings: Mapping[str, Any] | None = None) -> Any:
    """Return a metamodel with the values of a preset, then of `settings`, over its defaults.

    Args:
        kind: a class with `fit(u, y, rng)`, whose settings are the keyword arguments of its constructor; its class
            variable `PRESETS`, where there is one, maps the name of a preset to settings. Or an object with `fit`, which
            is returned as it is and has no settings.
        preset: name of a preset, or None for the defaults.
        settings: values by name; they win over the preset.

    Raises:
        InputError: an unknown preset or setting (with the valid ones), a required one that is missing, a value that the
            metamodel refuses, or no `fit(u, y, rng)`.
    """
    name = kind.__name__ if isinstance(kind, type) else type(kind).__name__
    presets: Mapping[str, Mapping[str, Any]] = getattr(kind, "PRESETS", {}) if isinstance(kind, type) else {}
    if preset is not None and preset not in presets:
        raise InputError(_unknown(name, "preset", preset, presets))
    values = {**presets.get(preset or "", {}), **(settings or {})}
    if isinstance(kind, type):
        _check_settings(name, kind, values)
        _check_values(kind, values)
        try:
            made = kind(**values)
        except SbtError:
            raise
        except RAISED as error:  # e.g. a comparison of text with a number
            raise InputError(f"{name} does not take the settings {values}: {type(error).__name__}: {error}") from error
    elif values:
        raise InputError(f"{name} is an object, which takes no settings, but got {', '.join(values)}; name its class instead")
    else:
        made = kind
    try:
        inspect.signature(made.fit).bind(None, None, None)
    except (AttributeError, TypeError) as error:
        raise InputError(f"a metamodel must have a method fit(u, y, rng), but {name} has not: {error}") from error
    return made


def _check_settings(name: str, kind: type, values: Mapping[str, Any]) -> None:
    """Raise InputError where the constructor of a class does not take these settings by keyword."""
    try:
        parameters = inspect.signature(kind).parameters.values()
    except ValueError:  # a class written in C; its constructor checks
        return
    required = [p for p in parameters if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    by_position = [p.name for p in required if p.kind is p.POSITIONAL_ONLY]
    if by_position:
        raise InputError(f"settings are given by name, but the constructor of {name} takes {by_position[0]} by position only")
    known = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        for each in values:
            if each not in known:
                raise InputError(_unknown(name, "setting", each, known))
    missing = [p.name for p in required if p.name not in values]
    if missing:
        raise InputError(f"{name} needs the setting{'s' * (len(missing) > 1)} {', '.join(missing)}, but got {_listed(values)}")


def _check_values(kind: type, values: Mapping[str, Any]) -> None:
    """Raise InputError where values are not what a metamodel of this package declares; others check their own.

    Whole numbers are at most a hundred times the default, or what a preset has; other numbers are finite.
    """
    if not (kind.__module__.startswith("sbt.") and dataclasses.is_dataclass(kind)):
        return
    presets: Iterable[Mapping[str, Any]] = getattr(kind, "PRESETS", {}).values()
    for field in dataclasses.fields(kind):
        if field.name not in values:
            continue
        value, declared = values[field.name], str(field.type)
        stated = [each for each in (field.default, *(p.get(field.name) for p in presets)) if each is not None]
        rule = _rule(declared.removesuffix(" | None"), value, stated)
        if rule and not (value is None and declared.endswith(" | None")):
            raise InputError(f"{field.name} must be {rule}, but got {value!r}")


def _rule(declared: str, value: Any, stated: Iterable[Any]) -> str:
    """Return what a value of a declared type must be and is not; "" where it is."""
    if declared == "tuple[int, ...]":
        flat = list(value) if isinstance(value, list | tuple) else [None]
        rule = next((r for each in flat if (r := _rule("int", each, [n for numbers in stated for n in numbers]))), "")
        return f"a list of at most {_LARGER}, each {rule or 'a whole number'}" if rule or len(flat) > _LARGER else ""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if declared == "int":
        most = max(_LARGER * next(iter(stated)), *stated)
        return "" if number and isinstance(value, int) and abs(value) <= most else f"a whole number of at most {most}"
    if declared == "float":
        return "" if number and math.isfinite(value) else "a finite number"
    return "true or false" if declared == "bool" and not isinstance(value, bool) else ""


@contextmanager
def named_errors(metamodel: Metamodel, n: int) -> Iterator[None]:
    """Return a context in which an error of a metamodel's own code names the metamodel, its n rows and the line (`naming`).

    Raises:
        SbtError: it raises, or predicts what is no prediction.
    """
    inner: Any = getattr(metamodel, "metamodel", metamodel) if type(metamodel).__module__.startswith("sbt.") else metamodel
    name = _called.get(type(inner), type(inner).__name__)  # of the user's own, whose errors these are, where another one wraps it
    with naming(f"metamodel {name} must learn from {n} rows and predict"):
        try:
            yield
        except PredictionError as error:
            raise SbtError(f"metamodel {name}, fitted to {n} rows: {error}") from error


def fitted(metamodel: Metamodel, u: Points, y: Vector, rng: np.random.Generator) -> Predictor:
    """Return what a metamodel learns from rows u (n, d), y (n,), in `named_errors`; it may change the copies that it gets."""
    with named_errors(metamodel, len(y)):
        return metamodel.fit(np.array(u), np.array(y), rng)


def predicted(predict: Predictor, u: Points) -> Prediction:
    """Return what a predictor says of points u (n, d); it may change the copy that it gets.

    Raises:
        PredictionError: it is no `Prediction`, or one of another number of points.
    """
    prediction, n = predict(u.copy()), len(u)
    if not isinstance(prediction, Prediction):
        kind = type(prediction).__name__
        rule = "a predictor must return a Prediction, such as Prediction.gaussian(mu, sigma)"
        raise PredictionError(f"{rule}, but returned a {kind}")
    if len(prediction) != n:
        asked = "1 point" if n == 1 else f"{n} points"
        raise PredictionError(f"a predictor must return one value a point, but returned {len(prediction)} for {asked}")
    return prediction


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


def without_repetitions(u: Points, y: Vector) -> tuple[Points, Vector]:
    """Return the rows u (n, d) and y (n,) in order, each once where equal u always gave equal y; otherwise all of them.

    A repetition of a deterministic run tells nothing, but two equal rows look like proof that there is nothing between
    runs that a smooth function does not explain. Of a noisy metric every repetition counts.

    >>> without_repetitions(np.array([[0.1], [0.2], [0.1]]), np.array([1.0, 2.0, 1.0]))[1].tolist()
    [1.0, 2.0]
    >>> without_repetitions(np.array([[0.1], [0.2], [0.1]]), np.array([1.0, 2.0, 3.0]))[1].tolist()
    [1.0, 2.0, 3.0]
    """
    kept = once(u, y)
    return u[kept], y[kept]


def once(u: Points, y: Vector) -> NDArray[np.intp]:
    """Return the rows that `without_repetitions` keeps."""
    first = np.unique(u, axis=0, return_index=True)[1]
    pairs = np.unique(np.column_stack([u, y]), axis=0)
    if len(first) == len(u) or len(pairs) > len(first) or len(first) < 2:
        return np.arange(len(u))
    return np.sort(first)


def gives_different(u: Points, y: Vector) -> bool:
    """Say whether equal rows of u (n, d) have different values of y (n,): the simulator is noisy."""
    if len(u) < 2:
        return False
    _, first, group = np.unique(u, axis=0, return_index=True, return_inverse=True)
    return not np.allclose(y, y[first][group.reshape(-1)], rtol=1e-9, atol=0.0)


def is_flag(y: Vector, critical: CriticalInterval) -> bool:
    """Say whether y (n,) has two values, one in M_c and one not: which side of it a run fell on is all that is told."""
    two = np.unique(y)
    return len(two) == 2 and int(critical.contains(two).sum()) == 1


def standardise(y: Vector) -> tuple[Vector, float, float]:
    """Return z (n,) with mean 0 and variance 1, and the shift and scale > 0 with y = shift + scale z.

    A constant y has no scale of its own: z is 0 and the scale is a thousandth of max(1, |y|), so that
    a prediction keeps a small sigma > 0.
    """
    shift = float(y.mean())
    scale = float(y.std())
    size = float(np.abs(y).max())
    if scale <= _CONSTANT * size or scale == 0.0:
        return np.zeros_like(y), shift, _CONSTANT_SCALE * max(1.0, size)
    return (y - shift) / scale, shift, scale


def _unknown(kind: str, what: str, name: str, valid: Iterable[str]) -> str:
    """Return the message about a name that is not among the valid ones."""
    names = sorted(valid)
    return f"{kind} takes a {what} of {_listed(names)}, but got {name!r}{did_you_mean(name, names)}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "(none)"
