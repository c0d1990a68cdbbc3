"""One concrete scenario that was run, as `sbt.simulate` returns it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.errors import InputError
from sbt.problem.description import described_alone, rebuild_scenario
from sbt.problem.outcome import Outcome, Status
from sbt.problem.plain import Json, JsonMapping, Value, written
from sbt.problem.scenario import LogicalScenario
from sbt.problem.trace import Trace

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Run"]


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """One concrete scenario that was run.

    Attributes:
        scenario: what was run.
        inputs: all of them, in their units.
        seed: of the run.
        outcome: status, metrics, or the reason why there are none.
        states: the trace; None where the scenario has none or the run failed.
        name: of the scenario, as it was asked for.
    """

    scenario: LogicalScenario
    inputs: Mapping[str, Value]
    seed: int
    outcome: Outcome
    states: Trace | None = None
    name: str = ""

    def __post_init__(self) -> None:
        """Take the scenario's own name where it was given as an object."""
        object.__setattr__(self, "name", self.name or self.scenario.name)

    def __reduce__(self) -> tuple[Callable[..., Run], tuple[Any, ...]]:
        """Return what a pickle keeps: plain data, and of the scenario its description, without its code."""
        said = described_alone(self.scenario)
        return _from_plain, (said, dict(self.inputs), self.seed, self.outcome, self.states, self.name)

    @property
    def status(self) -> Status:
        """How the run ended."""
        return self.outcome.status

    @property
    def concrete(self) -> str:
        """The concrete scenario on one line."""
        return written(self.inputs)

    @property
    def metrics(self) -> Mapping[str, float]:
        """Every metric by name; empty where the run failed."""
        return self.outcome.metrics

    @property
    def reason(self) -> str:
        """Why there are no metrics."""
        return self.outcome.reason

    @property
    def critical(self) -> bool | None:
        """Whether the requirement is violated; None where the run has no metric."""
        return self.scenario.requirement.is_critical(self.metrics) if self.status == Status.OK else None

    @property
    def margin(self) -> float | None:
        """Signed distance of the metric to the critical interval, <= 0 where critical; None where the run has no metric.

        Of several requirements the least (any) or largest (all), every metric in its own unit.
        """
        need = self.scenario.requirement
        if self.status != Status.OK:
            return None
        told = need.told_of(self.metrics)
        return told if need.combined else float(need.critical.margin(np.array(told)))

    @cached_property
    def trace(self) -> pd.DataFrame:
        """The states of every road user over time.

        Raises:
            InputError: the run has no trace.
        """
        import pandas as pd

        if self.states is None:
            reason = self.reason or f"scenario {self.scenario.name} gives its metrics directly"
            raise InputError(f"only a run with a trace can be shown, but this one has none: {reason}")
        return pd.DataFrame(self.states.rows())

    @property
    def unconfirmed(self) -> str:
        """Where contacts and SUMO's own list of collisions differ, and how; "" where they do not."""
        return self.outcome.unconfirmed

    def to_dict(self) -> Json:
        """Return what `simulate --json` prints; `unconfirmed` only where there is something to say."""
        evidence = {"unconfirmed": self.unconfirmed} if self.unconfirmed else {}
        return evidence | {
            "scenario": self.name, "seed": self.seed, "inputs": dict(self.inputs), "status": str(self.status),
            "metrics": dict(self.metrics), "critical": self.critical, "reason": self.reason, "seconds": self.outcome.seconds,
        }  # fmt: skip

    def __repr__(self) -> str:
        """Return status, metrics and verdict."""
        metrics = ", ".join(f"{name} {value:g}" for name, value in self.metrics.items())
        verdict = {True: "critical", False: "not critical", None: self.reason}[self.critical]
        return f"<Run of {self.name}, seed {self.seed}: {self.status}, {metrics or 'no metrics'}; {verdict}>"


def _from_plain(
    described: JsonMapping, inputs: Mapping[str, Value], seed: int, outcome: Outcome, states: Trace | None, name: str
) -> Run:
    """Return a run from what a pickle kept of it."""
    return Run(rebuild_scenario(described), inputs, seed, outcome, states, name)
