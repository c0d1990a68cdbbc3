"""Runs of an earlier campaign that a metamodel learns from beside those of its own.

Where the earlier campaign had another setup, one more input tells its runs from the campaign's: a metamodel of all of them learns
how alike both setups are, and trusts the earlier runs where there are no own ones. Whether they help is judged on the own runs,
each predicted from all others.

Source:
    Bonilla, Chai and Williams (2007), Multi-task Gaussian process prediction, NeurIPS 20: tasks are told apart by a kernel of
    their own, here that of the further input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbt.metamodels.base import named_errors
from sbt.metamodels.stacking import Bins
from sbt.problem.arrays import Points, Vector
from sbt.problem.combination import CombinedInterval
from sbt.problem.plain import Json, JsonMapping
from sbt.problem.requirement import CriticalInterval

__all__ = ["EarlierRuns"]

_FEWEST, _MOST = 6, 300
"""Own runs from which on the earlier ones are judged, and that they are judged by at most."""


@dataclass(frozen=True, eq=False)
class EarlierRuns:
    """Runs of an earlier campaign.

    Args:
        u: (m, e) metamodel inputs, as the new campaign has them.
        y: (m,) what is learned of them, or (m, q) of a combination, NaN where a run does not have a metric.
        other: the setup was another one.
    """

    u: Points
    y: Vector
    other: bool

    def __len__(self) -> int:
        return len(self.u)

    def own(self, u: Points) -> Points:
        """Return metamodel inputs (n, e) of the campaign's own runs as a metamodel of both gets them."""
        return np.column_stack([u, np.ones(len(u))]) if self.other else u

    def joined(self, u: Points, y: Vector) -> tuple[Points, Vector]:
        """Return the rows of both: the earlier ones and then the own, of inputs as `own` returns them."""
        before = np.column_stack([self.u, np.zeros(len(self))]) if self.other else self.u
        return np.concatenate([before, u]), np.concatenate([self.y, y])

    def helps(self, u: Points, y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> bool:
        """Return whether own runs are predicted no worse with the earlier ones, each from all others.

        Runs of the same setup help; of few own runs nothing can be told.

        Args:
            u: (n, e) own inputs, as `own` returns them.
            y: (n,) or (n, q) own values.
            critical: M_c, or that of the combination.
            rng: the only source of randomness.
        """
        if not self.other or len(u) < _FEWEST:
            return True
        rows = np.sort(rng.permutation(len(u))[:_MOST])
        u, y = u[rows], y[rows]
        all_u, all_y = self.joined(u, y)
        if not isinstance(critical, CombinedInterval):
            return bool(_gain(u, y, all_u, all_y, critical, rng) >= 0.0)
        leaves = enumerate(critical.leaves)
        return sum(_gain(u, y[:, k], all_u, all_y[:, k], leaf, rng) for k, leaf in leaves) >= 0.0

    def to_json(self) -> Json:
        """Return plain data."""
        return {"u": self.u.tolist(), "y": [_plain(row) for row in self.y.tolist()], "other": self.other}

    @classmethod
    def from_json(cls, data: JsonMapping) -> EarlierRuns:
        """Return the runs from plain data."""
        y = np.array([[np.nan if v is None else v for v in row] if isinstance(row, list) else row for row in data["y"]])
        return cls(np.array(data["u"], dtype=np.float64), y.astype(np.float64), bool(data["other"]))


def _plain(row: Json) -> Json:
    return [None if v != v else v for v in row] if isinstance(row, list) else row


def _gain(u: Points, y: Vector, all_u: Points, all_y: Vector, critical: CriticalInterval, rng: np.random.Generator) -> float:
    """Return how much more log likelihood the own runs' ranges have with all rows, the own ones last, than with the own ones."""
    mine, known = np.isfinite(y), np.isfinite(all_y)
    if mine.sum() < _FEWEST:
        return 0.0
    bins = Bins.around_edge(y[mine], critical)
    alone, together = _left_out(u[mine], y[mine], bins, rng), _left_out(all_u[known], all_y[known], bins, rng)
    return float(together[-int(mine.sum()) :].mean() - alone.mean())


def _left_out(u: Points, y: Vector, bins: Bins, rng: np.random.Generator) -> Vector:
    """Return (n,) log probabilities of the range that each row fell into, predicted from all others."""
    from sbt.metamodels.gaussian_process import GaussianProcess

    judge = GaussianProcess(nu=2.5, input_noise=False)
    with named_errors(judge, len(y)):
        return bins.log_score(judge.fit(u, y, rng).leave_one_out(u, y), y)
