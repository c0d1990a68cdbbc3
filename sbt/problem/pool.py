"""Recorded outcomes, of which a campaign takes each at most once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sbt.errors import InputError
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import Requirement
from sbt.problem.space import ParameterSpace

__all__ = ["Pool"]


@dataclass(frozen=True, eq=False)
class Pool:
    """Recorded outcomes to choose among instead of simulating: x (n, d), metrics of (n,) each.

    Rows of the same inputs are runs of other seeds. Which of them is taken when does not matter, and so the first time that these
    inputs are asked for gives the first one, the next time the next.

    Args:
        x: (n, d) inputs in their units, a choice as its position.
        metrics: (n,) of each, by name.
        notes: in sentences, what whoever reads results of these rows must know of them.
        assumed: the requirement that nobody stated; None: one is stated.
        even: whoever made the table says that rows fill the space evenly, or that they do not; None: it is not said.
    """

    x: Points
    metrics: Mapping[str, Vector]
    notes: tuple[str, ...] = ()
    assumed: Requirement | None = None
    even: bool | None = None

    @cached_property
    def _rows(self) -> dict[bytes, list[int]]:
        rows: dict[bytes, list[int]] = {}
        for k, row in enumerate(self.x):
            rows.setdefault(_key(row), []).append(k)
        return rows

    @cached_property
    def repeats(self) -> bool:
        """Whether some inputs have several rows."""
        return len(self._rows) < len(self.x)

    def within(self, own: ParameterSpace, space: ParameterSpace) -> Pool:
        """Return the rows that are feasible in a space, its choices coded as there; `own` is the space that they are of now.

        Raises:
            InputError: fewer than two are.
        """
        x = np.array(self.x)
        for k, (old, new) in enumerate(zip(own.parameters, space.parameters, strict=True)):
            if old.choices:
                place = [new.choices.index(choice) if choice in new.choices else -1 for choice in old.choices]
                x[:, k] = np.array(place)[x[:, k].astype(np.intp)]
        kept = space.feasible(x)
        every, left = len(kept), int(kept.sum())
        if left < 2:
            raise InputError(f"inputs and constraints must admit at least two of the {every:,} recorded rows, but admit {left}")
        if left == every:
            return replace(self, x=x)
        note = f"{every - left:,} of {every:,} recorded rows lie outside of the inputs' ranges or constraints, and are left out."
        return replace(self, x=x[kept], metrics={name: y[kept] for name, y in self.metrics.items()}, notes=(*self.notes, note))

    def y(self, metric: str) -> Vector:
        """Return (n,) values of a metric."""
        return self.metrics[metric]

    def row(self, x: Vector, number: int = 0) -> int | None:
        """Return the index of a row with exactly these inputs, of several that of this number; None where there is none."""
        found = self._rows.get(_key(x))
        return None if found is None else found[number % len(found)]

    def taken(self, x: Points) -> Mask:
        """Return (n,) booleans: the row is among the points (m, d); as many of the same inputs as there are such points."""
        mask = np.zeros(len(self.x), dtype=bool)
        for key, times in Counter(map(_key, x)).items():
            mask[self._rows.get(key, [])[:times]] = True
        return mask

    def numbers(self, before: Points, x: Points) -> list[int | None]:
        """Return for each of the points (n, d) which row of its inputs comes next after `before` (m, d).

        None where there is but one, or none.
        """
        times, found = Counter(map(_key, before)), []
        for key in map(_key, x):
            found.append(times[key] if len(self._rows.get(key, ())) > 1 else None)
            times[key] += 1
        return found

    def told(self, requirement: Requirement) -> tuple[str, ...]:
        """Return in sentences what a reader must know of the rows where this is required."""
        if requirement is not self.assumed:
            return self.notes
        need = f"{requirement.metric} ≤ {requirement.high:g}"
        return (f"Nothing says what is critical of these rows: {need} is assumed (state requirement to change it).", *self.notes)


def _key(x: Iterable[float]) -> bytes:
    """Return what inputs are found by; zero has no sign."""
    return (np.ascontiguousarray(x, dtype=np.float64) + 0.0).tobytes()
