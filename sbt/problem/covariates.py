"""What the seed of a run draws, where it is known before the run: named numbers of a pair of inputs and seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sbt.errors import RAISED, InputError, SbtError, described, shown
from sbt.problem.arrays import Points, Vector
from sbt.problem.plain import Values, written
from sbt.problem.scenario import LogicalScenario, Simulate

__all__ = ["Covariates", "DrawsAhead", "telling_all"]


_LARGEST = 1e30


@runtime_checkable
class DrawsAhead(Protocol):
    """A `simulate` or `evaluate` that can tell what it draws for a seed, without running."""

    def known_before(self, values: Values, seed: int) -> Mapping[str, float] | None:
        """Return the covariates of a concrete scenario by name, always the same names; None: it tells none."""
        ...


@runtime_checkable
class TellsAll(Protocol):
    """A `DrawsAhead` that has a general set of covariates, where it has none of its own."""

    def telling_all(self) -> Simulate:
        """Return a copy that tells the general set, or its own."""
        ...


def telling_all(scenario: LogicalScenario) -> LogicalScenario:
    """Return the scenario with the general covariates, where it has none of its own and its traffic is drawn before the run."""
    simulate = scenario.simulate
    return replace(scenario, simulate=simulate.telling_all()) if isinstance(simulate, TellsAll) else scenario


@dataclass(frozen=True, eq=False)
class Covariates:
    """The covariates of a scenario.

    Args:
        scenario: whose inputs they take.
        source: its `simulate` or `evaluate`.
        names: of the covariates.
    """

    scenario: LogicalScenario
    source: DrawsAhead
    names: tuple[str, ...]
    _known: dict[tuple[bytes, int], Vector] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, scenario: LogicalScenario) -> Covariates | None:
        """Return the covariates of a scenario, None where it tells none.

        Raises:
            InputError: they are not finite.
        """
        source = scenario.simulate if scenario.evaluate is None else scenario.evaluate
        if not isinstance(source, DrawsAhead):
            return None
        centre = scenario.space.named(np.array([p.centre for p in scenario.space.parameters], dtype=np.float64))
        found = _told(source, centre, 0)
        return None if not found else cls(scenario, source, tuple(found))

    def at(self, x: Points, seeds: Sequence[int], *, keep: bool = True) -> Points:
        """Return the (n, c) covariates of inputs (n, d), in their units, with a seed each.

        Args:
            x: the inputs.
            seeds: of each.
            keep: remember what was computed; not worth the memory for pools, of which few pairs are met again.

        Raises:
            InputError: they are not finite, have other names than elsewhere in the space, or are not what they were before.
        """
        self._check_unchanged()
        rows = np.empty((len(x), len(self.names)))
        for k, (row, seed) in enumerate(zip(x, seeds, strict=True)):
            key = row.tobytes(), int(seed)
            known = self._known.get(key)
            rows[k] = self._drawn(row, int(seed)) if known is None else known
            if keep and known is None:
                self._known[key] = rows[k].copy()
        return rows

    def of_points(self, u: Points, seeds: NDArray[np.int64], *, keep: bool = True) -> Points:
        """Return `at` of points of the unit cube u (n, d), with their n seeds."""
        return self.at(self.scenario.space.from_unit(u), seeds.tolist(), keep=keep)

    def beside_inputs(self, x: Points, seeds: Sequence[int], *, keep: bool = True) -> Points:
        """Return the (n, e + c) columns that pairs are learned by: metamodel inputs of x (n, d), and `at`."""
        return np.column_stack([self.scenario.space.metamodel_inputs_at(x), self.at(x, seeds, keep=keep)])

    def _check_unchanged(self) -> None:
        """Compute the covariates of the first pair again: runs since then must not have changed them."""
        if self._known:
            (row, seed), known = next(iter(self._known.items()))
            again = self._drawn(np.frombuffer(row), seed)
            if not np.array_equal(again, known):
                name, old, new = next(each for each in zip(self.names, known, again, strict=True) if each[1] != each[2])
                raise InputError(
                    f"covariates must be known before the run, the same whenever they are computed, but {name} of seed {seed} was"
                    f" {old:g} and is now {new:g}"
                )

    def _drawn(self, row: Vector, seed: int) -> Vector:
        values = self.scenario.space.named(row)
        found = _told(self.source, values, seed)
        if found is None or set(found) != set(self.names):
            raise InputError(
                f"covariates must have the same names everywhere ({', '.join(self.names)}), but at {written(values)}, seed {seed}"
                f" they are {', '.join(found or ()) or 'none'}"
            )
        for name, value in found.items():
            if not math.isfinite(value):
                raise InputError(f"covariate {name} must be finite, but is {value} at {written(values)}, seed {seed}")
            if abs(value) > _LARGEST:
                rule = f"covariate {name} must be within \N{PLUS-MINUS SIGN}{_LARGEST:g}, as it is learned in single precision"
                raise InputError(f"{rule}, but is {value:g} at {written(values)}, seed {seed}")
        return np.array([found[name] for name in self.names], dtype=np.float64)


def _told(source: DrawsAhead, values: Values, seed: int) -> Mapping[str, float] | None:
    """Return the covariates of a pair; an error of the scenario's own code says where."""
    try:
        found = source.known_before(values, seed)
    except SbtError:
        raise
    except RAISED as error:
        raise InputError(
            f"covariates must be known before the run, but at {written(values)}, seed {seed} computing them raised"
            f" {described(error)}"
        ) from error
    where = f"at {written(values)}, seed {seed}"
    if found is not None and not isinstance(found, Mapping):
        raise InputError(f"known_before must return numbers by name, or None, but is {shown(found)} {where}")
    for name, value in (found or {}).items():
        if not isinstance(value, float | Real):
            raise InputError(f"covariate {name} must be a number, but is {shown(value)} {where}")
    return found
