"""Estimation: the probability of a critical scenario under the inputs' distribution, with an honest interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sbt.campaigns.batches import clipped, told_by_batches
from sbt.campaigns.clustering import Spread
from sbt.campaigns.counting import DRAWN, NOMINAL, RANDOM, Seen, counted_batches, counted_iterations, nothing_critical
from sbt.campaigns.crude import MonteCarloStage, SubsetStage, nominal_proportion, took_monte_carlo
from sbt.campaigns.each import RequirementEstimate, each_estimate, estimates_words
from sbt.campaigns.explained import ExplainedVariance, explained_variance
from sbt.campaigns.gate import GateVerdict, Limits, gate_verdict
from sbt.campaigns.levels import LevelsTold, is_two_level, left_two_levels, levels_told
from sbt.campaigns.likeness import EarlierTold, earlier_told
from sbt.campaigns.lost import failed_runs
from sbt.campaigns.many_inputs import ManyInputsStage, took_subset
from sbt.campaigns.pairing import PairStage, pairs_of, pairs_words
from sbt.campaigns.repeated import told_by_repeats
from sbt.campaigns.repeats import REPEAT, SimulatorNoise, stated_noise
from sbt.campaigns.sequential import SequentialStage
from sbt.campaigns.settings import CampaignKind, Settings
from sbt.campaigns.stopping import not_met
from sbt.campaigns.summing import SummingStage, summed, sums, took_sum
from sbt.campaigns.telling import tell_estimation
from sbt.campaigns.two_level import TwoLevelStage
from sbt.campaigns.unviolated import Unviolated
from sbt.campaigns.warmed import warmed_traffic
from sbt.campaigns.wording import number, plural
from sbt.errors import InputError
from sbt.estimators.intervals import CountedBatch, combine_estimates
from sbt.loop.stages import Campaign, Facts, Log, Stage
from sbt.problem.combination import CombinedRequirement
from sbt.problem.plain import Json
from sbt.store.records import optional, to_json

__all__ = ["ESTIMATION", "EstimateStep", "EstimationConclusion", "conclude_sum", "recipe"]

_HIGH_DIMENSION = 20  # inputs from which on the metamodels learn less than the chains of subset simulation find
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class EstimateStep:
    """Estimate and interval after a number of runs."""

    runs: int
    probability: float
    low: float
    high: float


@dataclass(frozen=True)
class EstimationConclusion:
    """The probability of a critical run under the inputs' distribution.

    Attributes:
        probability: the estimate, failed runs counted as safe; None: no draw counts.
        low, high: ends of its interval, or one-sided bounds where there are few hits; failed runs count as safe for the low end
            and as critical for the high end.
        confidence: of the interval.
        cov: coefficient of variation.
        effective_sample_size: of the weighted draws.
        hits: critical runs that count.
        failed_as_safe, failed_as_critical: the estimate, by how failed runs are read.
        undetected_mass_bound: what critical regions that no run has met, or failures that few seeds show, may hold at most.
        warnings: what limits the estimate.
        largest_weight_share: of one draw.
        convergence: the estimate after each counted batch but the first.
        counted: draws that count.
        exact_bound: where nothing was critical, the exact upper bound.
        gate: its verdict, where there is one.
        simulator_noise: what repeats with other seeds tell; None: none were asked for.
        requirements: of a combination, the probability of each requirement, from the same draws.
        warmed_traffic: what the result is conditional on, where runs began with warmed traffic.
        combinations: of whole numbers and choices, where all of them were to be run and their probabilities summed.
        drawn_combinations: of these, those that random draws stand for, since the simulator is noisy; None: each was to be run.
        fidelity: what coarse runs did for it, where there are some.
        pairs: of inputs and seed, from which counted runs were drawn by what the seed draws; None: seeds were not looked at.
        explained: what inputs and drawn traffic explain of the metric; None: it is not known.
        earlier: what a campaign of another setup told; None: there is none.
    """

    probability: float | None
    low: float
    high: float
    confidence: float = _CONFIDENCE
    cov: float | None = None
    effective_sample_size: float = 0.0
    hits: int = 0
    failed_as_safe: float | None = None
    failed_as_critical: float | None = None
    undetected_mass_bound: float = 1.0
    warnings: tuple[str, ...] = ()
    largest_weight_share: float | None = optional()
    convergence: tuple[EstimateStep, ...] | None = optional()
    counted: int | None = optional()
    exact_bound: float | None = optional()
    gate: GateVerdict | None = optional()
    simulator_noise: SimulatorNoise | None = optional()
    requirements: tuple[RequirementEstimate, ...] | None = optional()
    warmed_traffic: Spread | None = optional()
    combinations: int | None = optional()
    drawn_combinations: int | None = optional()
    fidelity: LevelsTold | None = optional()
    pairs: int | None = optional()
    explained: ExplainedVariance | None = optional()
    earlier: EarlierTold | None = optional()

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        found: Json = to_json(self)
        return found

    def sentences(self, facts: Facts) -> list[str]:
        """Return the probability with its interval, what it does not tell, what to do next, and then the details."""
        noise = [] if self.simulator_noise is None else self.simulator_noise.sentences(facts.requirement.told_as, facts.unit)
        noise = [*estimates_words(self.requirements, self.confidence), *noise]
        noise += [] if self.warmed_traffic is None else [self.warmed_traffic.sentence()]
        noise += [] if self.fidelity is None else [self.fidelity.sentence()]
        noise += [] if self.earlier is None else self.earlier.sentences()
        details = {"coefficient of variation": self.cov, "effective sample size": self.effective_sample_size}
        behind = [f"Behind it: {', '.join(f'{k} {number(v, 3)}' for k, v in details.items() if v is not None)}."]
        behind = behind if self.probability is not None and self.exact_bound is None else []
        if self.failed_as_critical is not None and self.failed_as_critical != self.probability:
            behind.append(f"If every failed run were critical, it would be {number(self.failed_as_critical, 3)}.")
        traffic = [] if self.pairs is None or self.counted is None else [pairs_words(self.pairs, self.counted)]
        traffic += [] if self.explained is None else [self.explained.sentence(facts.requirement.told_as)]
        return [*tell_estimation(self, facts), *behind, *traffic, *noise]


Concluded = tuple[EstimationConclusion, Limits]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: `difference` (the sequential estimator), `monte_carlo`, or `subset`.

    `auto` is `difference` below 20 inputs; from 20 on it draws in a subspace, or is `monte_carlo` or `subset`. Where the budget
    is enough to run every combination of whole numbers and choices, it runs them.

    Raises:
        InputError: recorded rows, which have no distribution to draw from, or an unknown method.
    """
    if settings.scenario.pool is not None:
        raise InputError("estimation needs a scenario that can be run anywhere, but recorded rows have no proposal density")
    method = settings.method
    if settings.coarse_cost is not None:
        if method not in ("auto", "difference") or settings.transfer is not None or settings.prior_runs is not None:
            got = f"acquisition.kind {method}" if method not in ("auto", "difference") else "warm_start"
            raise InputError(f"fidelity goes with acquisition.kind auto, and without warm_start, but got {got}")
        rule = "coarse runs choose what is run next (fidelity)"
        return replace(_campaign(settings, TwoLevelStage(settings), _from_draws), depends=rule)
    if method == "auto" and settings.scenario.space.dimension >= _HIGH_DIMENSION:
        if settings.transfer is not None:
            rule = f"warm_start.transfer needs fewer than {_HIGH_DIMENSION} inputs, or acquisition.kind difference"
            raise InputError(f"{rule}, but got {settings.scenario.space.dimension} inputs")
        return _campaign(settings, ManyInputsStage(settings), _from_either)
    if method == "auto" and sums(settings):
        return _campaign(settings, SummingStage(settings), conclude_sum)
    method = "difference" if method == "auto" else method
    if method == "monte_carlo":
        cov = settings.stop.get("cov")
        depends = None if cov is None else f"stop.cov = {cov:g} ends it where the results say (null: the whole budget is run)"
        return replace(_campaign(settings, MonteCarloStage(settings), _from_nominal), depends=depends)
    if method == "subset":
        return _campaign(settings, SubsetStage(settings), _from_repeats)
    if method == "difference":
        pairs = settings.covariates is not None and settings.transfer is None and settings.prior_runs is None
        return _campaign(settings, PairStage(settings) if pairs else SequentialStage(settings), _from_draws)
    raise InputError(f"estimation draws by auto, difference, monte_carlo or subset, but got '{method}'")


def _campaign(settings: Settings, stage: Stage, concluded: Callable[[Log, Settings], Concluded]) -> Campaign:
    def conclude(log: Log) -> tuple[EstimationConclusion, None]:
        found, limits = concluded(log, settings)
        traffic = warmed_traffic(log, settings)
        found, limits = on_warm_ups(found, limits, traffic)
        noise = stated_noise(log.history, settings.scenario) if (log.history.stage == REPEAT).any() else None
        asked, met = settings.gate, Seen.of(log, settings).surprises
        unseen = 0.0 if found.combinations is not None else not_met(log, settings, found.counted, found.undetected_mass_bound)
        gate = None if asked is None else gate_verdict(limits, asked, unseen, met, found.cov)
        each = each_estimate(log, settings)
        return replace(
            found, gate=gate, simulator_noise=noise, requirements=each, fidelity=levels_told(log, settings),
            pairs=pairs_of(log), explained=explained_variance(settings, log.history), earlier=earlier_told(log, settings),
        ), None  # fmt: skip

    return Campaign((stage,), conclude)


def on_warm_ups(found: EstimationConclusion, limits: Limits, traffic: Spread | None) -> Concluded:
    """Return the conclusion with an interval that has the spread between warm-ups; None: there are none."""
    if traffic is None:
        return found, limits
    value, error = found.probability, traffic.std_error
    limits, tail = traffic.widened(limits, value, found.failed_as_critical), 0.5 * (1.0 + _CONFIDENCE)
    cov = found.cov if not value or error is None else max(found.cov or 0.0, error / value)
    warnings = found.warnings
    if value and error is not None and traffic.differs and error / value > (found.cov or 0.0):
        more = "more warm-ups (warm_up.seeds) narrow the interval, more runs hardly do"
        warnings = (*warnings, f"traffic differs from warm-up to warm-up: {more}")
    elif error is None and traffic.warm_ups == 1:
        warnings = (*warnings, "there is one warm-up: how much others differ from it is not known")
    low, high = limits.lower(tail), limits.upper(tail)
    return replace(found, low=low, high=high, cov=cov, warnings=warnings, warmed_traffic=traffic), limits


def _conclusion(
    log: Log, probability: float | None, limits: Limits, *, failed: int, beside: int = 0, warnings: tuple[str, ...] = (),
    **rest: Any,
) -> EstimationConclusion:
    """Return the conclusion with the interval that the limits give; `failed` runs count, those `beside` for the upper one."""
    tail = 0.5 * (1.0 + _CONFIDENCE)
    given = {"failed_as_safe": probability, "failed_as_critical": probability} | rest
    said = failed_runs(failed, int((~log.history.ok).sum()), len(log.history), beside)
    return EstimationConclusion(probability, limits.lower(tail), limits.upper(tail), warnings=(*said, *warnings), **given)


def _from_batches(log: Log, settings: Settings, seen: Seen | None = None) -> Concluded:
    """Return what the sequential estimator says; `seen` None: what the runs of the log met."""
    seen = Seen.of(log, settings) if seen is None else seen
    safe, critical = counted_batches(log, settings), counted_batches(log, settings, failed_critical=True)
    if not safe:
        return _uncounted(log, seen)
    need, ok = settings.scenario.requirement, log.history.ok.all()
    told = told_by_batches(
        safe, critical, seen, Unviolated.of(log.history, settings), drawn_from="the inputs' distribution",
        known_of=" of a requirement" if isinstance(need, CombinedRequirement) and need.how == "any" else "",
        unstated=not ok and any(map(is_two_level, log.iterations)),
    )  # fmt: skip
    value, limits, low = told.value, told.limits, told.low
    return _conclusion(
        log, value, limits, failed=told.worst_hits - told.hits, beside=_failed_beside(log, settings, seen, limits),
        failed_as_safe=value, failed_as_critical=value if ok else told.highest, hits=told.hits,
        cov=low.std_error / low.value if value > 0 else None, effective_sample_size=low.effective_sample_size,
        undetected_mass_bound=seen.most(seen.surprises, _CONFIDENCE), warnings=told.warnings,
        largest_weight_share=low.largest_share,
        convergence=_convergence(log, safe, critical) if seen.critical and seen.safe else None,
        counted=sum(len(b.critical) for b in safe), exact_bound=told.exact_bound,
    ), limits  # fmt: skip


def _failed_beside(log: Log, settings: Settings, seen: Seen, limits: Limits) -> int:
    """Return how many failed runs beside the draws of an estimate its upper limit depends on."""
    if not seen.failed_apart:
        return 0
    other, tail = _from_batches(log, settings, seen.without_failed_apart)[1], 0.5 * (1.0 + _CONFIDENCE)
    same = other.lower(tail) == limits.lower(tail) and other.upper(tail) == limits.upper(tail)
    return 0 if same else seen.failed_apart


def _convergence(log: Log, safe: list[CountedBatch], critical: list[CountedBatch]) -> tuple[EstimateStep, ...]:
    """Return estimate and interval after each counted batch but the first, whose spread is not known."""
    counted = counted_iterations(log)
    tail, steps = 0.5 * (1.0 + _CONFIDENCE), []
    for k in range(2, len(safe) + 1):
        low, high = combine_estimates(safe[:k]), combine_estimates(critical[:k])
        runs = int((log.history.iteration <= counted[k - 1]).sum())
        steps.append(EstimateStep(runs, clipped(low.value), low.limit(tail, side=-1), high.limit(tail, side=1)))
    return tuple(steps)


def _uncounted(log: Log, seen: Seen) -> Concluded:
    """Return what is known before any draw counts: the bound by the draws there are."""
    n = len(log.history)
    few = f"no draw counts: {plural(n, 'run')} {'is' if n == 1 else 'are'} too few to search, to learn and to count"
    if seen.critical:
        limits = Limits(lambda _: 0.0, lambda _: 1.0)
        return _conclusion(log, None, limits, failed=0, warnings=(few,)), limits
    limits = Limits(lambda _: 0.0, seen.most_critical)
    exact, warnings = limits.upper(_CONFIDENCE), (few, nothing_critical())
    return _conclusion(log, None, limits, failed=seen.failed, warnings=warnings, exact_bound=exact), limits


def _from_nominal(log: Log, settings: Settings, stage: str = NOMINAL) -> Concluded:
    """Return what crude Monte Carlo says; its interval is exact, with few hits too."""
    share = nominal_proportion(log, settings, stage)
    limits = Limits(share.lower, share.upper)
    rest: Json = {}
    if share.hits == 0:
        rest = {"exact_bound": share.upper(_CONFIDENCE), "warnings": (nothing_critical(),)}
    return _conclusion(
        log, share.value if share.n else None, limits, failed=share.failed, cov=share.cov,
        effective_sample_size=float(share.n), hits=share.hits,
        failed_as_safe=share.value, failed_as_critical=(share.hits + share.failed) / max(share.n, 1),
        undetected_mass_bound=1.0 - (1.0 - _CONFIDENCE) ** (1.0 / max(share.n, 1)), counted=share.n, **rest,
    ), limits  # fmt: skip


def _from_either(log: Log, settings: Settings) -> Concluded:
    """Return what subset simulation or crude Monte Carlo says where it was taken, else the draws in the subspace."""
    if took_subset(log):
        return _from_repeats(log, settings)
    crude = took_monte_carlo(log) or (len(log.history) > 0 and bool((log.history.stage == RANDOM).all()))
    return _from_nominal(log, settings) if crude else _from_batches(log, settings)


def _from_draws(log: Log, settings: Settings) -> Concluded:
    """Return what crude Monte Carlo says where noise, or useless coarse runs, left it to that, else the draws of pools."""
    if left_two_levels(log):
        return _from_nominal(log, settings, DRAWN)
    return _from_nominal(log, settings) if took_monte_carlo(log) else _from_batches(log, settings)


def conclude_sum(log: Log, settings: Settings) -> Concluded:
    """Return the sum over the combinations; what draws say where a smaller budget had begun with them."""
    if not took_sum(log):
        return _from_draws(log, settings)
    found = summed(log, settings)
    value, limits = clipped(found.share.value), Limits(found.lower, found.upper)
    bound = limits.upper(_CONFIDENCE) if found.hits == 0 and found.noisy else None
    return _conclusion(
        log, value, limits, failed=int(found.worst.critical.sum()) - found.hits,
        cov=found.std_error / value if value > 0 else None, hits=found.hits, failed_as_safe=value,
        failed_as_critical=clipped(found.worst.value), effective_sample_size=float(len(found.share.weight)),
        undetected_mass_bound=found.missing, counted=len(found.share.weight), combinations=found.combinations, exact_bound=bound,
        drawn_combinations=found.drawn or None,
    ), limits  # fmt: skip


def _from_repeats(log: Log, settings: Settings) -> Concluded:
    """Return what the repeats of subset simulation say."""
    value, limits, rest = told_by_repeats(log, settings, _CONFIDENCE)
    return _conclusion(log, value, limits, failed=int((~log.history.ok).sum()), **rest), limits


ESTIMATION = CampaignKind(
    "probability of a critical scenario under the inputs' distribution", recipe, EstimationConclusion, acquisition="auto",
    most_initial=15, batch=15,
    methods=("auto", "difference", "monte_carlo", "subset"), stop={"cov": 0.1}, metamodel_free=("monte_carlo", "subset"),
    takes_gate=True, takes_fidelity=True,
)  # fmt: skip
