"""A scenario in which the ego can be exchanged from run to run: one of its inputs says who drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sbt.errors import InputError
from sbt.metrics.conflict_types import Decisive
from sbt.metrics.preventability import applicability
from sbt.problem.parameter import Parameter
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario, Simulate
from sbt.problem.space import ParameterSpace
from sbt.problem.trace import Trace

__all__ = ["DRIVER", "ExchangedEgo", "with_drivers"]

DRIVER = "driver"
"""Name of the input: 0 is the scenario's own ego, k the k-th of the drivers."""


@dataclass(frozen=True)
class ExchangedEgo:
    """Simulates the same concrete scenario with one of several egos.

    Args:
        scenarios: that with its own ego first.
    """

    scenarios: tuple[LogicalScenario, ...]
    isolations: tuple[str, ...] = ()
    step_length: float = 0.0

    def __call__(self, values: Values, seed: int) -> Trace:
        """Run the scenario with the ego that `values` ask for."""
        scenario = self.scenarios[int(values[DRIVER])]
        if scenario.simulate is None:
            raise InputError(f"scenario {scenario.name} gives its metrics directly: its ego cannot be exchanged")
        return scenario.simulate({name: values[name] for name in scenario.space.names}, seed)

    def prepare(self) -> None:
        """Load what is slow to load."""
        self.scenarios[0].prepare()

    def limited(self, timeout: float | None) -> Simulate:
        """Return a copy whose runs end after so many wall-clock seconds."""
        return replace(self, scenarios=tuple(each.limited(timeout) for each in self.scenarios))

    def configured(
        self, ego: Mapping[str, Any] | None = None, isolation: str | None = None, step_length: float | None = None
    ) -> Simulate:
        """Refuse further choices.

        Raises:
            InputError: always.
        """
        raise InputError("a scenario whose ego is exchanged takes no further choices")


def with_drivers(
    scenario: LogicalScenario, drivers: Sequence[Mapping[str, Any]], decisive: Sequence[Decisive] = ()
) -> LogicalScenario:
    """Return the scenario with the further input `DRIVER`, and with the metrics that say whether drivers can judge a run.

    Args:
        scenario: with its own ego.
        drivers: other egos: kind and settings.
        decisive: metrics that decide whether a run is critical, and so whom its conflict is with.

    Raises:
        InputError: it does not take one of them.
    """
    egos = (scenario, *(scenario.configured(ego=dict(driver)) for driver in drivers))
    who = Parameter(DRIVER, 0, max(len(drivers), 1), "", kind="integer")
    found = applicability(scenario.roles.ego, decisive, scenario.roles.also_tested)
    metrics = (*(m for m in scenario.metrics if m.name != found.name), found)
    space = ParameterSpace((*scenario.space.parameters, who))
    return replace(scenario, space=space, simulate=ExchangedEgo(egos), metrics=metrics)
