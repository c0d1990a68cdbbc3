"""Which combinations are critical, where no input is continuous: there are no edges to tell of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sbt.campaigns.place import LogOdds, succeeding
from sbt.campaigns.wording import input_value, measured, plural
from sbt.problem.plain import Value
from sbt.problem.scenario import LogicalScenario

__all__ = ["CriticalCombinations", "critical_combinations"]

_TOLD, _NAMED = 3, 4  # combinations, and inputs, that a sentence tells


@dataclass(frozen=True)
class CriticalCombinations:
    """The combinations of whole numbers and choices with P(critical) > 0.5 that rather give a metric.

    Attributes:
        count: how many.
        combinations: of so many that can be run.
        surest: up to three of them, those of the largest P first.
        values: of each input, those that it takes among them.
    """

    count: int
    combinations: int
    surest: tuple[Mapping[str, Value], ...]
    values: Mapping[str, tuple[Value, ...]]

    def sentence(self, units: Mapping[str, str]) -> str:
        """Return how many, and which."""
        are = "is" if self.count == 1 else "are"
        lead = f"By the metamodel {self.count:,} of {plural(self.combinations, 'combination')} {are} critical"
        if self.count <= _TOLD:
            return f"{lead}: {'; '.join(_named(each, units) for each in self.surest)}."
        names = sorted(self.values, key=lambda name: len(self.values[name]))[:_NAMED]
        ranges = ", ".join(_range(name, self.values[name], units) for name in names)
        return f"{lead}, within {ranges}; the surest is {_named(self.surest[0], units)}."


def critical_combinations(
    log_odds: LogOdds, scenario: LogicalScenario, log_success: LogOdds | None
) -> CriticalCombinations | None:
    """Return the critical combinations by the metamodel; None without any, with a continuous input, or with more than 4,096."""
    space = scenario.space
    u = space.combinations
    if u is None:
        return None
    odds = log_odds(u) if len(u) else np.empty(0)
    critical = np.flatnonzero((odds > 0.0) & succeeding(log_success, u))
    if not len(critical):
        return None
    surest = critical[np.argsort(-odds[critical], kind="stable")]
    rows = [space.named(row) for row in space.from_unit(u[surest])]
    order = np.argsort(u[surest], axis=0, kind="stable")
    values = {name: tuple(dict.fromkeys(rows[k][name] for k in order[:, column])) for column, name in enumerate(space.names)}
    return CriticalCombinations(len(critical), len(u), tuple(rows[:_TOLD]), values)


def _named(row: Mapping[str, Value], units: Mapping[str, str]) -> str:
    more = f", {plural(len(row) - _NAMED, 'more input')}" if len(row) > _NAMED else ""
    return ", ".join(measured(name, input_value(row[name]), units.get(name, "")) for name in list(row)[:_NAMED]) + more


def _range(name: str, values: tuple[Value, ...], units: Mapping[str, str]) -> str:
    if len(values) == 1:
        return measured(name, input_value(values[0]), units.get(name, ""))
    if isinstance(values[0], str):
        return f"{name} {' or '.join(map(str, values))}"
    return f"{name} {input_value(values[0])} to {measured('', input_value(values[-1]), units.get(name, '')).strip()}"
