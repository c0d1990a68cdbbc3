"""Inputs that are a profile over time, such as the speed of a leader: several inputs shape one curve.

A profile is given by the values at knots, each of them an input, or by a recorded curve that inputs deform.

>>> speed = KnotProfile.of("v", (0.0, 2.0, 4.0), low=0.0, high=30.0, unit="m/s")
>>> [p.name for p in speed.parameters]
['v_0', 'v_1', 'v_2']
>>> curve = speed.curve({"v_0": 20.0, "v_1": 10.0, "v_2": 15.0})
>>> [curve(0.0), curve(1.0), curve(9.0)]
[20.0, 15.0, 15.0]
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from sbt import plugins
from sbt.errors import InputError, did_you_mean
from sbt.problem.arrays import Vector
from sbt.problem.distribution import Distribution
from sbt.problem.parameter import Parameter
from sbt.problem.plain import check_table

__all__ = ["DEFORMATIONS", "Curve", "Interpolation", "KnotProfile", "Profile", "RecordedProfile", "read_curve"]

Interpolation = Literal["linear", "pchip"]
DEFORMATIONS: Mapping[str, tuple[float, str]] = {
    "scale": (1.0, ""), "offset": (0.0, "value"), "shift": (0.0, "s"), "stretch": (1.0, ""),
}  # fmt: skip
"""What inputs can do to a recorded curve: neutral value, and unit (`value`: that of the curve)."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity over time, constant before the first and after the last instant.

    Args:
        time: (n,) increasing (s).
        value: (n,) at these instants.
        interpolate: between them: `linear`, or `pchip` (smooth, monotone between two knots, without overshoot).
    """

    time: Vector
    value: Vector
    interpolate: Interpolation = "linear"

    @cached_property
    def _function(self) -> Callable[[float], float]:
        if self.interpolate == "linear":
            return lambda t: float(np.interp(t, self.time, self.value))
        from scipy.interpolate import PchipInterpolator

        smooth, first, last = PchipInterpolator(self.time, self.value), self.time[0], self.time[-1]
        return lambda t: float(smooth(min(max(t, first), last)))

    def __call__(self, t: float) -> float:
        """Return the value at a time (s)."""
        return self._function(t)

    def at(self, times: Vector) -> Vector:
        """Return the (n,) values at (n,) times (s)."""
        return np.array([self(t) for t in np.asarray(times, dtype=np.float64).tolist()])


class Profile(Protocol):
    """A curve that inputs shape."""

    @property
    def name(self) -> str:
        """Of the profile; its inputs have names that begin with it."""
        ...

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The inputs."""
        ...

    def curve(self, values: Mapping[str, float]) -> Curve:
        """Return the curve for the values of the inputs."""
        ...


@dataclass(frozen=True)
class KnotProfile:
    """A profile by the values at knots, which are its inputs `NAME_0`, `NAME_1`, ...

    Args:
        name: of the profile.
        times: of the knots (s), increasing.
        parameters: as many inputs, in order.
        interpolate: between the knots.
        rate: lowest and highest mean rate of change between two knots (unit / s); infinite: no limit.

    Raises:
        InputError: fewer than two knots, times that do not increase, or a number of inputs that differs.
    """

    name: str
    times: tuple[float, ...]
    parameters: tuple[Parameter, ...]
    interpolate: Interpolation = "linear"
    rate: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.times, self.times[1:], strict=False))
        if len(self.times) < 2 or not rising or not all(map(math.isfinite, self.times)):
            raise InputError(f"profile {self.name}: knots must be two or more increasing times (s), but got {list(self.times)}")
        if len(self.parameters) != len(self.times):
            raise InputError(f"profile {self.name}: {len(self.times)} knots need as many inputs, but got {len(self.parameters)}")
        _check_interpolation(self.name, self.interpolate)
        if not self.rate[0] < self.rate[1]:
            raise InputError(f"profile {self.name}: rate must be [lowest, highest], but got {list(self.rate)}")

    @classmethod
    def of(
        cls, name: str, times: Sequence[float], low: float, high: float, unit: str = "",
        distribution: Distribution | None = None, *, description: str = "", interpolate: Interpolation = "linear",
        rate: tuple[float, float] = (-math.inf, math.inf),
    ) -> KnotProfile:  # fmt: skip
        """Return a profile whose inputs have the same range, unit and distribution."""
        about = f"{description or name} at t = "
        inputs = tuple(
            Parameter(f"{name}_{k}", low, high, unit, distribution, "continuous", f"{about}{t:g} s") for k, t in enumerate(times)
        )
        return cls(name, tuple(map(float, times)), inputs, interpolate, rate)

    @property
    def constraints(self) -> tuple[str, ...]:
        """Conditions on the inputs that keep the mean rate between knots within its limits."""
        found, names = [], [p.name for p in self.parameters]
        for k in range(len(names) - 1):
            step, change = self.times[k + 1] - self.times[k], f"{names[k + 1]} - {names[k]}"
            if math.isfinite(self.rate[0]):
                found.append(f"{change} >= {self.rate[0] * step!r}")
            if math.isfinite(self.rate[1]):
                found.append(f"{change} <= {self.rate[1] * step!r}")
        return tuple(found)

    def curve(self, values: Mapping[str, float]) -> Curve:
        """Return the curve for the values of the inputs."""
        return Curve(np.array(self.times), np.array([float(values[p.name]) for p in self.parameters]), self.interpolate)


@dataclass(frozen=True, eq=False)
class RecordedProfile:
    """A recorded curve that inputs deform: scale * value + offset at the times stretch * time + shift.

    Args:
        name: of the profile.
        recorded: the curve.
        deformations: (what, input) pairs, each `scale`, `offset`, `shift` (s) or `stretch`.

    Raises:
        InputError: no deformation, an unknown one, or a scale of time that can be <= 0.
    """

    name: str
    recorded: Curve
    deformations: tuple[tuple[str, Parameter], ...] = field(default=())

    def __post_init__(self) -> None:
        if not self.deformations:
            known = ", ".join(DEFORMATIONS)
            raise InputError(f"profile {self.name}: a recorded profile needs an input that deforms it ({known}), but has none")
        for what, parameter in self.deformations:
            if what not in DEFORMATIONS:
                hint = did_you_mean(what, list(DEFORMATIONS))
                raise InputError(f"profile {self.name}: must be deformed by {', '.join(DEFORMATIONS)}, but got '{what}'{hint}")
            if what == "stretch" and not parameter.low > 0:
                raise InputError(f"profile {self.name}: stretch must be > 0, but its range begins at {parameter.low:g}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The inputs."""
        return tuple(parameter for _, parameter in self.deformations)

    def curve(self, values: Mapping[str, float]) -> Curve:
        """Return the curve for the values of the inputs."""
        by = {what: neutral for what, (neutral, _) in DEFORMATIONS.items()}
        by |= {what: float(values[parameter.name]) for what, parameter in self.deformations}
        recorded = self.recorded
        time, value = by["stretch"] * recorded.time + by["shift"], by["scale"] * recorded.value + by["offset"]
        return Curve(time, value, recorded.interpolate)


def read_curve(path: Path, time: str, value: str, interpolate: Interpolation = "linear") -> Curve:
    """Read a recorded curve from a CSV file with a header.

    Args:
        path: the file, separated by `,` or `;`.
        time: column of the times (s); the first one becomes 0.
        value: column of the values.
        interpolate: between them.

    Raises:
        InputError: it cannot be read, lacks a column, or the times do not increase.
    """
    check_table(path)
    try:
        lines = plugins.noted(path.resolve()).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"a recorded profile must be a readable CSV file, but '{path}' is not: {error}") from None
    try:
        rows = list(csv.reader(lines, delimiter=";" if lines and ";" in lines[0] else ","))
    except csv.Error as error:
        raise InputError(f"a recorded profile must be a readable CSV file, but '{path}' is not: {error}") from None
    header = [name.strip() for name in rows[0]] if rows else []
    for column in (time, value):
        if column not in header:
            hint = did_you_mean(column, header)
            raise InputError(f"{path}: a column must be one of {', '.join(header) or 'none'}, but got '{column}'{hint}")
    numbers: list[tuple[float, float]] = []
    for k, row in enumerate(rows[1:], start=2):
        if row:
            try:
                t, v = float(row[header.index(time)]), float(row[header.index(value)])
            except (ValueError, IndexError):
                raise InputError(f"{path}:{k}: {time} and {value} must be numbers, but got '{','.join(row)}'") from None
            if not (math.isfinite(t) and math.isfinite(v)) or (numbers and not t > numbers[-1][0]):
                raise InputError(f"{path}:{k}: {time} must increase and both be finite, but got '{','.join(row)}'")
            numbers.append((t, v))
    if len(numbers) < 2:
        raise InputError(f"{path}: a recorded profile must have two rows or more, but has {len(numbers)}")
    _check_interpolation(str(path), interpolate)
    table = np.array(numbers)
    return Curve(table[:, 0] - table[0, 0], table[:, 1], interpolate)


def _check_interpolation(name: str, interpolate: str) -> None:
    if interpolate not in ("linear", "pchip"):
        raise InputError(f"profile {name}: interpolate must be linear or pchip, but got '{interpolate}'")
