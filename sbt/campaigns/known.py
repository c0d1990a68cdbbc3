"""What an estimation knows when it chooses a batch: the runs to learn from, and what the metamodel makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sbt.campaigns.repeats import simulator_noise
from sbt.campaigns.settings import Settings
from sbt.errors import InputError
from sbt.estimators.choices import choice_scores
from sbt.estimators.events import given_a_metric, with_failed_runs
from sbt.estimators.surrogate import QUANTILE, Coordinates, LogProbability, fit_log_probability
from sbt.metamodels.base import Metamodel, fitted, predicted
from sbt.metamodels.warp import Warp
from sbt.problem.arrays import Mask, Points, Vector
from sbt.store.history import History

__all__ = ["SURE_NOISE", "Known", "metamodel_of"]

_PROBES = 9
"""Points on the segment between two critical runs, at which P must stay above 0.5 for them to be one mode."""
SURE_NOISE = 0.4
"""Part of the variance among repeats that the metamodel's noise is not allowed to be below: two repeats exaggerate."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of finished runs.

    Attributes:
        z, u, y, critical, batch: normal scores, coordinates, metric, what is critical, and the batch, of runs to learn from.
        coordinates: from normal scores to the metamodel's inputs.
        settings: of the campaign.
        noise: of each metric of the requirement, its standard deviation among repeats.
        failed, failed_batch: (k, d) normal scores and (k,) batch of runs that gave no metric.
    """

    z: Points
    u: Points
    y: Vector
    critical: Mask
    batch: Vector
    coordinates: Coordinates
    settings: Settings
    noise: tuple[float, ...]
    failed: Points
    failed_batch: Vector

    @classmethod
    def of(cls, history: History, coordinates: Coordinates, settings: Settings) -> Known:
        """Return what the history teaches, and what another campaign does."""
        runs, space = history.training, settings.scenario.space
        requirement = settings.scenario.requirement
        x, y, batch = runs.x, requirement.values(runs), runs.iteration
        lost, lost_batch = history.x[~history.ok], history.iteration[~history.ok]
        if settings.prior_runs is not None:
            first, all_first = settings.prior_runs.training, settings.prior_runs
            x, y = np.vstack([first.x, x]), np.concatenate([requirement.values(first), y])
            batch = np.concatenate([np.full(len(first), -1), batch])
            lost = np.vstack([all_first.x[~all_first.ok], lost])
            lost_batch = np.concatenate([np.full(len(lost) - len(lost_batch), -1), lost_batch])
        z, failed = (space.to_normal(rows) if len(rows) else np.empty((0, space.dimension)) for rows in (x, lost))
        noise = tuple(simulator_noise(history, part).std or 0.0 for part in requirement.parts)
        critical = requirement.critical.contains(y)
        return cls(z, coordinates(z), y, critical, batch, coordinates, settings, noise, failed, lost_batch)

    @property
    def one_sided(self) -> bool:
        """Whether all runs are critical, or none is; before the first run not, where an earlier campaign tells of both."""
        if not len(self.y) and self.settings.transfer is not None:
            return False
        return not self.critical.any() or bool(self.critical.all())

    @property
    def constant(self) -> bool:
        """Whether all runs have one metric, as where flags and speeds of impact are 0: there is nothing to follow."""
        return not len(self.y) or bool((self.y == self.y[0]).all())

    @property
    def starts(self) -> Points:
        """(k, d) normal scores of critical runs to look around, at first those of an earlier campaign."""
        found, transfer = self.z[self.critical], self.settings.transfer
        return found if transfer is None or len(found) else transfer.hits

    def modes(self, log_probability: LogProbability | None) -> int:
        """Return the number of groups of critical runs that the metamodel's critical region does not connect."""
        hits = self.z[self.critical]
        if log_probability is None or len(hits) < 2:
            return len(hits)
        i, j = np.triu_indices(len(hits), 1)
        for choice in choice_scores(self.settings.scenario.space):  # there is nothing between choices
            alike = choice.cells(hits)[i] == choice.cells(hits)[j]
            i, j = i[alike], j[alike]
        if len(i) == 0:
            return len(hits)
        along = np.linspace(0.1, 0.9, _PROBES)[:, None, None]
        probes = hits[i] * along + hits[j] * (1.0 - along)  # (probes, pairs, d)
        inside = given_a_metric(log_probability)(probes.reshape(-1, hits.shape[1]))[0].reshape(_PROBES, -1) > np.log(0.5)
        joined = inside.all(axis=0)
        graph = coo_array((np.ones(int(joined.sum())), (i[joined], j[joined])), shape=(len(hits), len(hits)))
        return int(connected_components(graph, directed=False)[0])

    def learn(self, rng: np.random.Generator) -> LogProbability | None:
        """Return log P(critical), failed runs as safe; None with too few runs."""
        transfer = self.settings.transfer
        if len(self.y) < 2 and transfer is None:
            return None
        interval, earlier = self.settings.scenario.requirement.critical, () if transfer is None else transfer.trends
        noise = [SURE_NOISE * std**2 for std in self.noise]
        given = fit_log_probability(
            metamodel_of(self.settings), self.coordinates, interval, self.z, self.y, rng, noise, earlier=earlier
        )  # fmt: skip
        ok = np.arange(len(self.z) + len(self.failed)) < len(self.z)
        return with_failed_runs(given, self.coordinates, np.vstack([self.z, self.failed]), ok, rng)

    def off(self, u: Points, y: Points | Vector, rng: np.random.Generator) -> Vector:
        """Return how many standard deviations metrics are from what a metamodel of these runs tells, the largest of each run.

        Args:
            u: (m, d) coordinates of other runs.
            y: (m,) or (m, q) their metrics.
            rng: of the fit.
        """
        own, others = (np.reshape(each, (len(each), -1)) for each in (self.y, y))
        found = np.zeros(len(y))
        for k, part in enumerate(self.settings.scenario.requirement.parts):
            known, told = np.isfinite(own[:, k]), np.isfinite(others[:, k])
            if known.sum() < 2 or not told.any():
                continue
            warp = Warp.around_edge(own[known, k], part.critical, quantile=QUANTILE)
            predictor = fitted(metamodel_of(self.settings), self.u[known], warp.values(own[known, k]), rng)
            p = predicted(predictor, u[told])
            far = np.abs(warp.values(others[told, k]) - p.mu) / np.maximum(p.sigma, 1e-300)
            found[told] = np.maximum(found[told], far)
        return found

    def attempts(self) -> tuple[Points, Vector, Vector]:
        """Return normal scores (n, d), metric (n,) and batch (n,) of all runs; the metric is NaN where a run failed."""
        none = np.full((len(self.failed), *self.y.shape[1:]), np.nan)
        return (
            np.vstack([self.z, self.failed]), np.concatenate([self.y, none]), np.concatenate([self.batch, self.failed_batch]),
        )  # fmt: skip


def metamodel_of(settings: Settings) -> Metamodel:
    """Return the metamodel of a campaign that cannot do without.

    Raises:
        InputError: there is none.
    """
    if settings.learner is None:
        raise InputError("the sequential estimator needs a metamodel, but got none")
    return settings.learner.metamodel
