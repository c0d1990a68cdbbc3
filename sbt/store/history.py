"""The rows of a campaign's log as columns: what stages, stop rules, metamodels and reports look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.outcome import Status

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["PLANNED", "VALIDATION", "History", "Record"]

PLANNED = "planned"
"""Status of a run that was decided on and has no outcome yet."""
VALIDATION = "validation"
"""Stage of runs that are drawn at random to score the metamodel and never train it."""


@dataclass(frozen=True)
class Record:
    """One row of the store."""

    index: int
    stage: str
    iteration: int
    inputs: Mapping[str, float]
    seed: int
    status: str
    metrics: Mapping[str, float]
    reason: str
    log_q: float | None
    seconds: float
    collisions: str
    versions: str


@dataclass(frozen=True)
class History:
    """Runs with an outcome, in the order of their index.

    Args:
        names: inputs, in the order of the columns of `x`.
        records: finished runs, by increasing index.
    """

    names: tuple[str, ...]
    records: tuple[Record, ...] = ()

    def __len__(self) -> int:
        """Return the number of finished runs."""
        return len(self.records)

    @cached_property
    def x(self) -> Points:
        """(n, d) inputs in their units."""
        rows = [[r.inputs[name] for name in self.names] for r in self.records]
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(self.names))

    @cached_property
    def ok(self) -> Mask:
        """(n,) the run gave metrics."""
        return np.array([r.status == Status.OK for r in self.records], dtype=bool)

    @cached_property
    def stage(self) -> Any:
        """(n,) names of the stages that asked for the runs."""
        return np.array([r.stage for r in self.records], dtype=np.str_)

    @cached_property
    def iteration(self) -> Any:
        """(n,) iteration of each run, from 0."""
        return np.array([r.iteration for r in self.records], dtype=np.int64)

    @cached_property
    def index(self) -> Any:
        """(n,) index of each run in the campaign, from 0."""
        return np.array([r.index for r in self.records], dtype=np.int64)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics, in the order of the first run that has them."""
        return next((tuple(r.metrics) for r in self.records if r.metrics), ())

    def y(self, metric: str) -> Vector:
        """Return (n,) values of a metric, NaN where the run has none."""
        return np.array([r.metrics.get(metric, np.nan) for r in self.records], dtype=np.float64)

    def where(self, mask: Mask) -> History:
        """Return the runs where `mask` holds."""
        return History(self.names, tuple(r for r, keep in zip(self.records, mask, strict=True) if keep))

    @property
    def training(self) -> History:
        """Runs that a metamodel may learn from: finished well and not held out."""
        return self.where(self.ok & (self.stage != VALIDATION))

    @property
    def finished(self) -> History:
        """All runs that finished well: what the final answer of a campaign learns from, once it has been scored."""
        return self.where(self.ok)

    @property
    def held_out(self) -> History:
        """Runs that no metamodel learns from."""
        return self.where(self.ok & (self.stage == VALIDATION))

    def to_frame(self) -> pd.DataFrame:
        """Return a tidy frame: index, stage, iteration, x.<input>, y.<metric>, status, seed, log_q, ..."""
        import pandas as pd

        data: dict[str, Any] = {"index": self.index, "stage": self.stage, "iteration": self.iteration}
        data |= {f"x.{name}": self.x[:, k] for k, name in enumerate(self.names)}
        data |= {f"y.{name}": self.y(name) for name in self.metrics}
        data["log_q"] = np.array([np.nan if r.log_q is None else r.log_q for r in self.records], dtype=np.float64)
        for column in ("status", "reason", "seed", "collisions", "seconds", "versions"):
            data[column] = [getattr(r, column) for r in self.records]
        return pd.DataFrame(data)
