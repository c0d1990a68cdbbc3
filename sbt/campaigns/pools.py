"""Pools that the draws of an estimation come from: points of a proposal with exact density, and how a batch is drawn from them.

The proposal changes the distribution of all inputs, or of the coordinates of a subspace alone. With constraints its nominal
component is the inputs' distribution within them, by rejection, and the others are fitted to what is admissible: a point outside
has no weight, and where little is admissible a pool that knew nothing of it would have next to no points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sbt.campaigns.counting import DRAWN, LEARNED
from sbt.campaigns.records import COUNT, LEARN, CountedDraws, EstimationProposal, EventDraws, NominalDraws, PoolSummary
from sbt.campaigns.teaching import select_teaching
from sbt.estimators.choices import ChoiceScore, log_normal, log_wide
from sbt.estimators.events import Event, events
from sbt.estimators.importance import Draws, Plan, draw_systematic, plan_batch, stated
from sbt.estimators.mixture import Mixture, Near, effective_size, fit_mixture, particles, reweighted, within_reach
from sbt.estimators.surrogate import LogProbability, sketch_of
from sbt.metamodels.joint import LogPair
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.space import ParameterSpace
from sbt.store.database import PlannedRun

__all__ = [
    "SKETCH", "Frame", "Pool", "Proposal", "Sampled", "admitted", "draw_batch", "draw_pool", "fit_proposal", "most_nominal",
    "planned", "sample_mixture",
]  # fmt: skip

# Sizes: larger ones changed the estimates of the testbeds by less than their spread (docs/measured/estimation.md).
_POOL, _POOL_COST, _POOL_EACH = 10_000, 2e10, 300
"""Points of a pool: its own variance is a hundredth of what 100 draws leave. Fewer with many runs (points times squared runs),
but so many for each draw."""
_PILOT = 2_500
"""Points of a pilot pool."""
_PARTICLES = 800
"""Particles that the mixture is fitted to, per cloud."""
SKETCH = 600
"""Runs that the metamodel learned from which guides the particles, from twice as many on."""
_REFITS, _REFIT_POINTS, _ENOUGH = 4, 3000, 0.15
"""How often the mixture is fitted again to its own points at most, how many they are, and the effective share of them that is
enough: of a perfect fit four tenths would be."""
_NOTHING = math.log(1e-9)
"""Log of the largest P of an event, where particles went to look for it, with which no points are proposed for it."""
_TRIES = 30
"""Draws of the inputs' distribution for a point of a pool at most, of which those within constraints are kept: where a
three-hundredth is admissible a tenth of the pool can be such points, and less where less is."""


def _unchanged(v: Points, rng: np.random.Generator) -> Points:
    del rng
    return v


@dataclass(frozen=True, eq=False)
class Frame:
    """The coordinates v (n, m) whose distribution a proposal changes, standard normal under that of the inputs.

    Args:
        wide: (m,) standard deviations of the wide component.
        choices: the scores of inputs with choices among the coordinates.
        lift: coordinates to normal scores z (n, d) of all inputs.
        reduce: normal scores of all inputs to coordinates; None: they are the same.
    """

    wide: Vector
    choices: tuple[ChoiceScore, ...] = ()
    lift: Callable[[Points, np.random.Generator], Points] = field(default=_unchanged)
    reduce: Callable[[Points], Points] | None = None


@dataclass(frozen=True, eq=False)
class Proposal:
    """What a pool is drawn with.

    Attributes:
        mixture: the proposal.
        log_probability: of the metamodel, at the frame's coordinates; None: there is none.
        pilot: the plan of a pilot pool, which decides the form of the estimator and whether the newest metamodel is drawn with: a
            pool that is counted must not decide that itself, as it would choose what its own points happen to flatter.
    """

    mixture: Mixture
    log_probability: LogProbability | None
    pilot: Plan


@dataclass(frozen=True, eq=False)
class Pool:
    """A pool: points z (N, d) and x (N, d), how a batch is drawn from it, and what the metamodel says there.

    Attributes:
        mixture: what it was drawn with.
        z, x: normal scores and inputs.
        plan: how a batch is drawn.
        whole, parts: what the metamodel says of critical runs, and of each requirement of a combination.
        stratum: (N,) component of the mixture that each point was drawn from.
    """

    mixture: Mixture
    z: Points
    x: Points
    plan: Plan
    whole: Event
    parts: tuple[Event, ...]
    stratum: Vector


def fit_proposal(
    space: ParameterSpace, frame: Frame, log_probability: LogProbability | None, hits: Points | None,
    shares: tuple[float, ...], rng: np.random.Generator,
) -> Proposal:  # fmt: skip
    """Return the proposal that fits a metamodel, with a pilot pool.

    Args:
        space: of the inputs.
        frame: whose distribution the proposal changes.
        log_probability: of the metamodel; None: there is none.
        hits: (k, m) coordinates of known critical runs; None: the proposal is the nominal and the wide distribution.
        shares: of the draws, as `SHARES`.
        rng: the only source of randomness.
    """
    mixture, drawn = Mixture(frame.wide, choices=frame.choices, most_nominal=most_nominal(space)), None
    if log_probability is not None and hits is not None:
        mixture, drawn = _fitted(space, frame, log_probability, mixture, hits, rng)
    if drawn is None:
        drawn = _drawn(space, frame, mixture, log_probability, _PILOT, rng)
    return Proposal(mixture, log_probability, _pooled(space, frame, mixture, drawn, shares, rng).plan)


def most_nominal(space: ParameterSpace) -> float:
    """Return the largest share of a mixture's nominal component whose points are not too dear to find within the constraints."""
    return min(_TRIES * space.feasible_mass, 1.0)


def draw_pool(
    space: ParameterSpace, frame: Frame, proposal: Proposal, shares: tuple[float, ...], rng: np.random.Generator,
    learned: int = 0, draws: int = 1,
) -> Pool:  # fmt: skip
    """Return a fresh pool and how a batch would be drawn from it, so many draws; the metamodel `learned` from so many runs."""
    n = int(np.clip(_POOL_COST / max(learned, 1) ** 2, min(_POOL_EACH * draws, _POOL), _POOL))
    drawn = _drawn(space, frame, proposal.mixture, proposal.log_probability, n, rng)
    return _pooled(space, frame, proposal.mixture, drawn, shares, rng, proposal.pilot.form)


@dataclass(frozen=True, eq=False)
class Sampled:
    """Points of a mixture: coordinates v (n, m), the component each was drawn from, log densities log h and log p of the inputs.

    With constraints also normal scores z (n, d); log p is -inf outside of them.
    """

    v: Points
    stratum: Vector
    log_h: Vector
    log_p: Vector
    z: Points | None = None


def sample_mixture(space: ParameterSpace, frame: Frame, mixture: Mixture, n: int, rng: np.random.Generator) -> Sampled:
    """Return n points of a mixture, of which the nominal component is the inputs' distribution within the constraints."""
    v, stratum = mixture.sample(n, rng)
    if not space.constraints:
        return Sampled(v, stratum, mixture.log_density(v), log_normal(v))
    z, nominal = frame.lift(v, rng), stratum == 0
    z[nominal] = space.sample_scores(int(nominal.sum()), rng)
    v = z if frame.reduce is None else frame.reduce(z)
    log_p = admitted(space, z, log_normal(v))
    return Sampled(v, stratum, mixture.log_density(v, log_p), log_p, z)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Points of a mixture, and what the metamodel says there."""

    at: Sampled
    whole: Event
    parts: tuple[Event, ...]


def _drawn(
    space: ParameterSpace, frame: Frame, mixture: Mixture, log_probability: LogProbability | None, n: int,
    rng: np.random.Generator,
) -> _Drawn:  # fmt: skip
    """Return n points of a mixture."""
    at, unsure = sample_mixture(space, frame, mixture, n, rng), np.full(n, np.log(0.5))
    whole, parts = (Event((unsure, unsure)), ()) if log_probability is None else events(log_probability, at.v)
    return _Drawn(at, whole, parts)


def admitted(space: ParameterSpace, z: Points, log_normal_density: Vector) -> Vector:
    """Return (n,) the log density of the inputs within the constraints, of that without them, at normal scores z (n, d)."""
    return np.where(space.feasible(space.from_normal(z)), log_normal_density - math.log(space.feasible_mass), -np.inf)


def _pooled(
    space: ParameterSpace, frame: Frame, mixture: Mixture, drawn: _Drawn, shares: tuple[float, ...], rng: np.random.Generator,
    form: str | None = None,
) -> Pool:  # fmt: skip
    """Return the pool of the points that were drawn."""
    at, whole, parts = drawn.at, drawn.whole, drawn.parts
    z = frame.lift(at.v, rng) if at.z is None else at.z
    x = space.from_normal(z)
    log_w = np.where(_has_density(space, x), at.log_p - at.log_h, -np.inf)
    log_wide_ratio = log_wide(at.v, frame.wide, frame.choices) - at.log_h
    plan = plan_batch(
        *whole.safe, log_w, log_wide_ratio, at.stratum, shares, form,
        others=tuple(event for event in (whole.critical, *(part.safe for part in parts)) if event is not None),
    )  # fmt: skip
    return Pool(mixture, z, x, plan, whole, parts, at.stratum)


def _has_density(space: ParameterSpace, x: Points) -> Mask:
    """Return which inputs x (n, d) have a density: far out a score is the end of a range, where a triangle, say, has none."""
    return np.all([np.isfinite(p.log_density(x[:, k])) for k, p in enumerate(space.parameters)], axis=0)


def _fitted(
    space: ParameterSpace, frame: Frame, log_probability: LogProbability, start: Mixture, hits: Points, rng: np.random.Generator
) -> tuple[Mixture, _Drawn | None]:
    """Return h, fitted to particles of p pi and of p sqrt(pi (1 - pi)), and of what else is estimated; and points of h, if any.

    What is next to impossible wherever the particles went is left out: of a requirement whose metric had one value in all runs a
    metamodel says that it is the less impossible the farther out one looks, and a share of the pool would follow that.
    With many runs a sketch of the metamodel guides the particles; the mixture is then fitted again to points of its own, which
    the metamodel itself weights. Whether a point of a subspace is admissible the other coordinates say: there only the points
    that the mixture is fitted to again are.
    """
    rough = sketch_of(log_probability, SKETCH)

    def target(v: Points, k: int) -> Vector:
        log_p = admitted(space, v, log_normal(v)) if space.constraints and frame.reduce is None else log_normal(v)
        return _targets(v, log_p, *events(rough, v))[k]

    near = Near(start, hits)
    count = len(_aims(*events(log_probability, hits[:1])))
    clouds = tuple(particles(partial(target, k=k), near, _PARTICLES, rng) for k in range(count))
    kept = [k for k, v in enumerate(clouds) if len(v) and _aims(*events(rough, v))[k].max() > _NOTHING]
    if not kept:
        return start, None
    clouds = tuple(clouds[k] for k in kept)
    mixture = _fitted_to(clouds, start, rng)
    for _ in range(_REFITS):  # from particles that a few ancestors share to points that are independent
        drawn = _drawn(space, frame, mixture, log_probability, _REFIT_POINTS, rng)
        at, every = drawn.at, _targets(drawn.at.v, drawn.at.log_p, drawn.whole, drawn.parts)
        targets = [every[k] for k in kept]
        if min(effective_size(target - at.log_h) for target in targets) >= _ENOUGH * _REFIT_POINTS:
            return mixture, drawn
        clouds = tuple(at.v[reweighted(target, at.log_h, _PARTICLES, rng)] for target in targets)
        mixture = _fitted_to(clouds, start, rng)
    return mixture, None


def _fitted_to(clouds: tuple[Points, ...], start: Mixture, rng: np.random.Generator) -> Mixture:
    """Return the mixture that is fitted to clouds of particles, with the nominal component of another one."""
    fitted = fit_mixture(clouds, start.wide, rng, choices=start.choices)
    return replace(fitted, most_nominal=start.most_nominal)


def _targets(v: Points, log_p: Vector, whole: Event, parts: tuple[Event, ...]) -> list[Vector]:
    """Return the log densities that points v (n, m) of a pool should follow, not normalised; that of the inputs is log_p (n,)."""
    log_p = np.where(within_reach(v), log_p, -np.inf)
    return [log_p + aim for aim in _aims(whole, parts)]


def _aims(whole: Event, parts: tuple[Event, ...]) -> list[Vector]:
    """Return (n,) the logs of what points of a pool should follow beside the density of the inputs.

    Those of the event's mass and boundary; where runs failed, between the mass and the boundary of critical or failed ones;
    the mass of each requirement of a combination.
    """
    log_pi, log_not = whole.safe
    worst = [] if whole.critical is None else [0.5 * whole.critical[0]]
    return [log_pi, 0.5 * (log_pi + log_not), *worst, *(part.safe[0] for part in parts)]


def draw_batch(
    space: ParameterSpace, pool: Pool, n: int, rng: np.random.Generator, *, counts: bool, once: bool = True,
    fallback: bool = False, existing: Points | None = None, phase: str = LEARN,
) -> tuple[tuple[PlannedRun, ...], EstimationProposal]:  # fmt: skip
    """Return n runs drawn from a pool with known density, that count or only teach, and what the log keeps of them.

    `once`: the metamodel has no point drawn twice, as where the simulator is deterministic. `existing`: (k, d) normal scores of
    earlier runs; where they are given, runs that only teach are chosen apart from them and from each other. `phase`: what the log
    calls a batch that only teaches.
    """
    log_pi, log_not = pool.whole.safe
    if not counts and existing is not None and len(existing):
        rows, first = select_teaching(pool.plan, n, pool.z, existing, rng)
        summary = PoolSummary(len(pool.z), pool.plan.predicted, pool.plan.anticipated, len(pool.mixture.shares), fallback)
        nominal = NominalDraws(tuple(np.exp(log_pi[rows[:first]]).tolist()))
        return planned(space, pool.z[rows], LEARNED), EstimationProposal(phase, "uncertainty", pool=summary, nominal=nominal)
    draws = draw_systematic(pool.plan, n, log_pi - log_not, rng, once=once)
    plan = draws.plan
    summary = PoolSummary(len(pool.z), plan.predicted, plan.anticipated, len(pool.mixture.shares), fallback)
    pi = tuple(np.exp(log_pi[draws.rows]).tolist())
    z, nominal = pool.z[draws.rows], NominalDraws(pi[: draws.nominal])
    if not counts:
        return planned(space, z, LEARNED), EstimationProposal(phase, "uncertainty", pool=summary, nominal=nominal)
    log_q = space.log_density(pool.x[draws.rows]) - np.log(draws.coefficient)
    counted = CountedDraws(
        plan.pool_variance, tuple(draws.coefficient.tolist()), tuple(draws.control_variate.tolist()), pi,
        tuple(_event_draws(part.safe, pool, draws, part.critical) for part in pool.parts) or None,
        None if pool.whole.critical is None else _event_draws(pool.whole.critical, pool, draws),
    )  # fmt: skip
    kept = EstimationProposal(COUNT, plan.form, pool=summary, counted=counted, nominal=nominal)
    return planned(space, z, DRAWN, log_q), kept


def _event_draws(event: LogPair, pool: Pool, draws: Draws, failed_critical: LogPair | None = None) -> EventDraws:
    """Return what the log keeps of an event at the draws from a pool."""
    said = stated(event, draws.plan, pool.stratum)
    worst = None if failed_critical is None else _event_draws(failed_critical, pool, draws)
    pi = tuple(said.pi[draws.rows].tolist())
    return EventDraws(said.prior, said.anticipated, said.pool_variance, pi, failed_critical=worst)


def planned(space: ParameterSpace, z: Points, stage: str, log_q: Vector | None = None) -> tuple[PlannedRun, ...]:
    """Return the runs at normal scores z (n, d), with their log densities (n,) where they are known."""
    rows = space.from_normal(z)
    densities = [None] * len(rows) if log_q is None else [float(q) for q in log_q]
    return tuple(PlannedRun(stage, space.named(row), density) for row, density in zip(rows, densities, strict=True))
