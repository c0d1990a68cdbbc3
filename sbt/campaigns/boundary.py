"""Boundary identification: runs where the metamodel is uncertain whether a concrete scenario is critical."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from sbt.acquisitions import even, is_greedy
from sbt.campaigns.chance import ChancePlace, chance_place
from sbt.campaigns.choices import ChoiceRule, from_roi, greedily, mixed
from sbt.campaigns.combinations import EveryCombination, every_combination
from sbt.campaigns.doubt import OverTraffic, TrafficDoubt, over_traffic, traffic_doubt, unused_words
from sbt.campaigns.each import each_share, fits_words, independence_words, shares_words
from sbt.campaigns.explained import ExplainedVariance, explained_variance
from sbt.campaigns.exploration import largest_batch, space_filling
from sbt.campaigns.in_doubt import pairs_in_doubt
from sbt.campaigns.likely import CriticalCombinations, critical_combinations
from sbt.campaigns.lost import none_gave_a_metric, nothing_known
from sbt.campaigns.openness import by_chance, failing_range, failing_words, open_range
from sbt.campaigns.parts import BatchStage, CriticalShare, critical_share, share_among_held_out
from sbt.campaigns.place import BoundaryPlace, LogOdds, boundary_place, succeeding
from sbt.campaigns.regions import CriticalRegion, critical_regions
from sbt.campaigns.repeats import SimulatorNoise, simulator_noise, stated_noise
from sbt.campaigns.settings import CampaignKind, Settings
from sbt.campaigns.telling import tell_boundary
from sbt.campaigns.unscored import unscored_batches, unscored_words
from sbt.campaigns.warmed import conditional_on
from sbt.campaigns.wording import plural, requirement_words
from sbt.errors import InputError
from sbt.loop.learner import FittedMetamodel
from sbt.loop.stages import Campaign, Facts, Log
from sbt.problem.arrays import Points, Vector
from sbt.problem.plain import Json
from sbt.samplers.sobol import SobolSequence
from sbt.samplers.surface import crossings
from sbt.store.history import VALIDATION, History
from sbt.store.records import Independence, RequirementFit, Validation, optional, to_json

__all__ = ["BOUNDARY", "BoundaryConclusion", "boundary_points", "recipe"]


_SMALL = 0.03  # critical share that the log's 4,096 points tell to more than 5 %


@dataclass(frozen=True)
class BoundaryConclusion:
    """Shares of the input space as the metamodel sees them, and how much that is worth.

    Attributes:
        critical_fraction: mean P(critical) where a run gives a metric; None: there is no metamodel yet.
        expected_misclassified: mean of min(P, 1 - P).
        ambiguous_volume: share of the space with P between 0.05 and 0.95.
        validation: scores on held-out runs; None without such runs.
        weights: of a metamodel that mixes others, the share of each.
        chosen_because: and why.
        held_out_fraction: critical share of the held-out random runs, free of any model.
        failing_fraction: mean P(a run gives no metric); None: all runs gave one.
        simulator_noise: what repeats with other seeds tell; None: recorded rows.
        requirements: of a combination, each as its own metamodel sees it.
        held_out_fractions: of a combination, the share of the held-out runs that violates each requirement.
        independence: of the metrics of a combination, given the inputs.
        place: where the boundary lies; None: the metamodel sees none.
        regions: separate critical regions, the largest first; None: the metamodel sees none.
        explained: what inputs and drawn traffic explain of the metric; None: it is not known.
        doubt: what inputs and drawn traffic decide of whether a run is critical; None: it is not known.
        every_combination: what is known because every combination of the inputs was run; None: some were not.
        earlier: runs of an earlier campaign that the metamodel learned from, too; 0: they do not help; None: there are none.
        critical_range: least and largest critical fraction, as runs fail or not where that is open; None: it hardly matters.
        even_fraction: critical share of all runs that fill the space evenly, the held-out ones among them; None: of recorded rows
            those that guided runs left are no random ones.
        fails_by_chance: nothing says that inputs decide which runs fail; None: runs suggest that they do, or none fails.
        failing_range: ends of the failing fraction; None: it is not known to be a part of the space.
        critical_combinations: where no input is continuous; None: one is, or the metamodel sees none.
        over_traffic: P(critical) is the mean over the traffic that seeds draw; None: what inputs alone tell.
        unused_seeds: runs whose seeds were chosen although P(critical) is not learned from what they draw; None: there are none.
        chance_place: where runs of a noisy simulator are critical most often, though not most of them are; None: most are.
        unscored: batches of which the acquisition scored no run above -inf; None: there are none.
    """

    critical_fraction: float | None
    expected_misclassified: float | None
    ambiguous_volume: float | None
    validation: Validation | None
    weights: Mapping[str, float] | None = optional()
    chosen_because: str | None = optional()
    held_out_fraction: CriticalShare | None = None
    failing_fraction: float | None = optional()
    simulator_noise: SimulatorNoise | None = optional()
    requirements: tuple[RequirementFit, ...] | None = optional()
    held_out_fractions: Mapping[str, CriticalShare] | None = optional()
    independence: Independence | None = optional()
    place: BoundaryPlace | None = optional()
    explained: ExplainedVariance | None = optional()
    doubt: TrafficDoubt | None = optional()
    every_combination: EveryCombination | None = optional()
    regions: tuple[CriticalRegion, ...] | None = optional()
    earlier: int | None = optional()
    critical_range: tuple[float, float] | None = optional()
    even_fraction: CriticalShare | None = optional()
    fails_by_chance: bool | None = optional()
    failing_range: tuple[float, float] | None = optional()
    critical_combinations: CriticalCombinations | None = optional()
    chance_place: ChancePlace | None = optional()
    over_traffic: OverTraffic | None = optional()
    unused_seeds: int | None = optional()
    unscored: int | None = optional()

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        found: Json = to_json(self)
        return found

    def sentences(self, facts: Facts) -> list[str]:
        """Return where the boundary lies, what that does not tell, what to do next, and then the details."""
        if none_gave_a_metric(facts):
            return nothing_known(facts)
        measured = self.held_out_fraction if self.held_out_fraction is not None else share_among_held_out(facts)
        every = self.every_combination
        condition = requirement_words(facts.requirement, facts.unit, facts.units)
        told = tell_boundary(self, measured, facts) if every is None else every.sentences(facts.scenario, condition)
        told += [] if self.critical_combinations is None else [self.critical_combinations.sentence(facts.units or {})]
        each = {name: share.given_a_metric for name, share in (self.held_out_fractions or {}).items()}
        held_out = " in the held-out runs" + (" that gave a metric" if measured.lost else "")
        found = [*told, *shares_words(each, held_out), *conditional_on(facts.history)]
        found += [*fits_words(self.requirements), *independence_words(self.independence)]
        found += failing_words(self.failing_fraction, self.fails_by_chance, self.failing_range, self.critical_range, facts)
        if self.earlier is not None:
            found.append(_earlier_words(self.earlier))
        if self.weights is not None:
            found.append(f"The metamodel chose among its members: {self.chosen_because}.")
        if self.simulator_noise is not None:
            found += self.simulator_noise.sentences(facts.requirement.told_as, facts.unit)
        if self.explained is not None:
            found.append(self.explained.sentence(facts.requirement.told_as))
        if self.over_traffic is not None:
            found.append(self.over_traffic.sentence())
        if self.unused_seeds is not None:
            found.append(unused_words(self.unused_seeds))
        if self.doubt is not None:
            found.append(self.doubt.sentence())
        return [*found, *unscored_words(self.unscored)]


def recipe(settings: Settings) -> Campaign:
    """Return the campaign: even first, then batches from the acquisition's region of interest.

    The acquisition decides how: `mix` (exploration where critical runs are rare, representative of a_BI,
    greedy, space filling), a greedy acquisition one by one, any other by rejection (`boundary`: the paper's).

    Raises:
        InputError: no metamodel.

    Source:
        Winkelmann et al. (2022), section V-A.
    """
    learner = settings.learner
    if learner is None:
        raise InputError("campaign boundary needs a metamodel, but got none")

    def conclude(log: Log) -> tuple[BoundaryConclusion, FittedMetamodel | None]:
        fitted = learner.fit(log.history)
        held_out = critical_share(log.history.where(log.history.stage == VALIDATION), settings.scenario)
        each = each_share(log.history.where(log.history.stage == VALIDATION), settings.scenario.requirement)
        if fitted is None:
            return BoundaryConclusion(None, None, None, None, held_out_fraction=held_out, held_out_fractions=each), None
        r, unchosen = fitted.record, space_filling(log) | (settings.acquisition is even)
        shares = r.critical_fraction, r.expected_misclassified, r.ambiguous_volume
        if r.critical_fraction < _SMALL and not settings.scenario.requirement.combined:
            shares = learner.fine_shares(fitted)
        every = every_combination(settings.scenario, log.history)
        shares = shares if every is None else (every.share, 0.0, 0.0)
        log_odds = partial(_log_odds, fitted, settings)
        place = boundary_place(log_odds, settings.scenario, settings.seed, fitted.log_success)
        met = _met(log.history, settings)
        regions = () if place is None else critical_regions(log_odds, settings.scenario, settings.seed, met, fitted.log_success)
        return BoundaryConclusion(
            *shares, r.validation, r.weights, r.chosen_because,
            held_out, r.failing_fraction, stated_noise(log.history, settings.scenario), r.requirements, each, r.independence,
            place, explained_variance(settings, log.history, unchosen), traffic_doubt(settings, log.history),
            every, regions or None, r.earlier, None if every is not None else open_range(learner, fitted, len(met)),
            critical_share(log.history.where(unchosen), settings.scenario) if settings.scenario.pool is None else None,
            by_chance(fitted),
            failing_range(learner, fitted, len(log.history.finished)),
            None if every is not None else critical_combinations(log_odds, settings.scenario, fitted.log_success),
            _by_chance(log_odds, log.history, settings) if every is None else None,
            over_traffic(fitted, log.history), None if r.over_traffic else int((~log.history.drawn).sum()) or None,
            unscored_batches(log),
        ), fitted  # fmt: skip

    most = largest_batch if settings.acquisition is None else None
    pairs = pairs_in_doubt if settings.acquisition is None else None
    stage = BatchStage("boundary", settings, _rule(settings), repeats=settings.acquisition is not even, most=most, pairs=pairs)
    return Campaign((stage,), conclude)


def _earlier_words(n: int) -> str:
    if n == 0:
        return "The runs of the earlier campaign were left out: the metamodel predicts this campaign's own better without them."
    return f"The metamodel also learned from {plural(n, 'run')} of the earlier campaign, which count nowhere else."


def _met(history: History, settings: Settings) -> Points:
    """Return (k, d) critical runs, in the unit cube."""
    scenario = settings.scenario
    return scenario.space.cube.snapped(scenario.space.to_unit(history.x[scenario.requirement.critical_runs(history)]))


def _by_chance(log_odds: LogOdds, history: History, settings: Settings) -> ChancePlace | None:
    """Return where runs of a noisy simulator are critical most often, though not most of them are; else None."""
    scenario = settings.scenario
    if scenario.pool is not None or not simulator_noise(history, scenario.requirement).noisy:
        return None
    runs = history.where(history.ok & history.drawn)
    u = scenario.space.cube.snapped(scenario.space.to_unit(runs.x))
    return chance_place(log_odds, scenario, settings.seed, u, scenario.requirement.critical_runs(runs))


def _log_odds(fitted: FittedMetamodel, settings: Settings, u: Points) -> Vector:
    """Return (n,) log odds of critical at points of the unit cube."""
    critical, uncritical = fitted.predict(u).log_probability(settings.scenario.requirement.critical)
    with np.errstate(invalid="ignore"):
        return np.asarray(critical - uncritical)


def _rule(settings: Settings) -> ChoiceRule:
    """Return the rule that chooses batches."""
    if settings.acquisition is None:
        return mixed
    return greedily if is_greedy(settings.acquisition) else from_roi


def boundary_points(settings: Settings, history: History, most: int = 500) -> Points:
    """Return up to `most` points (m, d) in the inputs' units where P(critical), learned from all runs, crosses 0.5.

    Those where a run rather fails are left out.

    Raises:
        InputError: there is no metamodel, or fewer than two runs to learn from.
    """
    if settings.learner is None or len(history.finished) < 2:
        raise InputError("boundary points need a metamodel and two finished runs, but there are none")
    learner = settings.learner.telling(history)
    predictor, _ = learner.over_traffic(learner.train(history.finished), history)
    predict = learner.on_inputs(predictor, len(history.finished))
    space, critical = settings.scenario.space, settings.scenario.requirement.critical
    sequence = SobolSequence(space.dimension, settings.seed)
    u = sequence.admissible(lambda v: space.feasible(space.from_unit(v)), 8192, 2048)
    group = np.unique(space.cube.cells(u), axis=0, return_inverse=True)[1].reshape(-1)  # there is nothing between choices
    alike = space.cube.snapped(u)
    found = np.concatenate([
        crossings(lambda v: predict(v).probability(critical), alike[group == g], most)
        for g in range(group.max() + 1)
    ])  # fmt: skip
    found = found[succeeding(settings.learner.success(history), found)]
    x = space.from_unit(found[np.unique(np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(np.intp))])
    return x[space.feasible(x)]


BOUNDARY = CampaignKind(
    "identify where critical meets uncritical", recipe, BoundaryConclusion, acquisition="mix", methods=("mix",),
    stop={"stable": None, "misclassified": None}, metamodel={"kind": "auto", "preset": "quick"}, takes_earlier=True,
    over_traffic=True,
)  # fmt: skip
