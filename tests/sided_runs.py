"""Runs of one input on both sides of a requirement."""

from __future__ import annotations

from sbt.problem.outcome import Status
from sbt.store.history import History, Record

__all__ = ["sided_runs"]


def sided_runs(critical: int, uncritical: int) -> History:
    """Return runs at inputs a with a metric y: so many with -1, and so many with 1."""
    return History.of(("a",), [
        Record(k, "initial", 0, {"a": k / (critical + uncritical)}, k, str(Status.OK), {"y": -1.0 if k < critical else 1.0})
        for k in range(critical + uncritical)
    ])  # fmt: skip
