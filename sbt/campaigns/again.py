"""An estimation asked again without runs: other distributions, another requirement, and what the answer depends on.

The counted draws have known densities, so they count under every distribution that has no mass where the campaign's has none.
A metamodel that knows only the runs before a batch is the control variate of its draws, as in the campaign itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sbt.campaigns.counting import DENIED, DRAWN, NOMINAL, Seen
from sbt.campaigns.crude import nominal_rows, took_monte_carlo
from sbt.campaigns.known import Known
from sbt.campaigns.pools import Frame, admitted, most_nominal, sample_mixture
from sbt.campaigns.records import EstimationProposal
from sbt.campaigns.settings import Settings
from sbt.campaigns.summing import counted_with, took_sum
from sbt.campaigns.unviolated import Unviolated
from sbt.errors import InputError
from sbt.estimators.choices import choice_scores, log_normal
from sbt.estimators.events import events
from sbt.estimators.mixture import Mixture, Near, fit_mixture, particles, wide_scales, within_reach
from sbt.estimators.reweighting import Predicted, ReusedBatch, defended_bound, effective_size
from sbt.estimators.surrogate import Coordinates, LogProbability
from sbt.loop.stages import Log
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.cells import MOST_GIVEN, MOST_JOINED
from sbt.problem.requirement import Requirement
from sbt.problem.sensitivity import drawn_between, outside
from sbt.problem.space import ParameterSpace
from sbt.seeds import stream
from sbt.store.history import History

__all__ = ["FLOOR", "Reused", "SeenAgain", "reused"]

Rows = NDArray[np.intp]

FLOOR = 3.0
"""Smallest effective sample size with which runs say anything of other distributions."""
_KEPT = 0.5
"""Of the effective sample size under the campaign's own distribution: enough, where that is small itself."""
_POOL, _PARTICLES, _CANDIDATES = 10_000, 800, 6_000
"""Sizes of the campaign's own pools."""
_FITS = 5
"""Metamodels at most: a batch takes the newest one that knows none of its draws."""
_FAR = 30.0
"""Normal score beyond which there is nothing to propose."""
_RATIOS = 2**13
"""Draws from the new distribution, which tell how much less of the old one there is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenAgain(Seen):
    """What all runs met where another distribution has mass, and what the draws from the campaign's distribution met.

    Attributes:
        nominal: share of each draw in proportion to the campaign's distribution, of those that taught as well.
        ratio: (m,) new over old density at draws from the new one.
    """

    nominal: Vector
    ratio: Vector

    def most(self, hits: int, confidence: float) -> float:
        """Return the upper limit of the probability of what the draws from the campaign's distribution met so many times."""
        return defended_bound(hits, self.nominal, self.ratio, confidence)


@dataclass(frozen=True, eq=False)
class Reused:
    """The counted draws of an estimation, weighted for another distribution of the inputs.

    Attributes:
        space: the inputs with that distribution.
        batches: of draws, a failed one as safe; one batch where they all come from the campaign's distribution.
        worst: the same with every failed draw as critical.
        failed: draws that failed.
        nominal: (n,) share of each draw in proportion to the campaign's distribution.
        crude: the draws come from the campaign's distribution itself.
        warm_up: (n,) that each draw began with, -1 without one.
        least: effective sample size below which the draws say nothing.
        seen: what the runs met where the new distribution has mass, and all draws from the campaign's distribution.
        unviolated: requirements that no run violated.
    """

    space: ParameterSpace
    batches: tuple[ReusedBatch, ...]
    worst: tuple[ReusedBatch, ...]
    failed: int
    nominal: Vector
    crude: bool
    warm_up: Vector
    least: float
    seen: SeenAgain
    unviolated: Unviolated = field(default_factory=Unviolated)


def reused(log: Log, settings: Settings, space: ParameterSpace, own: Requirement) -> Reused:
    """Return the counted draws of a campaign, with weights for the distribution of `space`.

    Args:
        log: of the campaign.
        settings: of the campaign, its scenario with the requirement that is asked for.
        space: the same inputs with the distribution that is asked for.
        own: the campaign's requirement.

    Raises:
        InputError: no draw has a known density, the new distribution has mass where the old has none, or the runs did not
            measure the metric.
    """
    _check(log, settings, space)
    history, old, hits = log.history, settings.scenario.space, settings.scenario.requirement.critical_runs(log.history)
    x = space.sample(_RATIOS, stream(settings.seed, "ratio"))
    crude = NOMINAL in history.stage and took_monte_carlo(log)
    plain = np.flatnonzero(nominal_rows(log))
    if took_sum(log):
        plain, log_q = counted_with(log, old)
        history = replace(history, columns={**history.columns, "log_q": log_q})
    plainly = crude or took_sum(log)
    draws = [_Draws(-1, plain, np.ones(len(plain)), len(plain) if crude else 0)] if plainly else [*_counted(log)]
    if old.joined:
        history = _with_densities(history, old, draws)
    every, reached = np.concatenate([d.rows for d in draws]), np.isfinite(space.log_density(history.x))
    least = 0.0 if took_sum(log) else _least(history.where(np.isin(np.arange(len(history)), every)), old, space)
    predicted = [(_NOTHING_SAID, _NOTHING_SAID)]
    if not plainly:
        with threadpool_limits(1):
            predicted = [*_predicted(log, settings, space, draws)]
    batches, worst = (
        tuple(_batch(history, space, outcomes, d.rows, said[k]) for d, said in zip(draws, predicted, strict=True))
        for k, outcomes in enumerate((hits, hits | ~history.ok))
    )
    nominal = np.concatenate([1.0 * (np.arange(len(d.rows)) < d.nominal) for d in draws])
    seen, others = Seen.of(log, settings, own), hits[every] & ~own.critical_runs(history)[every] & (nominal > 0.0)
    denied = np.concatenate([np.full(len(d.rows), said[0].denied) for d, said in zip(draws, predicted, strict=True)])
    taught = 0 if plainly else seen.draws - round(float(nominal.sum()))
    met = SeenAgain(
        int((hits & reached).sum()), int((history.ok & ~hits & reached).sum()), seen.draws, seen.hits, seen.failed,
        seen.surprises + int((others & denied).sum()), seen.known, seen.late and not plainly, seen.failed_apart,
        nominal=np.concatenate([nominal, np.ones(taught)]), ratio=np.exp(space.log_density(x) - old.log_density(x)),
    )  # fmt: skip
    return Reused(
        space, batches, worst, int((~history.ok[every]).sum()), nominal, crude, history.columns["warm_up"][every], least, met,
        Unviolated.of(history, settings),
    )  # fmt: skip


def _least(drawn: History, old: ParameterSpace, space: ParameterSpace) -> float:
    """Return the effective sample size below which draws say nothing; refuse less."""
    worth, own = (effective_size(np.exp(each.log_density(drawn.x) - drawn.log_q)) for each in (space, old))
    least = min(FLOOR, _KEPT * own)
    if worth < least:
        rule = f"the runs must be worth at least {least:.2g} draws from the distributions asked for (effective sample size)"
        advice = "run a campaign with these distributions, with warm_start to learn from this one"
        raise InputError(f"{rule}, but are worth {worth:.2g}: {advice}")
    return least


def _batch(history: History, space: ParameterSpace, hits: Mask, rows: Rows, said: _Said) -> ReusedBatch:
    """Return the draws in these rows, weighted by the new density over that which they were drawn with."""
    x = history.x[rows]
    weight = np.exp(space.log_density(x) - history.log_q[rows])
    at_draws = np.zeros(len(rows)) if said.at_draws is None else said.at_draws
    return ReusedBatch(x, weight, at_draws, hits[rows].astype(np.float64), said.pool)


@dataclass(frozen=True, eq=False)
class _Said:
    """What a metamodel says of an event: P at the draws of a batch, and over a pool of its own; None: there is no metamodel."""

    at_draws: Vector | None = None
    pool: Predicted | None = None

    @property
    def denied(self) -> Mask | bool:
        """(n,) which draws would be surprises if they were critical; False: there is no metamodel."""
        return False if self.at_draws is None else self.at_draws < DENIED


_NOTHING_SAID = _Said()


@dataclass(frozen=True, eq=False)
class _Draws:
    """A batch that counts: its number, its rows in the log, their weights; of the first `nominal` that is 1."""

    number: int
    rows: Rows
    coefficient: Vector
    nominal: int


def _counted(log: Log) -> Iterator[_Draws]:
    """Yield every complete batch that counts."""
    history = log.history
    for batch in log.iterations if DRAWN in history.stage else ():
        proposal = batch.read(EstimationProposal)
        draws, nominal = proposal.counted, proposal.nominal
        rows = np.flatnonzero((history.stage == DRAWN) & (history.iteration == batch.number))
        if draws is not None and len(rows) == len(draws.coefficient):
            yield _Draws(batch.number, rows, np.array(draws.coefficient), 0 if nominal is None else len(nominal.pi))


def _with_densities(history: History, old: ParameterSpace, draws: list[_Draws]) -> History:
    """Return a history with the densities of draws by their weights: stores of before have others of correlated whole numbers."""
    log_q = history.log_q.copy()
    for each in draws:
        log_q[each.rows] = old.log_density(history.x[each.rows]) - np.log(each.coefficient)
    return replace(history, columns={**history.columns, "log_q": log_q})


def _check(log: Log, settings: Settings, space: ParameterSpace) -> None:
    """Refuse what cannot be answered from these runs."""
    history = log.history
    crude = NOMINAL in history.stage and took_monte_carlo(log)
    if not crude and not took_sum(log) and next(_counted(log), None) is None:
        rule = "only draws with known densities can be counted again, but this campaign has none that count"
        raise InputError(f"{rule}: run an estimation with acquisition.kind difference or monte_carlo")
    for metric in (part.metric for part in settings.scenario.requirement.parts):
        if metric not in history.metrics and history.ok.any():
            raise InputError(f"a metric must be one that the runs measured ({', '.join(history.metrics)}), but got '{metric}'")
    _check_joined(settings.scenario.space, space)
    for old, new in zip(settings.scenario.space.parameters, space.parameters, strict=True):
        x = outside(old, new)
        if len(x):
            rule = f"input {new.name} must stay where the campaign drew it, within {drawn_between(old)}"
            reach = f"but is to be {x.min():.6g} to {x.max():.6g}, where there were no draws"
            raise InputError(f"{rule}, {reach}: run a campaign there")


def _check_joined(old: ParameterSpace, space: ParameterSpace) -> None:
    """Refuse other distributions of correlated whole numbers whose joint probability is not computed."""
    names, pairs = old.uncounted or space.uncounted, zip(old.parameters, space.parameters, strict=True)
    changed = any(p != q for p, q in pairs if p.name in old.correlated | space.correlated)
    if names and (changed or old.correlation != space.correlation):
        most = f"{MOST_JOINED} correlated whole numbers ({MOST_GIVEN} where they are correlated with continuous inputs)"
        rule = f"runs can be asked for another distribution of at most {most}"
        raise InputError(f"{rule}, but {', '.join(names)} are {len(names)}: run a campaign with these distributions")


def _predicted(log: Log, settings: Settings, space: ParameterSpace, draws: list[_Draws]) -> Iterator[tuple[_Said, _Said]]:
    """Yield what a metamodel of earlier runs only says of each batch, failed runs as safe, and as critical."""
    old, history = settings.scenario.space, log.history
    coordinates = Coordinates(old)
    step = -(-len(draws) // _FITS)
    for k, batch in enumerate(draws):
        if k % step == 0:
            known = Known.of(history.where(history.iteration < batch.number), coordinates, settings)
            learned = None if settings.learner is None else known.learn(stream(settings.seed, "fit", batch.number))
            if learned is not None:
                mixture = _mixture(learned, known, old, space, stream(settings.seed, "again", batch.number))
        if learned is None:
            yield _NOTHING_SAID, _NOTHING_SAID
            continue
        frame = Frame(mixture.wide, mixture.choices)
        at = sample_mixture(space, frame, mixture, _POOL, stream(settings.seed, "again pool", batch.number))
        x, weight = space.from_normal(at.v), np.exp(at.log_p - at.log_h) / _POOL
        at_draws, at_pool = (events(learned, old.to_normal(points))[0] for points in (history.x[batch.rows], x))
        said = [
            _Said(np.exp(there[0]), Predicted(x, weight, np.exp(here[0]), at.stratum))
            for there, here in ((at_draws.safe, at_pool.safe), (at_draws.critical, at_pool.critical))
            if there is not None and here is not None
        ]  # fmt: skip
        yield said[0], said[-1]


def _mixture(
    learned: LogProbability, known: Known, old: ParameterSpace, space: ParameterSpace, rng: np.random.Generator
) -> Mixture:
    """Return a proposal for points that the metamodel takes for critical, in proportion to the new distribution."""
    choices = choice_scores(space)
    blank = Mixture(wide_scales(Coordinates(space).bounded), choices=choices, most_nominal=most_nominal(space))
    hits = old.from_normal(known.z[known.critical])
    hits = space.to_normal(hits[np.isfinite(space.log_density(hits))])
    hits = hits[(np.abs(hits) < _FAR).all(axis=1)]
    if not len(hits):
        return blank

    def log_p(z: Points) -> Vector:
        density = admitted(space, z, log_normal(z)) if space.constraints else log_normal(z)
        return np.where(within_reach(z), density, -np.inf)

    def mass(z: Points) -> Vector:
        return log_p(z) + learned(old.to_normal(space.from_normal(z)))[0]

    def failed_critical(z: Points) -> Vector:
        worst = events(learned, old.to_normal(space.from_normal(z)))[0].critical
        return log_p(z) if worst is None else log_p(z) + 0.5 * worst[0]

    targets = (mass, failed_critical) if len(known.failed) else (mass,)
    clouds = tuple(particles(target, Near(blank, hits), _PARTICLES, rng, _CANDIDATES) for target in targets)
    return replace(fit_mixture(clouds, blank.wide, rng, choices=choices), most_nominal=blank.most_nominal)
