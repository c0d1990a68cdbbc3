"""P(critical | inputs) over the traffic that seeds draw: learned from pairs of inputs and seed, averaged over fresh seeds.

Most of what decides a run in traffic is known before it (`Covariates`). A metamodel of the inputs takes it for noise; one of
inputs and covariates does not, and its mean over fresh seeds is P(critical | inputs).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from sbt.metamodels.risk import Risk, fit_risk, fit_risk_scored
from sbt.problem.arrays import Points, Vector
from sbt.problem.covariates import Covariates
from sbt.problem.plain import JsonMapping
from sbt.problem.scenario import LogicalScenario
from sbt.samplers.noise import scores
from sbt.samplers.sobol import SobolSequence
from sbt.seeds import SEED_END, stream
from sbt.store.history import VALIDATION, History

__all__ = ["OVER_TRAFFIC", "DrawnTraffic", "PairRisk", "decoded", "encoded"]

OVER_TRAFFIC = "over_traffic"
"""Key of what a store that is read tells (`DrawnTraffic.kept`)."""
_POINTS, _SEEDS = 512, 16
"""Points of the space, and fresh seeds at each, over which P is averaged."""
_FEWEST, _FEWEST_CRITICAL = 40, 3
"""Runs that teach, and critical ones among them, from which on P is taken from pairs."""
_FEWEST_POINTS = 16
"""Feasible points of the space."""
_SURELY, _PROMISING = 2.0, 0.5
"""Standard errors by which the traffic makes left-out runs likelier, from which on it counts, or pairs are searched by it."""
_LEAST_GIVES = 0.02
"""P(a run gives a metric) below which what is critical of those that do is not told."""
_STEPS = 2**16 - 1


@dataclass(frozen=True, eq=False)
class PairRisk:
    """What runs teach of pairs of inputs and seed.

    Attributes:
        risk: (n, c) `Covariates.beside_inputs` to P(critical); a run that fails is not.
        fails: the same to P(a run gives no metric); None: all gave one.
        tells: left-out runs are surely likelier by it than by their inputs alone, and some of each side are known.
        promises: left-out runs, or of few critical ones the nearest to them, are rather likelier by it.
    """

    risk: Risk
    fails: Risk | None
    tells: bool
    promises: bool


@dataclass(frozen=True, eq=False)
class DrawnTraffic:
    """The mean of P(critical) over traffic at fixed points of the space.

    Args:
        scenario: with the campaign's space and requirement, of one metric.
        seed: of the campaign.
        covariates: what seeds draw; None: a store is read, whose code is not loaded.
        kept: what the newest record of a store holds (`encoded`); None: nothing.
    """

    scenario: LogicalScenario
    seed: int
    covariates: Covariates | None = None
    kept: str | None = None
    _newest: dict[bytes, PairRisk] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls, scenario: LogicalScenario, seed: int, covariates: Covariates | None, kept: JsonMapping
    ) -> DrawnTraffic | None:
        """Return it with what is kept of a store that is read; None where seeds are not looked at, or for a combination."""
        told = kept.get(OVER_TRAFFIC)
        nothing = (covariates is None and told is None) or scenario.requirement.combined
        return None if nothing else cls(scenario, seed, covariates, told)

    @cached_property
    def points(self) -> Points:
        """(m, d) points of the unit cube, feasible and evenly distributed."""
        space = self.scenario.space
        sequence = SobolSequence(space.dimension, self.seed + 1)
        return sequence.admissible(lambda u: space.feasible(space.from_unit(u)), _POINTS, _POINTS)[:_POINTS]

    def means(self, history: History) -> Vector | None:
        """Return (m,) P(critical | inputs) at the points, of runs with a metric; None where the inputs alone tell as much."""
        if self.covariates is None:
            return None if self.kept is None else decoded(self.kept)
        found = self.learned(history)
        if found is None or not found.tells:
            return None
        p = self.table(found.risk).mean(axis=1)
        if found.fails is None:
            return p
        gives = 1.0 - self.table(found.fails).mean(axis=1)  # traffic with which runs fail is not that of those that give one
        return np.minimum(p / np.maximum(gives, _LEAST_GIVES), 1.0)

    def table(self, risk: Risk) -> Points:
        """Return (m, s) P of what a risk tells, at the points with each of s fresh seeds."""
        with threadpool_limits(1):
            return np.exp(risk(self._fresh)[0]).reshape(len(self.points), _SEEDS)

    def learned(self, history: History) -> PairRisk | None:
        """Return what all runs but held-out ones teach of pairs; None where they are too few, or hardly a point is feasible."""
        runs = history.where((history.stage != VALIDATION) & (history.columns["level"] == 0))
        if self.covariates is None or runs.ok.sum() < _FEWEST or len(self.points) < _FEWEST_POINTS:
            return None
        key = runs.index.tobytes()
        if key not in self._newest:
            self._newest.clear()
            self._newest[key] = self._fitted(self.covariates, runs)
        return self._newest[key]

    def _fitted(self, covariates: Covariates, runs: History) -> PairRisk:
        critical = self.scenario.requirement.critical_runs(runs)
        margin = np.nan_to_num(self.scenario.requirement.margins(runs), nan=np.inf, posinf=np.inf)
        margin, rng = np.where(runs.ok, margin, np.inf), stream(self.seed, "traffic fails", len(runs))
        known, near = covariates.beside_inputs(runs.x, runs.seed.tolist()), scores(margin)
        alone = self.scenario.space.metamodel_inputs_at(runs.x)
        with threadpool_limits(1):
            (risk, with_traffic), (_, without) = (
                fit_risk_scored(rows, near, margin, critical, stream(self.seed, "traffic", len(runs))) for rows in (known, alone)
            )
        gain, known_sides = with_traffic - without, min(critical.sum(), (~critical).sum()) >= _FEWEST_CRITICAL
        gives = np.where(runs.ok, 1.0, -1.0)
        with threadpool_limits(1):
            fails = None if runs.ok.all() else fit_risk(known, gives, gives, ~runs.ok, rng)
        sure = float(gain.sum() / max(np.sqrt(len(gain)) * gain.std(), 1e-300))
        return PairRisk(risk, fails, bool(known_sides and sure > _SURELY), sure > _PROMISING)

    @cached_property
    def _fresh(self) -> Points:
        """(m s, c) columns of fresh pairs, the seeds of a point one after the other."""
        if self.covariates is None:
            raise ValueError("pairs need covariates")
        seeds = stream(self.seed, "fresh traffic").integers(0, SEED_END, len(self.points) * _SEEDS)
        x = np.repeat(self.scenario.space.from_unit(self.points), _SEEDS, axis=0)
        return self.covariates.beside_inputs(x, seeds.tolist(), keep=False)


def encoded(p: Vector) -> str:
    """Return P (m,) as hexadecimal text, to 16 bits of its square root.

    >>> decoded(encoded(np.array([0.0, 1e-4, 0.25, 1.0]))).round(4).tolist()
    [0.0, 0.0001, 0.25, 1.0]
    """
    return np.round(np.sqrt(p) * _STEPS).astype(">u2").tobytes().hex()


def decoded(text: str) -> Vector:
    """Return P (m,) from its text."""
    return (np.frombuffer(bytes.fromhex(text), dtype=">u2") / _STEPS) ** 2
