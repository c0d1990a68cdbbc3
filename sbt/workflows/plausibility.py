"""A check of one trace for users' own tests: nobody in it does what the laws of motion exclude."""

from __future__ import annotations

from collections.abc import Sequence

from sbt.metrics.physics import breaches
from sbt.problem.trace import Trace
from sbt.workflows.contracts import ContractError

__all__ = ["check_physics"]


def check_physics(trace: Trace, scripted: Sequence[str] = ()) -> None:
    """Check that nobody in a trace does what tyres, drivers and pedestrians cannot (`sbt.metrics.physics`).

    Args:
        trace: of one run.
        scripted: road users whose braking an input of the scenario decides: not judged as drivers.

    Raises:
        ContractError: a law of motion is broken.
    """
    broken = breaches(trace, scripted)
    if broken:
        raise ContractError("; ".join(map(str, broken)))
