"""The sequential estimator as a stage: hunt, learn, then count, every batch a function of the log.

A batch of the estimation has draws from a fresh pool, with known density, and hunting picks without
one. Up to a stopping time the draws only teach; from then on they count, with weights fixed in advance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtri

from sbt.arrays import Points, Vector
from sbt.campaign import Batch, Log
from sbt.campaigns.parts import Settings
from sbt.errors import InputError
from sbt.estimators.hunt import BASIN, greedy, outside
from sbt.estimators.importance import BLIND, SHARES, Plan, chosen, planned
from sbt.estimators.intervals import Combined, Counted, combined
from sbt.estimators.mixture import Mixture, fitted, log_normal, particles, wide_scales
from sbt.estimators.surrogate import Coordinates, LogProbability, learned
from sbt.history import History
from sbt.problem.space import ParameterSpace
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import stream
from sbt.store import PlannedRun

__all__ = ["DRAWN", "SequentialStage", "counted_batches"]

DRAWN = "estimation"
"""Stage of runs that were drawn with a known density."""
_HUNT = "hunt"
_POOL = 10_000
_PARTICLES = 800
_CANDIDATES = 6_000
_PHASE_0 = (0.25, 0.4)
_LEARN = 0.6
_HUNTED_SHARE = 0.2
_FEWEST_BATCHES = 4
_TARGET = 0.02


@dataclass(frozen=True)
class SequentialStage:
    """Hunts critical regions, learns them, then draws runs that count.

    Source:
        the difference form, its defence, weights and interval: `sbt.estimators`.
    """

    settings: Settings
    name: str = DRAWN

    @cached_property
    def _coordinates(self) -> Coordinates:
        return Coordinates(self.settings.scenario.space)

    @cached_property
    def _wide(self) -> Vector:
        return wide_scales(self._coordinates.bounded)

    def stop(self, log: Log) -> str | None:
        """Return `budget` once it is used up, `cov` where the estimate is precise enough."""
        s = self.settings
        if log.iterations and len(log.history) >= s.budget:
            return "budget"
        target = s.stop.get("cov")
        counted = counted_batches(log, s)
        if target is not None and len(counted) >= _FEWEST_BATCHES:
            found = combined(counted)
            hits = sum(float(b.critical.sum()) for b in counted)
            if hits >= 10 and found.value > 0 and found.std_error <= target * found.value:
                return "cov"
        return None

    def propose(self, log: Log) -> Batch:
        """Return the next batch."""
        s = self.settings
        if log.iteration == 0:
            return self._initial(min(s.initial, s.budget))
        size = min(s.batch, s.budget - len(log.history))
        known = _Known.of(log.history, self._coordinates, s)
        if self._hunting(log, known):
            rows = self._hunt(known, log.iteration, size)
            return Batch(self._runs(rows, _HUNT), {"method": "hunt", "phase": "hunt", "modes": known.modes})
        return self._drawn(log, known, size)

    def _initial(self, n: int) -> Batch:
        """Return an even design over the wide law."""
        sobol = SobolSequence(self.settings.scenario.space.dimension, self.settings.seed)
        z = ndtri(sobol.points(0, n)) * self._wide
        return Batch(self._runs(self._feasible(z, 0), "initial"), {"method": "sobol", "phase": "initial"})

    def _feasible(self, z: Points, iteration: int) -> Points:
        """Return the points with those outside of the constraints replaced by draws of the law."""
        space = self.settings.scenario.space
        bad = ~space.feasible(space.from_normal(z))
        if bad.any():
            z = z.copy()
            z[bad] = space.to_normal(space.sample(int(bad.sum()), stream(self.settings.seed, "feasible", iteration)))
        return z

    def _runs(self, z: Points, stage: str, log_q: Vector | None = None) -> tuple[PlannedRun, ...]:
        space = self.settings.scenario.space
        rows = space.from_normal(z)
        densities = [None] * len(rows) if log_q is None else [float(q) for q in log_q]
        return tuple(
            PlannedRun(stage, {name: float(v) for name, v in zip(space.names, row, strict=True)}, density)
            for row, density in zip(rows, densities, strict=True)
        )

    def _hunting(self, log: Log, known: _Known) -> bool:
        """Return whether phase 0 goes on: to 40 % of the budget, no longer than two batches without a new mode."""
        spent = len(log.history)
        if spent >= _PHASE_0[1] * self.settings.budget or any(i.get("phase") != "hunt" for i in log.iterations[1:]):
            return False
        modes = [i["modes"] for i in log.iterations[1:]] + [known.modes]
        return not (len(modes) >= 3 and modes[-1] == modes[-3] and known.modes > 0)

    def _hunt(self, known: _Known, iteration: int, n: int) -> Points:
        """Return n hunting picks (n, d)."""
        s, rng = self.settings, stream(self.settings.seed, "hunt", iteration)
        if n == 0:
            return np.empty((0, s.scenario.space.dimension))
        z = self._feasible(rng.standard_normal((4000, len(self._wide))) * self._wide, iteration)
        u = self._coordinates(z)
        free = outside(u, known.u[known.critical])
        if free.sum() < 10 * n:
            free[:] = True
        z, u = z[free], u[free]
        belief = known.learn(stream(s.seed, "hunt fit", iteration), deflated=True)
        score = (lambda _: np.zeros(len(z))) if belief is None else (lambda _: belief(z)[0])
        return z[greedy(u, score, known.u, n, even=max(n // 3, 1) if n > 1 else 0)]

    def _drawn(self, log: Log, known: _Known, size: int) -> Batch:
        """Return draws from a fresh pool, and hunting picks."""
        s, rng = self.settings, stream(self.settings.seed, "draw", log.iteration)
        hunted = min(round(_HUNTED_SHARE * size), size - 1)
        belief = known.learn(stream(s.seed, "fit", log.iteration))
        mixture = self._mixture(belief, known, rng)
        z, stratum = mixture.sample(_POOL, rng)
        x = s.scenario.space.from_normal(z)
        log_w = log_normal(z) - mixture.log_density(z)
        if s.scenario.space.constraints:
            log_w = np.where(s.scenario.space.feasible(x), log_w - np.log(s.scenario.space.feasible_mass), -np.inf)
        log_wide = log_normal(z, self._wide) - mixture.log_density(z)
        unsure = np.full(len(z), np.log(0.5))
        log_pi, log_not = (unsure, unsure) if belief is None else belief(z)
        plan = planned(log_pi, log_not, log_w, log_wide, stratum, BLIND if known.one_sided else SHARES)
        n = size - hunted
        draws = chosen(plan, n, rng.permutation(len(z)).astype(float), rng)
        log_q = s.scenario.space.log_density(x[draws.rows]) - np.log(draws.coefficient)
        counts = self._counts(log, plan, size)
        how = {
            "method": plan.form, "phase": "count" if counts else "learn", "pool": _POOL, "draws": n,
            "prior": plan.prior, "anticipated": plan.anticipated, "pool_variance": plan.pool_variance,
            "nominal": plan.nominal, "coefficient": draws.coefficient.tolist(), "believed": draws.believed.tolist(),
            "pi": np.exp(log_pi[draws.rows]).tolist(), "components": len(mixture.shares), "modes": known.modes,
        }  # fmt: skip
        picks = self._runs(self._hunt(known, log.iteration, hunted), _HUNT)
        return Batch((*self._runs(z[draws.rows], DRAWN, log_q), *picks), how)

    def _mixture(self, belief: LogProbability | None, known: _Known, rng: np.random.Generator) -> Mixture:
        """Return h, fitted to particles of p pi and of p sqrt(pi (1 - pi))."""
        if belief is None or not known.critical.any():
            return Mixture(self._wide)
        start = Mixture(self._wide, None)
        z, _ = start.sample(_CANDIDATES, rng)
        hits = known.z[known.critical]
        near = hits[rng.integers(len(hits), size=_CANDIDATES // 3)]
        near = near + 0.3 * rng.standard_normal(near.shape)
        z = np.concatenate([z, near])
        from scipy.special import logsumexp
        d = z.shape[1]
        kernel = -0.5 * ((z[:, None] - hits[None]) ** 2).sum(axis=2) / 0.09 - 0.5 * d * np.log(2 * np.pi * 0.09)
        kernel = logsumexp(kernel, axis=1) - np.log(len(hits))
        log_start = np.logaddexp(start.log_density(z) + np.log(0.75), kernel + np.log(0.25))
        clouds = []
        for doubtful in (False, True):
            def target(points: Points, doubtful: bool = doubtful) -> Vector:
                log_pi, log_not = belief(points)
                return log_normal(points) + (0.5 * (log_pi + log_not) if doubtful else log_pi)

            clouds.append(particles(target, z, log_start, _PARTICLES, rng))
        return fitted(tuple(clouds), self._wide, rng)

    def _counts(self, log: Log, plan: Plan, size: int) -> bool:
        """Return whether this batch counts: from the stopping time on, which looks only at what is past."""
        drawn = [i for i in log.iterations if i.get("phase") in ("learn", "count")]
        if any(i["phase"] == "count" for i in drawn):
            return True
        s, spent = self.settings, len(log.history)
        if spent + size > _LEARN * s.budget:
            return True
        left = (1.0 - _HUNTED_SHARE) * (s.budget - spent)
        base = max(plan.prior, 1e-300)
        target = s.stop.get("cov")
        target = _TARGET if target is None else target
        return len(drawn) >= 1 and (plan.anticipated / left) ** 0.5 <= target * base


@dataclass(frozen=True, eq=False)
class _Known:
    """Runs to learn from: normal scores z, coordinates u, metric y, and what is critical."""

    z: Points
    u: Points
    y: Vector
    critical: Any
    coordinates: Coordinates
    settings: Settings

    @classmethod
    def of(cls, history: History, coordinates: Coordinates, settings: Settings) -> _Known:
        runs = history.training
        z = settings.scenario.space.to_normal(runs.x) if len(runs) else np.empty((0, settings.scenario.space.dimension))
        requirement = settings.scenario.requirement
        y = runs.y(requirement.metric)
        return cls(z, coordinates(z), y, requirement.critical.contains(y), coordinates, settings)

    @property
    def one_sided(self) -> bool:
        """Whether all runs are critical, or none is."""
        return not self.critical.any() or bool(self.critical.all())

    @cached_property
    def modes(self) -> int:
        """Number of basins that the critical runs fill, in their order."""
        centres: list[Vector] = []
        for u in self.u[self.critical]:
            if not centres or outside(u[None], np.array(centres), BASIN)[0]:
                centres.append(u)
        return len(centres)

    def learn(self, rng: np.random.Generator, *, deflated: bool = False) -> LogProbability | None:
        """Return the belief; `deflated` leaves out what lies around critical runs. None with too few runs."""
        keep = np.ones(len(self.y), dtype=bool)
        if deflated and self.critical.any():
            rest = outside(self.u, self.u[self.critical])
            keep = rest if rest.sum() >= 5 else keep
        learner = self.settings.learner
        if learner is None:
            raise InputError("the difference estimator needs a metamodel, but got none")
        if keep.sum() < 2:
            return None
        interval = self.settings.scenario.requirement.critical
        return learned(learner.metamodel, self.coordinates, interval, self.z[keep], self.y[keep], rng)


def counted_batches(log: Log, settings: Settings, *, failed_critical: bool = False) -> list[Counted]:
    """Return the batches that count, with their outcomes; failed runs count as stated.

    Raises:
        InputError: a counted run has no proposal density.
    """
    found, requirement = [], settings.scenario.requirement
    critical = requirement.critical.contains(log.history.y(requirement.metric))
    critical = critical | (failed_critical & ~log.history.ok)
    drawn = log.history.stage == DRAWN
    for how in log.iterations:
        if how.get("phase") != "count":
            continue
        rows = np.flatnonzero(drawn & (log.history.iteration == how["iteration"]))
        if len(rows) < how["draws"]:
            continue  # a batch counts only when it is complete
        if any(log.history.records[k].log_q is None for k in rows):
            raise InputError("an estimate needs runs with a known proposal density, but a counted run has none")
        found.append(Counted(
            how["prior"], how["anticipated"], how["pool_variance"], np.array(how["coefficient"]), np.array(how["believed"]),
            critical[rows].astype(np.float64),
        ))  # fmt: skip
    return found
