"""What a falsification found: failure modes, what was not found, and the sentences that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sbt.campaigns.beside import Links, batches_by, confirmations, links_of, raced_runs, with_links
from sbt.campaigns.between import RunsBetween
from sbt.campaigns.crowding import crowded_inputs, crowded_words
from sbt.campaigns.each import independence_words, violations_words
from sbt.campaigns.explained import ExplainedVariance, explained_variance
from sbt.campaigns.levels import ScreeningTold
from sbt.campaigns.likeness import EarlierTold
from sbt.campaigns.linking import LinksTold
from sbt.campaigns.lost import none_gave_a_metric, nothing_known
from sbt.campaigns.modes import FailureMode, Mode, describe, modes_of, most_often, single, violations
from sbt.campaigns.parts import share_among_held_out
from sbt.campaigns.preventable import count_avoided
from sbt.campaigns.rates import LocalRates, local_rates
from sbt.campaigns.records import CONFIRM, LINK, RACE
from sbt.campaigns.repeats import SimulatorNoise, simulator_noise, stated_noise
from sbt.campaigns.settings import Settings
from sbt.campaigns.telling import tell_failures
from sbt.campaigns.unscored import unscored_batches, unscored_words
from sbt.campaigns.warmed import conditional_on
from sbt.campaigns.ways import OpenWays, links_told, open_ways, runs_between
from sbt.campaigns.wording import percent, plural
from sbt.errors import InputError
from sbt.estimators.binomial import upper
from sbt.loop.stages import Facts, Log
from sbt.problem.arrays import Vector
from sbt.problem.plain import Json, Value
from sbt.problem.requirement import Requirement
from sbt.samplers.search import Search, WarpedModel, fit_warped
from sbt.seeds import stream
from sbt.store.history import VALIDATION, History
from sbt.store.records import FitRecord, Independence, Validation, optional, to_json

__all__ = [
    "FILLING", "ClosestRun", "FailureSearch", "FalsificationConclusion", "SearchBound", "batches_by", "search_runs",
]  # fmt: skip

_TOLD = 5  # failure rates in the sentences; all of them are in the conclusion
FILLING = ("initial", "even", VALIDATION)
"""Stages of runs that fill the space, whatever the results."""


@dataclass(frozen=True)
class SearchBound:
    """What the space-filling runs bound where nothing critical was found; the guided ones were chosen by results.

    Attributes:
        box_fraction: at most this share of the box is critical.
        confidence: of the bounds.
        space_filling_runs: Sobol points and random ones.
        random_runs: those among them that are independent draws.
        box_fraction_random_runs: the bound by the random ones alone; None: there are none.
        failed_runs: among the space-filling ones; each may hide a critical run.
        box_fraction_failed_as_critical: the bound that counts them as critical.
    """

    box_fraction: float
    confidence: float
    space_filling_runs: int
    random_runs: int
    box_fraction_random_runs: float | None
    failed_runs: int
    box_fraction_failed_as_critical: float

    @classmethod
    def of(cls, runs: History) -> SearchBound:
        """Return the bound by the space-filling ones of these runs."""
        filling = runs.where(np.isin(runs.stage, FILLING))
        n, failed = len(filling), int((~filling.ok).sum())
        drawn = int((filling.stage == VALIDATION).sum())
        high, with_failed = (float(upper(k, n, 0.95)) for k in (0, failed))
        return cls(high, 0.95, n, drawn, float(upper(0, drawn, 0.95)) if drawn else None, failed, with_failed)


@dataclass(frozen=True)
class ClosestRun:
    """The uncritical run nearest to the critical interval, by the metric."""

    run: int
    inputs: Mapping[str, Value]
    metric: float | None
    margin: float


@dataclass(frozen=True)
class FalsificationConclusion:
    """What a falsification found.

    Attributes:
        first_critical_run: index of the first critical run of the search, from 0; None: there is none.
        runs_to_first: how many runs of the search it took, from 1.
        critical_runs: of the search; confirmations are not counted.
        failure_modes: the deepest first; of a noisy simulator in the order of failure rates (`rates.local_rates`).
        bound: where nothing critical was found, what the space-filling runs say about the critical share of the box; None also of
            recorded rows that are not spread evenly.
        closest: where nothing critical was found, the run nearest to the critical interval.
        statement: what follows from the runs, and no more.
        validation: scores of the metamodel on held-out runs; None without such runs.
        simulator_noise: what repeats with other seeds tell; None: recorded rows.
        violates: of a combination, how many critical runs violate each requirement.
        independence: of the metrics of a combination, given the inputs.
        explained: what inputs and drawn traffic explain of the metric; None: it is not known.
        fidelity: what coarse runs did for it, where there are some.
        raced: repetitions that helped to order the modes and count in no rate; None: there are none.
        links: runs that asked whether critical runs are of one mode; None: there are none.
        earlier: what a campaign of another setup told; None: there is none.
        critical_inputs: different inputs of the critical runs; None: of each its own.
        crowded: of inputs whose distribution lies in a small part of their range, the share that holds half of it; None: of none.
        unscored: batches of which the acquisition scored no run above -inf; None: there are none.
    """

    first_critical_run: int | None
    runs_to_first: int | None
    critical_runs: int
    failure_modes: tuple[FailureMode, ...]
    bound: SearchBound | None
    closest: ClosestRun | None
    statement: str
    validation: Validation | None = None
    simulator_noise: SimulatorNoise | None = optional()
    violates: Mapping[str, int] | None = optional()
    independence: Independence | None = optional()
    explained: ExplainedVariance | None = optional()
    fidelity: ScreeningTold | None = optional()
    raced: int | None = optional()
    links: LinksTold | None = optional()
    earlier: EarlierTold | None = optional()
    critical_inputs: int | None = optional()
    crowded: Mapping[str, float] | None = optional()
    unscored: int | None = optional()

    @property
    def look_at(self) -> int | None:
        """The failure to look at first: that of the first mode, or of one that came back clearly more often; None without one."""
        mode = most_often(self.failure_modes)
        return None if mode is None else mode.representative

    def to_dict(self) -> Json:
        """Return the JSON of the command line."""
        found: Json = to_json(self)
        return found

    def sentences(self, facts: Facts) -> list[str]:
        """Return whether the requirement is falsified, and what follows from the runs."""
        if none_gave_a_metric(facts):
            return nothing_known(facts)
        said = tell_failures(self, share_among_held_out(facts), facts)
        said += [*_more(self, facts), *crowded_words(self.crowded)]
        if self.simulator_noise is not None:
            said += self.simulator_noise.sentences(facts.requirement.told_as, facts.unit)
        said += [*violations_words(self.violates), *independence_words(self.independence)]
        said += [] if self.links is None else [self.links.sentence()]
        said += _rates(self)
        said += [] if self.explained is None else [self.explained.sentence(facts.requirement.told_as)]
        said += [] if self.fidelity is None else [self.fidelity.sentence()]
        said += [] if self.earlier is None else self.earlier.sentences()
        judged = [mode.preventable for mode in self.failure_modes if mode.preventable]
        return [*said, *count_avoided(judged), *conditional_on(facts.history), *unscored_words(self.unscored)]


class FailureSearch:
    """A search for failures as functions of its runs, shared by both stages and the conclusion.

    It remembers its last answer: stages ask again and again, and finished rows never change.

    Args:
        settings: of the campaign.
    """

    def __init__(self, settings: Settings):
        self.settings = settings
        self._last: tuple[tuple[tuple[int, ...], tuple[int, ...], Links], _Learned] | None = None

    @cached_property
    def search(self) -> Search:
        """What is searched, with the campaign's metamodel."""
        scenario, learner = self.settings.scenario, self.settings.learner
        if learner is None:
            raise InputError("campaign falsification needs a metamodel, but got none")
        space = scenario.space
        return Search(
            scenario.requirement.critical, learner.metamodel, space.metamodel_inputs,
            lambda u: space.feasible(space.from_unit(u)), cube=space.cube,
        )  # fmt: skip

    def margin(self, history: History) -> Vector:
        """Return (n,) distance to M_c in the metric's unit, NaN where a run failed."""
        return self.settings.scenario.requirement.margins(history)

    def critical_inputs(self, history: History) -> int:
        """Return how many different inputs critical runs among these have."""
        return len(np.unique(history.x[self.margin(history) <= 0], axis=0))

    def modes(self, history: History, raced: History | None = None, links: Links = ()) -> list[Mode]:
        """Return the failure modes among these runs, some of them `links`; with noise `raced` repetitions help to order them."""
        return self._learned(history, raced, links).modes

    def rates(self, history: History, raced: History, links: Links) -> LocalRates:
        """Return the failure rates at these runs of a noisy simulator, some of them critical; NaN where there is no metric."""
        return self._learned(history, raced, links).rates

    def ways_to_ask(self, log: Log) -> OpenWays:
        """Return the ways between critical runs on which a run would tell whether they are of one mode."""
        history, links = with_links(log), links_of(log)
        learned = self._learned(history, raced_runs(log), links)
        return open_ways(learned.fitted, history, self.settings.scenario, links, learned.between)

    def _learned(self, history: History, raced: History | None, links: Links = ()) -> _Learned:
        runs = tuple(history.index.tolist()), () if raced is None else tuple(raced.index.tolist()), links
        if self._last is None or runs != self._last[0]:
            self._last = runs, self._learn(history, raced, links)
        return self._last[1]

    def _learn(self, history: History, raced: History | None, links: Links) -> _Learned:
        scenario = self.settings.scenario
        ok, rates = np.flatnonzero(history.ok), LocalRates(*np.full((2, len(history)), np.nan))
        if not (self.margin(history) <= 0).any():
            return _Learned([], rates)
        if len(ok) < 2:
            only = int(ok[0])
            return _Learned([Mode((only,), only, only, None)], rates)
        u, y = scenario.space.to_unit(history.x[ok]), scenario.requirement.values(history)[ok]
        rng = stream(self.settings.seed, "modes", len(history))
        search, y = self.search.reached(u, y)
        fitted = fit_warped(search.for_noise(u, y), u, y, rng)
        if not self.noisy(history):
            return _Learned(modes_of(fitted, history, scenario, links=links), rates, fitted)
        again = history.where(np.zeros(len(history), dtype=bool)) if raced is None else raced.where(raced.ok)
        critical = scenario.requirement.critical_runs(again)
        found = local_rates(search, u, y, history.drawn[ok], scenario.space.to_unit(again.x), critical, rng)
        rates.mean[ok], rates.std[ok] = found.mean, found.std
        between = runs_between(fitted, history, scenario, rates)
        return _Learned(modes_of(fitted, history, scenario, rates=rates.mean, between=between), rates, fitted, between)

    def noisy(self, history: History) -> bool:
        """Say whether the requirement's metric differed among runs of equal inputs: then failing is a matter of rates."""
        return bool(simulator_noise(history, self.settings.scenario.requirement).std)

    def conclusion(self, log: Log, fit: FitRecord | None) -> FalsificationConclusion:
        """Return what was found."""
        history, aside = log.history, batches_by(log, RACE, LINK)
        searched, scenario, known = search_runs(history), self.settings.scenario, with_links(log)
        raced = raced_runs(log)
        margin = self.margin(searched)
        hits = np.flatnonzero(margin <= 0)
        modes = []
        for mode in self.modes(known, raced, links_of(log)):
            again = history.where(confirmations(history, known.x[mode.representative], aside))
            modes.append(describe(mode, known, scenario, again, noisy=self.noisy(history)))
        left, stand_for = self.ways_to_ask(log), [mode.representative for mode in modes]
        first, inputs = int(hits[0]) if len(hits) else None, self.critical_inputs(searched)
        bound = None if len(hits) or scenario.uneven else SearchBound.of(searched)
        return FalsificationConclusion(
            None if first is None else int(searched.index[first]), None if first is None else first + 1, len(hits), tuple(modes),
            bound, None if len(hits) else _closest(searched, margin, scenario.requirement),
            _statement(searched, len(hits), inputs, modes, bound), None if fit is None else fit.validation,
            stated_noise(history, scenario), violations(scenario.requirement, searched.where(margin <= 0)),
            None if fit is None else fit.independence,
            explained_variance(self.settings, history, (history.iteration == 0) | (history.stage == VALIDATION)),
            raced=len(raced) or None, links=links_told(log, scenario.requirement, left, stand_for),
            critical_inputs=inputs if inputs < len(hits) else None, crowded=crowded_inputs(scenario.space),
            unscored=unscored_batches(log),
        )  # fmt: skip


@dataclass(frozen=True)
class _Learned:
    """What runs say: failure modes, the metamodel, and with noise rates of failing and what is known between critical runs."""

    modes: list[Mode]
    rates: LocalRates
    fitted: WarpedModel | None = None
    between: RunsBetween | None = None


def search_runs(history: History) -> History:
    """Return the runs of the search, without the confirmations."""
    return history.where(history.stage != CONFIRM)


def _rates(found: FalsificationConclusion) -> list[str]:
    """Return what orders the modes of a noisy simulator, and the failure rates of the first ones; nothing where there is one."""
    rates = [(mode.representative, mode.failure_rate) for mode in found.failure_modes if mode.failure_rate is not None]
    if len(rates) < 2:  # that of the worst is told
        return []
    told = "; ".join(
        f"run {run} {percent(r.estimate or 0.0)} of {r.runs} ({percent(r.low)} to {percent(r.high)})" for run, r in rates[:_TOLD]
    )
    race = "" if found.raced is None else f" and {plural(found.raced, 'repetition')} that count in no rate below"
    first = f" of the first {_TOLD} of {len(rates)}" if len(rates) > _TOLD else ""
    return [
        "Failure modes are told in the order of the failure rates that the search expects, by the share of critical runs near"
        f" them{race}, not of how deep they are; few repetitions may say otherwise.",
        f"Failure rates{first} with fresh seeds ({percent(rates[0][1].confidence)} interval): {told}.",
    ]


def _closest(runs: History, margin: Vector, requirement: Requirement) -> ClosestRun | None:
    """Return the run that came nearest to M_c."""
    if not np.isfinite(margin).any():
        return None
    k = int(np.nanargmin(margin))
    return ClosestRun(int(runs.index[k]), runs.inputs(k), float(requirement.told(runs)[k]), float(margin[k]))


def _statement(runs: History, hits: int, inputs: int, modes: list[FailureMode], bound: SearchBound | None) -> str:
    """Return what follows from the runs, and no more."""
    n, failed = len(runs), int((~runs.ok).sum())
    hidden = f" {failed} runs failed and say nothing about safety." if failed else ""
    if failed == n:
        return f"All {n} runs failed: nothing was tested."
    if bound is not None:
        sobol = bound.space_filling_runs - bound.random_runs
        how = f" ({sobol} of them scrambled Sobol points, for which this bound of random ones is approximate)" if sobol else ""
        share = bound.box_fraction_failed_as_critical
        return (
            f"No critical run in {n}. The guided runs bound nothing; from the {bound.space_filling_runs} space-filling ones"
            f" alone{how}, at most {100 * share:.3g} % of the box is critical (95 %).{hidden}"
        )
    if hits == 0:
        return f"No critical run in {n}. Rows that are not spread evenly over the box bound nothing.{hidden}"
    if hits == n - failed:
        return f"Every run that gave a metric was critical ({hits}): no boundary was met.{hidden}"
    unsure = [mode for mode in modes if _uncritical(mode)]
    unconfirmed = f" Repeats with fresh seeds did not all fail in {plural(len(unsure), 'mode')}." if unsure else ""
    counted = f"{hits} of {n} runs of the search were critical, in {plural(len(modes), 'failure mode')}"
    same = "the same inputs" if inputs == 1 else f"{inputs} different inputs"
    different = f" They have {same}." if inputs < hits else ""
    return f"{counted}.{different}{unconfirmed}{hidden}"


def _uncritical(mode: FailureMode) -> bool:
    """Return whether some repetition gave a metric and was not critical."""
    again, gave = mode.came_back
    return again < gave


def _more(found: FalsificationConclusion, facts: Facts) -> list[str]:
    """Return what of the statement the first sentences of the conclusion do not say."""
    bound, runs, said = found.bound, search_runs(facts.history), []
    if bound is not None and (sobol := bound.space_filling_runs - bound.random_runs):
        every = sobol == bound.space_filling_runs
        of = f"{'the' if every else f'{sobol} of the'} {plural(bound.space_filling_runs, 'space-filling run')}"
        are = "is a scrambled Sobol point" if every and sobol == 1 else "are scrambled Sobol points"
        said.append(f"The bound is that of random runs, and approximate, as {of} {are}.")
    failed = int((~runs.ok).sum())
    if found.critical_runs and found.critical_runs == len(runs) - failed:
        said.append("Every run that gave a metric was critical: no boundary was met.")
    alone = single(found.failure_modes, facts.history)
    whose = f"all {alone}" if alone == len(found.failure_modes) else f"{alone} of {len(found.failure_modes)}"
    said += [f"Modes of one input each ({whose}) may be parts of one thin or bent region."] if alone > 1 else []
    unsure = [mode for mode in found.failure_modes[1:] if _uncritical(mode)]
    said += [f"Of the other modes {len(unsure)} did not fail in every repetition with fresh seeds."] if unsure else []
    says = "says" if failed == 1 else "say"
    return [*said, *([f"{plural(failed, 'run')} of the search failed and {says} nothing about safety."] if failed else [])]
